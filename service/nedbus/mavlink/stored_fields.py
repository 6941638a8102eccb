"""Fields of one MAVLink message that complete another one; no I/O, callers pass monotonic time [s]."""

import math
from collections.abc import Mapping
from typing import Any, Final, cast

from pymavlink.dialects.v20 import common as dialect

from nedbus_msgs import DEFAULT, is_unix_time
from nedbus_msgs.frames import wrap

from .fields import Conversion, Fields, can_be_vtol, vtol_status

_VALUE_TIMEOUT: Final = 2.0  # s for which a received value is used
_STATUS_TIMEOUT: Final = 5.0  # s; without a request, PX4 sends ESTIMATOR_STATUS once a second
_UNKNOWN_HEADING: Final = 65535
_POLE: Final = 90e7  # 1e-7 deg
_NOTHING: Final[Mapping[str, Any]] = {}


def _heading(message: Any) -> Fields:
    """Convert GLOBAL_POSITION_INT; an unknown heading ends the earlier one."""
    if message.hdg == _UNKNOWN_HEADING:
        return {}
    return {"heading": wrap(math.radians(message.hdg / 100))}


def _yaw(message: Any) -> Fields:
    """Convert ATTITUDE."""
    if not math.isfinite(message.yaw):
        return {}
    return {"heading": wrap(message.yaw)}


def has_origin(message: Any) -> bool:
    """Return whether GPS_GLOBAL_ORIGIN has an origin: zeros are none, and PX4 up to 1.15 exceeds 180 degrees."""
    return abs(message.latitude) <= _POLE and bool(message.latitude or message.longitude)


def _origin(message: Any) -> Fields:
    fields: Fields = {
        "ref_lat": message.latitude / 1e7,
        "ref_lon": message.longitude / 1e7,
        "ref_alt": message.altitude / 1e3,
        "xy_global": True,
        "z_global": True,
    }
    if message.time_usec:
        fields["ref_timestamp"] = message.time_usec
    return fields


def _clearance(message: Any) -> Fields:
    """Convert ALTITUDE."""
    clearance = message.bottom_clearance
    if not (math.isfinite(clearance) and clearance >= 0):
        return {"dist_bottom_valid": False}
    return {"dist_bottom_valid": True, "dist_bottom": clearance}


def _velocity_errors(message: Any) -> Fields:
    """Convert ODOMETRY; variances of 0 are unknown."""
    covariance = message.velocity_covariance
    north = covariance[0]
    east = covariance[6]
    down = covariance[11]
    fields: Fields = {}
    if min(north, east) >= 0 and 0 < north + east < math.inf:
        fields["evh"] = math.sqrt(north + east)
    if 0 < down < math.inf:
        fields["evv"] = math.sqrt(down)
    return fields


def _position_errors(message: Any) -> Fields:
    """Convert the errors in ESTIMATOR_STATUS; an error of 0 is unknown."""
    fields: Fields = {}
    if 0 < message.pos_horiz_accuracy < math.inf:
        fields["eph"] = message.pos_horiz_accuracy
    if 0 < message.pos_vert_accuracy < math.inf:
        fields["epv"] = message.pos_vert_accuracy
    return fields


def _local_status(message: Any) -> Fields:
    """Convert ESTIMATOR_STATUS to the validity of a local position.

    Up to PX4 1.15, constant position mode means that there is no horizontal velocity. Since PX4's commit 48f1687d3a it
    is also set for a vehicle at rest, whose velocity and position are valid.
    """
    flags = message.flags
    has_velocity = bool(flags & dialect.ESTIMATOR_VELOCITY_HORIZ)
    has_position = bool(flags & (dialect.ESTIMATOR_POS_HORIZ_REL | dialect.ESTIMATOR_POS_HORIZ_ABS))
    is_held = bool(flags & dialect.ESTIMATOR_CONST_POS_MODE)
    return {
        "xy_valid": has_position and (has_velocity or not is_held),
        "z_valid": bool(flags & dialect.ESTIMATOR_POS_VERT_ABS),
        "v_xy_valid": has_velocity,
        "v_z_valid": bool(flags & dialect.ESTIMATOR_VELOCITY_VERT),
        **_position_errors(message),
    }


def _global_status(message: Any) -> Fields:
    """Convert ESTIMATOR_STATUS to the validity of a global position."""
    local = _local_status(message)
    is_global = bool(message.flags & dialect.ESTIMATOR_POS_HORIZ_ABS)
    return {
        "lat_lon_valid": local["xy_valid"] and is_global,
        "alt_valid": local["z_valid"],
        **_position_errors(message),
    }


def _sensors(message: Any) -> Fields:
    """Convert SYS_STATUS."""
    return {
        "onboard_control_sensors_present": message.onboard_control_sensors_present,
        "onboard_control_sensors_enabled": message.onboard_control_sensors_enabled,
        "onboard_control_sensors_health": message.onboard_control_sensors_health,
    }


def _vtol(message: Any) -> Fields:
    """Convert EXTENDED_SYS_STATE."""
    return vtol_status(message.vtol_state)


_PARTS: Final[Mapping[str, Mapping[str, Conversion]]] = {
    "vehicle_local_position": {
        "ATTITUDE": _yaw,
        "GLOBAL_POSITION_INT": _heading,  # replaces that of ATTITUDE
        "ESTIMATOR_STATUS": _local_status,
        "ALTITUDE": _clearance,
        "ODOMETRY": _velocity_errors,
        "GPS_GLOBAL_ORIGIN": _origin,
    },
    "vehicle_global_position": {"ESTIMATOR_STATUS": _global_status},
    "vehicle_status": {"SYS_STATUS": _sensors, "EXTENDED_SYS_STATE": _vtol},
}
"""By topic: the MAVLink messages that complete it, and what they add."""

_KINDS: Final = {kind for parts in _PARTS.values() for kind in parts}
_TIMEOUTS: Final = {
    **dict.fromkeys(_KINDS, _VALUE_TIMEOUT),
    "ESTIMATOR_STATUS": _STATUS_TIMEOUT,
    "SYS_STATUS": _STATUS_TIMEOUT,
    "EXTENDED_SYS_STATE": _STATUS_TIMEOUT,
    "SYSTEM_TIME": _STATUS_TIMEOUT,
    "GPS_GLOBAL_ORIGIN": math.inf,
}


class StoredFields:
    """The newest fields of a vehicle that complete its messages of other types."""

    def __init__(self) -> None:
        # by topic and type of message, in the order of _PARTS
        self._fields = {topic: dict.fromkeys(parts, _NOTHING) for topic, parts in _PARTS.items()}
        self._until = dict.fromkeys(_TIMEOUTS, -math.inf)  # when the fields of a message expire
        self._boot = 0  # UTC of the boot [us]

    def add(self, kind: str, message: Any, timestamp: int | None, now: float) -> None:
        """Store what a message of this type adds to others; `timestamp`: its time since boot [us].

        The caller leaves out a GPS_GLOBAL_ORIGIN without an origin: an earlier one is still valid.
        """
        timeout = _TIMEOUTS.get(kind)
        if timeout is None:
            return
        if kind == "SYSTEM_TIME":
            if timestamp is None or not is_unix_time(message.time_unix_usec):
                return
            self._boot = message.time_unix_usec - timestamp
        self._until[kind] = now + timeout
        for topic, parts in _PARTS.items():
            if kind in parts:
                self._fields[topic][kind] = parts[kind](message)

    def complete(self, topic: str, fields: Fields, now: float) -> None:
        """Add to the fields of a message, which include its timestamp, what is known from others."""
        for kind, further in self._fields.get(topic, _NOTHING).items():
            if kind == "EXTENDED_SYS_STATE" and not can_be_vtol(fields.get("system_type")):
                continue
            if now <= self._until[kind]:
                fields |= further
        if topic == "vehicle_local_position":
            _check_flags(fields)
        elif topic == "sensor_gps" and now <= self._until["SYSTEM_TIME"]:
            fields["time_utc_usec"] = self._boot + cast("int", fields["timestamp"])


def _check_flags(fields: Fields) -> None:
    """Clear the flags of fields that are not finite: a flag is from an earlier message than its fields."""
    for flag, names in DEFAULT.flags.items():
        if not fields.get(flag):
            continue
        if not all(math.isfinite(cast("float", fields[name])) for name in names):
            fields[flag] = False
