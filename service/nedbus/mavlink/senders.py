"""Senders on a MAVLink link: which of them are autopilots."""

from collections.abc import Set
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

from nedbus_msgs import ARDUPILOT, OTHER_AUTOPILOT

from .fields import DECODED, HIGH_LATENCY

AUTOPILOT: Final = 1  # component id; cameras, gimbals and ground stations should have others

_BROADCAST: Final = (
    "id 0 is for broadcast only; an autopilot has system id 1 to 255 and component id 1"
)
_OTHER_COMPONENT: Final = f"not an autopilot, which has component id {AUTOPILOT}"
NO_HEARTBEAT: Final = "not known to be an autopilot, because no HEARTBEAT has arrived"
"""Why a message of a sender is ignored that may identify itself later."""

IDENTIFYING: Final[Set[str]] = {"HEARTBEAT", HIGH_LATENCY}
"""Names of the messages that contain the type and the autopilot of their sender."""

_SENT_BY_AUTOPILOTS: Final = {
    "LOCAL_POSITION_NED", "ESTIMATOR_STATUS", "SYS_STATUS", "EXTENDED_SYS_STATE", "ATTITUDE_QUATERNION", "ATTITUDE",
    "GPS_GLOBAL_ORIGIN",
}  # fmt: skip
"""Names of the messages that only autopilots send; companions also send ODOMETRY, and ground stations positions."""

_PRESUMED: Final = DECODED - {"COMMAND_ACK", "TIMESYNC"}
"""Names of the messages whose sender is presumed to be an autopilot while no HEARTBEAT of it has arrived."""

_NOT_AUTOPILOTS: Final = {
    dialect.MAV_TYPE_GCS, dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_TYPE_GIMBAL, dialect.MAV_TYPE_ADSB,
    dialect.MAV_TYPE_CAMERA, dialect.MAV_TYPE_CHARGING_STATION, dialect.MAV_TYPE_FLARM, dialect.MAV_TYPE_SERVO,
    dialect.MAV_TYPE_ODID, dialect.MAV_TYPE_BATTERY, dialect.MAV_TYPE_PARACHUTE, dialect.MAV_TYPE_LOG,
    dialect.MAV_TYPE_OSD, dialect.MAV_TYPE_IMU, dialect.MAV_TYPE_GPS, dialect.MAV_TYPE_WINCH,
    dialect.MAV_TYPE_ILLUMINATOR, dialect.MAV_TYPE_GRIPPER,
}  # fmt: skip
"""Each MAV_TYPE of a component that is not a vehicle."""


class Senders:
    """The senders on one link, or in one file.

    A component id of 1 alone does not show an autopilot: routers, companions and ground stations use it, too, even
    together with the system id of a vehicle. The type and the autopilot in HEARTBEAT decide. A sender that identified
    itself as something else is ignored, unless it also sends what only autopilots send: then another program uses the
    ids of an autopilot, and only its HEARTBEAT can be told from the messages of the autopilot.
    """

    def __init__(self) -> None:
        self._autopilots: set[int] = set()  # system ids
        self._presumed: set[int] = set()  # system ids of autopilots whose HEARTBEAT has not arrived
        self._others: dict[int, str] = {}  # system ids of other senders, and what they are

    def ignore_reason(self, message: Any, system: int, component: int) -> str:
        """Return why a message with these ids is ignored; "" for a message of an autopilot."""
        if not (system and component):
            return _BROADCAST
        if component != AUTOPILOT:
            return _OTHER_COMPONENT
        kind = message.get_type()
        if kind in IDENTIFYING:
            if reason := _why_no_autopilot(message.type, message.autopilot):
                self._others[system] = reason
                return reason
            self._autopilots.add(system)
        elif kind in _SENT_BY_AUTOPILOTS:
            self._autopilots.add(system)
        if system in self._autopilots:
            return ""
        if system in self._others:
            return self._others[system]
        if kind in _PRESUMED:
            self._presumed.add(system)
        return "" if system in self._presumed else NO_HEARTBEAT

    def ignores(self, system: int, component: int) -> bool:
        """Return whether all messages with these ids are ignored, as far as known."""
        if component != AUTOPILOT or not system:
            return True
        return system in self._others and system not in self._autopilots


def text_source(autopilot: int) -> str | None:
    """Return the source of the log messages of this MAV_AUTOPILOT; None for PX4, and for a generic one."""
    if autopilot in {dialect.MAV_AUTOPILOT_PX4, dialect.MAV_AUTOPILOT_GENERIC}:
        return None
    return ARDUPILOT if autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA else OTHER_AUTOPILOT


def _why_no_autopilot(kind: int, autopilot: int) -> str:
    """Return why a sender with this MAV_TYPE and MAV_AUTOPILOT is not an autopilot; "" if it is one."""
    name = _name("MAV_TYPE", kind)
    if name is None:
        return f"not an autopilot: its HEARTBEAT has the unknown type {kind}"
    if kind in _NOT_AUTOPILOTS:
        return f"not an autopilot: its HEARTBEAT has the type {name}"
    if autopilot == dialect.MAV_AUTOPILOT_INVALID:
        return "not an autopilot: its HEARTBEAT has the autopilot MAV_AUTOPILOT_INVALID"
    return ""


def _name(enum: str, number: int) -> str | None:
    """Return the name of a value of an enumeration, None if it has none."""
    entry = dialect.enums[enum].get(number)
    if entry is None or entry.name.endswith("_ENUM_END"):  # pymavlink's own
        return None
    return str(entry.name)
