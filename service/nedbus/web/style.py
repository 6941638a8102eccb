"""Style of the page: dark and light theme, state symbols, and text templates."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import jinja2

from nedbus import limits
from nedbus.clock import format_duration
from nedbus.health import describe_stream
from nedbus_msgs.frames import derive

from .stream import is_position

SHAPES: Final[Mapping[str, str]] = {"bad": "■", "watch": "▲", "ok": "●", "info": "●"}
"""Text symbol of a grade or event severity."""
MARKERS: Final[Mapping[str, str]] = {
    "bad": "square",
    "watch": "triangle",
    "ok": "circle",
    "info": "circle",
}
"""Bokeh marker of the same shape."""
PALETTE: Final = 8  # number of vehicle colours; none is a state colour


def read_asset(name: str) -> str:
    """Return the text of a file in `assets/`."""
    return (Path(__file__).parent / "assets" / name).read_text()


@dataclass(frozen=True, slots=True)
class Style:
    """Colours of the page, its CSS and its plots; text has a contrast ratio of at least 4.5 (WCAG 2 AA).

    `colours`: by CSS variable, with one for each grade; `vehicles`: by number.
    """

    name: str
    colours: Mapping[str, str]
    vehicles: tuple[str, ...]

    def vehicle_colour(self, number: int) -> str:
        """Return the colour of a vehicle, by its number."""
        return self.vehicles[number % PALETTE]


@cache
def panels() -> jinja2.Template:
    """Return the template of `panels.html`; its context has a style, a timeline and its `format_time`."""
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters.update(age=format_duration, degrees=math.degrees)
    environment.tests.update(finite=math.isfinite, position=is_position)
    environment.globals.update(
        limits=limits, SHAPES=SHAPES, describe=describe_stream, derive=derive
    )
    return environment.from_string(re.sub(r"(?<=[>}])\n\s*(?=[<{])", "", read_asset("panels.html")))


DARK: Final = Style(
    "dark",
    {"ground": "#0f1419", "panel": "#182028", "line": "#26303a", "text": "#d8dee6", "quiet": "#94a1ae",
     "truth": "#8b98a5", "chosen": "#1d3650", "bad": "#ff8a80", "watch": "#ffb74d", "ok": "#66d17a", "info": "#94a1ae",
     "bad-fill": "#5c1a1a", "watch-fill": "#553a08", "ok-fill": "#123a1d"},
    ("#6cb6ff", "#c9a0ff", "#5ad1d1", "#ff9ed2", "#9fb4ff", "#c5b38a", "#8fa8b8", "#e0e0ff"),
)  # fmt: skip
LIGHT: Final = Style(
    "light",
    {"ground": "#ffffff", "panel": "#eef2f5", "line": "#d5dce2", "text": "#17202a", "quiet": "#55626f",
     "truth": "#6b7885", "chosen": "#cfe3f7", "bad": "#b3261e", "watch": "#8a5000", "ok": "#1b6e2c", "info": "#55626f",
     "bad-fill": "#fbdcda", "watch-fill": "#fbe8c8", "ok-fill": "#d9f2de"},
    ("#0b5cad", "#7b3fb5", "#0a7a7a", "#b0357f", "#3949ab", "#6b5a2a", "#4a6272", "#5c5c9e"),
)  # fmt: skip
