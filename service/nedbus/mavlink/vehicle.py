"""State of a MAVLink vehicle: MAVLink in, PX4 messages and requests out; no I/O, callers pass monotonic time [s]."""

import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any, Final, Protocol

from nedbus import limits
from nedbus.samples import Rejection, SourceMessage
from nedbus.timeline import RecentTimes, TimeKind
from nedbus.ulog import LOG_MESSAGE, RateLimit
from nedbus_msgs import TOPICS, Address

from .boot_time import new_clock, read_time, time_since_boot
from .fields import CONVERSIONS, HIGH_LATENCY, OF_HIGH_LATENCY
from .requests import ORIGIN, QUATERNION, Requests
from .senders import text_source
from .sequence import REPEATED
from .status_texts import StatusTexts, TextCopies
from .stored_fields import StoredFields, has_origin

_SILENCE_TIMEOUT: Final = 3.0  # s without messages after which all state is reset
_QUATERNION_TIMEOUT: Final = 2.0  # s without ATTITUDE_QUATERNION after which ATTITUDE replaces it
# s without a HEARTBEAT until a link with HIGH_LATENCY2 is a satellite link
_HEARTBEAT_TIMEOUT: Final = 10.0
# s from the first message within which the first HEARTBEAT is expected
_FIRST_HEARTBEAT: Final = 1.5
# s without a new message on the first link after which another one is the first
_HANDOVER: Final = 0.5
# s without a new message on the first link after which messages without a time are used
_LINK_TIMEOUT: Final = 2.0
_SENT_ONCE: Final = frozenset({"sensor_gps", "vehicle_odometry"})  # their messages have `time_usec`
_LEADING: Final = frozenset({TimeKind.NEW, TimeKind.REBOOT, TimeKind.STEP})  # times of new messages

Item = SourceMessage | Rejection


class StreamedTopics(Protocol):
    """What a vehicle's ULog stream delivers."""

    @property
    def is_streaming(self) -> bool:
        """True while the stream delivers messages."""

    def delivers(self, address: Address) -> bool:
        """Return whether the stream has messages of an address."""


class _FirstLink:
    """The one of a vehicle's links that delivers new messages first."""

    def __init__(self) -> None:
        self._number: int | None = None
        self._led = -math.inf  # time of its last new message

    def add(self, link: int, now: float) -> None:
        """Note that a link has delivered a new message."""
        if self._number is None or now - self._led > _HANDOVER:
            self._number = link
        if link == self._number:
            self._led = now

    def precedes(self, link: int, now: float) -> bool:
        """Return whether another link than this one is the first, and still delivers messages."""
        if self._number is None or now - self._led > _LINK_TIMEOUT:
            return False
        return link != self._number


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
        self._requests = Requests(name, self._topics, rate=rate, baud=baud)
        self.clock = new_clock()
        self.copies = 0
        self.lost = 0
        self._certain = 0  # losses before the last LOGGING_DATA, which are not of the stream
        self.rebooted = False
        self._link = 0  # of the last message
        self._first_link = _FirstLink()
        self._last_message = 0.0
        self._last_heartbeat = -math.inf
        self._last_high_latency = -math.inf
        self._text_source: str | None = None  # of its log messages, if it is not PX4
        self._text_limit = RateLimit()
        self._text_address = Address(name, LOG_MESSAGE.name)
        self._reset(0.0)

    def _reset(self, now: float) -> None:
        """Discard all state and request everything again, after silence or a reboot."""
        self._started = now
        self._stored = StoredFields()
        # newest timestamps, and the links that delivered them
        self._last: dict[Address, tuple[int, int]] = {}
        self._delivered = RecentTimes()
        # times of the last samples, and the links that delivered them
        self._samples: dict[Address, tuple[int, int]] = {}
        self._texts = StatusTexts()
        self._text_copies = TextCopies()
        self._requests.restart(now)

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
        lost = self.lost
        if log is not None and log.is_streaming:
            lost = min(lost, self._certain)
        if not (lost or self.rebooted):
            return message
        rebooted = self.rebooted
        self.rebooted = False
        self.lost -= lost
        self._certain = 0
        return replace(message, lost=message.lost + lost, rebooted=rebooted)

    def next_request(self, now: float) -> tuple[int, float] | None:
        """Return id and rate [Hz] of the next message to request, rate 0 for a single one; None if none is due.

        Nothing is requested from a silent vehicle, or over a satellite link.
        """
        if now - self._last_message > _SILENCE_TIMEOUT or self.is_high_latency:
            return None
        return self._requests.next(now)

    @property
    def is_high_latency(self) -> bool:
        """Whether the link is a satellite link, whose only message is HIGH_LATENCY2."""
        return self._last_high_latency > self._last_heartbeat + _HEARTBEAT_TIMEOUT

    def handle_all(self, message: Any, now: float, log: StreamedTopics | None = None) -> list[Item]:
        """Convert a message as `handle` does; HIGH_LATENCY2 contains several topics."""
        kind = message.get_type()
        if kind == HIGH_LATENCY:
            return self._handle_high_latency(message, now, log)
        if kind == "HEARTBEAT":
            self._last_heartbeat = now
            self._text_source = text_source(message.autopilot)
        item = self.handle(message, now, log)
        return [] if item is None else [item]

    def _handle_high_latency(
        self, message: Any, now: float, log: StreamedTopics | None
    ) -> list[Item]:
        self._last_high_latency = now
        kind, timestamp = self._track_time(message, now)
        if self._is_copy(message, kind, now):
            self.copies += 1
            return []
        items = list[Item]()
        for topic, convert in OF_HIGH_LATENCY.items():
            if topic not in self._topics or timestamp is None:
                continue
            item = self._publish(self._address(topic), convert(message), timestamp, now, log)
            if item is not None:
                items.append(item)
        return items

    def handle(self, message: Any, now: float, log: StreamedTopics | None = None) -> Item | None:
        """Convert a message; return a Rejection if it is out of order, or there are too many texts.

        Return None if no chosen topic needs it, or `log`, the vehicle's ULog stream, delivers that topic.
        """
        name = message.get_type()
        kind, timestamp = self._track_time(message, now)
        if kind is TimeKind.WILD and timestamp is not None:
            return self._reject_wild(message, timestamp)
        if self._is_copy(message, kind, now):
            self.copies += 1
            return None
        self._requests.note_arrival(message.get_msgId(), now)
        if name == "GPS_GLOBAL_ORIGIN":
            self._add_origin(message, now)
        else:
            self._stored.add(name, message, timestamp, now)
        if name == "STATUSTEXT":
            return self._add_text(message, now, log) or self._next_text(now, log)
        if name not in CONVERSIONS:
            return self._next_text(now, log)
        topic, convert = CONVERSIONS[name]
        address = self._address_of(topic, message)
        is_redundant = name == "ATTITUDE" and self._has_quaternion(now)
        if _is_streamed(address, log):  # most messages with `log=`, so they are not converted first
            is_redundant = True
        if topic not in self._topics or timestamp is None or is_redundant:
            return None
        return self._publish(address, convert(message), timestamp, now, log)

    def _add_origin(self, message: Any, now: float) -> None:
        if has_origin(message):
            self._stored.add("GPS_GLOBAL_ORIGIN", message, None, now)
            self._requests.end(ORIGIN)

    def _add_text(self, message: Any, now: float, log: StreamedTopics | None) -> Rejection | None:
        """Add a STATUSTEXT, unless it is not needed; return a Rejection if there are too many."""
        address = self._text_address
        if address.topic not in self._topics or _is_streamed(address, log):
            return None
        if not self._text_limit.admits(round(now * 1e6)):
            reason = f"more than {limits.LOG_MESSAGES} log messages per second"
            return Rejection(str(address), reason, address)
        self._texts.add(message, now)
        return None

    def _next_text(self, now: float, log: StreamedTopics | None) -> Item | None:
        """Return the next text that is complete, with the newest time."""
        newest = self.clock.newest
        if self._text_address.topic not in self._topics or newest is None:
            return None
        if self._is_anonymous(now):
            return None
        return self._publish(self._text_address, self._texts.pop(now), newest, now, log)

    def _is_anonymous(self, now: float) -> bool:
        """Return True while the first HEARTBEAT, which names the source of texts, is expected.

        A .tlog may begin with texts. A HEARTBEAT comes once a second.
        """
        return self._last_heartbeat == -math.inf and now - self._started < _FIRST_HEARTBEAT

    def _has_quaternion(self, now: float) -> bool:
        """Return whether ATTITUDE_QUATERNION arrives, so that ATTITUDE is not needed."""
        return now <= self._requests.last_arrival(QUATERNION) + _QUATERNION_TIMEOUT

    def _is_copy(self, message: Any, kind: TimeKind | None, now: float) -> bool:
        """Return whether the last message came before; `kind`: what its time shows, None if it has none.

        A text did if another link delivered it; any other message without a time, if its link is behind the first.
        """
        if kind is not None:
            return kind is TimeKind.COPY
        if message.get_type() == "STATUSTEXT":
            return self._text_copies.add(message, self._link, now)
        return self._link == REPEATED or self._first_link.precedes(self._link, now)

    def _reject_wild(self, message: Any, timestamp: int) -> Rejection | None:
        topic, _ = CONVERSIONS.get(message.get_type(), ("", None))
        if topic not in self._topics:
            return None
        address = self._address_of(topic, message)
        return Rejection(str(address), f"wild time ({timestamp // 1000} ms since boot)", address)

    def _address_of(self, topic: str, message: Any) -> Address:
        if topic == "battery_status":
            return self._address(topic, message.id)
        return self._address(topic)

    def _address(self, topic: str, instance: int = 0) -> Address:
        return Address(self._name, topic, instance if TOPICS[topic].instances else None)

    def _publish(
        self,
        address: Address,
        fields: Mapping[str, object],
        timestamp: int,
        now: float,
        log: StreamedTopics | None,
    ) -> Item | None:
        """Return the message of an address, from which unknown fields are left out; see `handle`."""
        known = {name: value for name, value in fields.items() if value is not None}
        if not known or _is_streamed(address, log):
            return None
        if address.topic in _SENT_ONCE:
            placed = self._place_sample(address, timestamp)
            if placed is None:
                self.copies += 1
                return None
            timestamp = placed
        last, link = self._last.get(address, (0, self._link))
        if timestamp < last:
            return self._reject_late(address, timestamp, last, link)
        self._last[address] = timestamp, self._link
        known = {"timestamp": timestamp, **known}
        self._stored.complete(address.topic, known, now)
        source = self._text_source if address.topic == LOG_MESSAGE.name else None
        return self.report(SourceMessage(0.0, address, known, source=source, arrived=now), log)

    def _reject_late(
        self, address: Address, timestamp: int, last: int, link: int
    ) -> Rejection | None:
        """Return the rejection of a message behind another one, which `link` delivered at the time `last` [us]."""
        if link != self._link:  # a second link's times need not be equal to those of the first
            self.copies += 1
            return None
        if self.clock.is_doubtful:
            return None  # probably the first messages after a reboot, which is not certain yet
        reason = f"out of order ({timestamp // 1000} ms since boot, after {last // 1000} ms)"
        return Rejection(str(address), reason, address)

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

    def _track_time(self, message: Any, now: float) -> tuple[TimeKind | None, int | None]:
        """Return what the time of a message shows, and the time [us since boot].

        A message without a time, or with that of an older sample, shows nothing; without one, its time is the newest.
        """
        sampled = time_since_boot(message)
        if sampled is not None:
            if self.clock.add(message.get_type(), sampled, now).kind is TimeKind.REBOOT:
                self._reboot(now)
            return None, sampled
        reading = read_time(self.clock, message, now)
        if reading is not None:
            if reading.kind in _LEADING:
                self._first_link.add(self._link, now)
            if reading.kind is TimeKind.REBOOT:
                self._reboot(now)
            return reading.kind, reading.time
        milliseconds: int | None = getattr(message, "time_boot_ms", None)
        if milliseconds is None:
            return None, self.clock.newest
        return None, self.clock.unwrap(1000 * milliseconds, now)

    def _reboot(self, now: float) -> None:
        self.rebooted = True
        # the sequence restarted too, so the count is wrong
        self.lost = 0
        self._certain = 0
        self._reset(now)


def _is_streamed(address: Address, log: StreamedTopics | None) -> bool:
    """Return whether the vehicle's ULog stream delivers the messages of an address."""
    return log is not None and log.delivers(address)
