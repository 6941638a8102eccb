"""Plots of the chosen stream: the last minute of its position, altitude, velocity and uncertainty."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from bokeh.models import ColumnDataSource, DatetimeTickFormatter, Range1d
from bokeh.plotting import figure

from nedbus_msgs import Address

from .fleet import Fleet
from .stream import COLUMNS, POINTS
from .style import Style

_MINUTE: Final = 60.0  # s
_NOTHING: Final = np.empty((0, len(COLUMNS)))
_PLOTS: Final = {
    "north, east [m]": ("north", "east"),
    "height above its origin [m]": ("height",),
    "velocity north, east, up [m/s]": ("vx", "vy", "climb"),
    "eph, epv, distance to the ground truth [m]": ("eph", "epv", "error"),
}


class Plots:
    """Four plots with one time axis; `chosen` has the points of the stream, beside those of its ground truth."""

    def __init__(self, style: Style, *, offset: float) -> None:
        self._offset = offset * 1e3  # ms: Bokeh shows times as they are, in UTC
        self.chosen, self._truth = (ColumnDataSource({name: [] for name in COLUMNS}) for _ in range(2))
        self._shown: dict[ColumnDataSource, tuple[Address | None, int]] = {}
        self._range = Range1d()
        self._style = style

    def draw(self) -> list[figure]:
        """Return the four plots: when the map is there, as they take as long as everything else of the page."""
        return [self._draw(title, names) for title, names in _PLOTS.items()]

    def update(self, fleet: Fleet, chosen: Address | None, truth: Address | None) -> None:
        """Send the points that are new."""
        for source, address in ((self.chosen, chosen), (self._truth, truth if truth != chosen else None)):
            stream = fleet.streams.get(address) if address is not None else None
            shown, seen = self._shown.get(source, (None, 0))
            begin = seen if shown == address else 0
            end = stream.written if stream is not None else 0  # once: another thread adds points
            points = stream.points(begin, end) if stream is not None else _NOTHING
            columns: dict[str, Any] = {name: points[:, index] for index, name in enumerate(COLUMNS)}
            columns["time"] = columns["time"] + self._offset
            if shown != address:
                source.data = columns
            elif len(points):
                source.stream(columns, rollover=POINTS)
            self._shown[source] = address, end

    def move(self, time: float) -> None:
        """Move the time axis to its end [s since the epoch]."""
        end = time * 1e3 + self._offset
        self._range.update(start=end - _MINUTE * 1e3, end=end)

    def clear(self) -> None:
        """Forget what was sent: the time has jumped."""
        self._shown.clear()

    def _draw(self, title: str, names: tuple[str, ...]) -> figure:
        plot = figure(
            title=title, x_range=self._range, x_axis_type="datetime", tools="", toolbar_location=None, min_border=4,
            sizing_mode="stretch_both", height=100,
        )  # fmt: skip
        for name, colour in zip(names, self._style.lines, strict=False):
            plot.line("time", name, source=self.chosen, color=colour, legend_label=name, line_width=1.5)
            if name in {"north", "east", "height", "vx", "vy", "climb"}:
                plot.line("time", name, source=self._truth, color=colour, line_dash="dotted", line_width=1.5)
        clock = "%H:%M:%S"
        plot.xaxis.formatter = DatetimeTickFormatter(seconds=clock, minsec=clock, minutes=clock, hourmin=clock)
        plot.legend.orientation = "horizontal"
        plot.legend.location = "top_left"
        return plot
