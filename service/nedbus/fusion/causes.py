"""Causes: which mistake of a sender explains that EKF2 does not use its position, from what PX4 received and did."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from .report import State

EV_BITS: Final = {"position": 1, "height": 2, "velocity": 4, "yaw": 8}
"""Bits of EKF2_EV_CTRL, by quantity."""

_MIN_RATE: Final = 5.0  # Hz; EKF2 starts to fuse if two samples are less than 200 ms apart
# s between time_usec and its arrival, beyond which EKF2's buffer does not take a message
_OLD: Final = 0.2
_NORM_TOLERANCE: Final = 1e-5  # of q
USELESS_VARIANCE: Final = 1e4  # m^2; such a measurement has no effect
_LARGE_RATIO: Final = 20.0  # of a yaw in another order or frame; noise has less


class Cause:
    """Texts of causes, each with its remedy."""

    MOCAP = "estimator_type is MOCAP, which EKF2 does not read (vehicle_mocap_odometry): send VISION (2)"
    TYPE = "PX4 does not support the estimator_type: send VISION (2)"
    NO_ECHO = (
        "PX4 does not publish what is sent: check the link, and that estimator_type is VISION (2)"
    )
    STOPPED = "no message arrives any more: the sender has stopped"
    POSE_FRAME = (
        "PX4 does not know the frame of the position: frame_id must be LOCAL_NED (1) or LOCAL_FRD (20), and no"
        " coordinate NaN; give an unknown one a variance of 1e6"
    )
    VELOCITY_FRAME = (
        "PX4 does not know the frame of the velocity: child_frame_id must be LOCAL_NED (1), LOCAL_FRD (20) or"
        " BODY_FRD (12)"
    )
    NO_VELOCITY = "the message has no velocity"
    NO_ATTITUDE = "the message has no attitude: q is NaN"
    QUATERNION = (
        "q is not a unit quaternion within 1e-5: normalise it in double precision, order w, x, y, z"
    )
    QUATERNION_ORDER = (
        "q is in another order than w, x, y, z, or its heading is of another frame than NED"
    )
    RATE = (
        "less than 5 messages per second: EKF2 starts only if two are within 200 ms; send 20 to 50"
    )
    COUNTER = "reset_counter changes with each message: raise it only when the position jumps"
    OLD = (
        "time_usec is {0:.1f} s old: after time synchronisation it counts; use one monotonic clock for it and for the"
        " answers to TIMESYNC, or answer none"
    )
    AHEAD = "a message was stamped {0:.0f} s ahead: EKF2 takes none until then; reboot PX4, and do not stamp ahead"
    CONTROL = "bit {0} of EKF2_EV_CTRL is not set, or quality {1} is below EKF2_EV_QMIN"
    UP = "z points up: it must point down in NED and FRD"
    ENU = "the axes are wrong, as with ENU sent as NED: x must be north or forward, y east or right, z down"
    TURNED = "the axes are turned about the vertical: align the frame with north, or send LOCAL_FRD and fuse its yaw"
    JUMP = "the position jumped without a new reset_counter, or is noisier than its variance"
    DELAY = "the velocity is late or in another frame: set EKF2_EV_DELAY to its age, check child_frame_id"
    CLOCK = "EKF2 takes no message: its time is wrong; answer no TIMESYNC, or use one clock, and reboot PX4"
    NOT_VALID = "the estimate has no valid position (xy_valid): EKF2 does not use what is sent"
    VARIANCES = "the variances are so large that the measurement has no effect: fused, but not used"


@dataclass(frozen=True, slots=True)
class Echo:
    """What PX4 received in the last second: vehicle_visual_odometry, and what EKF2 does not read.

    `rate`: messages per second, NaN before the second one. `is_echoed`: such a message arrives. `age`: of the last by
    its own time [s]. `ahead`: how far a message was stamped ahead of the current time, 0 if none [s].
    `is_sent`: a service sends positions, None if unknown. Other fields are those of the last message.
    """

    is_echoed: bool = False
    is_mocap: bool = False
    is_type_unsupported: bool = False
    is_sent: bool | None = None
    rate: float = math.nan
    pose_frame: int = 1
    velocity_frame: int = 1
    has_velocity: bool = True
    norm_error: float = 0.0
    age: float = 0.0
    ahead: float = 0.0
    counts_messages: bool = False
    quality: int = 0


def cause_of(name: str, states: Mapping[str, State], ratio: float, echo: Echo) -> str:
    """Return why a quantity is not fused; "" if it is, or if nothing explains it.

    `states`: of all quantities. `ratio`: the test ratio of this one.
    """
    state = states[name]
    if state == "fused":
        return ""
    if not echo.is_echoed:
        return _cause_without_echo(name, states, ratio, echo)
    wrong = _wrong_field(name, echo)
    if wrong:
        return wrong
    if state == "rejected":
        return _cause_of_rejection(name, states, ratio)
    if state == "unknown":
        return ""
    return _cause_of_disuse(name, states, echo)


def _cause_of_disuse(name: str, states: Mapping[str, State], echo: Echo) -> str:
    """Return why EKF2 neither fuses nor rejects a quantity whose fields are right."""
    is_received = states[name] != "not received"
    # EKF2 reports it only while it fuses it
    is_velocity = name == "velocity" and states["position"] != "not received"
    if echo.ahead:
        cause = Cause.AHEAD.format(echo.ahead)
    elif not is_received and echo.age > _OLD:
        cause = Cause.OLD.format(echo.age)
    elif echo.counts_messages:
        cause = Cause.COUNTER
    elif echo.rate < _MIN_RATE:
        cause = Cause.RATE
    elif is_received or is_velocity:
        cause = Cause.CONTROL.format(EV_BITS[name], echo.quality)
    else:
        cause = Cause.CLOCK
    return cause


def _cause_without_echo(name: str, states: Mapping[str, State], ratio: float, echo: Echo) -> str:
    """Return what is known without the fields that PX4 received: not whether a jump had a new reset_counter."""
    if states[name] == "rejected":
        cause = _cause_of_rejection(name, states, ratio)
        is_unknown = cause == Cause.JUMP or math.isnan(ratio)
        return "" if is_unknown else cause
    if states[name] != "not received":
        return ""
    if echo.is_mocap:
        return Cause.MOCAP
    if echo.is_type_unsupported:
        return Cause.TYPE
    if echo.is_sent:
        return Cause.NO_ECHO
    return Cause.STOPPED


def _wrong_field(name: str, echo: Echo) -> str:
    """Return which field keeps EKF2 from using a quantity, whatever else is right."""
    wrong = ""
    if name == "yaw":
        if math.isnan(echo.norm_error):
            wrong = Cause.NO_ATTITUDE
        elif echo.norm_error > _NORM_TOLERANCE:
            wrong = Cause.QUATERNION
    elif name == "velocity" and not echo.velocity_frame:
        wrong = Cause.VELOCITY_FRAME
    elif name == "velocity" and not echo.has_velocity:
        wrong = Cause.NO_VELOCITY
    elif not echo.pose_frame:  # without it, a velocity in NED is refused as well
        wrong = Cause.POSE_FRAME
    return wrong


def _cause_of_rejection(name: str, states: Mapping[str, State], ratio: float) -> str:
    """Return which mistake rejects these quantities together."""
    rejected = {quantity for quantity, state in states.items() if state == "rejected"}
    if name == "yaw":
        is_order = ratio > _LARGE_RATIO or len(rejected) == 1
        return Cause.QUATERNION_ORDER if is_order else ""
    if rejected >= {"position", "height", "velocity"}:
        return Cause.ENU
    if rejected >= {"position", "velocity"}:
        return Cause.TURNED
    if name == "height":
        return Cause.UP
    if name == "velocity":
        return Cause.DELAY
    return Cause.JUMP
