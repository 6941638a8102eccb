"""The timeline under the map: what happened to whom, in the last minutes or in the whole flight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from bokeh.models import ColumnDataSource, FixedTicker, HoverTool, Range1d, TapTool
from bokeh.plotting import figure

from nedbus.events import ALL, Event, Span

from .send import replace
from .style import MARKERS, Style

NOTABLE: Final = frozenset({"armed", "disarmed", "takeoff", "landed", "mode", "reboot", "gps_fix"})
"""Kinds of events that are shown though they are only info."""

_ROWS: Final = 7
_OWN: Final = "link, page"
_MARKS: Final = ("time", "row", "marker", "colour", "words", "who")
_SPANS: Final = ("begin", "end", "row", "colour")


class Timeline:
    """The timeline of one viewer: `shown` has an event for each row of `marks`, whose selection was tapped."""

    def __init__(self, style: Style, clock: Any) -> None:
        self.marks = ColumnDataSource({name: [] for name in _MARKS})
        self.shown: list[Event] = []
        self.range = Range1d()
        self._spans = ColumnDataSource({name: [] for name in _SPANS})
        self._now = ColumnDataSource({"time": []})
        self._style = style
        self._names: list[str] = []
        self.figure = self._draw(clock)

    def update(
        self, told: Sequence[Event], spans: Mapping[str, Sequence[Span]], vehicles: Sequence[str], *,
        begin: float, end: float, now: float,
    ) -> None:  # fmt: skip
        """Show what happened from `begin` to `end` [s]; `vehicles`: the most important first."""
        shown = [event for event in told if begin <= event.time <= end and is_notable(event)]
        affected = {event.vehicle for event in shown if event.severity != "info"}
        affected |= {name for name in vehicles if any(_is_shown(span, begin) for span in spans.get(name, ()))}
        names = [name for name in vehicles[:1] if name]
        names += [name for name in vehicles if name in affected and name not in names]
        names = [*([ALL] if ALL in affected else []), *names][:_ROWS]
        rows = {name: len(names) - index for index, name in enumerate(names)}
        self.shown = [event for event in shown if event.vehicle in rows]
        colours = self._style.grades
        replace(
            self.marks,
            [
                (
                    event.time * 1e3, rows[event.vehicle], MARKERS[event.severity], colours[event.severity],
                    event.text[:100], event.vehicle,
                )
                for event in self.shown
            ],
        )  # fmt: skip
        held = [(span, rows[name]) for name in names for span in spans.get(name, ()) if _is_shown(span, begin)]
        held.sort(key=lambda each: each[0].severity == "bad")
        ends = [min(end, now if span.until is None else span.until) for span, _ in held]
        bars = zip(held, ends, strict=True)
        shown_bars = [
            (max(begin, span.since) * 1e3, stop * 1e3, row, colours[span.severity]) for (span, row), stop in bars
        ]
        replace(self._spans, shown_bars)
        replace(self._now, [(now * 1e3,)])
        if names != self._names:
            self._names = names
            axis, count = self.figure.yaxis[0], len(names)
            axis.ticker = FixedTicker(ticks=list(rows.values()))
            axis.major_label_overrides = {row: _OWN if name == ALL else name[:14] for name, row in rows.items()}
            room = (max(count, 4) - count) / 2  # bars of few vehicles are no walls
            self.figure.y_range.update(start=0.4 - room, end=count + 0.6 + room)

    def move(self, begin: float, end: float) -> None:
        """Move the time axis."""
        self.range.update(start=begin * 1e3, end=end * 1e3)

    def _draw(self, clock: Any) -> figure:
        plot = figure(
            x_range=self.range, y_range=Range1d(start=0.4, end=3.6), x_axis_type="datetime", tools="",
            toolbar_location=None, sizing_mode="stretch_both", height=100, min_border=4, css_classes=["time"],
        )  # fmt: skip
        plot.xaxis.formatter = clock
        plot.ygrid.grid_line_color = None
        plot.hbar(y="row", left="begin", right="end", source=self._spans, height=0.28, color="colour", alpha=0.75)
        marks = plot.scatter(
            "time", "row", source=self.marks, marker="marker", size=11, fill_color="colour",
            line_color=self._style.ground, nonselection_alpha=1.0,
        )  # fmt: skip
        plot.vspan(x="time", source=self._now, line_color=self._style.text, line_dash="dotted")
        plot.add_tools(HoverTool(renderers=[marks], tooltips="@who: @words"), TapTool(renderers=[marks]))
        return plot


def is_notable(event: Event) -> bool:
    """Return whether an event is shown: what is bad or to be watched, and what a flight consists of."""
    return event.severity != "info" or event.kind in NOTABLE


def _is_shown(span: Span, begin: float) -> bool:
    return span.severity != "info" and span.since != span.until and (span.until is None or span.until > begin)
