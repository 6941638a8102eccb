"""Bokeh column data sources of a viewer, updated incrementally."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from bokeh.models import ColumnDataSource

from nedbus_msgs import Address

from .fleet import TRUTH
from .stream import COLUMNS, History
from .style import PALETTE

# points of all tracks together, which a browser can draw ten times a second
_MAX_POINTS: Final = 6_000
_MIN_TRACK_POINTS: Final = 60
_EAST, _NORTH, _DOUBTFUL = (COLUMNS.index(name) for name in ("east", "north", "doubtful"))
_DOUBTFUL_LINE, _TRUTH_LINE = "doubtful", "truth"
LINE_TYPES: Final = (*(f"valid{number}" for number in range(PALETTE)), _DOUBTFUL_LINE, _TRUTH_LINE)
"""Line types of tracks: valid positions in each vehicle colour, doubtful positions, and ground truth."""
_COLUMNS: Final = ("east", *LINE_TYPES)

Track = tuple[History, int]  # points, and colour number


def table(*names: str) -> ColumnDataSource:
    """Return an empty data source with these columns."""
    return ColumnDataSource({name: [] for name in names})


def replace(source: ColumnDataSource, rows: Sequence[Mapping[str, Any]]) -> None:
    """Replace all rows; send only changed columns, or all columns if the number of rows changed."""
    old = source.data
    new = {name: [row[name] for row in rows] for name in old}
    if any(len(column) != len(rows) for column in old.values()):
        source.data = new
    else:  # repr, because NaN is not equal to itself
        cells = slice(len(rows))
        changed = {
            name: [(cells, values)]
            for name, values in new.items()
            if repr(values) != repr(old[name])
        }
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
        self._step = self._slots = 1

    def update(self, tracks: Mapping[Address, Track]) -> None:
        """Add the new points of these tracks."""
        if tracks != self._tracks:  # a new vehicle, or a seek, which creates new histories
            # Choose the number of slots, and the number of points per slot.
            self._tracks, self._seen = dict(tracks), [0] * len(tracks)
            longest = max((history.size for history, _ in tracks.values()), default=1)
            points = max(_MIN_TRACK_POINTS, min(longest, _MAX_POINTS // max(1, len(tracks))))
            written = max(
                (min(history.written, history.size) for history, _ in tracks.values()), default=1
            )
            self._step = -(-min(longest, max(2 * written, _MAX_POINTS)) // points)
            self._slots = longest // self._step + 2  # plus the incomplete slot and the gap
            self.source.data = {
                name: np.full((self._slots + 2) * len(tracks), math.nan) for name in _COLUMNS
            }
        cells: dict[str, dict[int, float]] = {name: {} for name in _COLUMNS}
        for index, (address, track) in enumerate(tracks.items()):
            self._add_points(cells, index, address, track)
        if cells["east"]:
            self.source.patch(
                {name: list(changed.items()) for name, changed in cells.items() if changed}
            )

    def _add_points(
        self, cells: dict[str, dict[int, float]], index: int, address: Address, track: Track
    ) -> None:
        history, number = track
        step, ring = self._step, self._slots
        seen, end = self._seen[index], history.written  # read once: another thread adds points
        if end == seen:
            return
        self._seen[index] = end
        names = (
            (_TRUTH_LINE,)
            if address.topic == TRUTH
            else (f"valid{number % PALETTE}", _DOUBTFUL_LINE)
        )

        def put(slot: int, point: Mapping[str, float]) -> None:
            for name in ("east", *names):
                # the copy continues the line after the last slot
                for place in (0, ring) if slot == 0 else (slot,):
                    cells[name][index * (ring + 2) + place] = point.get(name, math.nan)

        points = history.points(seen // step * step, end)
        broken = False
        for position, point in enumerate(points.tolist(), end - len(points)):
            east = point[_EAST]
            north = point[_NORTH]
            doubtful = point[_DOUBTFUL]
            broken = math.isnan(east) or (broken and position % step > 0)
            kind = names[-1 if doubtful > 0 else 0]
            put(
                position // step % ring,
                {"east": round(east, 2), kind: math.nan if broken else round(north, 2)},
            )
        put(((end - 1) // step + 1) % ring, {})
