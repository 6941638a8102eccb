"""How the page looks: a dark and a light theme, the colours of conditions, and the styles of tables and text."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Final

from bokeh.themes import Theme

from .fleet import Condition

_YEARS: Final = 1e8  # s: no recording is as long, and no clock as early
COLOURS: Final[Mapping[Condition, str]] = {
    "disconnected": "#616b75", "gone": "#616b75", "stale": "#616b75", "invalid": "#c62828",
    "dead reckoning": "#d97706", "slow": "#b58900", "ok": "#2e7d32",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Style:
    """The colours of a page, and what is made of them."""

    name: str
    ground: str
    panel: str
    line: str
    text: str
    quiet: str
    track: str
    lines: tuple[str, str, str]
    chosen: str

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
            "label_text_font_size": "11px", "glyph_width": 14, "spacing": 8, "margin": 4, "label_height": 12,
        }  # fmt: skip
        grid = {"grid_line_color": self.line}
        attrs = {"figure": figure, "Axis": axis, "Grid": grid, "Title": title, "Legend": legend}
        return Theme(json={"attrs": attrs})

    @property
    def page_css(self) -> str:
        """CSS of the page itself."""
        return f"html, body {{ margin: 0; height: 100%; overflow: hidden; background: {self.ground}; }}"

    @property
    def text_css(self) -> str:
        """CSS of a piece of text."""
        return (
            f":host {{ color: {self.text}; font: 13px/1.5 system-ui, sans-serif; }}"
            f".quiet {{ color: {self.quiet}; }} a {{ color: {self.quiet}; }} b {{ font-weight: 600; }}"
            ".badge { color: #fff; border-radius: 9px; padding: 1px 9px; margin-right: 4px; white-space: nowrap; }"
            ".bad { color: #fff; background: #c62828; padding: 1px 9px; border-radius: 9px; }"
        )

    @property
    def table_css(self) -> str:
        """CSS of a table."""
        return (
            f":host {{ border: 1px solid {self.line}; }}"
            f".slick-header, .slick-header-columns, .slick-header-column {{ background: {self.panel} !important; "
            f"color: {self.quiet}; border-color: {self.line} !important; font: 11px system-ui, sans-serif; }}"
            f".slick-row, .slick-row.even, .slick-row.odd {{ background: {self.ground} !important; "
            f"color: {self.text}; }} .grid-canvas, .slick-viewport {{ background: {self.ground} !important; }}"
            f".slick-cell {{ border-color: {self.line} !important; font: 11px/20px system-ui, sans-serif; }}"
            f".slick-row:hover .slick-cell {{ background: {self.panel}; }}"
            f".slick-cell.selected {{ background: {self.chosen} !important; }}"
        )


DARK: Final = Style(
    "dark", "#0f1419", "#182028", "#26303a", "#d8dee6", "#8b98a5", "#4f7da8", ("#6cb6ff", "#c9a0ff", "#7fd1ae"),
    "#24405c",
)  # fmt: skip
LIGHT: Final = Style(
    "light", "#ffffff", "#eef2f5", "#d5dce2", "#17202a", "#55626f", "#5d86ad", ("#0b5cad", "#7b3fb5", "#10704a"),
    "#cfe3f7",
)  # fmt: skip


def badge(condition: Condition, count: int | None = None) -> str:
    """Return a coloured condition, with a count before it if there is one, as HTML."""
    text = condition if count is None else f"{count} {condition}"
    return f'<span class="badge" style="background: {COLOURS[condition]}">{escape(text)}</span>'


def to_clock(seconds: float) -> str:
    """Return a time of this host without its date, or the minutes and seconds since the start of a recording."""
    if seconds < _YEARS:
        seconds = round(seconds, 1)
        return f"{seconds // 60:.0f}:{seconds % 60:04.1f}"
    return time.strftime("%H:%M:%S", time.localtime(seconds))
