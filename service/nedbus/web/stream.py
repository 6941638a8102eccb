"""What is kept of one stream for a page: the last minute at ten points a second, and longer at fewer; no I/O.

Of other messages than positions only the last one is kept.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Final, NamedTuple

import numpy as np

from nedbus.client import Sample
from nedbus_msgs import BY_TOPIC, DEFAULT, Address, MapProjection, ResetTracker, VehicleLocalPosition, to_global

POINTS: Final = 600
"""Points of the last minute."""

LONG: Final = 900, 1.0
"""Points of the history beyond it, and seconds between two of them: a quarter of an hour."""

COLUMNS: Final = ("time", "east", "north", "height", "speed", "climb", "eph", "epv", "error", "doubtful")
"""Of a history: ms since the epoch, m, m/s, and 1 while dead reckoning; NaN where the message was not valid.

`height` is above the vehicle's own origin, `speed` horizontal, `error` the distance to the ground truth of then.
"""

_ERROR: Final = COLUMNS.index("error")
_STEP: Final = 0.095  # s between two points
_SAME: Final = 0.5  # s between an estimate and the ground truth that it is compared with
_events = attrgetter(
    "xy_reset_counter", "z_reset_counter", "vxy_reset_counter", "vz_reset_counter", "xy_global", "xy_valid", "z_valid",
    "dead_reckoning",
)  # fmt: skip


def is_position(address: Address) -> bool:
    """Return whether there are positions at an address, which a map and plots can show."""
    return BY_TOPIC.get(address.topic) is DEFAULT


class Place(NamedTuple):
    """Where a message is [m]: `altitude` is above mean sea level where that is known, `common`: from the common origin.

    Without a common origin east, north and altitude are from the vehicle's own.
    """

    east: float
    north: float
    altitude: float
    common: bool


class History:
    """A ring of the last points: array of shape (size, columns), of which `written` have been written so far."""

    def __init__(self, size: int, step: float) -> None:
        self.size, self.step = size, step
        self.written = 0
        self._points = np.empty((size, len(COLUMNS)))  # no memory until it is written, as it never is for others

    def points(self, begin: int, end: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        """Return the points with these numbers that are still there, in order, shape (n, columns)."""
        return self._points[np.arange(max(begin, end - self.size, 0), end) % self.size]

    def write(self, values: list[float]) -> None:
        """Write the next point."""
        self._points[self.written % self.size] = values
        self.written += 1


@dataclass(slots=True)
class Origin:
    """The common origin: that of the first message that has one."""

    projection: MapProjection | None = None

    def place(self, message: VehicleLocalPosition) -> Place:
        """Return where a message is; NaN where it is not valid."""
        position = to_global(message)
        north, east = message.x, message.y
        if position:
            self.projection = self.projection or MapProjection(message.ref_lat, message.ref_lon)
            north, east = self.projection.project(position.latitude, position.longitude)
        if not message.xy_valid:
            north = east = math.nan
        altitude = (message.ref_alt if message.z_global else 0.0) - message.z
        return Place(east, north, altitude if message.z_valid else math.nan, bool(position))


class Stream:
    """One stream: its last sample, and its histories: of the last minute, and a longer one.

    `last`: the last sample; `valid`: the last place that was valid, None if none was; `heading` [rad], NaN if unknown.
    """

    def __init__(self, origin: Origin, long: tuple[int, float] = LONG) -> None:
        self.minute, self.long = History(POINTS, _STEP), History(*long)
        self.last: Sample[Any] | None = None
        self.time = -math.inf  # of `last` [s since the epoch]
        self.valid: Place | None = None
        self.origin = origin
        self._tracker = ResetTracker()
        self._state: object = None
        self._sampled = self._sampled_long = -math.inf

    def add(self, sample: Sample[Any], time: float, truth: Stream | None = None) -> None:
        """Add the next sample of the stream at this time [s], beside the ground truth of its vehicle."""
        before, self.last, self.time = self.last, sample, time
        if not is_position(sample.address):
            return
        state = _events(sample.message)
        if state == self._state:
            if time - self._sampled < _STEP:
                return
        elif before is not None:
            self._tracker.add(before.message)  # so that the jump is seen between these two
        self._state, self._sampled = state, time
        self._add_point(sample.message, time, truth)

    @property
    def error(self) -> float:
        """The distance to the ground truth at the last point [m], NaN without one."""
        last = self.minute.points(self.minute.written - 1, self.minute.written)
        return float(last[0, _ERROR]) if len(last) else math.nan

    def _add_point(self, message: VehicleLocalPosition, time: float, truth: Stream | None) -> None:
        track, place = self._tracker.add(message), self.origin.place(message)
        if track.reset & {"xy", "z"} or track.discontinued or track.origin_changed:
            gap = [time * 1e3, *[math.nan] * (len(COLUMNS) - 1)]  # the line breaks here
            self.minute.write(gap)
            self.long.write(gap)
            self._sampled_long = -math.inf
        if math.isfinite(place.north):
            self.valid = place
        speed_north, speed_east = (message.vx, message.vy) if message.v_xy_valid else (math.nan, math.nan)
        point = [
            time * 1e3,
            place.east,
            place.north,
            -message.z if message.z_valid else math.nan,
            math.hypot(speed_north, speed_east),
            -message.vz if message.v_z_valid else math.nan,
            message.eph,
            message.epv,
            _distance(place, message, truth),
            float(message.dead_reckoning),
        ]
        self.minute.write(point)
        if time - self._sampled_long >= self.long.step:
            self._sampled_long = time
            self.long.write(point)


def _distance(place: Place, message: VehicleLocalPosition, truth: Stream | None) -> float:
    """Return the distance to the ground truth of the same moment [m], NaN without one."""
    if truth is None or truth.last is None or not math.isfinite(place.north):
        return math.nan
    real = truth.last.message
    other = truth.origin.place(real)
    seconds = (_moment(message) - _moment(real)) / 1e6
    if other.common != place.common or abs(seconds) > _SAME:
        return math.nan
    offsets = [
        other.east + real.vy * seconds - place.east,
        other.north + real.vx * seconds - place.north,
        other.altitude - real.vz * seconds - place.altitude,
    ]
    return math.hypot(*(offset for offset in offsets if math.isfinite(offset)))


def _moment(message: VehicleLocalPosition) -> int:
    return message.timestamp_sample or message.timestamp
