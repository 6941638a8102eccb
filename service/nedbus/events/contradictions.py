"""Comparison of the estimate with independent measurements: GNSS, barometer and ground truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import chain
from typing import Final

from nedbus_msgs.frames import MapProjection

from . import rules
from .detectors import ChangeDetector, Detection, Finding, read_fields

AIR_DATA: Final = "vehicle_air_data"
_GNSS: Final = ("GNSS", ("fix_type", "latitude_deg", "longitude_deg", "altitude_msl_m", "eph", "epv"))
REFERENCES: Final = {
    "vehicle_gps_position": _GNSS, "sensor_gps": _GNSS, AIR_DATA: ("barometer", ("baro_alt_meter", "baro_device_id")),
    "vehicle_local_position_groundtruth": ("ground truth", ("x", "y", "z", "ref_lat", "ref_lon", "ref_alt")),
}  # fmt: skip
"""Topics with independent measurements, each with its instrument and its fields."""

_ESTIMATE: Final = ("x", "y", "z", "vx", "vy", "z_valid", "xy_valid", "ref_lat", "ref_lon", "ref_alt")
_INTERVAL: Final = 390_000  # us between comparisons with a reference
_MAX_AGE: Final = 500_000  # us between a measurement and the estimate
_FRESH: Final = 1_500_000  # us for which a comparison is valid
_TWO_G: Final = 19.6  # m/s^2


class ReferenceDetector(ChangeDetector):
    """Detector for a topic in REFERENCES: compares the estimate with it, and runs the topic's `own` detection."""

    def __init__(self, topic: str, comparison: Comparison, own: Detection | None) -> None:
        self._name, fields = REFERENCES[topic]
        super().__init__(*(own or (fields, (), lambda _, __: iter(()))))
        self._read_reference = read_fields(fields, math.nan)
        self._comparison, self._compared = comparison, 0
        self.pause = 0.0 if own else 1.05e-6 * _INTERVAL

    def add(self, message: object, missing: frozenset[str]) -> Iterator[Finding] | None:
        """Return the topic's own findings and the contradictions that begin or end; None if nothing has changed."""
        found = super().add(message, missing)
        if 0 <= self.stamp - self._compared < _INTERVAL:
            return found
        self._compared, values = self.stamp, self._read_reference(message)
        if not all(isinstance(each, int | float) for each in values):  # fields of AIR_DATA may have any type
            return found
        new = self._comparison.add(self._name, self.stamp, values)
        return chain(found or (), new) if new else found

    def reset(self) -> None:
        """Discard the state after a reboot of the vehicle."""
        super().reset()
        self._compared = 0
        self._comparison.reset()


class Comparison:
    """Comparison of a valid estimate with all references; `position` returns the detector of the estimate in use."""

    def __init__(self, position: Callable[[], ChangeDetector | None]) -> None:
        self._estimate = position
        self._read = read_fields(_ESTIMATE, math.nan)
        self.reset()

    def reset(self) -> None:
        """Discard the state after a reboot of the vehicle."""
        self._height, self._position = _Contradiction("height", "z"), _Contradiction("position", "xy")
        self._offsets: dict[str, tuple[object, float]] = {}  # origin and first difference, by reference

    def add(self, name: str, stamp: int, values: tuple[float, ...]) -> list[Finding]:
        """Compare the estimate with a reference's fields; return contradictions that begin or end."""
        position = self._estimate()
        if position is None or abs(stamp - position.stamp) > _MAX_AGE:
            return []
        x, y, z, vx, vy, z_valid, xy_valid, latitude, longitude, altitude = self._read(position.last)
        has_origin, speed = math.isfinite(altitude), math.hypot(vx, vy)
        height, up, distance = (altitude if has_origin else 0.0) - z, math.nan, math.nan
        height_limit = rules.HEIGHT_LIMIT + rules.HEIGHT_SHARE * abs(z)
        limit = rules.POSITION_LIMIT + rules.GNSS_DELAY * speed
        project = MapProjection(latitude, longitude).project
        if name == "barometer":
            up = self._relative(name, height - values[0], (values[1], has_origin))
            height_limit += speed * speed / _TWO_G  # dynamic pressure error
        elif name == "ground truth":
            up = self._relative(name, height - values[5] + values[2], has_origin)
            distance = math.dist((x - values[0], y - values[1]), project(values[3], values[4]))
        elif values[0] >= rules.MIN_FIX_TYPE and (values[1] or values[2]):
            up, distance = altitude - z - values[3], math.dist((x, y), project(values[1], values[2]))
            eph, epv = (each if each > 0.0 else rules.UNKNOWN_ACCURACY for each in values[4:])
            height_limit, limit = height_limit + rules.SIGMAS * epv, limit + rules.SIGMAS * eph
        if z_valid != 1 or "z_valid" in position.missing:
            up = math.nan
            self._offsets.clear()
        if xy_valid != 1 or "xy_valid" in position.missing:
            distance = math.nan
        found = self._height.update(name, stamp, up, height_limit), self._position.update(name, stamp, distance, limit)
        return [each for each in found if each]

    def _relative(self, name: str, difference: float, origin: object) -> float:
        """Return the change of a height difference since the first comparison with this origin."""
        if name not in self._offsets or self._offsets[name][0] != origin:
            self._offsets[name] = (origin, difference)
        return difference - self._offsets[name][1]


@dataclass(slots=True)
class _Contradiction:
    """State of one quantity, contradicted while all errors exceed their limits in the same direction.

    `errors`: last time [us], error and limit [m] by reference. `since`: time when all exceeded their limits [us], or 0.
    """

    quantity: str
    flag: str
    errors: dict[str, tuple[int, float, float]] = field(default_factory=dict)
    since: int = 0
    worst: float = 0.0
    text: str = ""

    def update(self, name: str, stamp: int, error: float, limit: float) -> Finding | None:
        """Add an error, NaN if not measured; return the finding that begins or ends a contradiction, if any."""
        self.errors[name] = (stamp, error, limit)
        if not self.since and not abs(error) > limit:
            return None
        kind, text = f"{self.quantity}_contradicted", self.text
        fresh = {
            each: (off, most)
            for each, (time, off, most) in self.errors.items()
            if abs(stamp - time) <= _FRESH and math.isfinite(off)
        }
        factor = 2.0 if self.quantity == "height" and len(fresh) == 1 else 1.0
        directions = {math.copysign(abs(off) > factor * most, off) for off, most in fresh.values()}
        if directions not in ({1.0}, {-1.0}):
            self.since, self.worst, self.text = 0, 0.0, ""
            return Finding(kind, "end", f"{self.quantity} no longer contradicted") if text else None
        self.since, self.worst = self.since or stamp, max(self.worst, error, key=abs)
        lasted = (stamp - self.since) / 1e6
        if lasted < rules.CONTRADICTED[self.quantity]:
            return None
        side = "off" if self.quantity == "position" else "above" if self.worst > 0.0 else "below"
        self.text = f"{self.quantity} {abs(self.worst):.0f} m {side} {' and '.join(sorted(fresh))}"
        numbers = {"distance": self.worst}
        begin = Finding(kind, "begin", f"{self.text} while {self.flag}_valid is true", numbers=numbers, age=lasted)
        return None if text else begin
