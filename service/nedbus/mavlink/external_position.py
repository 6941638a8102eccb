"""External position: a position from the bus in, ODOMETRY for PX4 out, or why not; no I/O, monotonic time [s]."""

import math
import struct
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import common as dialect

from nedbus_msgs.messages import VehicleLocalPosition, VehicleOdometry

MAX_RATE: Final = 50.0
"""Messages per second to send at most; PX4 drops what is faster than its buffer."""
MIN_RATE: Final = 5.0
"""Messages per second below which PX4 does not start to fuse: it needs two within 200 ms."""
MAX_AGE: Final = 0.1
"""Seconds between the measurement and its transmission beyond which a position is left out."""
UNKNOWN_VARIANCE: Final = 1e6
"""Variance of a quantity that is unknown: PX4 accepts it without an effect on the estimate."""

_EXACT_NORM: Final = 1e-5  # error of the norm of q that EKF2 accepts
_REPAIRED_NORM: Final = 1e-2  # ... that is normalised, as of quaternions with few decimals
_EARLY: Final = 0.3  # share of an interval by which a message may be early
# s between timestamp_sample and timestamp; more means that their clocks differ
_MAX_SENSOR_AGE: Final = 10.0
# s by which the way on the bus may vary; a larger change is a step of the publisher's clock
_MAX_DELAY: Final = 1.0
_STEADY: Final = 0.05  # s by which it varies after such a step ...
# s ... for this time, until the step counts: a backlog does not last as long
_STEADY_TIME: Final = 0.3
_WINDOW: Final = 30.0  # s after which the shortest delay is measured anew, because clocks drift
_TAKEOVER: Final = 1.0  # s of silence of a sender until another one is used
_JUMP: Final = 1.0  # m
_MAX_SPEED: Final = 20.0  # m/s of positions without a velocity
_COUNTS_MESSAGES: Final = 5  # messages in a row with a new reset_counter
_RATE_WINDOW: Final = 10  # messages over which the rate is measured
_MAX_REASONS: Final = 20

_POSE_FRAMES: Final = {
    VehicleOdometry.POSE_FRAME_NED: dialect.MAV_FRAME_LOCAL_NED,
    VehicleOdometry.POSE_FRAME_FRD: dialect.MAV_FRAME_LOCAL_FRD,
}
_VELOCITY_FRAMES: Final = {
    VehicleOdometry.VELOCITY_FRAME_NED: dialect.MAV_FRAME_LOCAL_NED,
    VehicleOdometry.VELOCITY_FRAME_FRD: dialect.MAV_FRAME_LOCAL_FRD,
    VehicleOdometry.VELOCITY_FRAME_BODY_FRD: dialect.MAV_FRAME_BODY_FRD,
}
COMPONENT: Final = dialect.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
"""Component that sends positions."""

_MAGIC: Final = b"\xfd"
_HEADER: Final = struct.Struct("<BBBBBBHB")  # length, flags, flags, sequence, system, component, id
_MESSAGE_ID: Final = dialect.MAVLINK_MSG_ID_ODOMETRY % 2**16, dialect.MAVLINK_MSG_ID_ODOMETRY >> 16
_PAYLOAD: Final[struct.Struct] = dialect.MAVLink_odometry_message.unpacker
_CRC_EXTRA: Final = bytes([dialect.MAVLink_odometry_message.crc_extra])
_CHECKSUM: Final = struct.Struct("<H")
_COVARIANCES: Final = 21  # elements of the upper triangle of a 6x6 matrix
_DIAGONAL: Final = (0, 6, 11, 15, 18, 20)  # those of the variances

_NAN3: Final = (math.nan,) * 3
_NAN4: Final = (math.nan,) * 4
_ZERO3: Final = (0.0,) * 3
_UNKNOWN3: Final = (UNKNOWN_VARIANCE,) * 3

Position = VehicleOdometry | VehicleLocalPosition
"""Messages that can be sent into a vehicle."""


class Refusal(NamedTuple):
    """Why a position was not sent. `kind`: a short name for counts; `text`: field, value and remedy."""

    kind: str
    text: str


class _RefusedError(ValueError):
    """A position that PX4 would ignore without a word."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.refusal = Refusal(kind, text)


class Odometry(NamedTuple):
    """The fields of ODOMETRY, except for its time; unknown values are NaN."""

    frame_id: int
    child_frame_id: int
    position: Sequence[float]
    q: Sequence[float]
    velocity: Sequence[float]
    rates: Sequence[float]
    pose_variances: Sequence[float]
    velocity_variances: Sequence[float]
    reset_counter: int
    quality: int

    def frame(self, time_usec: int, *, system: int, sequence: int) -> bytes:
        """Return the MAVLink 2 frame of ODOMETRY with this time [us], from the VIO component of a system.

        It is packed here, because the message object of pymavlink takes three times as long.
        """
        payload = _PAYLOAD.pack(
            time_usec, *self.position, *self.q, *self.velocity, *self.rates, *_covariance(self.pose_variances),
            *_covariance(self.velocity_variances), self.frame_id, self.child_frame_id, self.reset_counter,
            dialect.MAV_ESTIMATOR_TYPE_VISION, self.quality,
        ).rstrip(b"\0")  # fmt: skip
        body = _HEADER.pack(len(payload), 0, 0, sequence, system, COMPONENT, *_MESSAGE_ID) + payload
        return _MAGIC + body + _CHECKSUM.pack(dialect.x25crc(body + _CRC_EXTRA).crc)


class Outcome(NamedTuple):
    """What becomes of one position: `odometry` to send with `time_usec`, or the `refusal`.

    `warning`: why PX4 may not use it, or "".
    """

    odometry: Odometry | None = None
    time_usec: int = 0
    refusal: Refusal | None = None
    warning: str = ""


class ExternalPosition:
    """Decide which positions of a publisher are sent, and convert them. State of one vehicle.

    PX4 stamps the messages on arrival, unless `TIMESYNC` is answered; either way they carry the time of the measurement
    on the monotonic clock of this host, which is never ahead.

    `sent`, `left_out`: number of positions sent, and of those not sent, by kind of refusal.
    `reasons`: the newest text of each kind. `warnings`: the active ones, by kind.
    `sender`: who is sending. `rate`: messages sent per second. `age`: of the last position sent [s].
    """

    def __init__(self) -> None:
        self.sent = 0
        self.left_out = Counter[str]()
        self.reasons: dict[str, str] = {}
        self.warnings: dict[str, str] = {}
        self.sender = ""
        self.age = 0.0
        self._last_heard = -math.inf
        self._sent_times: deque[float] = deque(maxlen=_RATE_WINDOW)
        self._reset()

    def _reset(self) -> None:
        """Discard what is known of a sender."""
        self._delay = _Delay()
        self._stamp = -1
        self._due = -math.inf
        self._last: tuple[Odometry, int] | None = None
        self._changes: deque[bool] = deque(maxlen=_COUNTS_MESSAGES)

    @property
    def last_sent(self) -> float:
        """Time of the last position sent; minus infinity before the first."""
        return self._sent_times[-1] if self._sent_times else -math.inf

    @property
    def rate(self) -> float:
        """Messages sent per second, over the last ten; 0 before the second one."""
        if len(self._sent_times) < 2:
            return 0.0
        return (len(self._sent_times) - 1) / max(1e-6, self._sent_times[-1] - self._sent_times[0])

    def add(self, position: Position, sender: str, now: float) -> Outcome:
        """Decide on a position that `sender` published, and that arrived at time `now`."""
        try:
            odometry = self._accept(position, sender, now)
        except _RefusedError as exc:
            return Outcome(refusal=self.refuse(*exc.refusal))
        self.sent += 1
        self._sent_times.append(now)
        self._warn_of_rate()
        time_usec = max(0, math.floor(1e6 * (now - self.age)))
        return Outcome(odometry, time_usec, warning="; ".join(self.warnings.values()))

    def refuse(self, kind: str, text: str) -> Refusal:
        """Count a position that is not sent."""
        if kind in self.reasons or len(self.reasons) < _MAX_REASONS:
            self.reasons[kind] = text
            self.left_out[kind] += 1
        else:
            self.left_out["other"] += 1
        return Refusal(kind, text)

    def _accept(self, position: Position, sender: str, now: float) -> Odometry:
        self._check_sender(sender, now)
        delay = self._delay_of(position.timestamp, now)
        age = delay + self._sensor_age(position)
        odometry = odometry_of(position)
        self._check_reset_counter(odometry, position.timestamp)
        if age > MAX_AGE:
            text = f"it is {1e3 * age:.0f} ms old, more than {1e3 * MAX_AGE:.0f}: send each position at once"
            raise _RefusedError("age", text)
        self._check_rate(now)
        self.age = age
        return odometry

    def _check_sender(self, sender: str, now: float) -> None:
        if sender != self.sender:
            if now - self._last_heard < _TAKEOVER:
                text = f"{sender} publishes, too, but {self.sender} is the sender: stop one of them"
                raise _RefusedError("sender", text)
            self.sender = sender
            self.warnings.clear()
            self._reset()
        self._last_heard = now

    def _delay_of(self, timestamp: int, now: float) -> float:
        """Return how long a message was under way [s], beyond the shortest way."""
        delay = self._delay.add(timestamp / 1e6, now)
        if delay is None:
            text = (
                f"timestamp {timestamp} is not the expected time: "
                "the clock of the sender has been stepped, or stalled"
            )
            raise _RefusedError("clock", f"{text}; use a monotonic clock")
        if self._delay.was_stepped:
            self._stamp, self._last = -1, None
        if timestamp <= self._stamp:
            text = f"timestamp {timestamp} follows {self._stamp}: it must rise with each message"
            raise _RefusedError("time", text)
        self._stamp = timestamp
        return delay

    def _sensor_age(self, position: Position) -> float:
        """Return the age of a measurement when it was published [s]; 0 if unknown, with a warning if it is wild."""
        if not position.timestamp_sample:
            return 0.0
        age = (position.timestamp - position.timestamp_sample) / 1e6
        if 0 <= age <= _MAX_SENSOR_AGE:
            self.warnings.pop("sample", None)
            return age
        order = "before" if age > 0 else "after"
        self.warnings["sample"] = (
            f"timestamp_sample {position.timestamp_sample} is {abs(age):.1f} s {order} timestamp and is not used:"
            " take both from one clock"
        )
        return 0.0

    def _check_reset_counter(self, odometry: Odometry, timestamp: int) -> None:
        """Refuse a counter that counts messages; warn of a jump without a new counter."""
        last, self._last = self._last, (odometry, timestamp)
        if last is None:
            return
        before, then = last
        has_changed = odometry.reset_counter != before.reset_counter
        self._changes.append(has_changed)
        if len(self._changes) == _COUNTS_MESSAGES and all(self._changes):
            text = (
                f"reset_counter {odometry.reset_counter} changes with each message: "
                "raise it only when position jumps"
            )
            raise _RefusedError("reset_counter", text)
        distance = math.dist(before.position, odometry.position)
        if (
            has_changed
            or distance <= _JUMP
            or not _is_jump(before, odometry, distance, (timestamp - then) / 1e6)
        ):
            self.warnings.pop("jump", None)
            return
        self.warnings["jump"] = (
            f"position jumped by {distance:.1f} m and reset_counter stayed {odometry.reset_counter}: PX4 rejects it for"
            " 1 s; raise the counter with each jump"
        )

    def _check_rate(self, now: float) -> None:
        interval = 1 / MAX_RATE
        if now < self._due - _EARLY * interval:
            raise _RefusedError(
                "rate", f"more than {MAX_RATE:.0f} per second: the others are left out"
            )
        self._due = max(self._due, now - interval) + interval

    def _warn_of_rate(self) -> None:
        self.warnings.pop("rate", None)
        if len(self._sent_times) == _RATE_WINDOW and self.rate < MIN_RATE:
            self.warnings["rate"] = (
                f"{self.rate:.1f} messages per second: PX4 fuses none below {MIN_RATE:.0f}; send 20 to 50"
            )


def _is_jump(before: Odometry, odometry: Odometry, distance: float, seconds: float) -> bool:
    """Return whether a vehicle cannot have moved by this distance [m] between two known positions."""
    if (
        before.pose_variances[0] >= UNKNOWN_VARIANCE
        or odometry.pose_variances[0] >= UNKNOWN_VARIANCE
    ):
        return False
    speed = _MAX_SPEED
    for each in (before, odometry):
        if _known(each.velocity):
            speed = max(speed, 2 * math.hypot(*each.velocity))
    return distance > _JUMP + speed * seconds


class _Delay:
    """Delay of messages beyond the shortest one, from the clock of their sender, which may be any clock and drift.

    A step of that clock counts once the delay is steady after it; a backlog that arrives at once is not steady.
    """

    def __init__(self) -> None:
        self.was_stepped = False
        # offset between the clocks, in this and the previous window
        self._shortest = self._previous = math.inf
        self._window = -math.inf
        self._candidate, self._since = math.inf, 0.0

    def add(self, stamp: float, now: float) -> float | None:
        """Return the delay of a message [s]; None if it does not fit the ones before."""
        offset, base = now - stamp, min(self._shortest, self._previous)
        self.was_stepped = False
        if math.isinf(base):
            self._start(offset, now)
        elif abs(offset - base) > _MAX_DELAY:
            if abs(offset - self._candidate) > _STEADY:
                self._candidate, self._since = offset, now
            if now - self._since < _STEADY_TIME:
                return None
            self.was_stepped = True
            self._start(min(offset, self._candidate), now)
        self._candidate = math.inf
        if now - self._window > _WINDOW:
            self._window = now
            self._previous = self._shortest
            self._shortest = offset
        self._shortest = min(self._shortest, offset)
        return offset - min(self._shortest, self._previous)

    def _start(self, offset: float, now: float) -> None:
        self._shortest = offset
        self._previous = math.inf
        self._window = now


def odometry_of(position: Position) -> Odometry:
    """Convert a position; raises ValueError, with field, value and remedy, for what PX4 would ignore silently."""
    return _CONVERSIONS[type(position)](position)


def _of_odometry(position: VehicleOdometry) -> Odometry:
    frame = _POSE_FRAMES.get(position.pose_frame)
    if frame is None:
        text = f"pose_frame is {position.pose_frame}: set it to POSE_FRAME_NED (1) or POSE_FRAME_FRD (2)"
        raise _RefusedError("pose_frame", text)
    velocity = _vector("velocity", position.velocity)
    child_frame = _VELOCITY_FRAMES.get(position.velocity_frame)
    if child_frame is None:
        if velocity is not _NAN3:
            text = f"velocity_frame is {position.velocity_frame}: set it to 1 (NED), 2 (FRD) or 3 (BODY_FRD)"
            raise _RefusedError("velocity_frame", text)
        child_frame = dialect.MAV_FRAME_BODY_FRD
    where = _vector("position", position.position)
    variance = _variances("position_variance", position.position_variance)
    if where is _NAN3:
        where = _ZERO3
        variance = _UNKNOWN3
    rates = position.angular_velocity if _known(position.angular_velocity) else _NAN3
    attitude = _variances("orientation_variance", position.orientation_variance)
    return Odometry(
        frame, child_frame, where, _quaternion(position.q), velocity, rates, (*variance, *attitude),
        _variances("velocity_variance", position.velocity_variance), position.reset_counter,
        max(-1, min(100, position.quality)),
    )  # fmt: skip


def _of_local_position(position: VehicleLocalPosition) -> Odometry:
    """Convert a position in NED, with the attitude of a level vehicle; what is not valid gets UNKNOWN_VARIANCE."""
    if not (position.xy_valid or position.z_valid or position.v_xy_valid or position.v_z_valid):
        raise _RefusedError(
            "validity",
            "xy_valid, z_valid, v_xy_valid and v_z_valid are false: there is nothing to send",
        )
    horizontal, vertical = _square("eph", position.eph) / 2, _square("epv", position.epv)
    where, variances = _valid(
        ("x", position.x, horizontal, position.xy_valid), ("y", position.y, horizontal, position.xy_valid),
        ("z", position.z, vertical, position.z_valid),
    )  # fmt: skip
    velocity, velocity_variances = _NAN3, _NAN3
    if position.v_xy_valid or position.v_z_valid:
        horizontal, vertical = _square("evh", position.evh) / 2, _square("evv", position.evv)
        velocity, velocity_variances = _valid(
            ("vx", position.vx, horizontal, position.v_xy_valid), ("vy", position.vy, horizontal, position.v_xy_valid),
            ("vz", position.vz, vertical, position.v_z_valid),
        )  # fmt: skip
    q: Sequence[float] = _NAN4
    if position.heading_good_for_control and math.isfinite(position.heading):
        q = math.cos(position.heading / 2), 0.0, 0.0, math.sin(position.heading / 2)
    counters = (
        position.xy_reset_counter, position.z_reset_counter, position.vxy_reset_counter, position.vz_reset_counter,
        position.heading_reset_counter,
    )  # fmt: skip
    heading_variances = _variances("heading_var", [position.heading_var])
    return Odometry(
        dialect.MAV_FRAME_LOCAL_NED, dialect.MAV_FRAME_LOCAL_NED, where, q, velocity, _NAN3,
        (*variances, UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, *heading_variances), velocity_variances,
        sum(counters) % 256, 0,
    )  # fmt: skip


def _valid(
    *axes: tuple[str, float, float, bool],
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return values and variances of three axes, each (field, value, variance, is valid)."""
    values, variances = list[float](), list[float]()
    for name, value, variance, is_valid in axes:
        if is_valid and not math.isfinite(value):
            raise _RefusedError(
                name,
                f"{name} is {value} although it is valid: mark it as not valid, or leave it out",
            )
        values.append(value if math.isfinite(value) else 0.0)
        variances.append(variance if is_valid else UNKNOWN_VARIANCE)
    return (values[0], values[1], values[2]), (variances[0], variances[1], variances[2])


def _vector(name: str, values: Sequence[float]) -> Sequence[float]:
    """Return a vector; all NaN if it is unknown. One NaN makes PX4 drop all three."""
    if _known(values):
        return values
    if all(map(math.isnan, values)):
        return _NAN3
    text = f"{name} is {list(values)}: PX4 drops all three coordinates; set the unknown one to 0"
    raise _RefusedError(name, f"{text}, and its variance to {UNKNOWN_VARIANCE:.0e}")


def _quaternion(q: Sequence[float]) -> Sequence[float]:
    """Return a unit quaternion; NaN if it is unknown."""
    if math.isnan(q[0]) or not any(q):
        return _NAN4
    norm = math.hypot(*q)
    if not abs(norm - 1) <= _REPAIRED_NORM:  # also of NaN
        text = f"q is {list(q)} with norm {norm:.5g}: send a unit quaternion (w, x, y, z), or NaN if it is unknown"
        raise _RefusedError("q", text)
    return [part / norm for part in q]


def _variances(name: str, values: Sequence[float]) -> Sequence[float]:
    """Return variances unless one is negative or absurd; NaN and 0 mean that PX4 uses its parameters."""
    for value in values:
        if value < 0 or value > UNKNOWN_VARIANCE:
            remedy = f"set NaN for PX4's parameters (EKF2_EVP_NOISE...), {UNKNOWN_VARIANCE:.0e} for an unknown quantity"
            raise _RefusedError("variance", f"{name} is {value:g}: {remedy}")
    return values


def _square(name: str, deviation: float) -> float:
    """Return the variance of a standard deviation."""
    if deviation < 0:
        raise _RefusedError(
            "variance", f"{name} is {deviation:g}: set a standard deviation above 0, or NaN"
        )
    return min(deviation * deviation, UNKNOWN_VARIANCE) if math.isfinite(deviation) else math.nan


def _covariance(variances: Sequence[float]) -> list[float]:
    """Return the upper triangle of a covariance matrix with these variances; the others are unknown."""
    matrix = [math.nan] * _COVARIANCES
    for index, variance in zip(_DIAGONAL, variances, strict=False):
        matrix[index] = variance
    return matrix


def _known(values: Sequence[float]) -> bool:
    return all(map(math.isfinite, values))


_CONVERSIONS: Final[Mapping[type, Callable[[Any], Odometry]]] = {
    VehicleOdometry: _of_odometry,
    VehicleOdometry.DEFINITION.row: _of_odometry,
    VehicleLocalPosition: _of_local_position,
    VehicleLocalPosition.DEFINITION.row: _of_local_position,
}
"""The conversion of each message, as a model or as a row."""
