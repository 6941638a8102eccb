"""How the page looks: a dark and a light theme, colours and shapes of states, colours of vehicles, and the CSS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from bokeh.themes import Theme

from .fleet import Grade

SHAPES: Final[Mapping[Grade, str]] = {"bad": "■", "watch": "▲", "ok": "●"}
MARKERS: Final[Mapping[str, str]] = {"bad": "square", "watch": "triangle", "info": "circle"}
"""The marker of an event by its severity: the shapes of the states."""

PALETTE: Final = 8
"""Colours of vehicles: none is like those of states."""


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
        }  # fmt: skip
        title = {"text_color": self.text, "text_font_size": "12px", "text_font_style": "normal"}
        legend = {
            "background_fill_alpha": 0.0, "border_line_alpha": 0.0, "label_text_color": self.quiet, "padding": 0,
            "label_text_font_size": "11px", "glyph_width": 14, "spacing": 8, "margin": 2, "label_height": 12,
        }  # fmt: skip
        grid = {"grid_line_color": self.line}
        attrs = {"figure": figure, "Axis": axis, "Grid": grid, "Title": title, "Legend": legend}
        return Theme(json={"attrs": attrs})

    @property
    def page_css(self) -> str:
        """CSS of the page itself: on a phone it scrolls, on a wide screen its parts do."""
        return f"html, body {{ margin: 0; background: {self.ground}; }}"

    @property
    def layout_css(self) -> str:
        """CSS of the places of all parts: three columns, two, or one."""
        return _LAYOUT

    @property
    def text_css(self) -> str:
        """CSS of all text."""
        grades = "".join(f".{grade} {{ color: {self.grades[grade]}; }}" for grade in SHAPES)
        fills = "".join(f".badge.{grade} {{ background: {self.fills[grade]}; }}" for grade in SHAPES)
        return (
            f":host {{ color: {self.text}; font: 13px/1.45 system-ui, sans-serif; --line: {self.line};"
            f" --panel: {self.panel}; --quiet: {self.quiet}; --chosen: {self.chosen}; --bad: {self.grades['bad']};"
            f" --ground: {self.ground}; --text: {self.text}; }} {grades} {fills} {_TEXT}"
        )


_LAYOUT: Final = """
:host { display: grid !important; height: 100vh; box-sizing: border-box; padding: 6px; gap: 6px 10px;
  grid-template: "head head head" auto "ctrl ctrl ctrl" auto "find tool why" auto "list map why" auto
    "list map nums" auto "list map plots" minmax(0, 1fr) "more time plots" 190px
    / minmax(340px, 25%) minmax(0, 1fr) minmax(285px, 24%); }
.head { grid-area: head; } .ctrl { grid-area: ctrl; } .find { grid-area: find; } .list { grid-area: list; }
.tool { grid-area: tool; } .map { grid-area: map; } .time { grid-area: time; } .why { grid-area: why; }
.nums { grid-area: nums; } .plots { grid-area: plots; } .more { grid-area: more; }
.list, .more { overflow-y: auto; min-height: 0; }
.why { max-height: 29vh; overflow-y: auto; } .plots { overflow-y: auto; min-height: 0; }
@media (max-width: 800px) {
  :host { height: auto; padding: 4px; grid-template: "head" auto "ctrl" auto "find" auto "list" auto "why" auto
    "tool" auto "map" min(62vh, 105vw) "time" 210px "nums" auto "plots" 480px "more" auto / minmax(0, 1fr); }
  .list { max-height: 190px; } .why { max-height: none; }
}
"""
_TEXT: Final = """
* { box-sizing: border-box; } .bk-clearfix { display: block; width: 100%; }
.quiet { color: var(--quiet); } a, button { color: var(--text); } b { font-weight: 600; }
.bar { display: flex; flex-wrap: wrap; gap: 4px 10px; align-items: center; }
.bar .end { margin-left: auto; }
.badge { border-radius: 9px; padding: 1px 9px; white-space: nowrap; font-weight: 600; }
.alarm { color: #fff; background: #b3261e; padding: 2px 9px; border-radius: 9px; }
button { font: inherit; background: var(--panel); border: 1px solid var(--line); border-radius: 6px; padding: 2px 9px;
  cursor: pointer; }
button[aria-pressed=true] { background: var(--chosen); }
button:focus-visible, .row:focus-visible { outline: 2px solid var(--text); outline-offset: -2px; }
.row { display: grid; grid-template-columns: 12px minmax(80px, 1fr) minmax(0, 1.9fr)
  62px minmax(0, 0.9fr) 44px 82px;
  gap: 0 6px; padding: 3px 5px; border-radius: 5px; cursor: pointer; align-items: center; }
.row > * { overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
.row.titles { cursor: default; color: var(--quiet); font-size: 11px; position: sticky; top: 0;
  background: var(--ground); }
.row:hover { background: var(--panel); } .row[aria-selected=true] { background: var(--chosen); }
.dot { display: inline-block; width: 9px; height: 9px; border-radius: 2px; margin-right: 5px; }
.why { border-left: 3px solid var(--line); background: var(--panel); border-radius: 5px; padding: 7px 10px; }
.why.bad { border-color: var(--bad); color: inherit; } .why div { margin-top: 3px; }
.tiles { display: grid; grid-template-columns: repeat(3, minmax(0, 1fr)); gap: 5px; }
.tile { background: var(--panel); border-radius: 5px; padding: 4px 8px; min-width: 0; }
.tile span { display: block; font-size: 11px; color: var(--quiet); }
.tile b { display: block; overflow-wrap: anywhere; } .name { font-size: 16px; }
.strip { position: relative; height: 16px; margin: 0 7px; }
.strip span { position: absolute; transform: translateX(-50%); cursor: pointer; font-size: 11px; }
table { border-collapse: collapse; width: 100%; font-size: 12px; } td, th { text-align: left; padding: 1px 6px 1px 0; }
th { color: var(--quiet); font-weight: normal; } td { overflow-wrap: anywhere; vertical-align: top; }
td + td:not(:last-child) { overflow-wrap: normal; }
input, .bk-input { background: var(--panel); color: var(--text); border-color: var(--line); }
.bk-input-group > label, .noUi-handle, .bk-slider-title { color: var(--text); }
.bk-btn { background: var(--panel) !important; color: var(--text) !important; border-color: var(--line) !important; }
@media (max-width: 800px) {
  .row { grid-template-columns: 12px minmax(84px, 1fr) minmax(0, 1.6fr) 62px 44px; }
  .row .mode, .row .gps { display: none; } button { padding: 5px 11px; }
}
@media (max-width: 1850px) and (min-width: 801px) {
  .row { grid-template-columns: 12px minmax(84px, 1fr) minmax(0, 1.4fr) 62px 44px; }
  .row .mode, .row .gps { display: none; }
}
"""
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
