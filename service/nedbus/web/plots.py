"""Plots of the chosen vehicle: height, speed and uncertainty over time, with what happened."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from bokeh.models import BasicTicker, ColumnDataSource, DatetimeTicker, Range1d
from bokeh.plotting import figure

from nedbus.events import Event, Span

from .send import replace
from .stream import COLUMNS, History
from .style import Style

_NOTHING: Final = np.empty((0, len(COLUMNS)))
_PLOTS: Final = {
    "height above its origin [m]": ("height",),
    "horizontal speed [m/s]": ("speed",),
    "eph, epv, distance to the ground truth [m]": ("eph", "epv", "error"),
}
_SPANS: Final = ("begin", "end", "colour")
_LABELS: Final = {"error": "off truth"}
_TRUE: Final = {"height", "speed"}


class Plots:
    """Three plots with one time axis [ms]; `chosen` has the points of the stream, beside those of its ground truth."""

    def __init__(self, style: Style, clock: Any, span: Range1d) -> None:
        self.chosen, self._truth = (ColumnDataSource({name: [] for name in COLUMNS}) for _ in range(2))
        self.marks = ColumnDataSource({"time": [], "colour": []})
        self._spans = ColumnDataSource({name: [] for name in _SPANS})
        self._shown: dict[ColumnDataSource, tuple[History | None, int]] = {}
        self._style, self._clock, self._range = style, clock, span

    def draw(self) -> list[figure]:
        """Return the plots: when the map is there, as they take as long as everything else of the page."""
        return [self._draw(title, names) for title, names in _PLOTS.items()]

    def update(self, chosen: History | None, truth: History | None) -> None:
        """Send the points that are new."""
        for source, history in ((self.chosen, chosen), (self._truth, truth if truth is not chosen else None)):
            shown, seen = self._shown.get(source, (None, 0))
            begin = seen if shown is history else 0
            end = history.written if history is not None else 0  # once: another thread adds points
            points = history.points(begin, end) if history is not None else _NOTHING
            columns: dict[str, Any] = {name: points[:, index] for index, name in enumerate(COLUMNS)}
            if shown is not history or source not in self._shown:
                source.data = columns
            elif history is not None and len(points):
                source.stream(columns, rollover=history.size)
            self._shown[source] = history, end

    def mark(self, told: Sequence[Event], spans: Sequence[Span], end: float) -> None:
        """Show when events of the vehicle happened [s], and what held until when."""
        grades = self._style.grades
        replace(self.marks, [(event.time * 1e3, grades[event.severity]) for event in told])
        held = [
            (begin, stop, grades[severity])
            for severity in ("watch", "bad")
            for begin, stop in _union([span for span in spans if span.severity == severity], end)
        ]
        replace(self._spans, held)

    def clear(self) -> None:
        """Forget what was sent: the time has jumped."""
        self._shown.clear()

    def _draw(self, title: str, names: tuple[str, ...]) -> figure:
        plot = figure(
            title=title, x_range=self._range, x_axis_type="datetime", tools="", toolbar_location=None, min_border=4,
            sizing_mode="stretch_both", height=76, min_height=76,
        )  # fmt: skip
        plot.vstrip(
            x0="begin", x1="end", source=self._spans, fill_color="colour", fill_alpha=0.12, line_alpha=0.0
        )  # fmt: skip
        for name, colour in zip(names, self._style.lines, strict=False):
            legend: dict[str, Any] = {"legend_label": _LABELS.get(name, name)} if len(names) > 1 else {}
            plot.line("time", name, source=self.chosen, color=colour, line_width=1.5, **legend)
            if name in _TRUE:
                plot.line("time", name, source=self._truth, color=self._style.truth, line_dash="dotted", line_width=1.5)
        plot.vspan(x="time", source=self.marks, line_color="colour", line_alpha=0.6, line_width=1)
        plot.xaxis.formatter = self._clock
        plot.xaxis[0].ticker = DatetimeTicker(desired_num_ticks=3)
        plot.yaxis[0].ticker = BasicTicker(desired_num_ticks=3)
        if len(names) > 1:
            plot.legend.orientation = "horizontal"
            plot.legend.location = "top_left"
        return plot


def _union(spans: Sequence[Span], end: float) -> list[tuple[float, float]]:
    """Return when any of these held, from begin to end [ms]: what overlaps is one."""
    found: list[tuple[float, float]] = []
    for span in sorted(spans, key=lambda each: each.since):
        begin, stop = span.since * 1e3, (end if span.until is None else span.until) * 1e3
        if found and begin <= found[-1][1]:
            before = found.pop()
            begin, stop = before[0], max(stop, before[1])
        if stop > begin:
            found.append((begin, stop))
    return found
