"""External position: a position from the bus in, ODOMETRY for PX4 out, or why not; no I/O, monotonic time [s]."""

import math
import struct
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import common as dialect

from nedbus_msgs.messages import VehicleLocalPosition, VehicleOdometry

RATE_LIMIT: Final = 50.0
"""Messages per second to send at most; PX4 drops what is faster than its buffer."""
FUSION_RATE: Final = 5.0
"""Messages per second below which PX4 does not start to fuse: it needs two within 200 ms."""
AGE_LIMIT: Final = 0.1
"""Seconds between the measurement and its transmission beyond which a position is left out."""
UNKNOWN_VARIANCE: Final = 1e6
"""Variance of a quantity that is unknown: PX4 accepts it without an effect on the estimate."""

_EXACT_NORM: Final = 1e-5  # error of the norm of q that EKF2 accepts
_REPAIRED_NORM: Final = 1e-2  # ... that is normalised, as of quaternions with few decimals
_EARLY: Final = 0.3  # share of an interval by which a message may be early
# s between timestamp_sample and timestamp; more means that their clocks differ
_PLAUSIBLE_AGE: Final = 10.0
# s by which the way on the bus may vary; a larger change is a step of the publisher's clock
_DELAY_TOLERANCE: Final = 1.0
_STEADY: Final = 0.05  # s by which it varies after such a step ...
# s ... for this time, until the step counts: a backlog does not last as long
_STEADY_TIME: Final = 0.3
_WINDOW: Final = 30.0  # s after which the shortest delay is measured anew, because clocks drift
_TAKEOVER: Final = 1.0  # s of silence of a sender until another one is used
_JUMP: Final = 1.0  # m
_PLAUSIBLE_SPEED: Final = 20.0  # m/s of positions without a velocity
_COUNTED_MESSAGES: Final = 5  # messages in a row with a new reset_counter
_RATE_WINDOW: Final = 10  # messages over which the rate is measured

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

_NAN3: Final = (math.nan, math.nan, math.nan)
_NAN4: Final = (math.nan, math.nan, math.nan, math.nan)
_ORIGIN: Final = (0.0, 0.0, 0.0)
_UNKNOWN3: Final = (UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, UNKNOWN_VARIANCE)

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
        complete = _PAYLOAD.pack(
            time_usec,
            *self.position,
            *self.q,
            *self.velocity,
            *self.rates,
            *_covariance(self.pose_variances),
            *_covariance(self.velocity_variances),
            self.frame_id,
            self.child_frame_id,
            self.reset_counter,
            dialect.MAV_ESTIMATOR_TYPE_VISION,
            self.quality,
        )
        payload = complete.rstrip(b"\0")
        header = _HEADER.pack(len(payload), 0, 0, sequence, system, COMPONENT, *_MESSAGE_ID)
        body = header + payload
        checksum = dialect.x25crc(body + _CRC_EXTRA).crc
        return _MAGIC + body + _CHECKSUM.pack(checksum)


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
        self._changes = 0  # messages in a row with a new reset_counter

    @property
    def last_sent(self) -> float:
        """Time of the last position sent; minus infinity before the first."""
        if not self._sent_times:
            return -math.inf
        return self._sent_times[-1]

    @property
    def rate(self) -> float:
        """Messages sent per second, over the last ten; 0 before the second one."""
        times = self._sent_times
        if len(times) < 2:
            return 0.0
        return (len(times) - 1) / max(1e-6, times[-1] - times[0])

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
        self.reasons[kind] = text
        self.left_out[kind] += 1
        return Refusal(kind, text)

    def _accept(self, position: Position, sender: str, now: float) -> Odometry:
        self._check_sender(sender, now)
        delay = self._delay_of(position.timestamp, now)
        age = delay + self._sensor_age(position)
        odometry = odometry_of(position)
        self._check_reset_counter(odometry, position.timestamp)
        if age > AGE_LIMIT:
            text = f"it is {1e3 * age:.0f} ms old, more than {1e3 * AGE_LIMIT:.0f}: send each position at once"
            raise _RefusedError("age", text)
        self._check_rate(now)
        self.age = age
        return odometry

    def _check_sender(self, sender: str, now: float) -> None:
        if sender == self.sender:
            self._last_heard = now
            return
        if now - self._last_heard < _TAKEOVER:
            text = f"{sender} publishes, too, but {self.sender} is the sender: stop one of them"
            raise _RefusedError("sender", text)
        self.sender = sender
        self._last_heard = now
        self.warnings.clear()
        self._reset()

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
            self._stamp = -1
            self._last = None
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
        if 0 <= age <= _PLAUSIBLE_AGE:
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
        last = self._last
        self._last = (odometry, timestamp)
        if last is None:
            return
        before, then = last
        has_changed = odometry.reset_counter != before.reset_counter
        self._changes = self._changes + 1 if has_changed else 0
        if self._changes >= _COUNTED_MESSAGES:
            text = (
                f"reset_counter {odometry.reset_counter} changes with each message: "
                "raise it only when position jumps"
            )
            raise _RefusedError("reset_counter", text)
        distance = math.dist(before.position, odometry.position)
        seconds = (timestamp - then) / 1e6
        if has_changed or not _is_jump(before, odometry, distance, seconds):
            self.warnings.pop("jump", None)
            return
        self.warnings["jump"] = (
            f"position jumped by {distance:.1f} m and reset_counter stayed {odometry.reset_counter}: PX4 rejects it for"
            " 1 s; raise the counter with each jump"
        )

    def _check_rate(self, now: float) -> None:
        interval = 1 / RATE_LIMIT
        if now < self._due - _EARLY * interval:
            text = f"more than {RATE_LIMIT:.0f} per second: the others are left out"
            raise _RefusedError("rate", text)
        self._due = max(self._due, now - interval) + interval

    def _warn_of_rate(self) -> None:
        self.warnings.pop("rate", None)
        if len(self._sent_times) == _RATE_WINDOW and self.rate < FUSION_RATE:
            self.warnings["rate"] = (
                f"{self.rate:.1f} messages per second: PX4 fuses none below {FUSION_RATE:.0f}; send 20 to 50"
            )


def _is_jump(before: Odometry, after: Odometry, distance: float, seconds: float) -> bool:
    """Return whether a vehicle cannot have moved by this distance [m] between two known positions."""
    if distance <= _JUMP:
        return False
    speed = _PLAUSIBLE_SPEED
    for odometry in (before, after):
        if odometry.pose_variances[0] >= UNKNOWN_VARIANCE:
            return False
        if _known(odometry.velocity):
            speed = max(speed, 2 * math.hypot(*odometry.velocity))
    return distance > _JUMP + speed * seconds


class _Delay:
    """Delay of messages beyond the shortest one, from the clock of their sender, which may be any clock and drift.

    A step of that clock counts once the delay is steady after it; a backlog that arrives at once is not steady.
    """

    def __init__(self) -> None:
        self.was_stepped = False
        # the shortest offset between the clocks [s], in this and the previous window
        self._shortest = math.inf
        self._previous = math.inf
        self._window = -math.inf
        self._candidate = math.inf  # offset after a step that is not certain yet ...
        self._since = 0.0  # ... and its first time

    def add(self, stamp: float, now: float) -> float | None:
        """Return the delay of a message [s]; None if it does not fit the ones before."""
        offset = now - stamp
        shortest = min(self._shortest, self._previous)
        self.was_stepped = False
        if math.isinf(shortest):
            self._start(offset, now)
        elif abs(offset - shortest) > _DELAY_TOLERANCE:
            if abs(offset - self._candidate) > _STEADY:
                self._candidate = offset
                self._since = now
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
    if child_frame is None and velocity is not _NAN3:
        text = f"velocity_frame is {position.velocity_frame}: set it to 1 (NED), 2 (FRD) or 3 (BODY_FRD)"
        raise _RefusedError("velocity_frame", text)
    where = _vector("position", position.position)
    variances = _variances("position_variance", position.position_variance)
    if where is _NAN3:
        where = _ORIGIN
        variances = _UNKNOWN3
    attitude = _variances("orientation_variance", position.orientation_variance)
    return Odometry(
        frame_id=frame,
        child_frame_id=dialect.MAV_FRAME_BODY_FRD if child_frame is None else child_frame,
        position=where,
        q=_quaternion(position.q),
        velocity=velocity,
        rates=position.angular_velocity if _known(position.angular_velocity) else _NAN3,
        pose_variances=(*variances, *attitude),
        velocity_variances=_variances("velocity_variance", position.velocity_variance),
        reset_counter=position.reset_counter,
        quality=max(-1, min(100, position.quality)),
    )


def _of_local_position(position: VehicleLocalPosition) -> Odometry:
    """Convert a position in NED, with the attitude of a level vehicle; what is not valid gets UNKNOWN_VARIANCE."""
    has_velocity = position.v_xy_valid or position.v_z_valid
    if not (position.xy_valid or position.z_valid or has_velocity):
        text = "xy_valid, z_valid, v_xy_valid and v_z_valid are false: there is nothing to send"
        raise _RefusedError("validity", text)
    horizontal = _square("eph", position.eph) / 2
    vertical = _square("epv", position.epv)
    axes = (
        _Axis("x", position.x, horizontal, position.xy_valid),
        _Axis("y", position.y, horizontal, position.xy_valid),
        _Axis("z", position.z, vertical, position.z_valid),
    )
    where = [axis.known_value for axis in axes]
    velocity: Sequence[float] = _NAN3
    velocity_variances: Sequence[float] = _NAN3
    if has_velocity:
        horizontal = _square("evh", position.evh) / 2
        vertical = _square("evv", position.evv)
        velocity_axes = (
            _Axis("vx", position.vx, horizontal, position.v_xy_valid),
            _Axis("vy", position.vy, horizontal, position.v_xy_valid),
            _Axis("vz", position.vz, vertical, position.v_z_valid),
        )
        velocity = [axis.known_value for axis in velocity_axes]
        velocity_variances = [axis.known_variance for axis in velocity_axes]
    q: Sequence[float] = _NAN4
    if position.heading_good_for_control and math.isfinite(position.heading):
        q = (math.cos(position.heading / 2), 0.0, 0.0, math.sin(position.heading / 2))
    resets = (
        position.xy_reset_counter
        + position.z_reset_counter
        + position.vxy_reset_counter
        + position.vz_reset_counter
        + position.heading_reset_counter
    )
    [heading] = _variances("heading_var", [position.heading_var])
    variances = [axis.known_variance for axis in axes]
    return Odometry(
        frame_id=dialect.MAV_FRAME_LOCAL_NED,
        child_frame_id=dialect.MAV_FRAME_LOCAL_NED,
        position=where,
        q=q,
        velocity=velocity,
        rates=_NAN3,
        pose_variances=(*variances, UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, heading),
        velocity_variances=velocity_variances,
        reset_counter=resets % 256,
        quality=0,
    )


class _Axis(NamedTuple):
    """One coordinate of a position or velocity."""

    field: str
    value: float
    variance: float
    is_valid: bool

    @property
    def known_value(self) -> float:
        """The value, 0 if it is not valid and not finite; raises ValueError if it is valid and not finite."""
        if math.isfinite(self.value):
            return self.value
        if self.is_valid:
            text = f"{self.field} is {self.value} although it is valid: mark it as not valid, or leave it out"
            raise _RefusedError(self.field, text)
        return 0.0

    @property
    def known_variance(self) -> float:
        if self.is_valid:
            return self.variance
        return UNKNOWN_VARIANCE


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
        text = f"{name} is {deviation:g}: set a standard deviation above 0, or NaN"
        raise _RefusedError("variance", text)
    if not math.isfinite(deviation):
        return math.nan
    return min(deviation * deviation, UNKNOWN_VARIANCE)


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
