"""A simulated flight that produces all four topics: the same seed gives the same messages, to the bit.

Take-off, then figures of eight at 20 m; every lap of 120 s has what estimates have in real flights:

    t = 15 s         the heading is aligned: a heading reset
    t = 60 to 75 s   no GPS: dead reckoning, growing error, xy invalid after 10 s; at its end resets of xy and vxy
    t = 90 s         a reset of z
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import count
from random import Random
from typing import Final

from nedbus_msgs import FIELD_TYPES, TOPICS, Address, VehicleLocalPosition, wrap

from .record import Flight, Home, Record
from .spec import SimulatorOptions

TICK: Final = 0.01  # s: EKF2's own step, and the rate of the estimate on hardware
LAP: Final = 120.0  # s
HEADING_RESET: Final = 15.0  # s into a lap
OUTAGE: Final = (60.0, 75.0)  # s into a lap without GPS
NO_AID: Final = 10.0  # s of dead reckoning after which the position is no longer valid
Z_RESET: Final = 90.0  # s into a lap
ORIGIN_SET: Final = 2.0  # s after the start: the global origin is known
REFERENCE: Final = (47.397742, 8.545594, 488.0)  # latitude, longitude [deg], altitude [m]: PX4's default home

_BOOT: Final = 10_000_000  # us since boot when the flight starts
_DELAY: Final = 5_000  # us from the sensor data to the estimate
_ALTITUDE: Final = 20.0  # m
_SIZE: Final = 40.0  # m
_SENSOR_RANGE: Final = 30.0  # m: how far down the distance sensor sees

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Truth:
    """Where the vehicle really is: position [m], velocity [m/s], acceleration [m/s^2] in local NED, heading [rad]."""

    position: Vector
    velocity: Vector
    acceleration: Vector
    heading: float


class Trajectory:
    """The flown path as a function of time, turned about the vertical by the seed."""

    def __init__(self, seed: int) -> None:
        self._turn = Random(f"{seed}/turn").uniform(-math.pi, math.pi)

    def at(self, time: float) -> Truth:
        """Return the truth at a time [s] since the start."""
        step = 1e-3
        before, now, after = (self._position(time + shift) for shift in (-step, 0.0, step))
        north, east, down = zip(before, now, after, strict=True)
        velocity = (_slope(north, step), _slope(east, step), _slope(down, step))
        acceleration = (_bend(north, step), _bend(east, step), _bend(down, step))
        moving = math.hypot(velocity[0], velocity[1]) > 0.5
        heading = math.atan2(velocity[1], velocity[0]) if moving else wrap(self._turn + math.pi / 4)
        return Truth(now, velocity, acceleration, heading)

    def _position(self, time: float) -> Vector:
        climb = _ease(time / 10.0)
        # The phase starts slowly after the climb and then advances evenly, one figure a minute.
        late = max(0.0, time - 8.0)
        phase = math.tau / 60.0 * (late - 6.0 * (1.0 - math.exp(-late / 6.0)))
        ahead, aside = _SIZE * math.sin(phase), _SIZE / 2 * math.sin(2 * phase)
        cos, sin = math.cos(self._turn), math.sin(self._turn)
        return (
            ahead * cos - aside * sin,
            ahead * sin + aside * cos,
            -climb * (_ALTITUDE + 2.0 * math.sin(phase / 2) ** 2),
        )


@dataclass(slots=True)
class Resets:
    """The counters and the last deltas of an estimate."""

    delta_xy: tuple[float, float] = (0.0, 0.0)
    xy: int = 0
    delta_z: float = 0.0
    z: int = 0
    delta_vxy: tuple[float, float] = (0.0, 0.0)
    vxy: int = 0
    delta_heading: float = 0.0
    heading: int = 0


@dataclass(slots=True)
class Estimator:
    """An estimate of the truth with errors that wander, drift while there is no GPS, and are reset.

    `noise`: standard deviation of its position error [m]; `aided`: whether it has GPS in an outage too.
    """

    name: str
    seed: int
    noise: float
    aided: bool = False
    resets: Resets = field(default_factory=Resets)
    _random: Random = field(init=False)
    _error: list[float] = field(init=False)
    _drift: list[float] = field(init=False)
    _heading_error: float = field(init=False)
    _gyro: float = 0.0
    _last_heading: float | None = None
    _dark: float = 0.0

    def __post_init__(self) -> None:
        self._random = Random(f"{self.seed}/{self.name}")
        self._error = [self._random.gauss(0.0, self.noise) for _ in range(3)]
        self._drift = [0.0, 0.0]
        self._heading_error = 0.0 if self.aided else self._random.choice((-1, 1)) * self._random.uniform(0.1, 0.3)

    def step(self, lap_time: float, truth: Truth) -> None:
        """Go on by one tick."""
        if not self.aided and OUTAGE[0] <= lap_time < OUTAGE[1]:
            self._drift_away()
        elif self._dark:
            self._reset_position()
        else:
            self._wander()
        if not self.aided and _hits(lap_time, HEADING_RESET):
            self.resets.delta_heading, self._heading_error = -self._heading_error, 0.0
            self.resets.heading = (self.resets.heading + 1) % 256
        if not self.aided and _hits(lap_time, Z_RESET):
            delta = self._random.gauss(0.0, 1.0) - self._error[2]
            self._error[2] += delta
            self.resets.delta_z = delta
            self.resets.z = (self.resets.z + 1) % 256
        # Shortly before the next lap the heading starts to be off again.
        if not self.aided and _hits(lap_time, LAP - 5.0):
            self._heading_error = self._random.gauss(0.0, 0.15)
        turned = wrap(truth.heading - self._last_heading) if self._last_heading is not None else 0.0
        self._gyro = wrap(self._gyro + turned + self._random.gauss(0.0, 2e-5))
        self._last_heading = truth.heading

    def fields(self, time: float, truth: Truth) -> dict[str, object]:
        """Return the message of this moment; the limits of EKF2 are "none"."""
        x, y, z = (value + error for value, error in zip(truth.position, self._error, strict=True))
        vx, vy = truth.velocity[0] + self._drift[0], truth.velocity[1] + self._drift[1]
        vz = truth.velocity[2]
        xy_valid = self._dark < NO_AID
        spread = self.noise * 2 + 0.02 * self._dark**2
        resets = self.resets
        origin = time >= ORIGIN_SET
        none = math.inf
        return {
            **_stamps(time),
            "xy_valid": xy_valid, "z_valid": True, "v_xy_valid": xy_valid, "v_z_valid": True,
            "x": x, "y": y, "z": z,
            "delta_xy": resets.delta_xy, "xy_reset_counter": resets.xy,
            "delta_z": resets.delta_z, "z_reset_counter": resets.z,
            "vx": vx, "vy": vy, "vz": vz, "z_deriv": vz + self._random.gauss(0.0, 0.02),
            "delta_vxy": resets.delta_vxy, "vxy_reset_counter": resets.vxy,
            "delta_vz": 0.0, "vz_reset_counter": 0,
            **dict(zip(("ax", "ay", "az"), truth.acceleration, strict=True)),
            "heading": wrap(truth.heading + self._heading_error), "heading_var": 0.001 + self._heading_error**2,
            "unaided_heading": self._gyro,
            "delta_heading": resets.delta_heading, "heading_reset_counter": resets.heading,
            "heading_good_for_control": resets.heading > 0 or self.aided, "tilt_var": 1e-4,
            **_origin(known=origin),
            **_ground(z),
            "eph": spread, "epv": self.noise * 3, "evh": self.noise / 2 + 0.05 * self._dark, "evv": self.noise / 2,
            "dead_reckoning": self._dark > 0,
            "vxy_max": none, "vz_max": none, "hagl_min": none, "hagl_max_z": none, "hagl_max_xy": none,
        }  # fmt: skip

    def _wander(self) -> None:
        keep = math.exp(-TICK / 20.0)
        kick = self.noise * math.sqrt(1.0 - keep * keep)
        self._error = [keep * error + self._random.gauss(0.0, kick) for error in self._error]

    def _drift_away(self) -> None:
        self._dark += TICK
        for axis in (0, 1):
            self._drift[axis] += self._random.gauss(0.02, 0.2) * TICK
            self._error[axis] += self._drift[axis] * TICK

    def _reset_position(self) -> None:
        """GPS is back: take its position and velocity, and say by how much that moved the estimate."""
        new = [self._random.gauss(0.0, self.noise) for _ in range(2)]
        resets = self.resets
        resets.delta_xy = (new[0] - self._error[0], new[1] - self._error[1])
        resets.delta_vxy = (-self._drift[0], -self._drift[1])
        resets.xy, resets.vxy = (resets.xy + 1) % 256, (resets.vxy + 1) % 256
        self._error[:2], self._drift, self._dark = new, [0.0, 0.0], 0.0


class SimulatorSource:
    """The simulated flight; endless unless its options give a duration."""

    loop = False

    def __init__(self, _: str, options: SimulatorOptions, home: Home) -> None:
        self._vehicle = options.vehicle or home.vehicle
        self._seed = options.seed
        self._ticks = None if options.duration is None else round(options.duration / TICK)
        self.finite = options.duration is not None
        self.speed = None if options.speed == "max" else options.speed
        self.wait = options.wait

    def open(self) -> Flight:
        """Return a new flight."""
        plain = (Address(self._vehicle, topic.name) for topic in TOPICS.values() if not topic.instances)
        estimate, truth, external = plain
        instances = [Address(self._vehicle, "estimator_local_position", instance) for instance in (0, 1)]
        # In every 100 ticks: 100 estimates, 50 truths, 50 external, 2 of each instance.
        total = None if self._ticks is None else 2 * self._ticks + 2 * math.ceil(self._ticks / 50)
        return Flight(
            records=self._records(estimate, truth, external, instances),
            addresses=(estimate, truth, external, *instances),
            total=total,
            summary=f"vehicle {self._vehicle}, seed {self._seed}, "
            + ("endless" if self._ticks is None else f"{total} messages, {self._ticks * TICK:g} s"),
        )

    def _records(
        self, estimate: Address, truth: Address, external: Address, instances: list[Address]
    ) -> Iterator[Record]:
        trajectory = Trajectory(self._seed)
        filters = [Estimator("ekf 0", self._seed, 0.3), Estimator("ekf 1", self._seed, 0.5)]
        ins = Estimator("ins", self._seed, 0.05, aided=True)
        for k in count() if self._ticks is None else range(self._ticks):
            time = k * TICK
            now = trajectory.at(time)
            for estimator in (*filters, ins):
                estimator.step(time % LAP, now)
            if k % 2 == 0:
                yield Record(time, truth, true_fields(time, now))
            else:
                yield Record(time, external, ins.fields(time, now))
            if k % 50 == 0:
                for address, estimator in zip(instances, filters, strict=True):
                    yield Record(time, address, estimator.fields(time, now))
            yield Record(time, estimate, filters[0].fields(time, now))


def true_fields(time: float, truth: Truth) -> dict[str, object]:
    """Return the message of the truth: no variance, no limits (0, as simulators say it)."""
    zero = """z_deriv delta_z delta_vz heading_var delta_heading tilt_var eph epv evh evv
              vxy_max vz_max hagl_min hagl_max_z hagl_max_xy"""
    return {
        **dict.fromkeys(zero.split(), 0.0),
        **dict.fromkeys((name for name, kind in FIELD_TYPES.items() if kind == "uint8"), 0),
        "dead_reckoning": False,
        **_stamps(time),
        **dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid", "heading_good_for_control"), True),
        **dict(zip(("x", "y", "z"), truth.position, strict=True)),
        **dict(zip(("vx", "vy", "vz"), truth.velocity, strict=True)),
        **dict(zip(("ax", "ay", "az"), truth.acceleration, strict=True)),
        "z_deriv": truth.velocity[2],
        "delta_xy": (0.0, 0.0),
        "delta_vxy": (0.0, 0.0),
        "heading": truth.heading,
        "unaided_heading": truth.heading,
        **_origin(known=True),
        **_ground(truth.position[2]),
    }


def _stamps(time: float) -> dict[str, object]:
    now = _BOOT + round(time * 1e6)
    return {"timestamp": now, "timestamp_sample": now - _DELAY}


def _origin(*, known: bool) -> dict[str, object]:
    latitude, longitude, altitude = REFERENCE if known else (math.nan,) * 3
    set_at = _BOOT + round(ORIGIN_SET * 1e6) if known else 0
    return {
        "xy_global": known, "z_global": known, "ref_timestamp": set_at,
        "ref_lat": latitude, "ref_lon": longitude, "ref_alt": altitude,
    }  # fmt: skip


def _ground(z: float) -> dict[str, object]:
    """Return what a distance sensor over flat ground adds."""
    distance = max(0.1, -z)
    seen = distance < _SENSOR_RANGE
    return {
        "dist_bottom_valid": seen,
        "dist_bottom": distance,
        "dist_bottom_var": 0.01,
        "delta_dist_bottom": 0.0,
        "dist_bottom_reset_counter": 0,
        "dist_bottom_sensor_bitfield": VehicleLocalPosition.DIST_BOTTOM_SENSOR_RANGE if seen else 0,
    }


def _ease(part: float) -> float:
    """Go from 0 to 1 without a jump in acceleration."""
    part = min(1.0, max(0.0, part))
    return part**3 * (10 - 15 * part + 6 * part**2)


def _slope(points: tuple[float, ...], step: float) -> float:
    return (points[2] - points[0]) / (2 * step)


def _bend(points: tuple[float, ...], step: float) -> float:
    return (points[2] - 2 * points[1] + points[0]) / step**2


def _hits(lap_time: float, moment: float) -> bool:
    return moment <= lap_time + TICK / 2 < moment + TICK
