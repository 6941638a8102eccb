"""Style of the page: dark and light theme, state symbols, and text templates."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import jinja2

from nedbus.client import format_duration

from .fleet import MAX_STREAMS
from .stream import is_position

SHAPES: Final[Mapping[str, str]] = {"bad": "■", "watch": "▲", "ok": "●", "info": "●"}
"""Text symbol of a grade or event severity."""
MARKERS: Final[Mapping[str, str]] = {"bad": "square", "watch": "triangle", "ok": "circle", "info": "circle"}
"""Bokeh marker of the same shape."""
PALETTE: Final = 8  # number of vehicle colours; none is a state colour


def read_asset(name: str) -> str:
    """Return the text of a file in `assets/`."""
    return (Path(__file__).parent / "assets" / name).read_text()


@dataclass(frozen=True, slots=True)
class Style:
    """Colours of the page, its CSS and its plots; text has a contrast ratio of at least 4.5 (WCAG 2 AA)."""

    name: str
    ground: str
    panel: str
    line: str
    text: str
    quiet: str
    grades: Mapping[str, str]
    fills: Mapping[str, str]
    vehicles: tuple[str, ...]
    truth: str
    chosen: str

    def vehicle_colour(self, number: int) -> str:
        """Return the colour of a vehicle, by its number."""
        return self.vehicles[number % PALETTE]

    @property
    def colours(self) -> dict[str, str]:
        """Colours by name in CSS and in the plot theme."""
        plain = {name: getattr(self, name) for name in ("ground", "panel", "line", "text", "quiet", "chosen")}
        return {**plain, **self.grades, **{f"{grade}-fill": colour for grade, colour in self.fills.items()}}


@cache
def panels() -> jinja2.Template:
    """Return the template of `panels.html`; its context has a style, a timeline and its `format_time`."""
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters.update(age=format_duration, degrees=math.degrees)
    environment.tests.update(finite=math.isfinite, position=is_position)
    environment.globals.update(MAX_STREAMS=MAX_STREAMS, SHAPES=SHAPES, hypot=math.hypot)
    return environment.from_string(re.sub(r"(?<=[>}])\n\s*(?=[<{])", "", read_asset("panels.html")))


DARK: Final = Style(
    "dark", "#0f1419", "#182028", "#26303a", "#d8dee6", "#94a1ae",
    {"bad": "#ff8a80", "watch": "#ffb74d", "ok": "#66d17a", "info": "#94a1ae"},
    {"bad": "#5c1a1a", "watch": "#553a08", "ok": "#123a1d"},
    ("#6cb6ff", "#c9a0ff", "#5ad1d1", "#ff9ed2", "#9fb4ff", "#c5b38a", "#8fa8b8", "#e0e0ff"), "#8b98a5", "#1d3650",
)  # fmt: skip
LIGHT: Final = Style(
    "light", "#ffffff", "#eef2f5", "#d5dce2", "#17202a", "#55626f",
    {"bad": "#b3261e", "watch": "#8a5000", "ok": "#1b6e2c", "info": "#55626f"},
    {"bad": "#fbdcda", "watch": "#fbe8c8", "ok": "#d9f2de"},
    ("#0b5cad", "#7b3fb5", "#0a7a7a", "#b0357f", "#3949ab", "#6b5a2a", "#4a6272", "#5c5c9e"), "#6b7885", "#cfe3f7",
)  # fmt: skip
