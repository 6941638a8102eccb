"""The looks of the page: a dark and a light theme, colours and shapes of states, colours of vehicles, and the CSS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bokeh.themes import Theme

SHAPES: Final[Mapping[str, str]] = {"bad": "■", "watch": "▲", "ok": "●", "info": "●"}
"""The shape of a grade, or of the severity of an event, in text."""
MARKERS: Final[Mapping[str, str]] = {"bad": "square", "watch": "triangle", "ok": "circle", "info": "circle"}
"""The same shape in a plot, as Bokeh calls it."""
PALETTE: Final = 8
"""Number of colours of vehicles: none is like those of states."""


def read_asset(name: str) -> str:
    """Return a file of `assets/`: CSS, JavaScript and HTML of the page."""
    return (Path(__file__).parent / "assets" / name).read_text()


@dataclass(frozen=True, slots=True)
class Style:
    """The colours of a page, and what is made of them; text on its ground has a contrast of 4.5 and more."""

    name: str
    ground: str
    panel: str
    line: str
    text: str
    quiet: str
    grades: Mapping[str, str]
    fills: Mapping[str, str]
    vehicles: tuple[str, ...]
    lines: tuple[str, str, str]
    truth: str
    chosen: str

    def vehicle(self, number: int) -> str:
        """Return the colour of a vehicle."""
        return self.vehicles[number % PALETTE]

    @property
    def theme(self) -> Theme:
        """Bokeh's theme for plots."""
        axis = {
            "axis_label_text_color": self.quiet, "major_label_text_color": self.quiet, "axis_line_color": self.line,
            "major_tick_line_color": None, "minor_tick_line_color": None, "axis_label_text_font_size": "11px",
            "axis_label_text_font_style": "normal", "major_label_text_font_size": "11px",
        }  # fmt: skip
        figure = {
            "background_fill_color": self.ground, "border_fill_color": self.ground, "outline_line_color": self.line,
            "min_border": 4,
        }  # fmt: skip
        title = {"text_color": self.text, "text_font_size": "12px", "text_font_style": "normal"}
        legend = {
            "background_fill_alpha": 0.0, "border_line_alpha": 0.0, "label_text_color": self.quiet, "padding": 0,
            "label_text_font_size": "11px", "glyph_width": 14, "spacing": 8, "margin": 2, "label_height": 12,
            "orientation": "horizontal", "location": "top_left",
        }  # fmt: skip
        scale_bar = {
            "background_fill_alpha": 0.0, "border_line_alpha": 0, "label_text_color": self.text,
            "bar_line_color": self.text, "label_text_font_size": "11px",
        }  # fmt: skip
        grid = {"grid_line_color": self.line}
        attrs = {"figure": figure, "Axis": axis, "Grid": grid, "Title": title, "Legend": legend, "ScaleBar": scale_bar}
        return Theme(json={"attrs": attrs})

    @property
    def page_css(self) -> str:
        """CSS of the page itself: the colours as variables, for all that is on it."""
        colours = {name: getattr(self, name) for name in ("ground", "panel", "line", "text", "quiet", "chosen")}
        colours |= {**self.grades, **{f"{grade}-fill": colour for grade, colour in self.fills.items()}}
        variables = " ".join(f"--{name}: {colour};" for name, colour in colours.items())
        return f":root {{ {variables} }} html, body {{ margin: 0; background: var(--ground); }}"


DARK: Final = Style(
    "dark", "#0f1419", "#182028", "#26303a", "#d8dee6", "#94a1ae",
    {"bad": "#ff8a80", "watch": "#ffb74d", "ok": "#66d17a", "info": "#94a1ae"},
    {"bad": "#5c1a1a", "watch": "#553a08", "ok": "#123a1d"},
    ("#6cb6ff", "#c9a0ff", "#5ad1d1", "#ff9ed2", "#9fb4ff", "#c5b38a", "#8fa8b8", "#e0e0ff"),
    ("#6cb6ff", "#c9a0ff", "#5ad1d1"), "#8b98a5", "#1d3650",
)  # fmt: skip
LIGHT: Final = Style(
    "light", "#ffffff", "#eef2f5", "#d5dce2", "#17202a", "#55626f",
    {"bad": "#b3261e", "watch": "#8a5000", "ok": "#1b6e2c", "info": "#55626f"},
    {"bad": "#fbdcda", "watch": "#fbe8c8", "ok": "#d9f2de"},
    ("#0b5cad", "#7b3fb5", "#0a7a7a", "#b0357f", "#3949ab", "#6b5a2a", "#4a6272", "#5c5c9e"),
    ("#0b5cad", "#7b3fb5", "#0a7a7a"), "#6b7885", "#cfe3f7",
)  # fmt: skip
