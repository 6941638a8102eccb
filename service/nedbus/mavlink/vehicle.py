"""State of a MAVLink vehicle: MAVLink in, PX4 messages and requests out; no I/O, callers pass monotonic time [s]."""

import logging
import math
from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any, Final, Protocol, cast

from pymavlink.dialects.v20 import common as dialect

from nedbus.log_event import about
from nedbus.samples import Rejection, SourceMessage
from nedbus.timeline import RecentTimes, TimeKind
from nedbus.ulog import LOG_MESSAGE, RateLimit, to_log_text
from nedbus_msgs import DEFAULT, DEFAULT_TOPIC, TOPICS, Address, decode_text, is_unix_time
from nedbus_msgs.frames import wrap

from .boot_time import new_clock, read_time, time_since_boot
from .fields import CONVERSIONS, HIGH_LATENCY, OF_HIGH_LATENCY, can_be_vtol, vtol_status
from .senders import text_source
from .sequence import REPEATED
from .text_copies import TextCopies

_log = logging.getLogger(__name__)

_VALUE_TIMEOUT: Final = 2.0  # s for which a received value is merged into the estimate
_STATUS_TIMEOUT: Final = 5.0  # s; without a request, PX4 sends ESTIMATOR_STATUS once a second
_SILENCE_TIMEOUT: Final = 3.0  # s without messages after which all state is reset
_FIRST_ROUNDS: Final = 3  # initial transmissions of each request, because links lose messages
_REQUEST_INTERVAL: Final = 5.0  # s between rounds of requests for messages that do not arrive
_UNKNOWN_HEADING: Final = 65535
_MAX_LATITUDE: Final = 90e7  # 1e-7 deg
# s without a HEARTBEAT until a link with HIGH_LATENCY2 is a satellite link
_HEARTBEAT_TIMEOUT: Final = 10.0
# s from the first message within which the first HEARTBEAT is expected
_FIRST_HEARTBEAT: Final = 1.5
_CHUNK_TIMEOUT: Final = 2.0  # s for the next chunk of a STATUSTEXT; then the text ends with "..."
_CHUNK: Final = 50  # bytes; a shorter chunk is the last
_MAX_WAITING: Final = 100  # log messages
_DEBUG: Final = 7
# s without a new message on the first link after which another one is the first
_HANDOVER: Final = 0.5
# s without a new message on the first link after which messages without a time are used
_LINK_TIMEOUT: Final = 2.0
_SENT_ONCE: Final = frozenset({"sensor_gps", "vehicle_odometry"})  # their messages have `time_usec`

ORIGIN: Final = 49  # GPS_GLOBAL_ORIGIN
_POSITION = 32
_STATUS = 230
_QUATERNION = 31
STREAMS: Final = {
    _POSITION: (40, 0.0, "vehicle_local_position"),
    _STATUS: (54, 0.0, "vehicle_local_position vehicle_global_position"),
    33: (40, 10.0, "vehicle_local_position vehicle_global_position"),
    141: (44, 10.0, "vehicle_local_position"),
    331: (244, 10.0, "vehicle_local_position vehicle_odometry"),
    _QUATERNION: (44, 0.0, "vehicle_attitude"),
    24: (64, 5.0, "sensor_gps"),
    2: (24, 1.0, "sensor_gps"),
    1: (55, 1.0, "vehicle_status"),
    147: (66, 1.0, "battery_status"),
    242: (72, 1.0, "home_position"),
    245: (14, 1.0, "vehicle_land_detected vehicle_status"),
}
"""Messages to request, in order: size in MAVLink 2 [bytes], rate [Hz] (0: option `rate`), topics that need them."""

_MIN_RATE: Final = 2.0  # Hz, on a saturated link
_USABLE_SHARE: Final = 0.9  # share of a link's bandwidth; the rest is for heartbeats and answers
_BITS_PER_BYTE: Final = 10  # on a serial line, with start and stop bits


def request_rates(rate: float, baud: int | None, topics: Collection[str]) -> dict[int, float]:
    """Return the rates to request [Hz] for these topics: positions at `rate`, other messages at their own rates.

    If a serial link with this baud rate cannot carry them all, the other messages share a common upper limit.
    """
    wanted = {
        number: max(_MIN_RATE, rate) if number == _STATUS else hertz or rate
        for number, (_, hertz, needed) in STREAMS.items()
        if not set(needed.split()).isdisjoint(topics)
    }
    others = sorted(wanted.keys() - {_POSITION}, key=wanted.__getitem__)
    capacity = math.inf if baud is None else _USABLE_SHARE * baud / _BITS_PER_BYTE  # bytes/s
    free = capacity - STREAMS[_POSITION][0] * wanted.get(_POSITION, 0.0)
    for index, number in enumerate(others):
        level = free / sum(STREAMS[each][0] for each in others[index:])
        wanted[number] = min(wanted[number], max(_MIN_RATE, level))
        free -= STREAMS[number][0] * wanted[number]
    return wanted


class StreamedTopics(Protocol):
    """What a vehicle's ULog stream delivers."""

    @property
    def is_streaming(self) -> bool:
        """True while the stream delivers messages."""

    def delivers(self, address: Address) -> bool:
        """Return whether the stream has messages of an address."""


class Vehicle:
    """State of one vehicle: pass its messages to `handle`, and send the requests from `next_request`.

    `topics`: those to deliver, None for all; `rate`: positions per second to request.
    `baud`: of a serial link; None for other links, whose bandwidth is unknown.
    `lost`, `rebooted`: losses and a reboot that were not reported yet.
    `copies`: messages that came again or late over a second link, and were dropped.
    """

    def __init__(
        self,
        name: str,
        topics: Collection[str] | None = None,
        *,
        rate: float = 30.0,
        baud: int | None = None,
    ) -> None:
        self._name = name
        self._topics = topics or TOPICS
        self._rates = request_rates(rate, baud, self._topics)
        if _POSITION in self._rates:
            self._rates[ORIGIN] = 0.0
        self.clock = new_clock()
        self.copies = 0
        self._link = 0  # of the last message
        self._first_link: int | None = None  # the link that delivers new messages first
        self._led = -math.inf  # time of its last new message
        self._last_message = 0.0
        # time of the last HEARTBEAT and HIGH_LATENCY2
        self._last_heartbeat = self._high_latency = -math.inf
        # `_certain`: those before the last LOGGING_DATA, which are not of the stream
        self.lost = self._certain = 0
        self.rebooted = False
        self._text_source: str | None = None  # of its log messages, if it is not PX4
        # what the time of the last message shows; None if it has none
        self._kind: TimeKind | None = None
        self._text_limit, self._text_address = RateLimit(), Address(name, LOG_MESSAGE.name)
        self._reported: set[int] = set()  # requested messages that were logged as not sent
        self._reset(0.0)

    def _reset(self, now: float) -> None:
        """Discard all state and request everything again, after silence or a reboot."""
        # fields of earlier messages, and their expiry
        self._stored: dict[str, tuple[dict[str, object], float]] = {}
        # newest timestamps, and the links that delivered them
        self._last: dict[Address, tuple[int, int]] = {}
        self._delivered = RecentTimes()
        # times of the last samples, and the links that delivered them
        self._samples: dict[Address, tuple[int, int]] = {}
        self._texts = _StatusTexts()
        self._text_copies = TextCopies()
        self._started = now
        self._arrivals: dict[int, float] = {}  # last arrival of each requested message
        self._pending = [*self._rates] * _FIRST_ROUNDS
        self._next_round = now + _REQUEST_INTERVAL

    def count_lost(
        self, lost: int, now: float, *, counted: int | None = None, link: int = 0
    ) -> None:
        """Count the messages of any type lost before one that arrived at `now`; a negative number corrects the count.

        `counted`: those that the ULog stream has counted, if this is one of its messages. `link`: its number, from 0,
        or `REPEATED`.
        """
        self._link = link
        if now - self._last_message > _SILENCE_TIMEOUT:
            self._reset(now)
        self._last_message = now
        self.lost = max(0, self.lost + lost - (counted or 0))
        if counted is not None:
            self._certain = self.lost

    def report(self, message: SourceMessage, log: StreamedTopics | None = None) -> SourceMessage:
        """Add the losses and the reboot that were not reported yet; during a ULog stream only losses of others."""
        lost = min(self.lost, self._certain) if log is not None and log.is_streaming else self.lost
        if not (lost or self.rebooted):
            return message
        rebooted = self.rebooted
        self.rebooted = False
        self.lost = self.lost - lost
        self._certain = 0
        return replace(message, lost=message.lost + lost, rebooted=rebooted)

    def next_request(self, now: float) -> tuple[int, float] | None:
        """Return id and rate [Hz] of the next message to request, rate 0 for a single one; None if none is due.

        Each message is requested three times, and then every 5 s until it arrives.
        """
        if now - self._last_message > _SILENCE_TIMEOUT or self.is_high_latency:
            return None
        if not self._pending and now >= self._next_round:
            self._next_round = now + _REQUEST_INTERVAL
            self._pending = [
                each
                for each in self._rates
                if now - self._arrivals.get(each, 0.0) > _SILENCE_TIMEOUT
            ]
            # No report for the origin, which the vehicle sends only once it has a global position.
            for number in {*self._pending} - self._arrivals.keys() - self._reported - {ORIGIN}:
                self._reported.add(number)
                name = dialect.mavlink_map[number].msgname
                address = Address(self._name, DEFAULT_TOPIC)
                extra = about("unsupported", address)
                _log.info("vehicle %s does not send %s on request", self._name, name, extra=extra)
        if not self._pending:
            return None
        number = self._pending.pop(0)
        return number, self._rates[number]

    @property
    def is_high_latency(self) -> bool:
        """Whether the link is a satellite link, whose only message is HIGH_LATENCY2."""
        return self._high_latency > self._last_heartbeat + _HEARTBEAT_TIMEOUT

    def handle_all(
        self, message: Any, now: float, log: StreamedTopics | None = None
    ) -> list[SourceMessage | Rejection]:
        """Convert a message as `handle` does; HIGH_LATENCY2 contains several topics."""
        kind = message.get_type()
        if kind == "HEARTBEAT":
            self._last_heartbeat, self._text_source = now, text_source(message.autopilot)
        if kind != HIGH_LATENCY:
            item = self.handle(message, now, log)
            return [] if item is None else [item]
        self._high_latency = now
        timestamp = self._track_time(message, now)
        if self._is_copy(message, now):
            self.copies += 1
            return []
        items = [
            self._publish(self._address(topic), fields_of(message), timestamp, now, log)
            for topic, fields_of in OF_HIGH_LATENCY.items()
            if topic in self._topics and timestamp is not None
        ]
        return [item for item in items if item is not None]

    def handle(
        self, message: Any, now: float, log: StreamedTopics | None = None
    ) -> SourceMessage | Rejection | None:
        """Convert a message; return a Rejection if it is out of order, or there are too many texts.

        Return None if no chosen topic needs it, or `log`, the vehicle's ULog stream, delivers that topic.
        """
        kind = message.get_type()
        topic, fields_of = CONVERSIONS.get(kind, ("", None))
        timestamp = self._track_time(message, now)
        if timestamp is not None and self._kind is TimeKind.WILD:
            return self._rejected(topic, message, f"wild time ({timestamp // 1000} ms since boot)")
        if self._is_copy(message, now):
            self.copies += 1
            return None
        if (number := message.get_msgId()) in self._rates:
            self._arrivals[number] = now
        is_redundant = (
            kind == "ATTITUDE"
            and now <= self._arrivals.get(_QUATERNION, self._started) + _VALUE_TIMEOUT
        )
        self._store_fields(kind, message, timestamp, now)
        address = self._text_address
        if (
            kind == "STATUSTEXT"
            and address.topic in self._topics
            and not (log and log.delivers(address))
        ):
            if not self._text_limit.admits(round(now * 1e6)):
                return Rejection(str(address), "more than 100 log messages per second", address)
            self._texts.add(message, now)
        if fields_of is None:
            topic, fields_of = LOG_MESSAGE.name, lambda _: self._next_text(now)
            timestamp = self.clock.newest
        if topic not in self._topics or is_redundant or timestamp is None:
            return None
        address = self._address(topic, message.id if kind == "BATTERY_STATUS" else 0)
        if kind in CONVERSIONS and log is not None and log.delivers(address):
            return None
        # a text is discarded only now
        return self._publish(address, fields_of(message), timestamp, now, log)

    def _is_copy(self, message: Any, now: float) -> bool:
        """Return whether the last message came before.

        A text did if another link delivered it; any other message without a time, if its link is behind the first.
        """
        if self._kind is not None:
            return self._kind is TimeKind.COPY
        if message.get_type() == "STATUSTEXT":
            return self._text_copies.add(message, self._link, now)
        if self._link == REPEATED:
            return True
        is_led = self._first_link is not None and now - self._led <= _LINK_TIMEOUT
        return is_led and self._link != self._first_link

    def _rejected(self, topic: str, message: Any, reason: str) -> Rejection | None:
        if topic not in self._topics:
            return None
        address = self._address(topic, message.id if message.get_type() == "BATTERY_STATUS" else 0)
        return Rejection(str(address), reason, address)

    def _address(self, topic: str, instance: int = 0) -> Address:
        return Address(self._name, topic, instance if TOPICS[topic].instances else None)

    def _publish(
        self,
        address: Address,
        fields: Mapping[str, object],
        timestamp: int,
        now: float,
        log: StreamedTopics | None,
    ) -> SourceMessage | Rejection | None:
        """Return the message of an address, from which unknown fields are left out; see `handle`."""
        fields = {name: value for name, value in fields.items() if value is not None}
        if not fields or (log is not None and log.delivers(address)):
            return None
        if address.topic in _SENT_ONCE:
            placed = self._place_sample(address, timestamp)
            if placed is None:
                self.copies += 1
                return None
            timestamp = placed
        last, link = self._last.get(address, (0, self._link))
        # a second link's times need not be equal to those of the first
        if timestamp < last and link != self._link:
            self.copies += 1
            return None
        if timestamp < last and self.clock.is_doubtful:
            return None  # probably the first messages after a reboot, which is not certain yet
        if timestamp < last:
            reason = f"out of order ({timestamp // 1000} ms since boot, after {last // 1000} ms)"
            return Rejection(str(address), reason, address)
        self._last[address] = timestamp, self._link
        fields = {"timestamp": timestamp, **fields}
        self._add_stored_fields(address.topic, fields, timestamp, now)
        source = self._text_source if address == self._text_address else None
        return self.report(SourceMessage(0.0, address, fields, source=source, arrived=now), log)

    def _next_text(self, now: float) -> dict[str, object]:
        """Return the fields of the next text; {} if there is none, or if its source is not known yet.

        A .tlog may begin with texts, before the first HEARTBEAT, which comes once a second and names their source.
        """
        is_anonymous = self._last_heartbeat == -math.inf
        if is_anonymous and now - self._started < _FIRST_HEARTBEAT:
            return {}
        return self._texts.pop(now)

    def _place_sample(self, address: Address, sampled: int) -> int | None:
        """Return the time of a message whose sensor sampled at `sampled` [us since boot]; None for a copy.

        While its GPS has no fix, ArduPilot repeats the time of the last one, with a new state: over the same link such
        a message is no copy, and has the vehicle's newest time. Later samples follow it.
        """
        last, link = self._samples.get(address, (-1, self._link))
        is_repeated = sampled == last and self._link == link != REPEATED
        if self._delivered.contains(address, sampled) and not is_repeated:
            return None
        self._delivered.add(address, sampled)
        self._samples[address] = sampled, self._link
        newest, _ = self._last.get(address, (0, self._link))
        if is_repeated:
            return max(newest, self.clock.newest or sampled)
        if sampled > last:
            return max(newest, sampled)
        return sampled

    def _store_fields(self, kind: str, message: Any, timestamp: int | None, now: float) -> None:
        match kind:
            case "GLOBAL_POSITION_INT":
                is_known = message.hdg != _UNKNOWN_HEADING
                heading = {"heading": wrap(math.radians(message.hdg / 100))} if is_known else {}
                # an unknown heading ends the earlier one
                self._store("heading", now + _VALUE_TIMEOUT, **heading)
            case "ATTITUDE":
                yaw = {"heading": wrap(message.yaw)} if math.isfinite(message.yaw) else {}
                self._store("yaw", now + _VALUE_TIMEOUT, **yaw)
            case "GPS_GLOBAL_ORIGIN" if _is_origin(message):
                known = {"ref_timestamp": message.time_usec} if message.time_usec else {}
                latitude = message.latitude / 1e7
                longitude = message.longitude / 1e7
                altitude = message.altitude / 1e3
                known |= {"ref_lat": latitude, "ref_lon": longitude, "ref_alt": altitude}
                self._store("origin", math.inf, xy_global=True, z_global=True, **known)
                self._arrivals[ORIGIN] = math.inf  # the vehicle sends the origin once per request
            case "ALTITUDE":
                is_known = math.isfinite(message.bottom_clearance) and message.bottom_clearance >= 0
                bottom = {"dist_bottom": message.bottom_clearance} if is_known else {}
                self._store("bottom", now + _VALUE_TIMEOUT, dist_bottom_valid=is_known, **bottom)
            case "ODOMETRY":
                covariance, known = message.velocity_covariance, {}
                north = covariance[0]
                east = covariance[6]
                down = covariance[11]
                if math.isfinite(north + east) and min(north, east) >= 0 and north + east > 0:
                    known["evh"] = math.sqrt(north + east)
                if math.isfinite(down) and down > 0:
                    known["evv"] = math.sqrt(down)
                self._store("velocity", now + _VALUE_TIMEOUT, **known)
            case "ESTIMATOR_STATUS":
                deviations = {"eph": message.pos_horiz_accuracy, "epv": message.pos_vert_accuracy}
                known = {
                    name: value
                    for name, value in deviations.items()
                    if math.isfinite(value) and value > 0
                }
                valid = _validity(message.flags)
                self._store("status", now + _STATUS_TIMEOUT, **valid, **known)
                is_global = bool(message.flags & dialect.ESTIMATOR_POS_HORIZ_ABS)
                on_globe = {
                    "lat_lon_valid": valid["xy_valid"] and is_global,
                    "alt_valid": valid["z_valid"],
                }
                self._store("global status", now + _STATUS_TIMEOUT, **on_globe, **known)
            case "SYS_STATUS":
                names = [
                    f"onboard_control_sensors_{part}" for part in ("present", "enabled", "health")
                ]
                self._store(
                    "sensors",
                    now + _STATUS_TIMEOUT,
                    **{name: getattr(message, name) for name in names},
                )
            case "EXTENDED_SYS_STATE":
                self._store("vtol", now + _STATUS_TIMEOUT, **vtol_status(message.vtol_state))
            case "SYSTEM_TIME" if timestamp is not None and is_unix_time(message.time_unix_usec):
                self._store("utc", now + _STATUS_TIMEOUT, boot=message.time_unix_usec - timestamp)

    def _store(self, name: str, until: float, **fields: object) -> None:
        self._stored[name] = fields, until

    def _recall(self, name: str, now: float) -> dict[str, object]:
        fields, until = self._stored.get(name, ({}, 0.0))
        return fields if now <= until else {}

    def _add_stored_fields(
        self, topic: str, fields: dict[str, object], timestamp: int, now: float
    ) -> None:
        match topic:
            case "vehicle_local_position":
                for name in ("yaw", "heading", "status", "bottom", "velocity", "origin"):
                    fields |= self._recall(name, now)
                # The flags are from an earlier message; the fields may have become NaN since.
                for flag, names in DEFAULT.flags.items():
                    if fields.get(flag) and not all(
                        math.isfinite(cast("float", fields[name])) for name in names
                    ):
                        fields[flag] = False
            case "vehicle_global_position":
                fields |= self._recall("global status", now)
            case "vehicle_status":
                fields |= self._recall("sensors", now)
                if can_be_vtol(fields.get("system_type")):
                    fields |= self._recall("vtol", now)
            case "sensor_gps" if utc := self._recall("utc", now):
                fields["time_utc_usec"] = cast("int", utc["boot"]) + timestamp

    def _track_time(self, message: Any, now: float) -> int | None:
        """Return the time of a message [us since boot], or of the newest message if it has none; None if unknown."""
        reading = read_time(self.clock, message, now)
        self._kind = None if reading is None else reading.kind
        if self._kind in (TimeKind.NEW, TimeKind.REBOOT, TimeKind.STEP):
            self._follow_link(now)
        sampled = time_since_boot(message)
        is_reboot = self._kind is TimeKind.REBOOT
        if sampled is not None:  # a sample may be old: it shows a reboot, and nothing else
            is_reboot = self.clock.add(message.get_type(), sampled, now).kind is TimeKind.REBOOT
        if is_reboot:
            self.rebooted = True
            self.lost = self._certain = 0  # the sequence restarted too, so the count is wrong
            self._reset(now)
        if sampled is not None:
            return sampled
        ms: int | None = getattr(message, "time_boot_ms", None)
        if reading is not None:
            return reading.time
        return self.clock.newest if ms is None else self.clock.unwrap(1000 * ms, now)

    def _follow_link(self, now: float) -> None:
        """Note that a link has delivered a new message."""
        if self._first_link is None or now - self._led > _HANDOVER:
            self._first_link = self._link
        if self._link == self._first_link:
            self._led = now


def _is_origin(message: Any) -> bool:
    """Return whether GPS_GLOBAL_ORIGIN has an origin: zeros are none, and PX4 up to 1.15 exceeds 180 degrees."""
    return abs(message.latitude) <= _MAX_LATITUDE and bool(message.latitude or message.longitude)


def _validity(bits: int) -> dict[str, object]:
    """Return the validity of position and velocity from ESTIMATOR_STATUS.flags.

    Up to PX4 1.15, constant position mode means that there is no horizontal velocity. Since PX4's commit 48f1687d3a it
    is also set for a vehicle at rest, whose velocity and position are valid.
    """
    has_velocity = bool(bits & dialect.ESTIMATOR_VELOCITY_HORIZ)
    has_position = bool(bits & (dialect.ESTIMATOR_POS_HORIZ_REL | dialect.ESTIMATOR_POS_HORIZ_ABS))
    return {
        "xy_valid": has_position and (has_velocity or not bits & dialect.ESTIMATOR_CONST_POS_MODE),
        "z_valid": bool(bits & dialect.ESTIMATOR_POS_VERT_ABS),
        "v_xy_valid": has_velocity,
        "v_z_valid": bool(bits & dialect.ESTIMATOR_VELOCITY_VERT),
    }


class _StatusTexts:
    """Join the STATUSTEXT chunks of one vehicle."""

    def __init__(self) -> None:
        self._current = (0, 0)  # severity and id of the incomplete text
        self._data = b""
        self._next = 0
        self._time = 0.0
        self._waiting: deque[dict[str, object]] = deque(maxlen=_MAX_WAITING)

    def add(self, message: Any, now: float) -> None:
        """Add a STATUSTEXT; a missing chunk becomes "..."."""
        data, sequence = message._text_raw, message.chunk_seq  # noqa: SLF001 - `text` is ASCII only
        current = min(message.severity, _DEBUG), message.id
        if self._next and (self._current != current or sequence < self._next):
            self._finish("...")
        gap = b"..." if sequence > self._next else b""
        self._data += gap + data.partition(b"\0")[0]  # at most 256 chunks
        self._current = current
        self._next = sequence + 1
        self._time = now
        if not message.id or len(data) < _CHUNK or b"\0" in data:
            self._finish()

    def pop(self, now: float) -> dict[str, object]:
        """Remove the next text that is complete or has timed out; return its fields, or {} if there is none."""
        if self._next and now - self._time > _CHUNK_TIMEOUT:
            self._finish("...")
        return self._waiting.popleft() if self._waiting else {}

    def _finish(self, end: str = "") -> None:
        self._waiting.append(
            {"severity": self._current[0], "text": to_log_text(decode_text(self._data) + end)}
        )
        self._data, self._next = b"", 0
