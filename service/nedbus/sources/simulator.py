"""Simulated flight: the estimates and other messages of a vehicle as functions of the time since the start.

The vehicle takes off and flies figures of eight at 20 m; each lap of 120 s has typical events of a real flight:

    t = 15 s         heading alignment: a heading reset
    t = 60 to 75 s   GPS outage: dead reckoning, xy invalid after 10 s; resets of xy and vxy at the end
    t = 90 s         z reset
"""

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from random import Random
from typing import Final, NamedTuple

from nedbus.errors import SourceError
from nedbus_msgs import BY_TOPIC, DEFAULT_TOPIC, MESSAGES, Address, VehicleLocalPosition
from nedbus_msgs.frames import MapProjection, euler_to_quaternion, wrap

from .options import SimulatorOptions
from .source import ReplayRun, SourceMessage

_TICK: Final = 0.01  # s: EKF2's own step, and the rate of the estimate on hardware
_ENDLESS: Final = sys.maxsize  # ticks of a flight without an end: 2.9 billion years
_LAP: Final = 120.0  # s
_OUTAGE: Final = (60.0, 75.0)  # s into a lap, without GPS
_ORIGIN_SET: Final = 2.0  # s after the start, when the global origin becomes known
# latitude, longitude [deg], altitude [m]: PX4's default home
_REFERENCE: Final = (47.397742, 8.545594, 488.0)
UPTIME: Final = 1_500_000
"""Time since boot at the start [us]: so short that a restart of the simulation is a possible reboot."""

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

    @property
    def has_origin(self) -> bool:
        """Whether the vehicle knows the origin."""
        return self.time >= _ORIGIN_SET

    @property
    def sampled(self) -> int:
        """Time of the sensor data of an estimate [us]."""
        return self.timestamp - _DELAY


def truth_at(time: float, direction: float, origin: tuple[float, float, float]) -> Truth:
    """Return the ground truth at a time since the start [s]; `direction` rotates the figures [rad]."""
    before = _position(time - _STEP, direction)
    position = _position(time, direction)
    after = _position(time + _STEP, direction)
    velocity = tuple((new - old) / (2 * _STEP) for old, new in zip(before, after, strict=True))
    acceleration = tuple(
        (new - 2 * now + old) / _STEP**2
        for old, now, new in zip(before, position, after, strict=True)
    )
    heading = wrap(direction + math.pi / 4)
    if math.hypot(velocity[0], velocity[1]) > 0.5:
        heading = math.atan2(velocity[1], velocity[0])
    timestamp = UPTIME + round(time * 1e6)
    return Truth(time, timestamp, position, velocity, acceleration, heading, origin)


def _position(time: float, direction: float) -> Vector:
    progress = min(1.0, max(0.0, time / _CLIMB))
    # from 0 to 1 with continuous acceleration
    climb = progress**3 * (10 - 15 * progress + 6 * progress**2)
    # The phase starts slowly near the end of the climb, and then advances by one figure per minute.
    late = max(0.0, time - 8.0)
    phase = math.tau / 60.0 * (late - 6.0 * (1.0 - math.exp(-late / 6.0)))
    along = _SIZE * math.sin(phase)
    across = _SIZE / 2 * math.sin(2 * phase)
    cos = math.cos(direction)
    sin = math.sin(direction)
    down = -climb * (_ALTITUDE + 2.0 * math.sin(phase / 2) ** 2)
    return along * cos - across * sin, along * sin + across * cos, down


class _Errors(NamedTuple):
    """Errors of an estimate [SI units], time in dead reckoning [s], and number and last delta of each kind of reset."""

    position: Vector
    velocity: Vector = (0.0, 0.0, 0.0)
    heading: float = 0.0
    dead_reckoning: float = 0.0
    xy_resets: int = 0  # of position and velocity
    delta_xy: Vector = (0.0, 0.0)
    delta_vxy: Vector = (0.0, 0.0)
    z_resets: int = 0
    delta_z: float = 0.0
    heading_resets: int = 0
    delta_heading: float = 0.0

    @property
    def xy_valid(self) -> bool:
        """Whether the horizontal estimate is valid."""
        return self.dead_reckoning < _VALID_DEAD_RECKONING


class Estimator:
    """Estimator whose error wanders, drifts without GPS, and is reset.

    `noise`: amplitude of the position error [m], 0 for the ground truth; `aided`: position aiding never fails, and
    there are no resets.
    """

    def __init__(self, name: str, seed: int, noise: float, *, aided: bool = False) -> None:
        random = Random(f"{seed}/{name}")
        self._noise = noise
        self._aided = aided
        self._phases = [random.uniform(0.0, math.tau) for _ in range(3)]
        direction = random.uniform(-math.pi, math.pi)  # of the drift
        self._north = math.cos(direction)
        self._east = math.sin(direction)
        self._heading_error = random.choice((-1, 1)) * random.uniform(0.1, 0.3)

    def fields(self, truth: Truth) -> Values:
        """Return the local position; its limits are infinite, as EKF2 sends them."""
        errors = self._errors(truth.time)
        x, y, z = _add(truth.position, errors.position)
        vx, vy, vz = _add(truth.velocity, errors.velocity)
        ax, ay, az = truth.acceleration
        distance = max(0.1, -z)  # of the distance sensor, above flat ground
        fields = {
            **self._deviations(errors),
            "timestamp_sample": truth.sampled,
            "x": x,
            "y": y,
            "z": z,
            "vx": vx,
            "vy": vy,
            "vz": vz,
            "z_deriv": vz,
            "ax": ax,
            "ay": ay,
            "az": az,
            "xy_valid": errors.xy_valid,
            "v_xy_valid": errors.xy_valid,
            "z_valid": True,
            "v_z_valid": True,
            "xy_reset_counter": errors.xy_resets,
            "delta_xy": errors.delta_xy,
            "vxy_reset_counter": errors.xy_resets,
            "delta_vxy": errors.delta_vxy,
            "z_reset_counter": errors.z_resets,
            "delta_z": errors.delta_z,
            "delta_vz": 0.0,
            "heading_reset_counter": errors.heading_resets,
            "delta_heading": errors.delta_heading,
            "heading": wrap(truth.heading + errors.heading),
            "heading_var": 0.001 + errors.heading**2,
            "unaided_heading": truth.heading,
            "heading_good_for_control": self._aided or errors.heading_resets > 0,
            "tilt_var": 1e-4,
            "evh": self._noise / 2 + 0.05 * errors.dead_reckoning,
            "evv": self._noise / 2,
            "vxy_max": math.inf,
            "vz_max": math.inf,
            "hagl_min": math.inf,
            "hagl_max_z": math.inf,
            "hagl_max_xy": math.inf,
            "dist_bottom_valid": distance < _SENSOR_RANGE,
            "dist_bottom": distance,
            "dist_bottom_var": 0.01,
            "delta_dist_bottom": 0.0,
        }
        if distance < _SENSOR_RANGE:
            fields["dist_bottom_sensor_bitfield"] = VehicleLocalPosition.DIST_BOTTOM_SENSOR_RANGE
        if truth.has_origin:
            latitude, longitude, altitude = truth.origin
            fields |= {
                "xy_global": True,
                "z_global": True,
                "ref_timestamp": UPTIME + round(_ORIGIN_SET * 1e6),
                "ref_lat": latitude,
                "ref_lon": longitude,
                "ref_alt": altitude,
            }
        return fields

    def attitude(self, truth: Truth) -> Values:
        """Return the attitude of a multicopter whose thrust causes the acceleration, without wind."""
        errors = self._errors(truth.time)
        ax, ay, az = truth.acceleration
        cos = math.cos(truth.heading)
        sin = math.sin(truth.heading)
        forward = ax * cos + ay * sin
        right = ay * cos - ax * sin
        up = _GRAVITY - az
        roll = math.atan2(right, math.hypot(forward, up))
        pitch = math.atan2(-forward, up)
        return {
            "timestamp_sample": truth.sampled,
            "q": euler_to_quaternion(roll, pitch, truth.heading + errors.heading),
            "delta_q_reset": euler_to_quaternion(0.0, 0.0, errors.delta_heading),
            "quat_reset_counter": errors.heading_resets,
        }

    def global_fields(self, truth: Truth) -> Values:
        """Return the global position, which the vehicle publishes only after the origin is known."""
        errors = self._errors(truth.time)
        position = _add(truth.position, errors.position)
        latitude, longitude, altitude = _to_global(position, truth)
        return {
            **self._deviations(errors),
            "timestamp_sample": truth.sampled,
            "lat": latitude,
            "lon": longitude,
            "alt": altitude,
            "alt_ellipsoid": altitude,
            "lat_lon_valid": errors.xy_valid,
            "alt_valid": True,
            "delta_alt": -errors.delta_z,
            "delta_terrain": 0.0,
            "lat_lon_reset_counter": errors.xy_resets,
            "alt_reset_counter": errors.z_resets,
            "terrain_alt": truth.origin[2],
            "terrain_alt_valid": -position[2] < _SENSOR_RANGE,
        }

    def status(self, truth: Truth) -> Values:
        """Return the status: take-off, then a mission; while the position is invalid, a failsafe in altitude mode."""
        intended = _Status.NAVIGATION_STATE_AUTO_MISSION
        if truth.time < _CLIMB:
            intended = _Status.NAVIGATION_STATE_AUTO_TAKEOFF
        failsafe = not self._errors(truth.time).xy_valid
        mode = intended
        if failsafe:
            mode = _Status.NAVIGATION_STATE_ALTCTL
        return {
            "armed_time": UPTIME - 1_000_000,
            "takeoff_time": UPTIME,
            "arming_state": _Status.ARMING_STATE_ARMED,
            "nav_state": mode,
            "nav_state_display": mode,
            "nav_state_user_intention": intended,
            "failsafe": failsafe,
            "vehicle_type": _Status.VEHICLE_TYPE_ROTARY_WING,
            "system_type": 2,
            "system_id": 1,
            "component_id": 1,
            "safety_off": True,
            "power_input_valid": True,
            "pre_flight_checks_pass": True,
        }

    def _errors(self, time: float) -> _Errors:
        """Return the errors at a time since the start [s]; without aiding, with the events of each lap."""
        x, y, z = (
            self._noise * (math.sin(time / 7.0 + phase) + math.sin(time / 2.3 - phase))
            for phase in self._phases
        )
        if self._aided:
            return _Errors((x, y, z))
        lap, lap_time = divmod(time + _TICK / 2, _LAP)
        xy_resets = int(lap) + (lap_time >= _OUTAGE[1])
        z_resets = int(lap) + (lap_time >= _Z_RESET)
        heading_resets = int(lap) + (lap_time >= _HEADING_RESET)

        dead_reckoning = 0.0
        if _OUTAGE[0] <= lap_time < _OUTAGE[1]:
            dead_reckoning = lap_time - _OUTAGE[0]
        distance, speed = _drift(dead_reckoning)
        corrected_distance = corrected_speed = 0.0
        if xy_resets:
            corrected_distance, corrected_speed = _drift(_OUTAGE[1] - _OUTAGE[0])

        delta_z = 0.0
        if z_resets:
            delta_z = -_Z_STEP
        if z_resets % 2:
            z += _Z_STEP
            delta_z = _Z_STEP

        heading = self._heading_error
        if _HEADING_RESET <= lap_time < _HEADING_DISTURBED:
            heading = 0.0
        delta_heading = 0.0
        if heading_resets:
            delta_heading = -self._heading_error
        return _Errors(
            position=(x + distance * self._north, y + distance * self._east, z),
            velocity=(speed * self._north, speed * self._east, 0.0),
            heading=heading,
            dead_reckoning=dead_reckoning,
            xy_resets=xy_resets,
            delta_xy=(-corrected_distance * self._north, -corrected_distance * self._east),
            delta_vxy=(-corrected_speed * self._north, -corrected_speed * self._east),
            z_resets=z_resets,
            delta_z=delta_z,
            heading_resets=heading_resets,
            delta_heading=delta_heading,
        )

    def _deviations(self, errors: _Errors) -> Values:
        return {
            "eph": self._noise * 2 + _DRIFT * errors.dead_reckoning**2,
            "epv": self._noise * 3,
            "dead_reckoning": errors.dead_reckoning > 0,
        }


def _add(true: Vector, error: Vector) -> Vector:
    return tuple(value + deviation for value, deviation in zip(true, error, strict=True))


def _drift(seconds: float) -> tuple[float, float]:
    """Return the errors of position [m] and velocity [m/s] after `seconds` of dead reckoning."""
    return _DRIFT * seconds**2, 2 * _DRIFT * seconds


def _to_global(position: Vector, truth: Truth) -> tuple[float, float, float]:
    """Return latitude, longitude [deg] and altitude [m] of a local position."""
    north, east, down = position
    latitude, longitude, altitude = truth.origin
    return *MapProjection(latitude, longitude).reproject(north, east), altitude - down


def land_detected(truth: Truth) -> Values:
    """Return the land detector's output: landed until take-off."""
    vx, vy, vz = truth.velocity
    landed = truth.position[2] > -0.1
    return {
        "landed": landed,
        "maybe_landed": landed,
        "ground_contact": landed,
        "at_rest": landed,
        "vertical_movement": abs(vz) > 0.5,
        "horizontal_movement": math.hypot(vx, vy) > 1.5,
        "close_to_ground_or_skipped_check": truth.position[2] > -1.0,
    }


def home(truth: Truth) -> Values:
    """Return the home position, with global coordinates once the origin is known."""
    fields: Values = {
        "x": 0.0,
        "y": 0.0,
        "z": 0.0,
        "roll": 0.0,
        "pitch": 0.0,
        "yaw": truth.heading,
        "valid_lpos": True,
        "valid_attitude": True,
        "update_count": 1,
    }
    if truth.has_origin:
        latitude, longitude, altitude = truth.origin
        fields["lat"] = latitude
        fields["lon"] = longitude
        fields["alt"] = altitude
        fields["valid_hpos"] = True
        fields["valid_alt"] = True
        fields["update_count"] = 2
    return fields


def battery(truth: Truth) -> Values:
    """Return the state of a battery that is discharged by a constant current."""
    discharged = _CURRENT * (truth.time % _ENDURANCE) / 3.6
    remaining = 1.0 - discharged / _CAPACITY
    return {
        "connected": True,
        "id": 1,
        "scale": 1.0,
        "voltage_v": 14.0 + 2.8 * remaining,
        "current_a": _CURRENT,
        "current_average_a": _CURRENT,
        "discharged_mah": discharged,
        "remaining": remaining,
        "capacity": round(_CAPACITY),
        "time_remaining_s": remaining * _CAPACITY * 3.6 / _CURRENT,
        "temperature": 30.0,
        "cell_count": 4,
    }


def gps(truth: Truth) -> Values:
    """Return a noisy GNSS fix, or no fix before the origin is set and during a GPS outage."""
    fields: Values = {"device_id": 1}
    if truth.has_origin:
        fields["time_utc_usec"] = _BOOT_UTC + truth.timestamp
    is_outage = _OUTAGE[0] <= truth.time % _LAP < _OUTAGE[1]
    if is_outage or not truth.has_origin:
        deviations = dict.fromkeys(("eph", "epv", "s_variance_m_s", "hdop", "vdop"), 100.0)
        return {**fields, **deviations, "fix_type": _Gps.FIX_TYPE_NONE}

    noise = tuple(0.3 * math.sin(truth.time * rate) for rate in (1.7, 2.3, 3.1))
    latitude, longitude, altitude = _to_global(_add(truth.position, noise), truth)
    vx, vy, vz = truth.velocity
    return fields | {
        "fix_type": _Gps.FIX_TYPE_3D,
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "altitude_msl_m": altitude,
        "altitude_ellipsoid_m": altitude,
        "eph": 0.9,
        "epv": 1.8,
        "s_variance_m_s": 0.4,
        "hdop": 0.7,
        "vdop": 1.1,
        "satellites_used": 14,
        "vel_ned_valid": True,
        "vel_n_m_s": vx,
        "vel_e_m_s": vy,
        "vel_d_m_s": vz,
        "vel_m_s": math.hypot(vx, vy),
        "cog_rad": math.atan2(vy, vx),
    }


class _Stream(NamedTuple):
    """Ticks at which a message is sent, and its fields that differ from "not provided", without `timestamp`."""

    ticks: range
    fields: Callable[[Truth], Values]


def open_simulator(_: str, options: SimulatorOptions, default_vehicle: str) -> ReplayRun:
    """Start a flight, endless without `duration`; raise SourceError if no requested topic is simulated."""
    vehicle = options.vehicle or default_vehicle
    end = _ENDLESS
    if options.duration is not None:
        end = round(options.duration / _TICK)
    streams = _streams(vehicle, options.seed, end)
    topics = options.chosen_topics
    chosen = {}
    for address, stream in streams.items():
        if stream.ticks and (topics is None or address.topic in topics):
            chosen[address] = stream
    if not chosen:
        asked = ", ".join(sorted(topics or ()))
        known = ", ".join(sorted({address.topic for address in streams}))
        raise SourceError("sim", f"a simulated vehicle has no {asked}; choose from {known}")
    total = None
    length = "endless"
    if options.duration is not None:
        total = sum(len(stream.ticks) for stream in chosen.values())
        length = f"{total} messages, {end * _TICK:g} s"
    return ReplayRun(
        messages=_messages(chosen, end, options),
        addresses=dict.fromkeys(sorted(chosen, key=lambda address: address.topic != DEFAULT_TOPIC)),
        total=total,
        summary=f"vehicle {vehicle}, seed {options.seed}, {length}",
    )


def _streams(vehicle: str, seed: int, end: int) -> dict[Address, _Stream]:
    """Return all streams until tick `end`, in the order of their messages in one tick."""
    first = Estimator("ekf 0", seed, 0.3)
    second = Estimator("ekf 1", seed, 0.5)
    groundtruth = Estimator("groundtruth", seed, 0.0, aided=True)
    ins = Estimator("ins", seed, 0.05, aided=True)
    origin = round(_ORIGIN_SET / _TICK)
    at = partial(Address, vehicle)
    return {
        at("vehicle_local_position_groundtruth"): _Stream(range(0, end, 2), groundtruth.fields),
        at("external_ins_local_position"): _Stream(range(1, end, 2), ins.fields),
        at("estimator_local_position", 0): _Stream(range(0, end, 50), first.fields),
        at("estimator_local_position", 1): _Stream(range(0, end, 50), second.fields),
        at("vehicle_local_position"): _Stream(range(end), first.fields),
        at("vehicle_attitude"): _Stream(range(0, end, 2), first.attitude),
        at("vehicle_global_position"): _Stream(range(origin, end, 10), first.global_fields),
        at("sensor_gps", 0): _Stream(range(0, end, 10), gps),
        at("vehicle_status"): _Stream(range(0, end, 50), first.status),
        at("vehicle_land_detected"): _Stream(range(0, end, 100), land_detected),
        at("battery_status", 0): _Stream(range(0, end, 100), battery),
        at("home_position"): _Stream(range(0, min(end, origin + 1), origin), home),
    }


def _messages(
    streams: Mapping[Address, _Stream], end: int, options: SimulatorOptions
) -> Iterator[SourceMessage]:
    direction = Random(f"{options.seed}/turn").uniform(-math.pi, math.pi)
    origin = options.origin or _REFERENCE
    not_provided = {address: _not_provided(address.topic) for address in streams}
    for tick in range(end):
        time = tick * _TICK
        truth = truth_at(time, direction, origin)
        for address, stream in streams.items():
            if tick in stream.ticks:
                fields = not_provided[address] | stream.fields(truth)
                fields["timestamp"] = truth.timestamp
                yield SourceMessage(time, address, fields)


def _not_provided(topic: str) -> Values:
    """Return all fields of PX4's newest layout, with values that mean "not provided"."""
    layout = BY_TOPIC[topic].layout_of_release("main")
    if layout is None:
        return {}
    return {name: kind.absent for name, kind in layout.types.items()}
