"""The tracks of all streams as one source of lines: a viewer gets the points that are new, and nothing twice."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
from bokeh.models import ColumnDataSource

from nedbus_msgs import Address

from .fleet import TRUTH
from .stream import COLUMNS, POINTS, Stream

_BUDGET: Final = 6_000  # points of all tracks together: what a browser draws ten times a second
_FEWEST: Final = 60  # of a track
_KINDS: Final = ("valid", "doubtful", "truth")
_NAMES: Final = ("east", *_KINDS)
_GAP: Final = (math.nan, math.nan, math.nan, math.nan)
_EAST, _NORTH, _DOUBTFUL = (COLUMNS.index(name) for name in ("east", "north", "doubtful"))


class Tracks:
    """One column of east, and one of north for each kind of line: NaN where that line does not go.

    Each track has a ring of slots, with a gap that moves on before its newest point, and behind it a copy of its first
    slot and a gap for good.
    """

    def __init__(self) -> None:
        self.source = ColumnDataSource({name: [] for name in _NAMES})
        self._addresses: tuple[Address, ...] | None = None
        self._seen: list[int] = []
        self._step = self._slots = 1

    def update(self, streams: Mapping[Address, Stream]) -> None:
        """Send what is new of these."""
        if tuple(streams) != self._addresses:
            self._begin(streams)
        patches: dict[str, list[tuple[int, float]]] = {name: [] for name in _NAMES}
        for index, (address, stream) in enumerate(streams.items()):
            for slot, values in self._points(index, address, stream):
                for name, value in zip(patches, values, strict=True):
                    patches[name].append((slot, value))
        if patches["east"]:
            self.source.patch(patches)

    def clear(self) -> None:
        """Forget all, so that the next update sends everything again."""
        self._addresses = None

    def _begin(self, streams: Mapping[Address, Stream]) -> None:
        self._addresses = tuple(streams)
        self._seen = [0] * len(streams)
        points = max(_FEWEST, min(POINTS, _BUDGET // max(1, len(streams))))
        self._step = -(-POINTS // points)
        self._slots = POINTS // self._step + 2  # with the one that is not complete yet, and the gap
        filled: dict[str, Any] = {n: np.full((self._slots + 2) * len(streams), math.nan) for n in _NAMES}
        for index, (address, stream) in enumerate(streams.items()):
            for slot, values in self._points(index, address, stream):
                for name, value in zip(filled, values, strict=True):
                    filled[name][slot] = value
        self.source.data = filled

    def _points(
        self, index: int, address: Address, stream: Stream
    ) -> Iterator[tuple[int, tuple[float, float, float, float]]]:
        """Yield the slots that change, with their values."""
        step, ring = self._step, self._slots
        seen, end = self._seen[index], stream.written  # once: another thread adds points
        if end == seen:
            return
        self._seen[index] = end
        rows = stream.points(seen // step * step, end)
        changed: dict[int, tuple[float, float, float, float]] = {}
        broken = False
        for number, row in enumerate(rows.tolist(), end - len(rows)):
            east, north, doubtful = row[_EAST], row[_NORTH], row[_DOUBTFUL]
            broken = math.isnan(east) or (broken and number % step > 0)
            point = round(east, 2), math.nan if broken else round(north, 2)
            changed[number // step % ring] = _columns(*point, truth=address.topic == TRUTH, doubtful=doubtful > 0)
        changed[((end - 1) // step + 1) % ring] = _GAP
        if 0 in changed:
            changed[ring] = changed[0]  # so that the line goes on from the last slot to the first
        for slot, values in changed.items():
            yield index * (ring + 2) + slot, values


def _columns(east: float, north: float, *, truth: bool, doubtful: bool) -> tuple[float, float, float, float]:
    kind = 2 if truth else int(doubtful)
    norths = [north if kind == each else math.nan for each in range(3)]
    return east, norths[0], norths[1], norths[2]
