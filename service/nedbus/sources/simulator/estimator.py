"""The simulated estimator: errors, an outage of GPS and resets, and the messages that it sends.

Every lap of 120 s has what estimates have in real flights:

    t = 15 s         the heading is aligned: a heading reset
    t = 60 to 75 s   no GPS: dead reckoning, growing error, xy invalid after 10 s; at its end resets of xy and vxy
    t = 90 s         a reset of z
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from random import Random
from typing import Any, Final

from nedbus_msgs import MapProjection, VehicleLocalPosition, euler_to_quaternion, wrap

from .trajectory import Truth

TICK: Final = 0.01  # s: EKF2's own step, and the rate of the estimate on hardware
LAP: Final = 120.0  # s
OUTAGE: Final = (60.0, 75.0)  # s into a lap, without GPS
ORIGIN_SET: Final = 2.0  # s after the start: the global origin is known
REFERENCE: Final = (47.397742, 8.545594, 488.0)  # latitude, longitude [deg], altitude [m]: PX4's default home
BOOT: Final = 10_000_000  # us since boot at the start
PROJECTION: Final = MapProjection(*REFERENCE[:2])

_HEADING_RESET: Final = 15.0  # s into a lap
_MAX_DEAD_RECKONING: Final = 10.0  # s after which the position is no longer valid
_Z_RESET: Final = 90.0  # s into a lap
_HEADING_DISTURBED: Final = LAP - 5.0  # s into a lap: the error that the next heading reset corrects
_DELAY: Final = 5_000  # us from the sensor data to the estimate
_SENSOR_RANGE: Final = 30.0  # m, of the distance sensor
_GRAVITY: Final = 9.80665  # m/s^2


class Estimator:
    """An estimate of the truth with errors that wander, drift without GPS, and are reset.

    `noise`: standard deviation of its position error [m]; `aided`: it has position aiding in the outage too.
    """

    def __init__(self, name: str, seed: int, noise: float, *, aided: bool = False) -> None:
        self._noise = noise
        self._aided = aided
        self._random = Random(f"{seed}/{name}")
        self._error = [self._random.gauss(0.0, noise) for _ in range(3)]
        self._drift = [0.0, 0.0]
        self._heading_error = 0.0 if aided else self._random.choice((-1, 1)) * self._random.uniform(0.1, 0.3)
        self._dead_reckoning = 0.0  # s since the last position aiding
        self._counters = dict.fromkeys(("xy", "z", "vxy", "vz", "heading"), 0)
        self._deltas: dict[str, Any] = {"xy": (0.0, 0.0), "z": 0.0, "vxy": (0.0, 0.0), "vz": 0.0, "heading": 0.0}

    def step(self, lap_time: float, truth: Truth) -> None:
        """Advance by one tick."""
        if not self._aided and OUTAGE[0] <= lap_time < OUTAGE[1]:
            self._drift_away()
        elif self._dead_reckoning:
            self._reset_position()
        else:
            self._wander()
        if not self._aided:
            self._disturb(lap_time)

    def fields(self, time: float, truth: Truth) -> dict[str, object]:
        """Return the message of this moment; EKF2's limits are infinite."""
        position = [value + error for value, error in zip(truth.position, self._error, strict=True)]
        velocity = [value + drift for value, drift in zip(truth.velocity, (*self._drift, 0.0), strict=True)]
        return {
            **_motion(time, position, velocity, truth.acceleration, origin=time >= ORIGIN_SET),
            **dict.fromkeys(("xy_valid", "v_xy_valid"), self.xy_valid), "z_valid": True, "v_z_valid": True,
            **{f"delta_{name}": delta for name, delta in self._deltas.items()},
            **{f"{name}_reset_counter": count for name, count in self._counters.items()},
            "heading": wrap(truth.heading + self._heading_error), "heading_var": 0.001 + self._heading_error**2,
            "unaided_heading": truth.heading,
            "heading_good_for_control": self._counters["heading"] > 0 or self._aided, "tilt_var": 1e-4,
            "eph": self._spread, "epv": self._noise * 3,
            "evh": self._noise / 2 + 0.05 * self._dead_reckoning, "evv": self._noise / 2,
            "dead_reckoning": self._dead_reckoning > 0,
            **dict.fromkeys(("vxy_max", "vz_max", "hagl_min", "hagl_max_z", "hagl_max_xy"), math.inf),
        }  # fmt: skip

    def attitude(self, time: float, truth: Truth) -> dict[str, object]:
        """Return the attitude: the tilt is that of a multicopter's thrust, which makes the acceleration; no wind."""
        ax, ay, az = truth.acceleration
        cos, sin = math.cos(truth.heading), math.sin(truth.heading)
        forward, right, up = ax * cos + ay * sin, ay * cos - ax * sin, _GRAVITY - az
        roll = math.atan2(right, math.hypot(forward, up))
        q = euler_to_quaternion(roll, math.atan2(-forward, up), truth.heading + self._heading_error)
        delta = euler_to_quaternion(0.0, 0.0, self._deltas["heading"])
        return {**_timestamps(time), "q": q, "delta_q_reset": delta, "quat_reset_counter": self._counters["heading"]}

    def global_fields(self, time: float, truth: Truth) -> dict[str, object]:
        """Return the global position; there is one once the origin is known."""
        x, y, z = (value + error for value, error in zip(truth.position, self._error, strict=True))
        (latitude, longitude), altitude = PROJECTION.reproject(x, y), REFERENCE[2]
        return {
            **_timestamps(time),
            "lat": latitude, "lon": longitude, "alt": altitude - z, "alt_ellipsoid": altitude - z,
            "lat_lon_valid": self.xy_valid, "alt_valid": True, "delta_alt": -self._deltas["z"], "delta_terrain": 0.0,
            "lat_lon_reset_counter": self._counters["xy"], "alt_reset_counter": self._counters["z"],
            "eph": self._spread, "epv": self._noise * 3,
            "terrain_alt": altitude, "terrain_alt_valid": -z < _SENSOR_RANGE,
            "dead_reckoning": self._dead_reckoning > 0,
        }  # fmt: skip

    @property
    def xy_valid(self) -> bool:
        """Validity of its horizontal position and velocity."""
        return self._dead_reckoning < _MAX_DEAD_RECKONING

    @property
    def _spread(self) -> float:
        return self._noise * 2 + 0.02 * self._dead_reckoning**2

    def _wander(self) -> None:
        keep = math.exp(-TICK / 20.0)
        kick = self._noise * math.sqrt(1.0 - keep * keep)
        self._error = [keep * error + self._random.gauss(0.0, kick) for error in self._error]

    def _drift_away(self) -> None:
        self._dead_reckoning += TICK
        for axis in (0, 1):
            self._drift[axis] += self._random.gauss(0.02, 0.2) * TICK
            self._error[axis] += self._drift[axis] * TICK

    def _disturb(self, lap_time: float) -> None:
        """Reset heading and height, and give the heading the error that the next reset corrects."""
        if _is_at(lap_time, _HEADING_RESET):
            self._reset("heading", -self._heading_error)
            self._heading_error = 0.0
        elif _is_at(lap_time, _Z_RESET):
            delta = self._random.gauss(0.0, 1.0) - self._error[2]
            self._error[2] += delta
            self._reset("z", delta)
        elif _is_at(lap_time, _HEADING_DISTURBED):
            self._heading_error = self._random.gauss(0.0, 0.15)

    def _reset_position(self) -> None:
        """Reset position and velocity to those of GPS, which is back."""
        new = [self._random.gauss(0.0, self._noise) for _ in range(2)]
        self._reset("xy", (new[0] - self._error[0], new[1] - self._error[1]))
        self._reset("vxy", (-self._drift[0], -self._drift[1]))
        self._error[:2], self._drift, self._dead_reckoning = new, [0.0, 0.0], 0.0

    def _reset(self, name: str, delta: float | tuple[float, float]) -> None:
        self._deltas[name], self._counters[name] = delta, (self._counters[name] + 1) % 256


def truth_fields(time: float, truth: Truth) -> dict[str, object]:
    """Return the groundtruth message: variances and limits are 0, as simulators send them."""
    return {
        **{name: 0.0 if kind.is_float else 0 for name, kind in VehicleLocalPosition.DEFINITION.types.items()},
        **_motion(time, truth.position, truth.velocity, truth.acceleration, origin=True),
        **dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid", "heading_good_for_control"), True),
        "dead_reckoning": False, "delta_xy": (0.0, 0.0), "delta_vxy": (0.0, 0.0),
        "heading": truth.heading, "unaided_heading": truth.heading,
    }  # fmt: skip


def _timestamps(time: float) -> dict[str, object]:
    timestamp = BOOT + round(time * 1e6)
    return {"timestamp": timestamp, "timestamp_sample": timestamp - _DELAY}


def _motion(
    time: float, position: Sequence[float], velocity: Sequence[float], acceleration: Sequence[float], *, origin: bool
) -> dict[str, object]:
    """Return the fields that estimate and truth have in common, with a distance sensor above flat ground."""
    latitude, longitude, altitude = REFERENCE if origin else (math.nan,) * 3
    names, distance = ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az"), max(0.1, -position[2])
    in_range = distance < _SENSOR_RANGE
    return {
        **_timestamps(time),
        **dict(zip(names, (*position, *velocity, *acceleration), strict=True)), "z_deriv": velocity[2],
        "xy_global": origin, "z_global": origin, "ref_timestamp": BOOT + round(ORIGIN_SET * 1e6) if origin else 0,
        "ref_lat": latitude, "ref_lon": longitude, "ref_alt": altitude,
        "dist_bottom_valid": in_range, "dist_bottom": distance, "dist_bottom_var": 0.01,
        "delta_dist_bottom": 0.0, "dist_bottom_reset_counter": 0,
        "dist_bottom_sensor_bitfield": VehicleLocalPosition.DIST_BOTTOM_SENSOR_RANGE if in_range else 0,
    }  # fmt: skip


def _is_at(lap_time: float, moment: float) -> bool:
    return moment <= lap_time + TICK / 2 < moment + TICK
