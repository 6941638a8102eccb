"""Conversion of individual MAVLink messages to fields of PX4's messages; unknown values are None."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

from nedbus_msgs import MESSAGES
from nedbus_msgs.frames import euler_to_quaternion, quaternion_to_euler, wrap

_U8: Final = 2**8 - 1  # "unknown", or more
_U16: Final = 2**16 - 1  # "unknown" in most fields of this type
# MAV_BATTERY_CHARGE_STATE to `warning`
_WARNINGS: Final = {1: 0, 2: 1, 3: 2, 4: 3, 5: 4, 6: 6, 7: 7}
# MAV_STATE to `failsafe`: standby, active, critical
_FAILSAFE: Final = {3: False, 4: False, 5: True}
_POSE_FRAMES: Final = {1: 1, 20: 2}  # MAV_FRAME to `pose_frame`: local NED, local FRD
_VELOCITY_FRAMES: Final = {**_POSE_FRAMES, 12: 3}  # 12: body FRD
_ARMED, _HIL = 128, 32  # bits of base_mode
_TRANSITIONS: Final = {
    dialect.MAV_VTOL_STATE_TRANSITION_TO_FW,
    dialect.MAV_VTOL_STATE_TRANSITION_TO_MC,
}
_VTOL_STATES: Final = {*_TRANSITIONS, dialect.MAV_VTOL_STATE_FW, dialect.MAV_VTOL_STATE_MC}
_MULTICOPTERS: Final = {
    dialect.MAV_TYPE_QUADROTOR, dialect.MAV_TYPE_COAXIAL, dialect.MAV_TYPE_HELICOPTER, dialect.MAV_TYPE_HEXAROTOR,
    dialect.MAV_TYPE_OCTOROTOR, dialect.MAV_TYPE_TRICOPTER, dialect.MAV_TYPE_DODECAROTOR, dialect.MAV_TYPE_DECAROTOR,
}  # fmt: skip


def _number(value: int, unit: float, *unknown: int) -> float | None:
    return None if value in unknown else value / unit


def _quaternion(*q: float) -> tuple[float, ...] | None:
    """Return a quaternion; None if it is unknown: not finite, or all zeros, as from MAVSDK's server."""
    return q if math.isfinite(sum(q)) and any(q) else None


def _variances(covariance: Sequence[float], *indices: int) -> tuple[float, ...] | None:
    """Return the variances at these indices; None if all are zero, because nothing is exact."""
    variances = tuple(covariance[index] for index in indices)
    return variances if any(variances) else None


def _global_position(message: Any) -> dict[str, object]:
    """Convert GLOBAL_POSITION_INT; other autopilots than PX4 send zeros until they have a position."""
    if not (message.lat or message.lon):
        return {}
    return {"lat": message.lat / 1e7, "lon": message.lon / 1e7, "alt": message.alt / 1e3}


def _attitude(message: Any) -> dict[str, object]:
    """Convert ATTITUDE_QUATERNION."""
    return {"q": _quaternion(message.q1, message.q2, message.q3, message.q4)}


def _home(message: Any) -> dict[str, object]:
    """Convert HOME_POSITION, which PX4 sends only with a valid global position; other programs send zeros before."""
    if not (message.latitude or message.longitude):
        return {}
    q = _quaternion(*message.q)
    angles = (None, None, None) if q is None else quaternion_to_euler(q)
    local = (each if math.isfinite(each) else None for each in (message.x, message.y, message.z))
    return {
        "lat": message.latitude / 1e7, "lon": message.longitude / 1e7, "alt": message.altitude / 1e3,
        "valid_hpos": True, "valid_alt": True,
        **dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), (*local, *angles), strict=True)),
    }  # fmt: skip


def _gps(message: Any) -> dict[str, object]:
    if message.satellites_visible == 255 and message.fix_type < 2:
        return {"fix_type": message.fix_type}  # no GPS receiver, or no data from it
    course = _number(message.cog, 100, _U16)
    heading = _number(message.yaw, 100, 0, _U16)
    return {
        # above 6 MAVLink and PX4 differ
        "fix_type": message.fix_type if message.fix_type <= 6 else None,
        "latitude_deg": message.lat / 1e7, "longitude_deg": message.lon / 1e7, "altitude_msl_m": message.alt / 1e3,
        "altitude_ellipsoid_m": _number(message.alt_ellipsoid, 1e3, 0),
        "eph": _number(message.h_acc, 1e3, 0), "epv": _number(message.v_acc, 1e3, 0),
        "s_variance_m_s": _number(message.vel_acc, 1e3, 0),
        "hdop": _number(message.eph, 100, 0, _U16), "vdop": _number(message.epv, 100, 0, _U16),
        "vel_m_s": _number(message.vel, 100, _U16), "cog_rad": None if course is None else math.radians(course),
        "heading": None if heading is None else wrap(math.radians(heading)),
        "satellites_used": None if message.satellites_visible == 255 else message.satellites_visible,
    }  # fmt: skip


def _status(message: Any) -> dict[str, object]:
    """Convert HEARTBEAT, without nav_state, which custom_mode does not contain."""
    model = MESSAGES["VehicleStatus"].model
    is_armed = message.base_mode & _ARMED
    return {
        "arming_state": model.ARMING_STATE_ARMED if is_armed else model.ARMING_STATE_DISARMED,
        "hil_state": int(bool(message.base_mode & _HIL)), "failsafe": _FAILSAFE.get(message.system_status),
        "system_type": message.type,
        "system_id": message.get_srcSystem(), "component_id": message.get_srcComponent(),
    }  # fmt: skip


def can_be_vtol(system_type: object) -> bool:
    """Return whether a vehicle of this MAV_TYPE can be a VTOL.

    ArduCopter (4.5.7) sends the `vtol_state` of a VTOL in hover for a quadrotor, and ArduPlane has the type of a fixed
    wing also if it is a VTOL.
    """
    return system_type not in _MULTICOPTERS


def vtol_status(state: int) -> dict[str, object]:
    """Return what the `vtol_state` of EXTENDED_SYS_STATE adds to the status of a VTOL; {} if it is undefined.

    During a transition PX4's Commander reports a rotary wing (`Commander::vtolStatusUpdate`).
    """
    if state not in _VTOL_STATES:
        return {}
    model = MESSAGES["VehicleStatus"].model
    is_fixed_wing = state == dialect.MAV_VTOL_STATE_FW
    return {
        "is_vtol": True,
        "vehicle_type": model.VEHICLE_TYPE_FIXED_WING
        if is_fixed_wing
        else model.VEHICLE_TYPE_ROTARY_WING,
        "in_transition_mode": state in _TRANSITIONS,
        "in_transition_to_fw": state == dialect.MAV_VTOL_STATE_TRANSITION_TO_FW,
    }


def _battery(message: Any) -> dict[str, object]:
    """Convert BATTERY_STATUS without cell voltages; if cells are not measured, the first voltage is the total."""
    cells = [each for each in message.voltages if each != _U16]
    cells += [each for each in message.voltages_ext if each not in (0, _U16)]
    return {
        "voltage_v": sum(cells) / 1e3 if cells else None, "current_a": _number(message.current_battery, 100, -1),
        "discharged_mah": _number(message.current_consumed, 1, -1),
        "remaining": _number(message.battery_remaining, 100, -1),
        "time_remaining_s": _number(message.time_remaining, 1, 0),
        "temperature": _number(message.temperature, 100, 2**15 - 1), "warning": _WARNINGS.get(message.charge_state),
    }  # fmt: skip


def _odometry(message: Any) -> dict[str, object]:
    """Convert ODOMETRY; pose and velocity only in frames that PX4 supports."""
    pose = _POSE_FRAMES.get(message.frame_id)
    velocity = _VELOCITY_FRAMES.get(message.child_frame_id)
    of_pose = {
        "pose_frame": pose, "position": (message.x, message.y, message.z), "q": _quaternion(*message.q),
        "position_variance": _variances(message.pose_covariance, 0, 6, 11),
        "orientation_variance": _variances(message.pose_covariance, 15, 18, 20),
    }  # fmt: skip
    of_velocity = {
        "velocity_frame": velocity, "velocity": (message.vx, message.vy, message.vz),
        "velocity_variance": _variances(message.velocity_covariance, 0, 6, 11),
    }  # fmt: skip
    return {
        **(of_pose if pose else {}), **(of_velocity if velocity else {}),
        "angular_velocity": (message.rollspeed, message.pitchspeed, message.yawspeed),
        "reset_counter": message.reset_counter, "quality": message.quality,
    }  # fmt: skip


def _position_of_high_latency(message: Any) -> dict[str, object]:
    """Convert the position in HIGH_LATENCY2; its errors in decimetres are at most 25.4 m."""
    if not (message.latitude or message.longitude):
        return {}
    is_valid = not message.failure_flags & dialect.HL_FAILURE_FLAG_ESTIMATOR
    return {
        "lat": message.latitude / 1e7, "lon": message.longitude / 1e7, "alt": float(message.altitude),
        "eph": _number(message.eph, 10, 0, _U8), "epv": _number(message.epv, 10, 0, _U8),
        "lat_lon_valid": is_valid, "alt_valid": is_valid,
    }  # fmt: skip


def _status_of_high_latency(message: Any) -> dict[str, object]:
    """Convert the status in HIGH_LATENCY2, in which only ArduPilot sends whether the vehicle is armed."""
    fields = {
        "system_type": message.type, "system_id": message.get_srcSystem(), "component_id": message.get_srcComponent(),
    }  # fmt: skip
    if message.autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA:
        model = MESSAGES["VehicleStatus"].model
        is_armed = message.custom0 & _ARMED
        fields["arming_state"] = (
            model.ARMING_STATE_ARMED if is_armed else model.ARMING_STATE_DISARMED
        )
    return fields


def _battery_of_high_latency(message: Any) -> dict[str, object]:
    return {"remaining": _number(message.battery, 100, -1)}


CONVERSIONS: Final[Mapping[str, tuple[str, Callable[[Any], dict[str, object]]]]] = {
    "LOCAL_POSITION_NED": (
        "vehicle_local_position",
        lambda each: {name: getattr(each, name) for name in ("x", "y", "z", "vx", "vy", "vz")},
    ),
    "GLOBAL_POSITION_INT": ("vehicle_global_position", _global_position),
    "ATTITUDE_QUATERNION": ("vehicle_attitude", _attitude),
    "ATTITUDE": (
        "vehicle_attitude",
        lambda each: {"q": euler_to_quaternion(each.roll, each.pitch, each.yaw)},
    ),
    "ODOMETRY": ("vehicle_odometry", _odometry),
    "HOME_POSITION": ("home_position", _home),
    "EXTENDED_SYS_STATE": (
        "vehicle_land_detected",
        lambda each: {"landed": each.landed_state == 1} if each.landed_state else {},
    ),
    "GPS_RAW_INT": ("sensor_gps", _gps),
    "HEARTBEAT": ("vehicle_status", _status),
    "BATTERY_STATUS": ("battery_status", _battery),
}
"""Topic and conversion function of each MAVLink message."""

HIGH_LATENCY: Final = "HIGH_LATENCY2"
"""Name of the only message that a vehicle sends over a satellite link."""

OF_HIGH_LATENCY: Final[Mapping[str, Callable[[Any], dict[str, object]]]] = {
    "vehicle_global_position": _position_of_high_latency,
    "vehicle_status": _status_of_high_latency,
    "battery_status": _battery_of_high_latency,
}
"""Conversion function of HIGH_LATENCY2 for each topic."""

DECODED: Final = {
    *CONVERSIONS, HIGH_LATENCY, "ALTITUDE", "COMMAND_ACK", "ESTIMATOR_STATUS", "GPS_GLOBAL_ORIGIN", "LOGGING_DATA",
    "LOGGING_DATA_ACKED", "STATUSTEXT", "SYSTEM_TIME", "SYS_STATUS", "TIMESYNC",
}  # fmt: skip
"""Names of all MAVLink messages that are used; of others, only the header is."""
