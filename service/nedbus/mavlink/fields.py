"""Conversion of MAVLink messages to fields of PX4's messages: a table of one function per message, without compilation.

A function returns the fields that a message has; None, or a field left out, means that its value is unknown:

>>> from pymavlink.dialects.v20 import common
>>> message = common.MAVLink_extended_sys_state_message(vtol_state=0, landed_state=1)
>>> topic, convert = CONVERSIONS[message.get_type()]
>>> topic, convert(message)
('vehicle_land_detected', {'landed': True})
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

from nedbus_msgs import MESSAGES
from nedbus_msgs.frames import euler_to_quaternion, quaternion_to_euler, wrap

Fields = dict[str, object]
Conversion = Callable[[Any], Fields]

# Numbers that mean "unknown" in MAVLink.
_U8: Final = 2**8 - 1  # in HIGH_LATENCY2 also "this, or more"
_I16: Final = 2**15 - 1
_U16: Final = 2**16 - 1
_NO_SATELLITES: Final = 2**8 - 1

_DEGREES: Final = 1e7  # latitudes and longitudes are in 1e-7 degrees
_ARMED: Final = dialect.MAV_MODE_FLAG_SAFETY_ARMED
_NO_FIX: Final = dialect.GPS_FIX_TYPE_NO_FIX
_LAST_COMMON_FIX: Final = dialect.GPS_FIX_TYPE_RTK_FIXED  # above it MAVLink and PX4 differ
# indices of the variances in the upper triangle of a 6x6 covariance matrix
_LINEAR: Final = (0, 6, 11)
_ANGULAR: Final = (15, 18, 20)

# MAV_BATTERY_CHARGE_STATE to `warning`
_WARNINGS: Final = {1: 0, 2: 1, 3: 2, 4: 3, 5: 4, 6: 6, 7: 7}
# MAV_STATE to `failsafe`: standby, active, critical
_FAILSAFE: Final = {3: False, 4: False, 5: True}
# MAV_FRAME to `pose_frame` and `velocity_frame`
_POSE_FRAMES: Final = {dialect.MAV_FRAME_LOCAL_NED: 1, dialect.MAV_FRAME_LOCAL_FRD: 2}
_VELOCITY_FRAMES: Final = {**_POSE_FRAMES, dialect.MAV_FRAME_BODY_FRD: 3}
_TRANSITIONS: Final = {
    dialect.MAV_VTOL_STATE_TRANSITION_TO_FW,
    dialect.MAV_VTOL_STATE_TRANSITION_TO_MC,
}
_VTOL_STATES: Final = {*_TRANSITIONS, dialect.MAV_VTOL_STATE_FW, dialect.MAV_VTOL_STATE_MC}
_MULTICOPTERS: Final = {
    dialect.MAV_TYPE_QUADROTOR,
    dialect.MAV_TYPE_COAXIAL,
    dialect.MAV_TYPE_HELICOPTER,
    dialect.MAV_TYPE_HEXAROTOR,
    dialect.MAV_TYPE_OCTOROTOR,
    dialect.MAV_TYPE_TRICOPTER,
    dialect.MAV_TYPE_DODECAROTOR,
    dialect.MAV_TYPE_DECAROTOR,
}


def _number(value: int, unit: float, *unknown: int) -> float | None:
    """Return a value in a unit; None if it is one of the unknown values."""
    if value in unknown:
        return None
    return value / unit


def _finite(value: float) -> float | None:
    if math.isfinite(value):
        return value
    return None


def _quaternion(*q: float) -> tuple[float, ...] | None:
    """Return a quaternion; None if it is unknown: not finite, or all zeros, as from MAVSDK's server."""
    if math.isfinite(sum(q)) and any(q):
        return q
    return None


def _variances(covariance: Sequence[float], indices: Sequence[int]) -> tuple[float, ...] | None:
    """Return the variances at these indices; None if all are zero, because nothing is exact."""
    variances = tuple(covariance[index] for index in indices)
    if any(variances):
        return variances
    return None


def _arming_state(bits: int) -> int:
    status = MESSAGES["VehicleStatus"].model
    armed: int = status.ARMING_STATE_ARMED
    disarmed: int = status.ARMING_STATE_DISARMED
    if bits & _ARMED:
        return armed
    return disarmed


def _sender(message: Any) -> Fields:
    return {
        "system_type": message.type,
        "system_id": message.get_srcSystem(),
        "component_id": message.get_srcComponent(),
    }


def _local_position(message: Any) -> Fields:
    """Convert LOCAL_POSITION_NED."""
    return {name: getattr(message, name) for name in ("x", "y", "z", "vx", "vy", "vz")}


def _global_position(message: Any) -> Fields:
    """Convert GLOBAL_POSITION_INT; other autopilots than PX4 send zeros until they have a position."""
    if not (message.lat or message.lon):
        return {}
    return {
        "lat": message.lat / _DEGREES,
        "lon": message.lon / _DEGREES,
        "alt": message.alt / 1e3,
    }


def _attitude(message: Any) -> Fields:
    """Convert ATTITUDE_QUATERNION."""
    return {"q": _quaternion(message.q1, message.q2, message.q3, message.q4)}


def _attitude_of_angles(message: Any) -> Fields:
    """Convert ATTITUDE."""
    return {"q": euler_to_quaternion(message.roll, message.pitch, message.yaw)}


def _home(message: Any) -> Fields:
    """Convert HOME_POSITION, which PX4 sends only with a valid global position; other programs send zeros before."""
    if not (message.latitude or message.longitude):
        return {}
    fields: Fields = {
        "lat": message.latitude / _DEGREES,
        "lon": message.longitude / _DEGREES,
        "alt": message.altitude / 1e3,
        "valid_hpos": True,
        "valid_alt": True,
        "x": _finite(message.x),
        "y": _finite(message.y),
        "z": _finite(message.z),
    }
    q = _quaternion(*message.q)
    if q is not None:
        fields["roll"], fields["pitch"], fields["yaw"] = quaternion_to_euler(q)
    return fields


def _landed(message: Any) -> Fields:
    """Convert EXTENDED_SYS_STATE."""
    if message.landed_state == dialect.MAV_LANDED_STATE_UNDEFINED:
        return {}
    return {"landed": message.landed_state == dialect.MAV_LANDED_STATE_ON_GROUND}


def _gps(message: Any) -> Fields:
    """Convert GPS_RAW_INT; without a receiver, or data from it, only the type of the fix is known."""
    fix_type = message.fix_type
    satellites = message.satellites_visible
    if satellites == _NO_SATELLITES and fix_type <= _NO_FIX:
        return {"fix_type": fix_type}
    fields: Fields = {
        "latitude_deg": message.lat / _DEGREES,
        "longitude_deg": message.lon / _DEGREES,
        "altitude_msl_m": message.alt / 1e3,
        "altitude_ellipsoid_m": _number(message.alt_ellipsoid, 1e3, 0),
        "eph": _number(message.h_acc, 1e3, 0),
        "epv": _number(message.v_acc, 1e3, 0),
        "s_variance_m_s": _number(message.vel_acc, 1e3, 0),
        "hdop": _number(message.eph, 100, 0, _U16),
        "vdop": _number(message.epv, 100, 0, _U16),
        "vel_m_s": _number(message.vel, 100, _U16),
    }
    if fix_type <= _LAST_COMMON_FIX:
        fields["fix_type"] = fix_type
    if message.cog != _U16:
        fields["cog_rad"] = math.radians(message.cog / 100)
    if message.yaw not in (0, _U16):
        fields["heading"] = wrap(math.radians(message.yaw / 100))
    if satellites != _NO_SATELLITES:
        fields["satellites_used"] = satellites
    return fields


def _status(message: Any) -> Fields:
    """Convert HEARTBEAT, without nav_state, which custom_mode does not contain."""
    return {
        "arming_state": _arming_state(message.base_mode),
        "hil_state": int(bool(message.base_mode & dialect.MAV_MODE_FLAG_HIL_ENABLED)),
        "failsafe": _FAILSAFE.get(message.system_status),
        **_sender(message),
    }


def can_be_vtol(system_type: object) -> bool:
    """Return whether a vehicle of this MAV_TYPE can be a VTOL.

    ArduCopter (4.5.7) sends the `vtol_state` of a VTOL in hover for a quadrotor, and ArduPlane has the type of a fixed
    wing also if it is a VTOL.
    """
    return system_type not in _MULTICOPTERS


def vtol_status(state: int) -> Fields:
    """Return what the `vtol_state` of EXTENDED_SYS_STATE adds to the status of a VTOL; {} if it is undefined.

    During a transition PX4's Commander reports a rotary wing (`Commander::vtolStatusUpdate`).
    """
    if state not in _VTOL_STATES:
        return {}
    model = MESSAGES["VehicleStatus"].model
    vehicle_type = model.VEHICLE_TYPE_ROTARY_WING
    if state == dialect.MAV_VTOL_STATE_FW:
        vehicle_type = model.VEHICLE_TYPE_FIXED_WING
    return {
        "is_vtol": True,
        "vehicle_type": vehicle_type,
        "in_transition_mode": state in _TRANSITIONS,
        "in_transition_to_fw": state == dialect.MAV_VTOL_STATE_TRANSITION_TO_FW,
    }


def _battery(message: Any) -> Fields:
    """Convert BATTERY_STATUS without cell voltages; if cells are not measured, the first voltage is the total."""
    cells = [cell for cell in message.voltages if cell != _U16]
    cells += [cell for cell in message.voltages_ext if cell not in (0, _U16)]
    fields: Fields = {
        "current_a": _number(message.current_battery, 100, -1),
        "discharged_mah": _number(message.current_consumed, 1, -1),
        "remaining": _number(message.battery_remaining, 100, -1),
        "time_remaining_s": _number(message.time_remaining, 1, 0),
        "temperature": _number(message.temperature, 100, _I16),
        "warning": _WARNINGS.get(message.charge_state),
    }
    if cells:
        fields["voltage_v"] = sum(cells) / 1e3
    return fields


def _odometry(message: Any) -> Fields:
    """Convert ODOMETRY; pose and velocity only in frames that PX4 supports."""
    fields: Fields = {
        "angular_velocity": (message.rollspeed, message.pitchspeed, message.yawspeed),
        "reset_counter": message.reset_counter,
        "quality": message.quality,
    }
    pose_frame = _POSE_FRAMES.get(message.frame_id)
    if pose_frame is not None:
        covariance = message.pose_covariance
        fields |= {
            "pose_frame": pose_frame,
            "position": (message.x, message.y, message.z),
            "q": _quaternion(*message.q),
            "position_variance": _variances(covariance, _LINEAR),
            "orientation_variance": _variances(covariance, _ANGULAR),
        }
    velocity_frame = _VELOCITY_FRAMES.get(message.child_frame_id)
    if velocity_frame is not None:
        fields |= {
            "velocity_frame": velocity_frame,
            "velocity": (message.vx, message.vy, message.vz),
            "velocity_variance": _variances(message.velocity_covariance, _LINEAR),
        }
    return fields


def _high_latency_position(message: Any) -> Fields:
    """Convert the position in HIGH_LATENCY2; its errors in decimetres are at most 25.4 m."""
    if not (message.latitude or message.longitude):
        return {}
    is_valid = not message.failure_flags & dialect.HL_FAILURE_FLAG_ESTIMATOR
    return {
        "lat": message.latitude / _DEGREES,
        "lon": message.longitude / _DEGREES,
        "alt": float(message.altitude),
        "eph": _number(message.eph, 10, 0, _U8),
        "epv": _number(message.epv, 10, 0, _U8),
        "lat_lon_valid": is_valid,
        "alt_valid": is_valid,
    }


def _high_latency_status(message: Any) -> Fields:
    """Convert the status in HIGH_LATENCY2, in which only ArduPilot sends whether the vehicle is armed."""
    fields = _sender(message)
    if message.autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA:
        fields["arming_state"] = _arming_state(message.custom0)
    return fields


def _high_latency_battery(message: Any) -> Fields:
    return {"remaining": _number(message.battery, 100, -1)}


CONVERSIONS: Final[Mapping[str, tuple[str, Conversion]]] = {
    "LOCAL_POSITION_NED": ("vehicle_local_position", _local_position),
    "GLOBAL_POSITION_INT": ("vehicle_global_position", _global_position),
    "ATTITUDE_QUATERNION": ("vehicle_attitude", _attitude),
    "ATTITUDE": ("vehicle_attitude", _attitude_of_angles),
    "ODOMETRY": ("vehicle_odometry", _odometry),
    "HOME_POSITION": ("home_position", _home),
    "EXTENDED_SYS_STATE": ("vehicle_land_detected", _landed),
    "GPS_RAW_INT": ("sensor_gps", _gps),
    "HEARTBEAT": ("vehicle_status", _status),
    "BATTERY_STATUS": ("battery_status", _battery),
}
"""Topic and conversion function of each MAVLink message."""

HIGH_LATENCY: Final = "HIGH_LATENCY2"
"""Name of the only message that a vehicle sends over a satellite link."""

OF_HIGH_LATENCY: Final[Mapping[str, Conversion]] = {
    "vehicle_global_position": _high_latency_position,
    "vehicle_status": _high_latency_status,
    "battery_status": _high_latency_battery,
}
"""Conversion function of HIGH_LATENCY2 for each topic."""

DECODED: Final = {
    *CONVERSIONS,
    HIGH_LATENCY,
    "ALTITUDE",
    "COMMAND_ACK",
    "ESTIMATOR_STATUS",
    "GPS_GLOBAL_ORIGIN",
    "LOGGING_DATA",
    "LOGGING_DATA_ACKED",
    "STATUSTEXT",
    "SYSTEM_TIME",
    "SYS_STATUS",
    "TIMESYNC",
}
"""Names of all MAVLink messages that are used; of others, only the header is."""
