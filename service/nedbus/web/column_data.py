"""Bokeh column data sources of a viewer, updated incrementally."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from bokeh.models import ColumnDataSource

from nedbus import limits
from nedbus_msgs import Address

from .fleet import TRUTH
from .stream import COLUMNS, History
from .style import PALETTE

_LEAST_POINTS: Final = 60  # of a track, however many there are
_EAST, _NORTH, _DOUBTFUL = (COLUMNS.index(name) for name in ("east", "north", "doubtful"))
_DOUBTFUL_LINE, _TRUTH_LINE = "doubtful", "truth"
LINE_TYPES: Final = (*(f"valid{number}" for number in range(PALETTE)), _DOUBTFUL_LINE, _TRUTH_LINE)
"""Line types of tracks: valid positions in each vehicle colour, doubtful positions, and ground truth."""
_COLUMNS: Final = ("east", *LINE_TYPES)


class Track(NamedTuple):
    """A track on the map: its points, and the number of its colour."""

    history: History
    number: int


def table(*names: str) -> ColumnDataSource:
    """Return an empty data source with these columns."""
    return ColumnDataSource({name: [] for name in names})


def replace(source: ColumnDataSource, rows: Sequence[Mapping[str, Any]]) -> None:
    """Replace all rows; send only changed columns, or all columns if the number of rows changed."""
    old = source.data
    new = {name: [row[name] for row in rows] for name in old}
    if any(len(column) != len(rows) for column in old.values()):
        source.data = new
        return
    all_rows = slice(len(rows))
    changed = {}
    for name, values in new.items():
        if repr(values) != repr(old[name]):  # repr, because NaN is not equal to itself
            changed[name] = [(all_rows, values)]
    if changed:
        source.patch(changed)


class Tracks:
    """Tracks of all streams in one data source: a column for east, and a column for north per line type.

    North is NaN where a line has a gap. Each track is a ring buffer of slots with a gap after the newest point, then a
    copy of its first slot and a permanent gap.
    """

    def __init__(self) -> None:
        self.source = table(*_COLUMNS)
        self._tracks: Mapping[Address, Track] = {}
        self._seen: list[int] = []  # number of points of each history in the data source
        self._step = 1  # points per slot
        self._slots = 1  # per track

    def update(self, tracks: Mapping[Address, Track]) -> None:
        """Add the new points of these tracks."""
        if tracks != self._tracks:  # a new vehicle, or a seek, which creates new histories
            self._resize(tracks)
        cells: dict[str, dict[int, float]] = {name: {} for name in _COLUMNS}
        for index, (address, track) in enumerate(tracks.items()):
            self._add_points(cells, index, address, track)
        if cells["east"]:
            changed = {name: [*values.items()] for name, values in cells.items() if values}
            self.source.patch(changed)

    def _resize(self, tracks: Mapping[Address, Track]) -> None:
        """Choose the number of slots, and of points per slot, for these tracks; clear all lines."""
        self._tracks = dict(tracks)
        self._seen = [0 for _ in tracks]
        histories = [track.history for track in tracks.values()]
        sizes = [history.size for history in histories]
        written = [min(history.written, history.size) for history in histories]
        longest = max(sizes, default=1)
        share = limits.PAGE_TRACK_POINTS // max(1, len(tracks))
        slots = max(_LEAST_POINTS, min(longest, share))
        # A history that has just begun need not be drawn as coarsely as a full one.
        most_written = max(written, default=1)
        expected = max(2 * most_written, limits.PAGE_TRACK_POINTS)
        drawn = min(longest, expected)
        self._step = math.ceil(drawn / slots)
        self._slots = longest // self._step + 2  # plus the incomplete slot and the gap
        cells = (self._slots + 2) * len(tracks)
        self.source.data = {name: np.full(cells, math.nan) for name in _COLUMNS}

    def _add_points(
        self, cells: dict[str, dict[int, float]], index: int, address: Address, track: Track
    ) -> None:
        history = track.history
        seen = self._seen[index]
        end = history.written  # read once: another thread adds points
        if end == seen:
            return
        self._seen[index] = end
        base = index * (self._slots + 2)
        lines = _lines_of(address, track)
        ring = _Ring(cells, base, self._slots, lines)
        first = seen // self._step * self._step
        points = history.points(first, end)
        is_broken = False
        for position, point in enumerate(points.tolist(), end - len(points)):
            east = point[_EAST]
            is_new_slot = position % self._step == 0
            is_broken = math.isnan(east) or (is_broken and not is_new_slot)
            if is_broken:
                north = math.nan
            else:
                north = round(point[_NORTH], 2)
            line = lines.valid
            if point[_DOUBTFUL] > 0:
                line = lines.doubtful
            ring.put(position // self._step, round(east, 2), line, north)
        newest = (end - 1) // self._step
        ring.put(newest + 1, math.nan, lines.valid, math.nan)


class _Lines(NamedTuple):
    """The line types of a track."""

    valid: str
    doubtful: str


def _lines_of(address: Address, track: Track) -> _Lines:
    if address.topic == TRUTH:
        return _Lines(_TRUTH_LINE, _TRUTH_LINE)
    return _Lines(f"valid{track.number % PALETTE}", _DOUBTFUL_LINE)


class _Ring(NamedTuple):
    """The slots of one track: changed cells by column, the row of the first slot, the number of slots, its lines."""

    cells: dict[str, dict[int, float]]
    base: int
    slots: int
    lines: _Lines

    def put(self, number: int, east: float, line: str, north: float) -> None:
        """Write slot `number`, with a gap in the other line."""
        slot = number % self.slots
        places = [self.base + slot]
        if slot == 0:  # the copy continues the line after the last slot
            places.append(self.base + self.slots)
        for place in places:
            self.cells["east"][place] = east
            for name in self.lines:
                self.cells[name][place] = math.nan
            self.cells[line][place] = north
