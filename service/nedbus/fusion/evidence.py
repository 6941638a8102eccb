"""FusionTracker: collects what PX4 publishes about an external position; times are the vehicle's own [us]."""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from nedbus import limits
from nedbus.samples import PositionStatus, Sample
from nedbus_msgs import FieldReader

from .causes import USELESS_VARIANCE, Cause, Echo, cause_of
from .report import Fusion, QuantityFusion, State

_AID: Final = "estimator_aid_src_ev_"
_ECHO: Final = "vehicle_visual_odometry"
_MOCAP: Final = "vehicle_mocap_odometry"
_FLAGS: Final = "estimator_status_flags"
SELECTOR: Final = "estimator_selector_status"
"""Topic that names the EKF in use."""

_ESTIMATE: Final = "vehicle_local_position"
_BIAS: Final = "estimator_ev_pos_bias"
_TEXT: Final = "log_message"
QUANTITIES: Final = {"position": "pos", "height": "hgt", "velocity": "vel", "yaw": "yaw"}
"""Quantities of an external position, with PX4's names for them."""

AID_TOPICS: Final = tuple(f"{_AID}{short}" for short in QUANTITIES.values())
"""Topics in which EKF2 reports what it does with an external position."""

_NAMES: Final = {_ECHO: "position"} | dict(zip(AID_TOPICS, QUANTITIES, strict=True))

VISION_TOPICS: Final = (*AID_TOPICS, _ECHO, _MOCAP)
"""Topics that a vehicle publishes only while it receives an external position."""

FUSION_TOPICS: Final = (
    *VISION_TOPICS,
    _FLAGS,
    SELECTOR,
    _ESTIMATE,
    _BIAS,
    _TEXT,
)
"""Topics that a FusionTracker uses."""

_PERIODIC: Final = frozenset(FUSION_TOPICS) - {_MOCAP, SELECTOR, _TEXT}
_WINDOW: Final = 1_000_000  # us
_CONFIRMED: Final = 3  # messages in a row that show what EKF2 does now
_REJECTED_SHARE: Final = 0.2  # of the messages in the window; vision that is 0.24 s late has 0.26
_TEXT_TIME: Final = 3_000_000  # us for which a text of PX4 explains what EKF2 does not receive
_START: Final = 400_000  # us from a measurement to its fusion, in which "not used" is normal
_SILENCE: Final = 600_000  # us without a message after which it no longer arrives
_FLAGS_LATE: Final = 1_500_000  # us of vision after which EKF2's flags show whether it is fused
_REBOOT: Final = 1_000_000  # us back in time
_PAUSE: Final = 10_000_000  # us ahead, more than between any two messages
_AHEAD: Final = 500_000  # us
_LARGE_BIAS: Final = 1.0  # m
_UNSUPPORTED: Final = "ODOMETRY: unsupported"  # PX4's text

_read_aid: Final = FieldReader(
    ("timestamp", "fused", "innovation_rejected", "test_ratio", "estimator_instance")
)
_FLAG_NAMES: Final = {name: f"cs_ev_{short}" for name, short in QUANTITIES.items()}
_read_flags: Final = FieldReader(("timestamp", *_FLAG_NAMES.values()))
_read_estimate: Final = FieldReader(("timestamp", "eph", "xy_valid"))
_read_bias: Final = FieldReader(("timestamp", "bias"))
_read_primary: Final = FieldReader(("timestamp", "primary_instance"))
_read_text: Final = FieldReader(("timestamp", "text"))
_read_time: Final = FieldReader(("timestamp",))


class _Received(NamedTuple):
    """The fields of a position that PX4 received, as it publishes them in vehicle_visual_odometry."""

    timestamp: Any
    timestamp_sample: Any
    pose_frame: Any
    velocity_frame: Any
    velocity: Any
    q: Any
    position_variance: Any
    reset_counter: Any
    quality: Any


_read_received: Final = FieldReader(_Received._fields)


class _Use(NamedTuple):
    """What EKF2 did with one measurement."""

    time: int
    is_fused: bool
    is_rejected: bool


def _recent_uses() -> deque[_Use]:
    return deque(maxlen=limits.FUSION_MESSAGES)


@dataclass(slots=True)
class _Aid:
    """Messages of one quantity in the window, and its state."""

    recent: deque[_Use] = field(default_factory=_recent_uses)
    ratio: float = math.nan
    first: int = 0  # of the messages that follow a silence [us]
    state: State = "unknown"
    since: int = 0


class FusionTracker:
    """The use of the external position of one vehicle; `add` its messages, and ask for `fusion`.

    `primary`: instance of the EKF in use. `now`: the vehicle's newest time [us].
    """

    def __init__(self) -> None:
        self.primary = 0
        self.now = 0
        self._is_odd = False  # the time of the last message did not follow
        self._reset()

    def _reset(self) -> None:
        self._aids = {name: _Aid() for name in QUANTITIES}
        self._echo_times: deque[int] = deque(maxlen=limits.FUSION_MESSAGES)
        self._changes: deque[int] = deque(maxlen=_CONFIRMED)  # times at which reset_counter changed
        self._received: _Received | None = None  # the last message of _ECHO
        self._mocap = 0  # time of the last one
        self._unsupported = 0  # time of the last one
        self._newest_sample = 0  # the largest timestamp_sample since boot
        self._ahead = 0.0  # how far it was ahead when it arrived [s]
        self._flags: dict[str, bool] = {}
        self._has_aids = False
        self._eph = math.nan
        self._is_valid: bool | None = None  # xy_valid of the estimate
        self._bias = (math.nan, math.nan)

    def add_sample(self, sample: Sample[Any]) -> bool:
        """Add a sample; return False for one from before the subscription, of which only the EKF in use counts."""
        if sample.retained and sample.topic != SELECTOR:
            return False
        self.add(sample.topic, sample.message, sample.instance)
        return True

    def add(self, topic: str, message: object, instance: int | None = None) -> None:
        """Add a message of one of FUSION_TOPICS: a model, a row, or a dict of fields."""
        if topic == _FLAGS and instance not in (None, self.primary):
            return
        time = _read_time(message)[0]
        if not isinstance(time, int) or not self._follow_time(topic, time):
            return
        if topic.startswith(_AID):
            self._add_aid(topic, message)
        elif topic == _ECHO:
            self._add_echo(message)
        elif topic == _MOCAP:
            self._mocap = time
        elif topic == _FLAGS:
            values = dict(zip(QUANTITIES, _read_flags(message)[1:], strict=True))
            self._flags = {name: bool(value) for name, value in values.items() if value is not None}
        elif topic == _ESTIMATE:
            _, eph, is_valid = _read_estimate(message)
            self._eph = _number(eph)
            self._is_valid = bool(is_valid)
        elif topic == _BIAS:
            self._add_bias(message)
        elif topic == SELECTOR:
            _, primary = _read_primary(message)
            if isinstance(primary, int):
                self.primary = primary
        elif topic == _TEXT and _UNSUPPORTED in str(_read_text(message)[1]):
            self._unsupported = time
        self._update()

    def _follow_time(self, topic: str, time: int) -> bool:
        """Set the current time; return whether the message belongs to it.

        Two messages in a row show a reboot, or a pause of the data: a single one may be damaged, or late.
        """
        is_odd = topic in _PERIODIC and not self.now - _REBOOT <= time <= self.now + _PAUSE
        was_odd = self._is_odd
        self._is_odd = is_odd and bool(self.now)
        if not self._is_odd:
            if topic in _PERIODIC:
                self.now = max(self.now, time)
            return True
        if was_odd:
            if time < self.now:
                self._reset()
            self.now = time
        return was_odd

    def _add_aid(self, topic: str, message: object) -> None:
        time, fused, rejected, ratio, instance = _read_aid(message)
        name = _NAMES.get(topic)
        if name is None or (instance is not None and instance != self.primary):
            return
        self._has_aids = True
        aid = self._aids[name]
        if not aid.recent or time - aid.recent[-1].time > _SILENCE:
            aid.recent.clear()
            aid.first = time
        aid.recent.append(_Use(time, bool(fused), bool(rejected)))
        aid.ratio = _largest(ratio)

    def _add_echo(self, message: object) -> None:
        before = self._received
        received = _Received._make(_read_received(message))
        self._received = received
        time = received.timestamp
        sample = received.timestamp_sample
        if self._echo_times and time - self._echo_times[-1] > _SILENCE:
            self._echo_times.clear()
        self._echo_times.append(time)
        if before is not None and before.reset_counter != received.reset_counter:
            self._changes.append(time)
        if isinstance(sample, int) and sample > self._newest_sample:
            self._newest_sample = sample
            self._ahead = (sample - time) / 1e6

    def _add_bias(self, message: object) -> None:
        _, bias = _read_bias(message)
        if isinstance(bias, tuple | list) and len(bias) >= 2:
            self._bias = (_number(bias[0]), _number(bias[1]))

    def _update(self) -> None:
        """Set the state of each quantity, and since when it holds."""
        for name, aid in self._aids.items():
            state, since = self._state_of(name, aid)
            if state != aid.state:
                aid.state = state
                aid.since = since

    def _state_of(self, name: str, aid: _Aid) -> tuple[State, int]:
        recent = aid.recent
        while recent and recent[0].time < self.now - _WINDOW:
            recent.popleft()
        if not recent or self.now - recent[-1].time > _SILENCE:
            return self._state_without_aid(name)
        rejected = [use.time for use in recent if use.is_rejected]
        if len(rejected) >= max(_CONFIRMED, _REJECTED_SHARE * len(recent)):
            return "rejected", rejected[0]
        if recent[-1].is_fused:
            first = next(use.time for use in recent if use.is_fused)
            return "fused", first
        is_undecided = any(use.is_fused for use in [*recent][-_CONFIRMED:])
        if is_undecided:
            return aid.state, aid.since
        is_starting = recent[-1].time - aid.first < _START
        if is_starting and aid.state in ("unknown", "not received"):
            return "unknown", self.now
        return "not used", aid.first

    def _state_without_aid(self, name: str) -> tuple[State, int]:
        """Return the state of a quantity whose measurements EKF2 does not report."""
        is_echoed = bool(self._echo_times) and self._is_recent(self._echo_times[-1])
        if not is_echoed:
            is_refused = self._is_recent(self._mocap)
            is_refused |= self._is_recent(self._unsupported, _TEXT_TIME)
            if self._aids[name].state == "unknown" and not is_refused:
                return "unknown", self.now
            return "not received", self.now
        age = self.now - self._echo_times[0]
        if age < _SILENCE:
            return "unknown", self.now
        if self._has_aids:
            return "not received", self.now
        if name not in self._flags or age < _FLAGS_LATE:
            return "unknown", self.now
        return ("fused" if self._flags[name] else "not used"), self.now

    def _is_recent(self, time: int, limit: int = _SILENCE) -> bool:
        return bool(time) and self.now - time <= limit

    def fusion(self, vehicle: str, sent: PositionStatus | None = None) -> Fusion:
        """Return the report; `sent`: what a service sends into the vehicle."""
        states: dict[str, State] = {name: aid.state for name, aid in self._aids.items()}
        echo = self._describe_echo(sent)
        quantities = []
        for name, aid in self._aids.items():
            cause = cause_of(name, states, aid.ratio, echo)
            since = None
            if aid.since and aid.state != "unknown":
                since = aid.since / 1e6
            quantities.append(QuantityFusion(name, aid.state, since, aid.ratio, cause))
        variance = math.nan
        received = self._received
        if echo.is_echoed and received is not None and received.position_variance:
            variance = _number(received.position_variance[0])
        remarks = self._remarks(states, variance, is_sent=bool(echo.is_sent))
        return Fusion(
            vehicle=vehicle,
            quantities=tuple(quantities),
            sent=sent,
            echoed=echo.rate,
            eph=self._eph,
            variance=variance,
            bias=self._bias,
            remarks=tuple(remarks),
            missing=tuple(self._missing(echo)),
        )

    def diagnosis(self, topic: str) -> str:
        """Return why what a topic reports is not fused, without the remedy; "" if nothing explains it.

        `topic`: that of an aid source, or the echo for the position.
        """
        name = _NAMES.get(topic)
        if name is None:
            return ""
        states: dict[str, State] = {own: aid.state for own, aid in self._aids.items()}
        echo = self._describe_echo(None)
        cause = cause_of(name, states, self._aids[name].ratio, echo)
        return cause.partition(": ")[0]

    def _describe_echo(self, sent: PositionStatus | None) -> Echo:
        is_mocap = self._is_recent(self._mocap)
        is_unsupported = self._is_recent(self._unsupported, _TEXT_TIME)
        if sent is None:
            is_sent = None
        else:
            is_sent = sent.rate > 0
        received = self._received
        if received is None or not self._is_recent(self._echo_times[-1]):
            return Echo(is_mocap=is_mocap, is_type_unsupported=is_unsupported, is_sent=is_sent)
        age = 0.0
        if received.timestamp_sample:
            age = (received.timestamp - received.timestamp_sample) / 1e6
        ahead = 0.0
        if self._newest_sample > self.now + _AHEAD:
            ahead = self._ahead
        is_counting = len(self._changes) == _CONFIRMED and self._changes[0] > self.now - _WINDOW
        return Echo(
            is_echoed=True,
            is_mocap=is_mocap,
            is_type_unsupported=is_unsupported,
            is_sent=is_sent,
            rate=self._echo_rate(),
            pose_frame=received.pose_frame,
            velocity_frame=received.velocity_frame,
            has_velocity=_is_known(received.velocity),
            norm_error=_norm_error(received.q),
            age=age,
            ahead=ahead,
            counts_messages=is_counting,
            quality=received.quality,
        )

    def _echo_rate(self) -> float:
        """Return how many messages PX4 received per second, NaN before the second one."""
        times = [time for time in self._echo_times if time >= self.now - _WINDOW - _SILENCE]
        if len(times) < 2:
            return math.nan
        period = (times[-1] - times[0]) / 1e6
        return (len(times) - 1) / max(1e-6, period)

    def _remarks(self, states: Mapping[str, State], variance: float, *, is_sent: bool) -> list[str]:
        remarks = []
        if is_sent and states["position"] == "unknown" and self._is_valid is False:
            remarks.append(Cause.NOT_VALID)
        if states["position"] == "fused" and variance >= USELESS_VARIANCE:
            remarks.append(Cause.VARIANCES)
        bias = math.hypot(*self._bias)
        if states["position"] == "fused" and bias > _LARGE_BIAS:
            remarks.append(
                f"with GNSS, EKF2 gives vision a bias of {bias:.1f} m: the estimate follows GNSS"
            )
        return remarks

    def _missing(self, echo: Echo) -> list[str]:
        """Return the evidence that the data lacks."""
        missing = []
        how = "add it to etc/logging/logger_topics.txt on the SD card and use log=1 (docs/external-position.md)"
        if not self._has_aids:
            missing.append(f"{_AID}*, which alone shows rejected measurements; {how}")
        if not (echo.is_echoed or echo.is_mocap or self._has_aids):
            missing.append(f"{_ECHO}, which shows what PX4 received; {how}")
        return missing


def _number(value: object) -> float:
    if isinstance(value, int | float):
        return float(value)
    return math.nan


def _largest(ratio: object) -> float:
    """Return the largest test ratio of all axes; NaN if one is NaN."""
    if isinstance(ratio, tuple | list):
        axes = ratio
    else:
        axes = [ratio]
    values = [_number(axis) for axis in axes]
    if any(map(math.isnan, values)):
        return math.nan
    return max(values, default=math.nan)


def _is_known(values: object) -> bool:
    return isinstance(values, tuple | list) and all(map(math.isfinite, values))


def _norm_error(q: object) -> float:
    """Return the error of the norm of q, NaN if it is unknown."""
    if not isinstance(q, tuple | list):
        return math.nan
    return abs(math.hypot(*q) - 1)
