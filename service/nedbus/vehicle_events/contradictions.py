"""Comparison of the estimate with independent measurements: GNSS, barometer and ground truth."""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

from nedbus import limits
from nedbus_msgs.frames import MapProjection

from . import rules
from .detectors import ChangeDetector, Detection, Finding, detect_nothing, read_fields

AIR_DATA: Final = "vehicle_air_data"


class Reference(NamedTuple):
    """The instrument of a topic with independent measurements, and its fields."""

    instrument: str
    fields: tuple[str, ...]


_GNSS: Final = Reference(
    "GNSS", ("fix_type", "latitude_deg", "longitude_deg", "altitude_msl_m", "eph", "epv")
)
REFERENCES: Final = {
    "vehicle_gps_position": _GNSS,
    "sensor_gps": _GNSS,
    AIR_DATA: Reference("barometer", ("baro_alt_meter", "baro_device_id")),
    "vehicle_local_position_groundtruth": Reference(
        "ground truth", ("x", "y", "z", "ref_lat", "ref_lon", "ref_alt")
    ),
}
"""Topics with independent measurements."""

_ESTIMATE: Final = (
    "x",
    "y",
    "z",
    "vx",
    "vy",
    "z_valid",
    "xy_valid",
    "z_global",
    "ref_lat",
    "ref_lon",
    "ref_alt",
)
# us of the vehicle's clock, of each of which the first measurement is compared
_INTERVAL: Final = 400_000
# us by which comparisons follow the estimate: topics are written and sent in any order
_DELAY: Final = 500_000
# us between the estimates before and after a measurement; it is not compared with those further apart
_ADJACENT: Final = 500_000
_FRESH: Final = 1_500_000  # us for which a comparison is valid
_TWO_G: Final = 19.6  # m/s^2


class ReferenceDetector(ChangeDetector):
    """Detector for a topic in REFERENCES: collects its measurements, and runs the topic's `own` detection."""

    def __init__(self, topic: str, comparison: Comparison, own: Detection | None) -> None:
        reference = REFERENCES[topic]
        if own is None:
            own = Detection((), (), detect_nothing)
        super().__init__(*own)
        self._name = reference.instrument
        self._read_reference = read_fields(reference.fields, math.nan)
        self._comparison = comparison
        self._interval = -1

    def add(self, message: object, missing: frozenset[str]) -> Iterator[Finding] | None:
        """Return the topic's own findings, None if nothing has changed; remember the measurement."""
        findings = super().add(message, missing)
        interval = self.stamp // _INTERVAL
        if interval != self._interval:
            self._interval = interval
            values = self._read_reference(message)
            # fields of AIR_DATA may have any type
            if all(isinstance(value, int | float) for value in values):
                self._comparison.remember(_Measurement(self.stamp, self._name, values))
        return findings

    def reset(self) -> None:
        """Discard the state after a reboot of the vehicle."""
        super().reset()
        self._interval = -1
        self._comparison.reset()


class _Measurement(NamedTuple):
    stamp: int
    name: str
    values: tuple[float, ...]


class _Message(NamedTuple):
    """A message of the estimate, and the names of its fields that were not provided."""

    stamp: int
    fields: object
    missing: frozenset[str]


class _Estimate(NamedTuple):
    """Fields of _ESTIMATE."""

    x: float
    y: float
    z: float
    vx: float
    vy: float
    z_valid: float
    xy_valid: float
    z_global: float
    latitude: float
    longitude: float
    altitude: float

    @property
    def has_origin(self) -> bool:
        return math.isfinite(self.altitude)

    @property
    def height(self) -> float:
        """Height above sea level, or above the unknown altitude of the origin [m]."""
        if self.has_origin:
            return self.altitude - self.z
        return -self.z

    @property
    def speed(self) -> float:
        return math.hypot(self.vx, self.vy)

    @property
    def height_limit(self) -> float:
        if math.isnan(self.z):
            return rules.HEIGHT_LIMIT
        return rules.HEIGHT_LIMIT + rules.HEIGHT_SHARE * abs(self.z)

    @property
    def distance_limit(self) -> float:
        return rules.POSITION_LIMIT + rules.GNSS_DELAY * self.speed


class Comparison:
    """Comparison of a valid estimate with all references, by PX4's timestamps alone.

    A measurement is compared with the estimate at its time, between the messages before and after it, once the
    estimate is _DELAY ahead. So a log, its conversion, its replay and a recording of that give the same result.
    """

    def __init__(self) -> None:
        self._read = read_fields(_ESTIMATE, math.nan)
        self.reset()

    def reset(self) -> None:
        """Discard the state after a reboot of the vehicle."""
        self._height = _Contradiction("height")
        self._position = _Contradiction("position")
        self._origin = _Contradiction("origin")
        self._offsets: dict[str, _Offset] = {}  # by reference
        self._waiting: list[_Measurement] = []  # by time
        self._estimates: deque[_Message] = deque(maxlen=limits.COMPARED_MESSAGES)

    def remember(self, measurement: _Measurement) -> None:
        """Add a measurement, which is compared later."""
        insort(self._waiting, measurement)
        if len(self._waiting) > limits.COMPARED_MESSAGES:  # the last ones have damaged times
            self._waiting.pop()

    def add_estimate(self, stamp: int, message: object, missing: frozenset[str]) -> list[Finding]:
        """Add a message of the estimate; return contradictions that began or ended, with their ages."""
        estimates = self._estimates
        if estimates and stamp <= estimates[-1].stamp:
            if stamp < estimates[-1].stamp - _DELAY:  # the last time was damaged
                estimates.clear()
            return []
        estimates.append(_Message(stamp, message, missing))
        findings: list[Finding] = []
        while self._waiting and self._waiting[0].stamp <= stamp - _DELAY:
            measurement = self._waiting.pop(0)
            delay = (stamp - measurement.stamp) / 1e6
            changes = self._compare(measurement)
            findings += [replace(finding, age=finding.age + delay) for finding in changes]
        while estimates[0].stamp < stamp - 2 * _DELAY - _ADJACENT:
            estimates.popleft()
        return findings

    def _compare(self, measurement: _Measurement) -> list[Finding]:
        """Compare a measurement with the estimate at its time; return contradictions that begin or end."""
        estimate = self._estimate_at(measurement.stamp)
        if estimate is None:
            return []
        error = self._error(measurement, estimate)
        name = measurement.name
        stamp = measurement.stamp
        changes = [
            self._height.update(name, stamp, error.height, error.height_limit),
            self._position.update(name, stamp, error.distance, error.distance_limit),
        ]
        if name == "GNSS" and estimate.z_global == 1 and not self._height.since:
            limit = self._limit_of_origin(error)
            changes.append(self._origin.update(name, stamp, error.altitude, limit))
        return [change for change in changes if change is not None]

    def _error(self, measurement: _Measurement, estimate: _Estimate) -> _Error:
        if measurement.name == "barometer":
            return self._error_of_barometer(measurement, estimate)
        if measurement.name == "ground truth":
            return self._error_of_truth(measurement, estimate)
        return self._error_of_gnss(measurement, estimate)

    def _limit_of_origin(self, error: _Error) -> float:
        """Return the limit of the origin's error [m].

        A climb and a worse accuracy increase the limit of a height. An origin that is wrong stays wrong meanwhile.
        """
        if self._origin.is_reported:
            return min(error.height_limit, self._origin.smallest_limit)
        return error.height_limit

    def _estimate_at(self, stamp: int) -> _Estimate | None:
        """Return the valid part of the estimate at this time; None between messages that are far apart or missing."""
        index = bisect_left(self._estimates, stamp, key=lambda message: message.stamp)
        if not 0 < index < len(self._estimates):
            return None
        before = self._estimates[index - 1]
        after = self._estimates[index]
        if after.stamp - before.stamp > _ADJACENT:
            return None
        estimate = self._interpolate(before, after, stamp)
        missing = before.missing | after.missing
        if estimate.z_valid != 1 or "z_valid" in missing:
            self._offsets.clear()
            estimate = estimate._replace(z=math.nan)
        if estimate.xy_valid != 1 or "xy_valid" in missing:
            estimate = estimate._replace(x=math.nan, y=math.nan)
        return estimate

    def _interpolate(self, before: _Message, after: _Message, stamp: int) -> _Estimate:
        old = _Estimate(*self._read(before.fields))
        new = _Estimate(*self._read(after.fields))
        share = (stamp - before.stamp) / (after.stamp - before.stamp)

        def between(first: float, second: float) -> float:
            return first + share * (second - first)

        return new._replace(
            x=between(old.x, new.x),
            y=between(old.y, new.y),
            z=between(old.z, new.z),
            vx=between(old.vx, new.vx),
            vy=between(old.vy, new.vy),
            z_valid=min(old.z_valid, new.z_valid),
            xy_valid=min(old.xy_valid, new.xy_valid),
        )

    def _error_of_barometer(self, measurement: _Measurement, estimate: _Estimate) -> _Error:
        """Return the change of the height difference, which a standard atmosphere and dynamic pressure limit."""
        height, device = measurement.values
        if height > rules.TROPOPAUSE:
            return _Error()
        error = self._relative("barometer", estimate.height - height, (device, estimate.has_origin))
        climbed = self._relative("climb", height, device)
        limit = estimate.height_limit + estimate.speed**2 / _TWO_G + atmosphere_error(climbed)
        return _Error(height=error, height_limit=limit)

    def _error_of_truth(self, measurement: _Measurement, estimate: _Estimate) -> _Error:
        """Return the errors in the local frame, whose origin differs by a constant."""
        x, y, z, latitude, longitude, altitude = measurement.values
        height = self._relative("ground truth", estimate.height - altitude + z, estimate.has_origin)
        if math.isfinite(estimate.latitude):
            projection = MapProjection(estimate.latitude, estimate.longitude)
            north, east = projection.project(latitude, longitude)
            distance = math.hypot(estimate.x - x - north, estimate.y - y - east)
        elif math.isfinite(estimate.x + estimate.y):
            north = self._relative("north", estimate.x - x, None)
            east = self._relative("east", estimate.y - y, None)
            distance = math.hypot(north, east)
        else:
            distance = math.nan
        return _Error(height, distance, math.nan, estimate.height_limit, estimate.distance_limit)

    def _error_of_gnss(self, measurement: _Measurement, estimate: _Estimate) -> _Error:
        """Return the errors in height, position and altitude.

        The height is off only if its change since the first comparison is off, too: else the origin's altitude is.
        """
        fix_type, latitude, longitude, altitude, eph, epv = measurement.values
        if fix_type < rules.MIN_FIX_TYPE or not (latitude or longitude):
            return _Error()
        error = estimate.altitude - estimate.z - altitude
        change = self._relative("GNSS", error, None)
        height = min(error, change, key=abs)
        # on opposite sides: the altitude and its change do not support each other
        if error * change < 0.0:
            height = 0.0
        projection = MapProjection(estimate.latitude, estimate.longitude)
        north, east = projection.project(latitude, longitude)
        return _Error(
            height=height,
            distance=math.hypot(estimate.x - north, estimate.y - east),
            altitude=error,
            height_limit=estimate.height_limit + rules.SIGMAS * _accuracy(epv),
            distance_limit=estimate.distance_limit + rules.SIGMAS * _accuracy(eph),
        )

    def _relative(self, name: str, difference: float, origin: object) -> float:
        """Return the change of a difference since the first one with this origin; NaN if it is unknown."""
        if not math.isfinite(difference):
            return math.nan
        known = self._offsets.get(name)
        if known is None or known.origin != origin:
            known = _Offset(origin, difference)
            self._offsets[name] = known
        return difference - known.difference


def _accuracy(value: float) -> float:
    """Return the accuracy of a GNSS receiver [m], or a usual one if it provides none."""
    if value > 0.0:
        return value
    return rules.UNKNOWN_ACCURACY


def atmosphere_error(climbed: float) -> float:
    """Return the possible error of a barometer's height [m] after a climb [m].

    PX4 computes it with the International Standard Atmosphere, whose temperature profile is 15 degrees C at sea level,
    less 6.5 K per km up to 11 km. By the hypsometric equation (ISO 2533; WMO-No. 8, chapter 3) the true thickness of a
    layer is proportional to its mean temperature in K: an error of 1 % of the climb per 3 degrees. ATMOSPHERE_SHARE
    covers a day that is 45 degrees colder or warmer.
    """
    return rules.ATMOSPHERE_SHARE * abs(climbed)


class _Error(NamedTuple):
    """Errors [m], NaN if unknown, and their limits: of the height, the horizontal position and the altitude."""

    height: float = math.nan
    distance: float = math.nan
    altitude: float = math.nan
    height_limit: float = math.inf
    distance_limit: float = math.inf


class _Offset(NamedTuple):
    """The first difference between estimate and reference since an origin was set [m]."""

    origin: object
    difference: float


class _Measured(NamedTuple):
    """The error that a reference last showed: its time [us], its size and its limit [m]."""

    stamp: int
    error: float
    limit: float


@dataclass(slots=True)
class _Contradiction:
    """State of one quantity, contradicted while all errors exceed their limits in the same direction.

    `errors`: the last one of each reference. `since`: time when all exceeded their limits [us], or 0.
    `smallest_limit`: of those that were exceeded since then [m].
    """

    quantity: str
    errors: dict[str, _Measured] = field(default_factory=dict)
    since: int = 0
    worst: float = 0.0
    smallest_limit: float = math.inf
    is_reported: bool = False

    def update(
        self,
        name: str,
        stamp: int,
        error: float,
        limit: float,
    ) -> Finding | None:
        """Add an error, NaN if not measured; return the finding that begins or ends a contradiction, if any."""
        self.errors[name] = _Measured(stamp, error, limit)
        if not self.since and not abs(error) > limit:
            return None
        fresh = {
            reference: measured
            for reference, measured in self.errors.items()
            if abs(stamp - measured.stamp) <= _FRESH and math.isfinite(measured.error)
        }
        if not self._do_all_contradict(fresh.values()):
            return self._end()
        self.since = self.since or stamp
        self.worst = max(self.worst, error, key=abs)
        self.smallest_limit = min(self.smallest_limit, limit)
        lasted = (stamp - self.since) / 1e6
        if self.is_reported or lasted < rules.CONTRADICTED[self.quantity]:
            return None
        self.is_reported = True
        return self._begin(" and ".join(sorted(fresh)), lasted)

    def _do_all_contradict(self, errors: Collection[_Measured]) -> bool:
        """Return whether all errors exceed their limits in the same direction; a single one must exceed it twice."""
        is_alone = self.quantity != "position" and len(errors) == 1
        factor = 2.0 if is_alone else 1.0
        exceed = [abs(measured.error) > factor * measured.limit for measured in errors]
        signs = {math.copysign(1.0, measured.error) for measured in errors}
        return all(exceed) and len(signs) == 1

    def _end(self) -> Finding | None:
        was_reported = self.is_reported
        self.is_reported = False
        self.since = 0
        self.worst = 0.0
        self.smallest_limit = math.inf
        if not was_reported:
            return None
        text = f"{self.quantity} no longer contradicted"
        return Finding(f"{self.quantity}_contradicted", "end", text)

    def _begin(self, references: str, lasted: float) -> Finding:
        size = f"{abs(self.worst):.0f} m"
        side = "below"
        if self.worst > 0.0:
            side = "above"
        if self.quantity == "height":
            text = f"height {size} {side} {references} while z_valid is true"
        elif self.quantity == "position":
            text = f"position {size} off {references} while xy_valid is true"
        else:
            text = f"origin altitude (ref_alt) {size} {side} {references} (z is right)"
        numbers = {"distance": self.worst}
        return Finding(f"{self.quantity}_contradicted", "begin", text, numbers=numbers, age=lasted)
