"""Real flight logs: every local position topic and every estimator instance of a PX4 .ulg file."""

from __future__ import annotations

import heapq
import threading
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
import numpy.typing as npt
import pyulog.core
from pyulog import ULog, ULogException

from nedbus.errors import AddressError, SourceError
from nedbus_msgs import FIELD_TYPES, LAYOUTS, TOPICS, Address, find_layout, get_topic

from .record import Flight, Home, Record
from .spec import RecordedOptions

_GAP: Final = 60_000_000  # us: a longer silence in a log is a damaged timestamp, not something to wait for

_HEAD: Final = 3  # bytes before each message of a log
_READ: Final = 4096  # what a read costs, in bytes, however little it reads
_PATIENCE: Final = 2**31  # what reading a damaged log may cost, beside what its size makes plausible
_CHUNK: Final = 1000  # rows that are turned into Python values at a time

_KNOWN: Final = frozenset(name for layout in LAYOUTS.values() for name in layout.fields)
_BOOL: Final = {0: False, 1: True}  # what a log may hold in a bool; anything else is left for the model to refuse


Columns = Mapping[str, npt.NDArray[np.generic]]
"""One topic of a log: PX4's field names, and the values of all messages; delta_xy and delta_vxy have two columns."""


@dataclass(frozen=True, slots=True)
class Track:
    """One topic of a log: its address, its columns by PX4's field name, and when each row is due."""

    address: Address
    columns: Mapping[str, npt.NDArray[np.generic]]
    due: npt.NDArray[np.float64]

    def records(self) -> Iterator[Record]:
        """Yield the rows."""
        for start in range(0, len(self.due), _CHUNK):
            rows = slice(start, start + _CHUNK)
            columns = [_values(name, column[rows]) for name, column in self.columns.items()]
            for due, row in zip(self.due[rows].tolist(), zip(*columns, strict=True), strict=True):
                yield Record(due, self.address, dict(zip(self.columns, row, strict=True)))


class UlogSource:
    """A .ulg file; `open` reads its local position topics into memory."""

    def __init__(self, path: str, options: RecordedOptions, home: Home) -> None:
        self._path = Path(path).expanduser()
        self._vehicle = options.vehicle
        self._default_vehicle = home.vehicle
        self.finite = not options.loop
        self.loop = options.loop
        self.speed = None if options.speed == "max" else options.speed
        self.wait = options.wait

    def open(self) -> Flight:
        """Read the log; raise SourceError when it is no ULog, or has none of the topics."""
        found, warnings = read_columns(self._path, vehicle=self._vehicle, default_vehicle=self._default_vehicle)
        vehicle = found[0][0].vehicle
        clocks = [_order(columns["timestamp"]) for _, columns in found]
        for (address, columns), clock in zip(found, clocks, strict=True):
            strays = int(np.count_nonzero(clock != columns["timestamp"]))
            if strays:
                warnings.append(f"{address}: {strays} timestamps out of order; the log's own order is kept")
            unknown = sorted(name for name in columns if name not in _KNOWN)
            if unknown and "hagl_max_z" in columns:
                warnings.append(f"{address}: {', '.join(unknown)} left out: the log is newer than this version")
        dues, gaps = _pace(clocks)
        if gaps:
            warnings.append(f"{gaps} gaps of more than {_GAP // 1e6:.0f} s in its timestamps are not waited for")
        tracks = [Track(address, columns, due) for (address, columns), due in zip(found, dues, strict=True)]
        total = sum(map(len, clocks))
        layouts = " and ".join(sorted({_layout_name(columns) for _, columns in found}))
        return Flight(
            records=heapq.merge(*(track.records() for track in tracks), key=lambda record: record.due),
            addresses=tuple(track.address for track in tracks),
            total=total,
            summary=f"vehicle {vehicle}, {total} messages of {len(tracks)} streams, layout {layouts},"
            f" {max(due[-1] for due in dues):.1f} s",
            warnings=tuple(warnings),
        )


def read_columns(
    path: Path, *, vehicle: str | None = None, default_vehicle: str = "1"
) -> tuple[list[tuple[Address, Columns]], list[str]]:
    """Return each local position topic of a log with its columns by PX4's field names, and what is wrong with it.

    `vehicle` is that of the log's MAV_SYS_ID unless it is given.

    Raises SourceError when it is no ULog, or has none of the topics.
    """
    log, warnings = _read(path)
    vehicle = vehicle or _system_id(log) or default_vehicle
    found: list[tuple[Address, Columns]] = []
    for data in log.data_list:
        try:
            address = Address(vehicle, data.name, data.multi_id if get_topic(data.name).instances else None)
        except AddressError as exc:
            warnings.append(f"{data.name} is left out: {exc}")
            continue
        if any(address == other for other, _ in found) or "timestamp" not in data.data:
            warnings.append(f"{data.name} [{data.multi_id}] is left out: a second one, or without timestamps")
            continue
        found.append((address, _columns(data.data)))
    if not found:
        raise SourceError(str(path), "no message of the local position topics is in this log")
    return found, warnings


class _Watched:
    """A file that is read only so much, as pyulog can go round in circles in a damaged one; it tells if it was cut."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self.cut = False
        self._file = file
        self._left = _PATIENCE + 1000 * size
        self.seek = file.seek
        self.tell = file.tell
        self.close = file.close

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(size)
        self._left -= _READ + len(data)
        # The only read that may find nothing is that of the next message's head.
        if len(data) < size and (data or size != _HEAD):
            self.cut = True
        if self._left < 0:
            raise ULogException("Invalid structure: its parts lead round in circles")
        return data


class _Said(threading.local):
    """What pyulog said in this thread; it prints, and standard output is not a library's."""

    def __init__(self) -> None:
        self.lines: list[str] = []


_said = _Said()


def _note(*words: object) -> None:
    _said.lines.append(" ".join(map(str, words)))


pyulog.core.print = _note


def _read(path: Path) -> tuple[ULog, list[str]]:
    """Return the log, and what its reader says is wrong with it."""
    _said.lines = []
    try:
        with path.open("rb") as file:
            watched = _Watched(file, path.stat().st_size)
            log = ULog(watched, list(TOPICS))
    except OSError as exc:
        raise SourceError(str(path), (exc.strerror or str(exc)).lower()) from exc
    except ULogException as exc:
        raise SourceError(str(path), f"this is no ULog file that can be read ({exc})") from exc
    warnings = [f"damaged: {line}" for line in _said.lines[:5]]
    if log.file_corruption and not warnings:
        warnings.append("damaged: parts of it were skipped")
    elif watched.cut:
        warnings.append("cut: it ends inside a message")
    return log, warnings


def _system_id(log: ULog) -> str | None:
    """Return the MAVLink system id of the vehicle that wrote the log."""
    value = log.initial_parameters.get("MAV_SYS_ID")
    return str(value) if isinstance(value, int) and 0 < value < 256 else None


def _columns(data: Mapping[str, npt.NDArray[np.generic]]) -> dict[str, npt.NDArray[np.generic]]:
    """Return the columns by PX4's field names: `delta_xy[0]` and `delta_xy[1]` become one column of pairs."""
    columns: dict[str, npt.NDArray[np.generic]] = {}
    for name, column in data.items():
        base, bracket, index = name.partition("[")
        if not bracket:
            if not name.startswith("_padding"):
                columns[name] = column
        elif index == "0]" and f"{base}[1]" in data:
            columns[base] = np.column_stack((column, data[f"{base}[1]"]))
    return columns


def _values(name: str, column: npt.NDArray[np.generic]) -> list[object]:
    """Return a column as what the model takes: int, float, bool, or tuples of two floats."""
    values: list[object] = column.tolist()
    if FIELD_TYPES.get(name) == "bool":
        return [_BOOL.get(value, value) if isinstance(value, int) else value for value in values]
    return [tuple(value) for value in values if isinstance(value, list)] if column.ndim == 2 else values


def _order(timestamps: npt.NDArray[np.generic]) -> npt.NDArray[np.uint64]:
    """Return timestamps that never go back, changing as few as possible: one stray must not delay all the others."""
    times = timestamps.astype(np.uint64)
    if not np.any(times[1:] < times[:-1]):
        return times
    # The longest run of rows that are in order keeps its times; each other row takes that of the one before it.
    tails: list[int] = []  # the smallest time that ends a run, by the length of the run
    length: list[int] = []  # of the longest run that ends with each row
    for time in times.tolist():
        place = bisect_right(tails, time)
        tails[place : place + 1] = [time]
        length.append(place)
    wanted, keep = len(tails) - 1, np.zeros(len(times), dtype=bool)
    for row in range(len(times) - 1, -1, -1):
        if length[row] == wanted:
            keep[row], wanted = True, wanted - 1
    first = times[np.argmax(keep)]
    return np.maximum.accumulate(np.where(keep, times, first))


def _pace(clocks: list[npt.NDArray[np.uint64]]) -> tuple[list[npt.NDArray[np.float64]], int]:
    """Return when each row of each track is due, in seconds since the first row, and how many gaps were closed."""
    times = np.unique(np.concatenate(clocks))
    steps = np.diff(times)
    gaps = steps > _GAP
    steps[gaps] = 0
    elapsed = np.concatenate(([0.0], np.cumsum(steps) / 1e6))
    return [elapsed[np.searchsorted(times, clock)] for clock in clocks], int(np.count_nonzero(gaps))


def _layout_name(columns: Mapping[str, object]) -> str:
    layout = find_layout(columns)
    return layout.name if layout else "newer than 1.16" if "hagl_max_z" in columns else "1.12 or older"
