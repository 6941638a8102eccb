"""One stream of a page: its last sample and, of positions, the last minute at 10 Hz and longer at 1 Hz; no I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from nedbus.client import Sample
from nedbus_msgs import BY_TOPIC, DEFAULT, Address, MapProjection, ResetTracker, VehicleLocalPosition, to_global

POINTS: Final = 600
"""Points of the last minute."""
LONG: Final = 900, 1.0
"""Points of the history beyond it, and seconds between two of them: a quarter of an hour."""
COLUMNS: Final = ("time", "east", "north", "height", "speed", "eph", "epv", "error", "doubtful")
"""Of a history: ms since the epoch, m, m/s, and 1 while dead reckoning; NaN where the message was not valid.

`height` is above the vehicle's own origin, `speed` horizontal, `error` the distance to the ground truth of then.
"""

_STEP: Final = 0.095  # s between two points
_MAX_TRUTH_AGE: Final = 0.5  # s between an estimate and the ground truth that it is compared with
_state_of = attrgetter(
    "xy_reset_counter", "z_reset_counter", "vxy_reset_counter", "vz_reset_counter", "xy_global", "xy_valid", "z_valid",
    "dead_reckoning",
)  # fmt: skip


def is_position(address: Address) -> bool:
    """Return whether there are positions at an address, which a map and plots can show."""
    return BY_TOPIC.get(address.topic) is DEFAULT


class Place(NamedTuple):
    """The place of a message [m]; `altitude` is above mean sea level where that is known.

    Without a common origin (`common`) east, north and altitude are from the vehicle's own.
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

    def points(self, begin: int = 0, end: int | None = None) -> npt.NDArray[np.float64]:
        """Return the points with these numbers that are still there, in order, shape (n, columns)."""
        end = self.written if end is None else end
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
        """Return the place of a message; NaN where it is not valid."""
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
    """The histories of one stream, of the last minute and longer.

    `last`: the last sample; `time`: when it came [s since the epoch]; `valid`: the last valid place, None without one.
    """

    def __init__(self, origin: Origin, long: tuple[int, float] = LONG) -> None:
        self.minute, self.long = History(POINTS, _STEP), History(*long)
        self.last: Sample[Any] | None = None
        self.time = -math.inf
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
        state = _state_of(sample.message)
        if state == self._state:
            if time - self._sampled < _STEP:
                return
        elif before is not None:
            self._tracker.add(before.message)  # so that the jump is seen between these two
        self._state, self._sampled = state, time
        self._add_point(sample.message, time, truth)

    def places_at(self, times: list[float]) -> list[Place | None]:
        """Return the last valid places at these times [s]; None where the histories do not reach back."""
        points = np.concatenate([self.long.points(), self.minute.points()])
        points = points[~np.isnan(points[:, 1])]
        points = points[points[:, 0].argsort(kind="stable")]
        numbers = points[:, 0].searchsorted(np.array(times) * 1e3, side="right").tolist()
        found = (points[number - 1, 1:3].tolist() if number else None for number in numbers)
        return [None if place is None else Place(place[0], place[1], math.nan, True) for place in found]

    def _add_point(self, message: VehicleLocalPosition, time: float, truth: Stream | None) -> None:
        track, place = self._tracker.add(message), self.origin.place(message)
        if track.reset & {"xy", "z"} or track.discontinued or track.origin_changed:
            gap = [time * 1e3, *[math.nan] * (len(COLUMNS) - 1)]  # the line breaks here
            self.minute.write(gap)
            self.long.write(gap)
            self._sampled_long = -math.inf
        if math.isfinite(place.north):
            self.valid = place
        height = -message.z if message.z_valid else math.nan
        speed = math.hypot(message.vx, message.vy) if message.v_xy_valid else math.nan
        error = _distance(place, message, truth)
        doubtful = float(message.dead_reckoning)
        point = [time * 1e3, place.east, place.north, height, speed, message.eph, message.epv, error, doubtful]
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
    seconds = ((message.timestamp_sample or message.timestamp) - (real.timestamp_sample or real.timestamp)) / 1e6
    if other.common != place.common or abs(seconds) > _MAX_TRUTH_AGE:
        return math.nan
    offsets = [
        other.east + real.vy * seconds - place.east,
        other.north + real.vx * seconds - place.north,
        other.altitude - real.vz * seconds - place.altitude,
    ]
    return math.hypot(*(offset for offset in offsets if math.isfinite(offset)))
