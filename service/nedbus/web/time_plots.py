"""Plots over time: the events of all vehicles, and values of the selected one."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from bokeh.models import (
    BasicTicker,
    ColumnDataSource,
    DatetimeTicker,
    FixedTicker,
    HoverTool,
    Range1d,
    TapTool,
)
from bokeh.models.annotations import Legend, LegendItem
from bokeh.plotting import figure

from nedbus import limits
from nedbus.health import Event, Span
from nedbus.vehicle_events import ALL, KINDS

from .column_data import replace, table
from .stream import COLUMNS, History
from .style import MARKERS, SHAPES, Style

_VEHICLE_ROWS: Final = 7  # if there are more vehicles, the last row counts the hidden ones
_LEAST_ROWS: Final = 4  # height in rows; fewer rows would have thick bars
_PLOTS: Final = (  # the title of each column of each plot
    {"height": "height above own origin [m]"},
    {"speed": "horizontal speed [m/s]"},
    {"eph": "eph", "epv": "epv", "error": "error to ground truth [m]"},
)
_LEGEND: Final = f"{SHAPES['bad']} bad  {SHAPES['watch']} watch  {SHAPES['info']} flight phase  ▬ duration  ┊ now"
_NO_POINTS: Final = np.empty((0, len(COLUMNS)))
_TRUTH_COLUMNS: Final = {"height", "speed"}


def notable(events: Iterable[Event]) -> list[Event]:
    """Return the events to mark: faults and flight phases; if more than 2,000, only the latest faults."""
    shown = [event for event in events if event.severity != "info" or KINDS[event.kind].phase]
    if len(shown) <= limits.PAGE_MARKS:
        return shown
    faults = [event for event in shown if event.severity != "info"]
    return faults[-limits.PAGE_MARKS :]


def set_time_range(axis: Range1d, begin: float, end: float) -> None:
    """Set the range of a time axis [s]."""
    axis.update(start=begin * 1e3, end=end * 1e3)


class TimelinePlot:
    """The event timeline of one viewer; `shown`: the event of each row of `marks`, which can be tapped."""

    def __init__(self, style: Style, clock: Any) -> None:
        self.marks = table("time", "row", "marker", "colour", "words", "vehicle")
        self.shown: list[Event] = []
        self._spans = table("begin", "end", "row", "colour")
        self._now = table("time")
        self._colours = style.colours
        self._ticker = FixedTicker()
        self.range = Range1d()
        self.figure = _time_figure(
            self.range,
            clock,
            y_range=Range1d(),
            height=100,
            css_classes=["time"],
            title=_LEGEND,
        )
        self.figure.yaxis.ticker = self._ticker
        self.figure.xaxis.ticker = DatetimeTicker(desired_num_ticks=4)
        self.figure.ygrid.grid_line_color = None
        self.figure.hbar(
            "row", 0.28, "end", "begin", source=self._spans, color="colour", alpha=0.75
        )
        marks = self.figure.scatter(
            "time",
            "row",
            source=self.marks,
            marker="marker",
            size=11,
            fill_color="colour",
            line_color=style.colours["ground"],
            nonselection_alpha=1.0,
        )
        self.figure.vspan(
            x="time", source=self._now, line_color=style.colours["text"], line_dash="dotted"
        )
        self.figure.add_tools(
            HoverTool(renderers=[marks], tooltips="@vehicle: @words"), TapTool(renderers=[marks])
        )

    def update(
        self,
        events: Sequence[Event],
        spans: Mapping[str, Sequence[Span]],
        vehicles: Sequence[str],
        *,
        begin: float,
        end: float,
        now: float,
    ) -> None:
        """Show the events from `begin` to `end` [s]; `vehicles`: the selected one first, then by severity."""
        events = notable(event for event in events if begin <= event.time <= end)
        held = _held_since(begin, spans, vehicles)
        affected = {name for name, _ in held}
        for event in events:
            if event.severity != "info":
                affected.add(event.vehicle)
        # The selected vehicle stays first, then those with faults.
        names = [*vehicles[:1], *sorted(vehicles[1:], key=lambda name: name not in affected)]
        if ALL in affected:
            names.insert(0, ALL)
        hidden = 0
        if len(names) > _VEHICLE_ROWS:
            hidden = len(names) - _VEHICLE_ROWS + 1
            names = names[: _VEHICLE_ROWS - 1]
        rows = {name: len(names) - index for index, name in enumerate(names)}
        self.shown = [event for event in events if event.vehicle in rows]
        replace(self.marks, [self._mark(event, rows[event.vehicle]) for event in self.shown])
        bars = [self._bar(span, rows[name], begin, end) for name, span in held if name in rows]
        replace(self._spans, bars)
        replace(self._now, [{"time": now * 1e3}])
        self._label_rows(rows, hidden)

    def _mark(self, event: Event, row: int) -> dict[str, Any]:
        return {
            "time": event.time * 1e3,
            "row": row,
            "marker": MARKERS[event.severity],
            "colour": self._colours[event.severity],
            "words": event.words[:100],
            "vehicle": event.vehicle,
        }

    def _bar(self, span: Span, row: int, begin: float, end: float) -> dict[str, Any]:
        if span.until is None:
            until = end
        else:
            until = min(end, span.until)
        return {
            "begin": max(begin, span.since) * 1e3,
            "end": until * 1e3,
            "row": row,
            "colour": self._colours[span.severity],
        }

    def _label_rows(self, rows: Mapping[str, int], hidden: int) -> None:
        """Label the rows with their vehicles; `hidden`: number of vehicles without a row."""
        labels: dict[Any, Any] = {}
        for name, row in rows.items():
            if name == ALL:
                labels[row] = "link, page"
            else:
                labels[row] = name[:14]
        padding = max(_LEAST_ROWS - len(rows), 0) / 2
        low = 0.4 - padding
        if hidden:
            labels[0] = f"+{hidden} more"
            low -= 1
        self._ticker.ticks = list(labels)
        self.figure.yaxis.major_label_overrides = labels
        self.figure.y_range.update(start=low, end=len(rows) + 0.6 + padding)


def _held_since(
    begin: float, spans: Mapping[str, Sequence[Span]], vehicles: Sequence[str]
) -> list[tuple[str, Span]]:
    """Return the conditions that were active after `begin` [s], with their vehicles: bad last, drawn over watch."""
    held: list[tuple[str, Span]] = []
    for severity in ("watch", "bad"):
        for name in vehicles:
            for span in spans.get(name, ()):
                is_recent = span.until is None or span.until > begin
                if span.severity == severity and span.until != span.since and is_recent:
                    held.append((name, span))
    return held


class Plots:
    """Three plots with a shared time axis; `chosen`: the points of the selected stream."""

    def __init__(self, style: Style, clock: Any) -> None:
        self.chosen = table(*COLUMNS)
        self._truth = table(*COLUMNS)
        self.range = Range1d()
        self._marks = table("time", "colour")
        self._spans = table("begin", "end", "colour")
        self._shown: dict[ColumnDataSource, tuple[History | None, int]] = {}
        self._style = style
        self._clock = clock

    def draw(self) -> Iterator[figure]:
        """Yield new plots one by one, because each takes a browser as long to draw as the map."""
        return (self._draw(titles) for titles in _PLOTS)

    def update(self, chosen: History | None, truth: History | None) -> None:
        """Add the new points of the selected stream and of its ground truth."""
        self._update_points(self.chosen, chosen)
        self._update_points(self._truth, None if truth is chosen else truth)

    def _update_points(self, source: ColumnDataSource, history: History | None) -> None:
        shown, seen = self._shown.get(source, (None, 0))
        if history is None:
            self._shown[source] = (None, 0)
            if shown is not None:
                source.data = _to_columns(_NO_POINTS)
            return
        end = history.written  # read once: another thread adds points
        self._shown[source] = (history, end)
        if history is not shown:
            source.data = _to_columns(history.points(0, end))
        elif end > seen:
            source.stream(_to_columns(history.points(seen, end)), rollover=history.size)

    def mark_events(self, events: Sequence[Event], spans: Sequence[Span], end: float) -> None:
        """Mark the events of the vehicle and shade its conditions; active ones end at `end` [s]."""
        colours = self._style.colours
        marks = []
        for event in events:
            marks.append({"time": event.time * 1e3, "colour": colours[event.severity]})
        replace(self._marks, marks)
        bars = []
        for span in spans:
            if span.severity != "info" and span.until != span.since:
                if span.until is None:
                    until = end
                else:
                    until = span.until
                bars.append(
                    {
                        "begin": span.since * 1e3,
                        "end": until * 1e3,
                        "colour": colours[span.severity],
                    }
                )
        replace(self._spans, bars)

    def _draw(self, titles: Mapping[str, str]) -> figure:
        title = None  # the legend
        if len(titles) == 1:
            (title,) = titles.values()
        plot = _time_figure(self.range, self._clock, title=title, height=76, min_height=76)
        plot.vstrip(
            x0="begin",
            x1="end",
            source=self._spans,
            fill_color="colour",
            fill_alpha=0.12,
            line_alpha=0.0,
        )
        entries: list[Any] = []
        for (name, label), colour in zip(titles.items(), self._style.vehicles, strict=False):
            line: Any = plot.line("time", name, source=self.chosen, color=colour, line_width=1.5)
            entries.append(LegendItem(label=label, renderers=[line]))
            if name in _TRUTH_COLUMNS:
                truth = self._style.colours["truth"]
                plot.line(
                    "time",
                    name,
                    source=self._truth,
                    color=truth,
                    line_dash="dotted",
                    line_width=1.5,
                )
        if title is None:
            # inside the frame it would cover the lines
            plot.add_layout(Legend(items=entries), "above")
        plot.vspan(x="time", source=self._marks, line_color="colour", line_alpha=0.6, line_width=1)
        plot.xaxis[0].ticker = DatetimeTicker(desired_num_ticks=3)
        plot.yaxis[0].ticker = BasicTicker(desired_num_ticks=3)
        return plot


def _to_columns(points: npt.NDArray[np.float64]) -> dict[str, Any]:
    return dict(zip(COLUMNS, points.T, strict=True))


def _time_figure(span: Range1d, clock: Any, **options: Any) -> figure:
    plot = figure(
        x_range=span,
        x_axis_type="datetime",
        tools="",
        toolbar_location=None,
        sizing_mode="stretch_both",
        **options,
    )
    plot.xaxis.formatter = clock
    return plot
