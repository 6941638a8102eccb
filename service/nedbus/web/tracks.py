"""The tracks of all streams as one source of lines: a viewer gets the points that are new, and nothing twice."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
from bokeh.models import ColumnDataSource

from nedbus_msgs import Address

from .fleet import TRUTH
from .stream import COLUMNS, History
from .style import PALETTE

_BUDGET: Final = 6_000  # points of all tracks together: what a browser draws ten times a second
_FEWEST: Final = 60  # of a track
_EAST, _NORTH, _DOUBTFUL = (COLUMNS.index(name) for name in ("east", "north", "doubtful"))
_DOUBT, _TRUE = "doubtful", "truth"
NAMES: Final = (*(f"valid{number}" for number in range(PALETTE)), _DOUBT, _TRUE)
"""The kinds of lines: valid ones in the colours of vehicles, doubtful ones, and ground truth."""

Track = tuple[History, int]  # with the number of its colour


class Tracks:
    """One column of east, and one of north for each kind of line: NaN where that line does not go.

    Each track has a ring of slots, with a gap that moves on before its newest point, and behind it a copy of its first
    slot and a gap for good.
    """

    def __init__(self) -> None:
        self.source = ColumnDataSource({name: [] for name in ("east", *NAMES)})
        self._tracks: Mapping[Address, Track] | None = None
        self._seen: list[int] = []
        self._step = self._slots = 1

    def update(self, tracks: Mapping[Address, Track]) -> None:
        """Send what is new of these."""
        if tracks != self._tracks:
            self._begin(tracks)
        patches: dict[str, list[tuple[int, float]]] = {name: [] for name in ("east", *NAMES)}
        for index, (address, track) in enumerate(tracks.items()):
            for slot, values in self._points(index, address, track):
                for name, value in values.items():
                    patches[name].append((slot, value))
        if patches["east"]:
            self.source.patch({name: patch for name, patch in patches.items() if patch})

    def clear(self) -> None:
        """Forget all, so that the next update sends everything again."""
        self._tracks = None

    def _begin(self, tracks: Mapping[Address, Track]) -> None:
        self._tracks = dict(tracks)
        self._seen = [0] * len(tracks)
        longest = max((history.size for history, _ in tracks.values()), default=1)
        points = max(_FEWEST, min(longest, _BUDGET // max(1, len(tracks))))
        written = max((min(history.written, history.size) for history, _ in tracks.values()), default=1)
        self._step = -(-min(longest, max(2 * written, _BUDGET)) // points)
        self._slots = longest // self._step + 2  # with the one that is not complete yet, and the gap
        filled: dict[str, Any] = {n: np.full((self._slots + 2) * len(tracks), math.nan) for n in ("east", *NAMES)}
        for index, (address, track) in enumerate(tracks.items()):
            for slot, values in self._points(index, address, track):
                for name, value in values.items():
                    filled[name][slot] = value
        self.source.data = filled

    def _points(self, index: int, address: Address, track: Track) -> Iterator[tuple[int, dict[str, float]]]:
        """Yield the slots that change, with their values."""
        history, number = track
        step, ring = self._step, self._slots
        seen, end = self._seen[index], history.written  # once: another thread adds points
        if end == seen:
            return
        self._seen[index] = end
        names = (_TRUE,) if address.topic == TRUTH else (f"valid{number % PALETTE}", _DOUBT)
        gap = dict.fromkeys(("east", *names), math.nan)
        rows = history.points(seen // step * step, end)
        changed: dict[int, dict[str, float]] = {}
        broken = False
        for position, row in enumerate(rows.tolist(), end - len(rows)):
            east, north, doubtful = row[_EAST], row[_NORTH], row[_DOUBTFUL]
            broken = math.isnan(east) or (broken and position % step > 0)
            values = {**gap, "east": round(east, 2)}
            values[names[-1 if doubtful > 0 else 0]] = math.nan if broken else round(north, 2)
            changed[position // step % ring] = values
        changed[((end - 1) // step + 1) % ring] = gap
        if 0 in changed:
            changed[ring] = changed[0]  # so that the line goes on from the last slot to the first
        for slot, values in changed.items():
            yield index * (ring + 2) + slot, values
