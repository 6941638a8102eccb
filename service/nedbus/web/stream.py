"""A stream on the page: for positions, a history at 10 Hz and a long one; no I/O."""

from __future__ import annotations

import math
from operator import attrgetter
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from nedbus import Sample
from nedbus_msgs import BY_TOPIC, DEFAULT, Address, ResetTracker, VehicleLocalPosition
from nedbus_msgs.frames import CommonOrigin, to_global

POINTS: Final = 600  # number of points in the history of the last minute
COLUMNS: Final = ("time", "east", "north", "height", "speed", "eph", "epv", "error", "doubtful")
"""Columns of a history, NaN where the message was not valid.

`time`: ms since the Unix epoch or the start of a recording.
`doubtful`: 1 while dead reckoning or if the validity is unknown, else 0.
`speed`: horizontal [m/s]. The others are in m: `height` above the vehicle's own origin, `error` from the ground truth.
"""

_STEP: Final = 0.095  # s between two points
_FIRST_POINTS: Final = 16  # initial capacity of a history
_TRUTH_WINDOW: Final = 0.5  # s; older ground truth is not compared with an estimate
_state_of = attrgetter(
    "xy_reset_counter",
    "z_reset_counter",
    "vxy_reset_counter",
    "vz_reset_counter",
    "xy_global",
    "xy_valid",
    "z_valid",
    "dead_reckoning",
)


class HistorySize(NamedTuple):
    """The number of points of a history, and the time between two [s]."""

    points: int
    step: float


LONG: Final = HistorySize(points=900, step=1.0)
"""The history of 15 minutes of live vehicles."""


def is_position(address: Address) -> bool:
    """Return whether the messages of an address are positions."""
    return BY_TOPIC.get(address.topic) is DEFAULT


class Position(NamedTuple):
    """A position [m].

    `common`: True if relative to the common origin, False if relative to the vehicle's own origin.
    `altitude`: above mean sea level if `is_altitude_global`, else above the vehicle's own origin.
    """

    east: float
    north: float
    altitude: float
    common: bool
    is_altitude_global: bool


class History:
    """Ring buffer of the newest `size` points; `written` counts all points written so far.

    Its memory grows with its points, because many streams have few.
    """

    def __init__(self, size: int, step: float) -> None:
        self.size = size
        self.step = step
        self.written = 0
        self._points = np.empty((0, len(COLUMNS)))

    def points(self, begin: int = 0, end: int | None = None) -> npt.NDArray[np.float64]:
        """Return points `begin` to `end` that are not overwritten yet, oldest first; shape (n, columns)."""
        if end is None:
            end = self.written
        oldest = max(begin, end - self.size, 0)
        slots = np.arange(oldest, end) % self.size
        return self._points[slots]

    def write(self, values: list[float]) -> None:
        """Write the next point."""
        slot = self.written % self.size
        if slot == len(self._points):
            self._grow()
        self._points[slot] = values
        self.written += 1

    def _grow(self) -> None:
        length = min(self.size, max(_FIRST_POINTS, 2 * len(self._points)))
        grown = np.empty((length, len(COLUMNS)))
        grown[: len(self._points)] = self._points
        self._points = grown


class Origin(CommonOrigin):
    """The common origin of all vehicles."""

    def locate(
        self, address: Address, message: VehicleLocalPosition, missing: frozenset[str] = frozenset()
    ) -> Position:
        """Return the position in a message, NaN where invalid; a validity flag in `missing` counts as valid."""
        position = to_global(message)
        north = message.x
        east = message.y
        if position:
            origin = self.update(address, message)
            north, east = origin.project(position.latitude, position.longitude)
        if not message.xy_valid and "xy_valid" not in missing:
            north = east = math.nan
        altitude = -message.z
        if message.z_global:
            altitude += message.ref_alt
        if not message.z_valid and "z_valid" not in missing:
            altitude = math.nan
        return Position(
            east,
            north,
            altitude,
            common=position is not None,
            is_altitude_global=message.z_global,
        )


class PageStream:
    """Histories of one stream; `Monitor` has its newest message.

    `time`: when that arrived [s]. `end`: the sample at the end of the track, if any; `valid`: the last valid position.
    """

    def __init__(
        self,
        sample: Sample[Any],
        time: float,
        truth: PageStream | None,
        origin: Origin,
        long: HistorySize,
    ) -> None:
        self.minute = History(POINTS, _STEP)
        self.long = History(long.points, long.step)
        self.end: Sample[Any] | None = None
        self.valid: Position | None = None
        self.origin = origin
        self._tracker = ResetTracker()
        self._state: object = None
        self._sampled = -math.inf
        self._sampled_long = -math.inf
        self.add(sample, time, truth)

    def add(self, sample: Sample[Any], time: float, truth: PageStream | None) -> None:
        """Add a sample received at `time` [s]; `truth`: the ground truth stream of its vehicle."""
        self.time = time
        if not is_position(sample.address):
            return
        before = self.end
        self.end = sample
        message = sample.message
        state = _state_of(message)
        if state == self._state and time - self._sampled < _STEP:
            return
        if state != self._state and before is not None:
            # the tracker needs the last message before the change
            self._tracker.add(before.message)
        self._state = state
        self._sampled = time
        track = self._tracker.add(message)
        if track.reset & {"xy", "z"} or track.discontinued or track.origin_changed:
            self._interrupt(time)
        point = self._point(sample, time, truth)
        self.minute.write(point)
        if time - self._sampled_long >= self.long.step:
            self._sampled_long = time
            self.long.write(point)

    def _interrupt(self, time: float) -> None:
        """Write a gap, which interrupts the lines."""
        gap = [math.nan for _ in COLUMNS]
        gap[0] = time * 1e3
        self.minute.write(gap)
        self.long.write(gap)
        self._sampled_long = -math.inf

    def _point(self, sample: Sample[Any], time: float, truth: PageStream | None) -> list[float]:
        """Return the point of a message, in the order of COLUMNS."""
        message = sample.message
        missing = sample.provenance.missing
        position = self.origin.locate(sample.address, message, missing)
        if math.isfinite(position.north):
            self.valid = position
        height = math.nan
        if message.z_valid or "z_valid" in missing:
            height = -message.z
        speed = math.nan
        if message.v_xy_valid or "v_xy_valid" in missing:
            speed = math.hypot(message.vx, message.vy)
        return [
            time * 1e3,
            position.east,
            position.north,
            height,
            speed,
            message.eph,
            message.epv,
            _distance(position, message, truth),
            float(message.dead_reckoning or "xy_valid" in missing),
        ]

    def positions_at(self, times: list[float]) -> list[Position | None]:
        """Return the last valid position at each time [s], None before the histories begin."""
        points = np.concatenate([self.long.points(), self.minute.points()])
        points = points[~np.isnan(points[:, 1])]
        points = points[points[:, 0].argsort(kind="stable")]
        numbers = points[:, 0].searchsorted(np.array(times) * 1e3, side="right").tolist()
        positions: list[Position | None] = []
        for number in numbers:
            if number == 0:
                positions.append(None)
                continue
            east, north = points[number - 1, 1:3].tolist()
            positions.append(Position(east, north, math.nan, common=True, is_altitude_global=False))
        return positions


def _distance(position: Position, message: VehicleLocalPosition, truth: PageStream | None) -> float:
    """Return the distance to the ground truth, extrapolated to the same time [m]; NaN if they are not comparable."""
    if truth is None or truth.end is None or not math.isfinite(position.north):
        return math.nan
    real = truth.end.message
    other = truth.origin.locate(truth.end.address, real)
    sampled = message.timestamp_sample or message.timestamp
    real_sampled = real.timestamp_sample or real.timestamp
    seconds = (sampled - real_sampled) / 1e6
    if other.common != position.common or abs(seconds) > _TRUTH_WINDOW:
        return math.nan
    offsets = [
        other.east + real.vy * seconds - position.east,
        other.north + real.vx * seconds - position.north,
        other.altitude - real.vz * seconds - position.altitude,
    ]
    return math.hypot(*(offset for offset in offsets if math.isfinite(offset)))
