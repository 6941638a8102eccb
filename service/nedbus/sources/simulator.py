"""Simulated flight: the estimates and other messages of a vehicle as functions of the time since the start.

The vehicle takes off and flies figures of eight at 20 m; each lap of 120 s has typical events of a real flight:

    t = 15 s         heading alignment: a heading reset
    t = 60 to 75 s   GPS outage: dead reckoning, xy invalid after 10 s; resets of xy and vxy at the end
    t = 90 s         z reset
"""

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import count
from random import Random
from typing import Any, Final, NamedTuple

from nedbus.errors import SourceError
from nedbus_msgs import BY_TOPIC, DEFAULT_TOPIC, MESSAGES, Address, VehicleLocalPosition
from nedbus_msgs.frames import MapProjection, euler_to_quaternion, wrap

from .options import SimulatorOptions
from .source import ReplayRun, SourceMessage

_TICK: Final = 0.01  # s: EKF2's own step, and the rate of the estimate on hardware
_LAP: Final = 120.0  # s
_OUTAGE: Final = (60.0, 75.0)  # s into a lap, without GPS
_ORIGIN_SET: Final = 2.0  # s after the start, when the global origin becomes known
# latitude, longitude [deg], altitude [m]: PX4's default home
_REFERENCE: Final = (47.397742, 8.545594, 488.0)
_BOOT: Final = 10_000_000  # us since boot at the start

_HEADING_RESET: Final = 15.0  # s into a lap
_VALID_DEAD_RECKONING: Final = 10.0  # s until the position becomes invalid
_Z_RESET: Final = 90.0  # s into a lap
# s into a lap: start of the heading error that the next heading reset corrects
_HEADING_DISTURBED: Final = _LAP - 5.0
_Z_STEP: Final = 1.0  # m, alternately up and down
_DRIFT: Final = 0.02  # m/s^2, half the acceleration of the position error in dead reckoning
_DELAY: Final = 5_000  # us from the sensor data to the estimate
_SENSOR_RANGE: Final = 30.0  # m, of the distance sensor
_GRAVITY: Final = 9.80665  # m/s^2

_ALTITUDE: Final = 20.0  # m
_CLIMB: Final = 10.0  # s to this altitude
_SIZE: Final = 40.0  # m, from the centre of a figure to each end
_STEP: Final = 1e-3  # s, step of the numerical derivatives

_Status: Final = MESSAGES["VehicleStatus"].model
_Gps: Final = MESSAGES["SensorGps"].model
_CAPACITY: Final = 5000.0  # mAh
_CURRENT: Final = 12.0  # A
_ENDURANCE: Final = 1200.0  # s until the battery, then at 20 %, is replaced by a full one
_BOOT_UTC: Final = 1_767_225_600_000_000  # us of Unix time at boot: start of 2026

Vector = tuple[float, ...]  # north, east, down
Values = dict[str, object]  # the fields of a message, by name


class Truth(NamedTuple):
    """Ground truth at a time since the start [s]: timestamp [us], motion in local NED [SI units], origin [deg, m]."""

    time: float
    timestamp: int
    position: Vector
    velocity: Vector
    acceleration: Vector
    heading: float
    origin: tuple[float, float, float]


def truth_at(time: float, direction: float, origin: tuple[float, float, float]) -> Truth:
    """Return the ground truth at a time since the start [s]; `direction` rotates the figures [rad]."""
    positions = [_position(time + offset, direction) for offset in (-_STEP, 0.0, _STEP)]
    axes = list(zip(*positions, strict=True))
    velocity = tuple((after - before) / (2 * _STEP) for before, _, after in axes)
    acceleration = tuple((after - 2 * now + before) / _STEP**2 for before, now, after in axes)
    moving = math.hypot(velocity[0], velocity[1]) > 0.5
    heading = math.atan2(velocity[1], velocity[0]) if moving else wrap(direction + math.pi / 4)
    return Truth(
        time, _BOOT + round(time * 1e6), positions[1], velocity, acceleration, heading, origin
    )


def _position(time: float, direction: float) -> Vector:
    progress = min(1.0, max(0.0, time / _CLIMB))
    # from 0 to 1 with continuous acceleration
    climb = progress**3 * (10 - 15 * progress + 6 * progress**2)
    # The phase starts slowly near the end of the climb, and then advances by one figure per minute.
    late = max(0.0, time - 8.0)
    phase = math.tau / 60.0 * (late - 6.0 * (1.0 - math.exp(-late / 6.0)))
    along, across = _SIZE * math.sin(phase), _SIZE / 2 * math.sin(2 * phase)
    cos, sin = math.cos(direction), math.sin(direction)
    down = -climb * (_ALTITUDE + 2.0 * math.sin(phase / 2) ** 2)
    return along * cos - across * sin, along * sin + across * cos, down


class _State(NamedTuple):
    """State of an estimate: errors [SI units], time in dead reckoning [s], validity, counts and deltas of resets."""

    position: tuple[float, float, float]
    velocity: tuple[float, float, float]
    heading: float
    dead_reckoning: float
    xy_valid: bool
    counters: Mapping[str, int]
    deltas: Mapping[str, Any]


class Estimator:
    """Estimator whose error wanders, drifts without GPS, and is reset.

    `noise`: amplitude of the position error [m]; `aided`: position aiding never fails, and there are no resets.
    """

    def __init__(self, name: str, seed: int, noise: float, *, aided: bool = False) -> None:
        random = Random(f"{seed}/{name}")
        self._noise, self._aided = noise, aided
        self._phases = [random.uniform(0.0, math.tau) for _ in range(3)]
        direction = random.uniform(-math.pi, math.pi)
        self._north, self._east = math.cos(direction), math.sin(direction)  # direction of the drift
        self._heading_error = 0.0 if aided else random.choice((-1, 1)) * random.uniform(0.1, 0.3)

    def fields(self, truth: Truth) -> Values:
        """Return the local position; its limits are infinite, as EKF2 sends them."""
        state = self._at(truth.time)
        position = [
            value + error for value, error in zip(truth.position, state.position, strict=True)
        ]
        velocity = [
            value + error for value, error in zip(truth.velocity, state.velocity, strict=True)
        ]
        return {
            **_motion(position, velocity, truth, has_origin=truth.time >= _ORIGIN_SET),
            **dict.fromkeys(("xy_valid", "v_xy_valid"), state.xy_valid), "z_valid": True, "v_z_valid": True,
            **{f"delta_{name}": delta for name, delta in state.deltas.items()},
            **{f"{name}_reset_counter": count for name, count in state.counters.items()},
            "heading": wrap(truth.heading + state.heading), "heading_var": 0.001 + state.heading**2,
            "unaided_heading": truth.heading,
            "heading_good_for_control": state.counters["heading"] > 0 or self._aided, "tilt_var": 1e-4,
            **self._deviations(state),
            "evh": self._noise / 2 + 0.05 * state.dead_reckoning, "evv": self._noise / 2,
            **dict.fromkeys(("vxy_max", "vz_max", "hagl_min", "hagl_max_z", "hagl_max_xy"), math.inf),
        }  # fmt: skip

    def attitude(self, truth: Truth) -> Values:
        """Return the attitude of a multicopter whose thrust causes the acceleration, without wind."""
        state, (ax, ay, az) = self._at(truth.time), truth.acceleration
        cos, sin = math.cos(truth.heading), math.sin(truth.heading)
        forward = ax * cos + ay * sin
        right = ay * cos - ax * sin
        up = _GRAVITY - az
        roll = math.atan2(right, math.hypot(forward, up))
        q = euler_to_quaternion(roll, math.atan2(-forward, up), truth.heading + state.heading)
        delta = euler_to_quaternion(0.0, 0.0, state.deltas["heading"])
        return {
            "timestamp_sample": truth.timestamp - _DELAY,
            "q": q, "delta_q_reset": delta, "quat_reset_counter": state.counters["heading"],
        }  # fmt: skip

    def global_fields(self, truth: Truth) -> Values:
        """Return the global position, which the vehicle publishes only after the origin is known."""
        state = self._at(truth.time)
        x, y, z = (
            value + error for value, error in zip(truth.position, state.position, strict=True)
        )
        (latitude, longitude) = MapProjection(*truth.origin[:2]).reproject(x, y)
        altitude = truth.origin[2]
        return {
            "timestamp_sample": truth.timestamp - _DELAY,
            "lat": latitude, "lon": longitude, "alt": altitude - z, "alt_ellipsoid": altitude - z,
            "lat_lon_valid": state.xy_valid, "alt_valid": True, "delta_alt": -state.deltas["z"], "delta_terrain": 0.0,
            "lat_lon_reset_counter": state.counters["xy"], "alt_reset_counter": state.counters["z"],
            **self._deviations(state),
            "terrain_alt": altitude, "terrain_alt_valid": -z < _SENSOR_RANGE,
        }  # fmt: skip

    def status(self, truth: Truth) -> Values:
        """Return the status: take-off, then a mission; while the position is invalid, a failsafe in altitude mode."""
        failsafe, is_mission = not self._at(truth.time).xy_valid, truth.time >= _CLIMB
        flown = (
            _Status.NAVIGATION_STATE_AUTO_MISSION
            if is_mission
            else _Status.NAVIGATION_STATE_AUTO_TAKEOFF
        )
        mode = _Status.NAVIGATION_STATE_ALTCTL if failsafe else flown
        return {
            "armed_time": _BOOT - 1_000_000, "takeoff_time": _BOOT, "arming_state": _Status.ARMING_STATE_ARMED,
            "nav_state": mode, "nav_state_display": mode, "nav_state_user_intention": flown, "failsafe": failsafe,
            "vehicle_type": _Status.VEHICLE_TYPE_ROTARY_WING, "system_type": 2, "system_id": 1, "component_id": 1,
            "safety_off": True, "power_input_valid": True, "pre_flight_checks_pass": True,
        }  # fmt: skip

    def _at(self, time: float) -> _State:
        lap, lap_time = (0.0, 0.0) if self._aided else divmod(time + _TICK / 2, _LAP)
        outages, steps, alignments = (
            int(lap) + (lap_time >= end) for end in (_OUTAGE[1], _Z_RESET, _HEADING_RESET)
        )
        dead_reckoning = lap_time - _OUTAGE[0] if _OUTAGE[0] <= lap_time < _OUTAGE[1] else 0.0
        moved, speed = self._drift(dead_reckoning)
        corrected, slowed = self._drift(_OUTAGE[0] - _OUTAGE[1] if outages else 0.0)
        x, y, z = (
            self._noise * (math.sin(time / 7.0 + each) + math.sin(time / 2.3 - each))
            for each in self._phases
        )
        return _State(
            position=(x + moved[0], y + moved[1], z + _Z_STEP * (steps % 2)),
            velocity=(*speed, 0.0),
            heading=0.0 if _HEADING_RESET <= lap_time < _HEADING_DISTURBED else self._heading_error,
            dead_reckoning=dead_reckoning,
            xy_valid=dead_reckoning < _VALID_DEAD_RECKONING,
            counters={"xy": outages, "z": steps, "vxy": outages, "vz": 0, "heading": alignments},
            deltas={
                "xy": (-corrected[0], -corrected[1]), "vxy": slowed, "vz": 0.0,
                "z": _Z_STEP * (1 if steps % 2 else -1) if steps else 0.0,
                "heading": -self._heading_error if alignments else 0.0,
            },
        )  # fmt: skip

    def _drift(self, seconds: float) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the errors of position and velocity after `seconds` of dead reckoning."""
        moved, speed = _DRIFT * seconds**2, 2 * _DRIFT * seconds
        return (moved * self._north, moved * self._east), (speed * self._north, speed * self._east)

    def _deviations(self, state: _State) -> Values:
        return {
            "eph": self._noise * 2 + _DRIFT * state.dead_reckoning**2, "epv": self._noise * 3,
            "dead_reckoning": state.dead_reckoning > 0,
        }  # fmt: skip


def truth_fields(truth: Truth) -> Values:
    """Return the groundtruth message: variances and limits are 0, as simulators send them."""
    return {
        **{name: 0.0 if kind.is_float else 0 for name, kind in VehicleLocalPosition.DEFINITION.types.items()},
        **_motion(truth.position, truth.velocity, truth, has_origin=True),
        **dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid", "heading_good_for_control"), True),
        "dead_reckoning": False, "delta_xy": (0.0, 0.0), "delta_vxy": (0.0, 0.0),
        "heading": truth.heading, "unaided_heading": truth.heading,
    }  # fmt: skip


def _motion(
    position: Sequence[float], velocity: Sequence[float], truth: Truth, *, has_origin: bool
) -> Values:
    """Return the fields common to estimate and truth, with a distance sensor above flat ground."""
    latitude, longitude, altitude = truth.origin if has_origin else (math.nan,) * 3
    names, distance = ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az"), max(0.1, -position[2])
    in_range = distance < _SENSOR_RANGE
    return {
        "timestamp_sample": truth.timestamp - _DELAY,
        **dict(zip(names, (*position, *velocity, *truth.acceleration), strict=True)), "z_deriv": velocity[2],
        "xy_global": has_origin, "z_global": has_origin,
        "ref_timestamp": _BOOT + round(_ORIGIN_SET * 1e6) if has_origin else 0,
        "ref_lat": latitude, "ref_lon": longitude, "ref_alt": altitude,
        "dist_bottom_valid": in_range, "dist_bottom": distance, "dist_bottom_var": 0.01,
        "delta_dist_bottom": 0.0, "dist_bottom_reset_counter": 0,
        "dist_bottom_sensor_bitfield": VehicleLocalPosition.DIST_BOTTOM_SENSOR_RANGE if in_range else 0,
    }  # fmt: skip


def land_detected(truth: Truth) -> Values:
    """Return the land detector's output: landed until take-off."""
    (vx, vy, vz), landed = truth.velocity, truth.position[2] > -0.1
    return {
        **dict.fromkeys(("landed", "maybe_landed", "ground_contact", "at_rest"), landed),
        "vertical_movement": abs(vz) > 0.5, "horizontal_movement": math.hypot(vx, vy) > 1.5,
        "close_to_ground_or_skipped_check": truth.position[2] > -1.0,
    }  # fmt: skip


def home(truth: Truth) -> Values:
    """Return the home position, with global coordinates once the origin is known."""
    known = truth.time >= _ORIGIN_SET
    latitude, longitude, altitude = truth.origin if known else (math.nan,) * 3
    return {
        "lat": latitude, "lon": longitude, "alt": altitude,
        "x": 0.0, "y": 0.0, "z": 0.0, "roll": 0.0, "pitch": 0.0, "yaw": truth.heading,
        "valid_hpos": known, "valid_alt": known, "valid_lpos": True, "valid_attitude": True,
        "update_count": 1 + known,
    }  # fmt: skip


def battery(truth: Truth) -> Values:
    """Return the state of a battery that is discharged by a constant current."""
    discharged = _CURRENT * (truth.time % _ENDURANCE) / 3.6
    remaining = 1.0 - discharged / _CAPACITY
    return {
        "connected": True, "id": 1, "scale": 1.0,
        "voltage_v": 14.0 + 2.8 * remaining, "current_a": _CURRENT, "current_average_a": _CURRENT,
        "discharged_mah": discharged, "remaining": remaining, "capacity": round(_CAPACITY),
        "time_remaining_s": remaining * _CAPACITY * 3.6 / _CURRENT, "temperature": 30.0, "cell_count": 4,
    }  # fmt: skip


def gps(truth: Truth) -> Values:
    """Return a noisy GNSS fix, or no fix before the origin is set and during a GPS outage."""
    time, is_started = truth.time, truth.time >= _ORIGIN_SET
    fix = is_started and not _OUTAGE[0] <= time % _LAP < _OUTAGE[1]
    noise = [0.3 * math.sin(time * rate) for rate in (1.7, 2.3, 3.1)]
    north, east, down = (value + error for value, error in zip(truth.position, noise, strict=True))
    latitude, longitude = (
        MapProjection(*truth.origin[:2]).reproject(north, east) if fix else (math.nan, math.nan)
    )
    altitude = truth.origin[2] - down if fix else math.nan
    vx, vy, vz = truth.velocity if fix else (math.nan,) * 3
    return {
        "device_id": 1, "fix_type": _Gps.FIX_TYPE_3D if fix else _Gps.FIX_TYPE_NONE,
        "latitude_deg": latitude, "longitude_deg": longitude,
        "altitude_msl_m": altitude, "altitude_ellipsoid_m": altitude,
        "eph": 0.9 if fix else 100.0, "epv": 1.8 if fix else 100.0, "s_variance_m_s": 0.4 if fix else 100.0,
        "hdop": 0.7 if fix else 100.0, "vdop": 1.1 if fix else 100.0, "satellites_used": 14 if fix else 0,
        "vel_ned_valid": fix, "vel_n_m_s": vx, "vel_e_m_s": vy, "vel_d_m_s": vz,
        "vel_m_s": math.hypot(vx, vy), "cog_rad": math.atan2(vy, vx),
        "time_utc_usec": _BOOT_UTC + truth.timestamp if is_started else 0,
    }  # fmt: skip


Fields = Callable[[Truth], Values]  # except `timestamp`
Streams = dict[Address, tuple[range, Fields]]  # the ticks and the fields of the messages


def open_simulator(_: str, options: SimulatorOptions, default_vehicle: str) -> ReplayRun:
    """Start a flight, endless without `duration`; raise SourceError if no requested topic is simulated."""
    vehicle, topics = options.vehicle or default_vehicle, options.chosen_topics
    ticks = None if options.duration is None else round(options.duration / _TICK)
    streams = _streams(vehicle, options.seed, sys.maxsize if ticks is None else ticks)
    chosen = {
        at: each
        for at, each in streams.items()
        if each[0] and (topics is None or at.topic in topics)
    }
    if not chosen:
        asked = ", ".join(sorted(topics or ()))
        known = ", ".join(sorted({address.topic for address in streams}))
        raise SourceError("sim", f"a simulated vehicle has no {asked}; choose from {known}")
    total = None if ticks is None else sum(len(ticks) for ticks, _ in chosen.values())
    length = "endless" if ticks is None else f"{total} messages, {ticks * _TICK:g} s"
    return ReplayRun(
        messages=_messages(chosen, options.seed, ticks, options.origin or _REFERENCE),
        addresses=dict.fromkeys(sorted(chosen, key=lambda address: address.topic != DEFAULT_TOPIC)),
        total=total,
        summary=f"vehicle {vehicle}, seed {options.seed}, {length}",
    )


def _streams(vehicle: str, seed: int, end: int) -> Streams:
    """Return the ticks and the fields of all streams, in the order of their messages in one tick."""
    first, second = (Estimator(f"ekf {each}", seed, noise) for each, noise in enumerate((0.3, 0.5)))
    ins = Estimator("ins", seed, 0.05, aided=True)
    origin = round(_ORIGIN_SET / _TICK)
    at = partial(Address, vehicle)
    return {
        at("vehicle_local_position_groundtruth"): (range(0, end, 2), truth_fields),
        at("external_ins_local_position"): (range(1, end, 2), ins.fields),
        at("estimator_local_position", 0): (range(0, end, 50), first.fields),
        at("estimator_local_position", 1): (range(0, end, 50), second.fields),
        at("vehicle_local_position"): (range(end), first.fields),
        at("vehicle_attitude"): (range(0, end, 2), first.attitude),
        at("vehicle_global_position"): (range(origin, end, 10), first.global_fields),
        at("sensor_gps", 0): (range(0, end, 10), gps),
        at("vehicle_status"): (range(0, end, 50), first.status),
        at("vehicle_land_detected"): (range(0, end, 100), land_detected),
        at("battery_status", 0): (range(0, end, 100), battery),
        at("home_position"): (range(0, min(end, origin + 1), origin), home),
    }


def _messages(
    chosen: Streams, seed: int, ticks: int | None, origin: tuple[float, float, float]
) -> Iterator[SourceMessage]:
    direction = Random(f"{seed}/turn").uniform(-math.pi, math.pi)
    absent = {}  # fields of PX4's newest layout, with values that mean "not provided"
    for address in chosen:
        layout = BY_TOPIC[address.topic].layout_of_release("main")
        absent[address] = (
            {name: kind.absent for name, kind in layout.types.items()} if layout else {}
        )
    for tick in count() if ticks is None else range(ticks):
        time = tick * _TICK
        now = truth_at(time, direction, origin)
        for address, (when, fields) in chosen.items():
            if tick in when:
                yield SourceMessage(
                    time, address, absent[address] | fields(now) | {"timestamp": now.timestamp}
                )
