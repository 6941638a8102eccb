"""Plots over time: the events of all vehicles, and values of the selected one."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
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

from nedbus.health import Event, Span
from nedbus.vehicle_events import ALL, KINDS

from .column_data import replace, table
from .stream import COLUMNS, History
from .style import MARKERS, SHAPES, Style

_MAX_ROWS: Final = 7  # vehicles; if there are more, the last row counts the hidden ones
_MAX_MARKS: Final = 2000
_MIN_ROWS: Final = 4  # minimum height in rows; fewer rows would have thick bars
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
    return (
        shown
        if len(shown) <= _MAX_MARKS
        else [each for each in shown if each.severity != "info"][-_MAX_MARKS:]
    )


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
        options: dict[str, Any] = {
            "y_range": Range1d(),
            "height": 100,
            "css_classes": ["time"],
            "title": _LEGEND,
        }
        self.figure = _time_figure(self.range, clock, **options)
        self.figure.yaxis.ticker = self._ticker
        self.figure.xaxis.ticker = DatetimeTicker(desired_num_ticks=4)
        self.figure.ygrid.grid_line_color = None
        self.figure.hbar(
            "row", 0.28, "end", "begin", source=self._spans, color="colour", alpha=0.75
        )
        marks = self.figure.scatter(
            "time", "row", source=self.marks, marker="marker", size=11, fill_color="colour",
            line_color=style.colours["ground"], nonselection_alpha=1.0,
        )  # fmt: skip
        self.figure.vspan(
            x="time", source=self._now, line_color=style.colours["text"], line_dash="dotted"
        )
        self.figure.add_tools(
            HoverTool(renderers=[marks], tooltips="@vehicle: @words"), TapTool(renderers=[marks])
        )

    def update(
        self, events: Sequence[Event], spans: Mapping[str, Sequence[Span]], vehicles: Sequence[str], *,
        begin: float, end: float, now: float,
    ) -> None:  # fmt: skip
        """Show the events from `begin` to `end` [s]; `vehicles`: the selected one first, then by severity."""
        events = notable(event for event in events if begin <= event.time <= end)
        held = [  # bad last, drawn over watch
            (name, span)
            for severity in ("watch", "bad")
            for name in vehicles
            for span in spans.get(name, ())
            if span.severity == severity
            and span.until != span.since
            and (span.until is None or span.until > begin)
        ]
        affected = {event.vehicle for event in events if event.severity != "info"} | {
            name for name, _ in held
        }
        others = sorted(vehicles[1:], key=lambda name: name not in affected)
        names = [*([ALL] if ALL in affected else []), *vehicles[:1], *others]
        hidden = len(names) - _MAX_ROWS + 1 if len(names) > _MAX_ROWS else 0
        names = names[: len(names) - hidden]
        rows = {name: len(names) - index for index, name in enumerate(names)}
        self.shown = [event for event in events if event.vehicle in rows]
        marks = [
            {"time": event.time * 1e3, "row": rows[event.vehicle], "marker": MARKERS[event.severity],
             "colour": self._colours[event.severity], "words": event.words[:100], "vehicle": event.vehicle}
            for event in self.shown
        ]  # fmt: skip
        replace(self.marks, marks)
        bars = [
            {"begin": max(begin, span.since) * 1e3, "row": rows[name], "colour": self._colours[span.severity],
             "end": (end if span.until is None else min(end, span.until)) * 1e3}
            for name, span in held if name in rows
        ]  # fmt: skip
        replace(self._spans, bars)
        replace(self._now, [{"time": now * 1e3}])
        labels: dict[Any, Any] = {
            row: "link, page" if name == ALL else name[:14] for name, row in rows.items()
        }
        labels |= {0: f"+{hidden} more"} if hidden else {}
        self._ticker.ticks = list(labels)
        self.figure.yaxis.major_label_overrides = labels
        padding = max(_MIN_ROWS - len(names), 0) / 2
        self.figure.y_range.update(
            start=0.4 - padding - bool(hidden), end=len(names) + 0.6 + padding
        )


class Plots:
    """Three plots with a shared time axis; `chosen`: the points of the selected stream."""

    def __init__(self, style: Style, clock: Any) -> None:
        self.chosen, self._truth = table(*COLUMNS), table(*COLUMNS)
        self.range = Range1d()
        self._marks = table("time", "colour")
        self._spans = table("begin", "end", "colour")
        self._shown: dict[ColumnDataSource, tuple[History | None, int]] = {}
        self._style, self._clock = style, clock

    def draw(self) -> Iterator[figure]:
        """Yield new plots one by one, because each takes a browser as long to draw as the map."""
        return (self._draw(titles) for titles in _PLOTS)

    def update(self, chosen: History | None, truth: History | None) -> None:
        """Add the new points of the selected stream and of its ground truth."""
        for source, history in (
            (self.chosen, chosen),
            (self._truth, truth if truth is not chosen else None),
        ):
            shown, seen = self._shown.get(source, (None, 0))
            # read once: another thread adds points
            end = history.written if history is not None else 0
            self._shown[source] = history, end
            points = (
                _NO_POINTS
                if history is None
                else history.points(seen if history is shown else 0, end)
            )
            columns: dict[str, Any] = dict(zip(COLUMNS, points.T, strict=True))
            if history is not shown:
                source.data = columns
            elif history is not None and len(points):
                source.stream(columns, rollover=history.size)

    def mark_events(self, events: Sequence[Event], spans: Sequence[Span], end: float) -> None:
        """Mark the events of the vehicle and shade its conditions; active ones end at `end` [s]."""
        colours = self._style.colours
        replace(
            self._marks,
            [{"time": event.time * 1e3, "colour": colours[event.severity]} for event in events],
        )
        held = [
            {"begin": span.since * 1e3, "end": (end if span.until is None else span.until) * 1e3,
             "colour": colours[span.severity]}
            for span in spans if span.severity != "info" and span.until != span.since
        ]  # fmt: skip
        replace(self._spans, held)

    def _draw(self, titles: Mapping[str, str]) -> figure:
        title = next(iter(titles.values())) if len(titles) == 1 else None  # otherwise the legend
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
