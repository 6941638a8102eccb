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
# number of points in the long history, and seconds between two points: 15 minutes
LONG: Final = 900, 1.0
COLUMNS: Final = ("time", "east", "north", "height", "speed", "eph", "epv", "error", "doubtful")
"""Columns of a history, NaN where the message was not valid.

`time`: ms since the Unix epoch or the start of a recording.
`doubtful`: 1 while dead reckoning or if the validity is unknown, else 0.
`speed`: horizontal [m/s]. The others are in m: `height` above the vehicle's own origin, `error` from the ground truth.
"""

_STEP: Final = 0.095  # s between two points
_MAX_TRUTH_AGE: Final = 0.5  # s between an estimate and the ground truth it is compared with
_state_of = attrgetter(
    "xy_reset_counter", "z_reset_counter", "vxy_reset_counter", "vz_reset_counter", "xy_global", "xy_valid", "z_valid",
    "dead_reckoning",
)  # fmt: skip


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
    """Ring buffer of the newest `size` points; `written` counts all points written so far."""

    def __init__(self, size: int, step: float) -> None:
        self.size, self.step = size, step
        self.written = 0
        # uses no memory until written, and only positions are written
        self._points = np.empty((size, len(COLUMNS)))

    def points(self, begin: int = 0, end: int | None = None) -> npt.NDArray[np.float64]:
        """Return points `begin` to `end` that are not overwritten yet, oldest first; shape (n, columns)."""
        end = self.written if end is None else end
        return self._points[np.arange(max(begin, end - self.size, 0), end) % self.size]

    def write(self, values: list[float]) -> None:
        """Write the next point."""
        self._points[self.written % self.size] = values
        self.written += 1


class Origin(CommonOrigin):
    """The common origin of all vehicles."""

    def locate(
        self, address: Address, message: VehicleLocalPosition, missing: frozenset[str] = frozenset()
    ) -> Position:
        """Return the position in a message, NaN where invalid; a validity flag in `missing` counts as valid."""
        position = to_global(message)
        north, east = message.x, message.y
        if position:
            north, east = self.update(address, message).project(
                position.latitude, position.longitude
            )
        if not (message.xy_valid or "xy_valid" in missing):
            north = east = math.nan
        altitude = (message.ref_alt if message.z_global else 0.0) - message.z
        has_height = message.z_valid or "z_valid" in missing
        return Position(
            east, north, altitude if has_height else math.nan, bool(position), message.z_global
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
        long: tuple[int, float],
    ) -> None:
        self.minute, self.long = History(POINTS, _STEP), History(*long)
        self.end: Sample[Any] | None = None
        self.valid: Position | None = None
        self.origin = origin
        self._tracker = ResetTracker()
        self._state: object = None
        self._sampled = self._sampled_long = -math.inf
        self.add(sample, time, truth)

    def add(self, sample: Sample[Any], time: float, truth: PageStream | None) -> None:
        """Add a sample received at `time` [s]; `truth`: the ground truth stream of its vehicle."""
        self.time = time
        if not is_position(sample.address):
            return
        before, self.end = self.end, sample
        state = _state_of(sample.message)
        if state == self._state:
            if time - self._sampled < _STEP:
                return
        elif before is not None:
            # the tracker needs the last message before the change
            self._tracker.add(before.message)
        self._state, self._sampled = state, time
        message, missing = sample.message, sample.provenance.missing
        track = self._tracker.add(message)
        position = self.origin.locate(sample.address, message, missing)
        if track.reset & {"xy", "z"} or track.discontinued or track.origin_changed:
            gap = [time * 1e3, *[math.nan] * (len(COLUMNS) - 1)]  # interrupts the line
            self.minute.write(gap)
            self.long.write(gap)
            self._sampled_long = -math.inf
        if math.isfinite(position.north):
            self.valid = position
        height = -message.z if message.z_valid or "z_valid" in missing else math.nan
        speed = (
            math.hypot(message.vx, message.vy)
            if message.v_xy_valid or "v_xy_valid" in missing
            else math.nan
        )
        error = _distance(position, message, truth)
        doubtful = float(message.dead_reckoning or "xy_valid" in missing)
        point = [
            time * 1e3,
            position.east,
            position.north,
            height,
            speed,
            message.eph,
            message.epv,
            error,
            doubtful,
        ]
        self.minute.write(point)
        if time - self._sampled_long >= self.long.step:
            self._sampled_long = time
            self.long.write(point)

    def positions_at(self, times: list[float]) -> list[Position | None]:
        """Return the last valid position at each time [s], None before the histories begin."""
        points = np.concatenate([self.long.points(), self.minute.points()])
        points = points[~np.isnan(points[:, 1])]
        points = points[points[:, 0].argsort(kind="stable")]
        numbers = points[:, 0].searchsorted(np.array(times) * 1e3, side="right").tolist()
        found = (points[number - 1, 1:3].tolist() if number else None for number in numbers)
        return [
            None
            if point is None
            else Position(point[0], point[1], math.nan, common=True, is_altitude_global=False)
            for point in found
        ]


def _distance(position: Position, message: VehicleLocalPosition, truth: PageStream | None) -> float:
    """Return the distance to the ground truth, extrapolated to the same time [m]; NaN if they are not comparable."""
    if truth is None or truth.end is None or not math.isfinite(position.north):
        return math.nan
    real = truth.end.message
    other = truth.origin.locate(truth.end.address, real)
    seconds = (
        (message.timestamp_sample or message.timestamp) - (real.timestamp_sample or real.timestamp)
    ) / 1e6
    if other.common != position.common or abs(seconds) > _MAX_TRUTH_AGE:
        return math.nan
    offsets = [
        other.east + real.vy * seconds - position.east,
        other.north + real.vx * seconds - position.north,
        other.altitude - real.vz * seconds - position.altitude,
    ]
    return math.hypot(*(offset for offset in offsets if math.isfinite(offset)))
