"""Replay a PX4 .ulg log with all instances of its topics, paced by their timestamps."""

from __future__ import annotations

import heapq
from bisect import bisect_right
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from nedbus.recording import UlogTopic, read_ulog
from nedbus_msgs import ALL, DEFAULT, Definition

from .options import RecordedOptions
from .source import ReplayRun, SourceContext, SourceMessage

_MAX_GAP: Final = 60_000_000  # us; a longer gap is a damaged timestamp, and is skipped
_CHUNK: Final = 1000  # rows converted to Python values at a time


class UlogSource:
    """A .ulg file; `open` reads its topics into memory."""

    def __init__(self, path: str, options: RecordedOptions, context: SourceContext) -> None:
        self._path, self._options = Path(path).expanduser(), options
        self._default_vehicle = context.vehicle
        self.finite, self.loop = not options.loop, options.loop
        self.speed, self.wait = options.speed, options.wait

    def open(self) -> ReplayRun:
        """Read the log; raise SourceError if it is not a ULog file or has none of the requested topics."""
        options = self._options
        log = read_ulog(
            self._path, topics=options.chosen_topics, vehicle=options.vehicle, default_vehicle=self._default_vehicle
        )
        topics, warnings = list(log.topics.values()), list(log.warnings)
        clocks = [_monotonic(topic.columns["timestamp"]) for topic in topics]
        for topic, clock in zip(topics, clocks, strict=True):
            outliers = int(np.count_nonzero(clock != topic.columns["timestamp"]))
            if outliers:
                warnings.append(f"{topic.address}: {outliers} timestamps out of order; the log's own order is kept")
            unknown = sorted(topic.columns.keys() - topic.definition.known_types.keys())
            if unknown and _is_newer(topic):
                warnings.append(f"{topic.address}: {', '.join(unknown)} left out: the log is newer than nedbus")
        warnings += options.absent_from({topic.address.topic for topic in topics}, "this log")
        dues, gaps = _pace(clocks)
        if gaps:
            warnings.append(f"skipped {gaps} gaps of more than {_MAX_GAP // 1e6:.0f} s in the timestamps")
        total = sum(map(len, clocks))
        layouts = " and ".join(sorted({_layout_name(topic) for topic in topics if topic.definition is DEFAULT}))
        layout = f", layout {layouts}" if layouts else ""
        return ReplayRun(
            messages=heapq.merge(*map(_messages, topics, dues), key=lambda message: message.due),
            addresses={topic.address: topic.definition for topic in topics},
            total=total,
            summary=f"vehicle {topics[0].address.vehicle}, {total} messages of {len(topics)} streams{layout},"
            f" {max(due[-1] for due in dues):.1f} s",
            warnings=tuple(warnings),
            damage=f"{self._path}: messages lost to damage: {'; '.join(log.warnings)}" if log.damaged else None,
        )


def _messages(topic: UlogTopic, dues: npt.NDArray[np.float64]) -> Iterator[SourceMessage]:
    """Yield the rows of a topic as messages with these due times."""
    definition, names = topic.definition, tuple(topic.columns)
    for start in range(0, len(dues), _CHUNK):
        rows = slice(start, start + _CHUNK)
        columns = [_python_values(definition, name, column[rows]) for name, column in topic.columns.items()]
        for due, row in zip(dues[rows].tolist(), zip(*columns, strict=True), strict=True):
            yield SourceMessage(due, topic.address, dict(zip(names, row, strict=True)), definition=definition)


def _python_values(definition: Definition[Any], name: str, column: npt.NDArray[np.generic]) -> list[object]:
    """Convert a column to values that the model accepts: int, float, bool, or tuples of them."""
    values: list[object] = column.tolist()
    if any(kind.base == "bool" for kind in definition.known_types.get(name, ())):
        return [_to_bool(value) for value in values]
    return list(map(tuple, column.tolist())) if column.ndim == 2 else values


def _to_bool(value: object) -> object:
    """Convert 0 and 1 to bool; leave any other byte for the model to reject."""
    if isinstance(value, list):
        return tuple(map(_to_bool, value))
    return bool(value) if value in (0, 1) else value


def _monotonic(timestamps: npt.NDArray[np.generic]) -> npt.NDArray[np.uint64]:
    """Make timestamps non-decreasing with the fewest changes, so one outlier does not delay the rest."""
    times = timestamps.astype(np.uint64)
    if not np.any(times[1:] < times[:-1]):
        return times
    # The longest non-decreasing subsequence keeps its times; every other row takes the time of the row before it.
    tails: list[int] = []  # the smallest time that ends a subsequence, by its length
    lengths: list[int] = []  # of the longest subsequence that ends with each row
    for time in times.tolist():
        length = bisect_right(tails, time)
        tails[length : length + 1] = [time]
        lengths.append(length)
    needed, keep = len(tails) - 1, np.zeros(len(times), dtype=bool)
    for row in range(len(times) - 1, -1, -1):
        if lengths[row] == needed:
            keep[row], needed = True, needed - 1
    first = times[np.argmax(keep)]
    return np.maximum.accumulate(np.where(keep, times, first))


def _pace(clocks: list[npt.NDArray[np.uint64]]) -> tuple[list[npt.NDArray[np.float64]], int]:
    """Return the due time of each row of each topic [s since the first row], and the number of gaps removed."""
    times = np.unique(np.concatenate(clocks))
    steps = np.diff(times)
    gaps = steps > _MAX_GAP
    steps[gaps] = 0
    elapsed = np.concatenate(([0.0], np.cumsum(steps) / 1e6))
    return [elapsed[np.searchsorted(times, clock)] for clock in clocks], int(np.count_nonzero(gaps))


def _is_newer(topic: UlogTopic) -> bool:
    """Return whether a log may be newer than this version: it has all fields of the newest known layout."""
    newest = [layout for layout in topic.definition.layouts.values() if layout.name != ALL][-1]
    return newest.types.keys() <= topic.columns.keys()


def _layout_name(topic: UlogTopic) -> str:
    layout = topic.definition.find_layout(topic.columns)
    return layout.name if layout else "newer than 1.16" if _is_newer(topic) else "1.12 or older"
