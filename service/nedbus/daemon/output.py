"""Output of a source: validate, publish or reject its messages, and track the health of each stream."""

import logging
import math
import threading
from collections import Counter
from collections.abc import Callable, Container
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Final

from nedbus import clock, limits
from nedbus.client import (
    Histogram,
    LogStreamStatus,
    PositionStatus,
    Publisher,
    PublisherRegistry,
    StreamHealth,
    StreamStatus,
)
from nedbus.errors import AddressInUseError, InvalidMessageError
from nedbus.log_event import about
from nedbus.sources import LinkLoad, Rejection, ReplayRun, SourceMessage, UnavailableTopics
from nedbus.timings import TIMINGS
from nedbus.vehicle_events import EventLog
from nedbus_msgs import Address, Definition, get_topic

_log = logging.getLogger(__name__)

_UNSETTLED: Final = 60.0  # s after which a stream that was stale counts as stable again
_ULOG_STREAM: Final = "mavlink-ulog"  # source of messages before which losses are estimated
_NO_MESSAGE: Final = "input that is no message"
TOO_MANY: Final = "too many addresses"
"""Rule of messages rejected because their source has too many addresses."""

_TIMED: Final = 16  # messages for each one whose duration is measured
_DURATIONS: Final = (1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 1e-1, 1.0)  # s


@dataclass(slots=True, eq=False)
class _Stream:
    """State of one address: health, open publisher if any, and the last message of a live source."""

    health: StreamHealth
    publisher: Publisher | None = None
    last_received: float = -math.inf  # of a live source
    last: SourceMessage | None = None
    settled: float = 0.0  # a stream that is stale again before then flaps, which is logged once
    flaps: int = 0

    @property
    def is_live(self) -> bool:
        """Whether a live source has delivered a message."""
        return self.last_received > -math.inf

    def is_fresh(self, now: float) -> bool:
        """Return whether the last message is recent, compared with the usual interval."""
        silence = now - self.last_received
        if silence < TIMINGS.stale:  # most streams; needs no interval
            return True
        usual = self.health.usual_interval
        return usual is not None and silence < 3 * usual

    def carries(self, definition: Definition[Any] | None) -> bool:
        """Return whether the publisher is open for messages of a definition; None for that of the topic."""
        if self.publisher is None:
            return False
        known = self.publisher.definition
        if definition is None or definition is known:
            return True
        # the same fields in the same order
        return [*definition.types.items()] == [*known.types.items()]

    def close(self) -> None:
        """Close the publisher, if it is open."""
        if self.publisher is not None:
            self.publisher.close()
            self.publisher = None


class SourceOutput:
    """Publish the messages of a source, called `name` in the log and configured as `text`; `now`: monotonic clock."""

    def __init__(
        self,
        name: str,
        text: str,
        registry: PublisherRegistry,
        now: Callable[[], float],
        event_log: EventLog,
    ) -> None:
        self.published = 0
        self.rejected = 0
        self.lost = 0
        self.reboots = 0
        self.rejections: Counter[str] = Counter()  # messages by violated rule
        # topics that vehicles publish but a live source does not deliver now
        self.unavailable = UnavailableTopics()
        self.log_streams: dict[str, LogStreamStatus] = {}  # by vehicle of a live source
        # by address of the positions that are sent into a vehicle
        self.positions: dict[str, PositionStatus] = {}
        self.load = LinkLoad()  # of a live source
        self.copies = 0  # messages that a live source left out
        # s to validate, encode and send a message, of every 16th one
        self.durations = Histogram(_DURATIONS)
        self._name = name
        self._text = text
        self._kind = text.partition(":")[0]
        self._registry = registry
        self._now = now
        self._event_log = event_log
        self._streams: dict[Address, _Stream] = {}
        self._warnings: dict[str, str] = {}  # by `where`
        self._silent: set[str] = set()  # addresses logged as silent
        self._invalid = 0
        self._is_full = False  # the address limit is reached, and no address is stale

    @property
    def addresses(self) -> list[Address]:
        """Currently published addresses."""
        return [
            address
            for address, stream in list(self._streams.items())
            if stream.publisher is not None
        ]

    @property
    def stale(self) -> list[Address]:
        """Addresses of a live source that are no longer published."""
        return [
            address
            for address, stream in list(self._streams.items())
            if stream.publisher is None and stream.is_live
        ]

    def streams(self, limit: int | None = None) -> tuple[StreamStatus, ...]:
        """Return the health of all streams, or of the first `limit`."""
        now = round(self._now() * 1e9)
        return tuple(
            StreamStatus(str(address), stream.health.snapshot(now))
            for address, stream in list(self._streams.items())[:limit]
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """First rejection of each origin."""
        return tuple(self._warnings.values())

    def claim_all(self, run: ReplayRun, *, lossless: bool, stop: threading.Event) -> None:
        """Claim all addresses known at the start of a run, or none, so two sources cannot block each other.

        `stop` ends it early: a busy computer may take seconds for a log of several hundred topics.

        Raises AddressInUseError if another source of this service publishes one of them.
        """
        for address in run.addresses.keys() - set(self.addresses):
            if address in self._registry.publishers:
                raise AddressInUseError(address)
        for address, definition in islice(run.addresses.items(), limits.REPLAYED_ADDRESSES):
            if stop.is_set():
                return
            self.claim(address, definition, lossless=lossless)

    def claim(
        self, address: Address, definition: Definition[Any] | None = None, *, lossless: bool = False
    ) -> _Stream:
        """Open a publisher, or keep one with this definition; raise AddressInUseError if another source has one."""
        stream = self._streams.get(address)
        if stream is None:
            stream = self._streams[address] = _Stream(StreamHealth(address.topic))
        if stream.carries(definition):
            return stream
        stream.close()  # perhaps another layout, for example of new firmware
        stream.publisher = self._registry.publisher(
            address, definition, lossless=lossless, short_history=True, source=self._kind
        )
        return stream

    def release(self, *, keep: Container[Address] = ()) -> None:
        """Close the publishers of all addresses except `keep`."""
        for address, stream in self._streams.items():
            if address not in keep:
                stream.close()

    def begin_dropout(self, message: SourceMessage) -> None:
        """Record the logging dropout before a message of a replay that is due later: its vehicle is not silent."""
        self._event_log.add_dropout(message.address.vehicle, message.dropout, clock.steady())

    def publish_replay(self, message: SourceMessage, *, lossless: bool) -> None:
        """Publish a message of a replay; claim its address first if it was unknown at the start."""
        address = message.address
        stream = self._streams.get(address)
        if stream is None and len(self._streams) >= limits.REPLAYED_ADDRESSES:
            self._reject_excess(address, limits.REPLAYED_ADDRESSES)
            return
        if stream is None or not stream.carries(message.definition):
            try:
                stream = self.claim(address, message.definition, lossless=lossless)
            except AddressInUseError as exc:
                self.reject(Rejection(str(address), str(exc)))
                return
        self._publish(message, stream)

    def _publish(
        self, message: SourceMessage, stream: _Stream, received: float | None = None
    ) -> None:
        """Validate a message of a claimed address, and publish or reject it; `received`: time, by default now."""
        address = message.address
        publisher = stream.publisher
        if publisher is None:
            raise KeyError(address)
        if message.error is not None:
            self._reject_invalid(message, _NO_MESSAGE, message.error)
            return
        source = message.source or self._kind
        if source != publisher.source:
            publisher.relabel(source)
        start = None if self.published % _TIMED else self._now()
        try:
            row, payload, provided, missing = message.encode()
            publisher.publish_encoded(payload, provided)
        except InvalidMessageError as exc:
            field, violation = exc.violations[0]
            rule, _, _ = violation.partition(" (")  # without values
            self._reject_invalid(message, f"{field}: {rule}", exc.reason)
            return
        now = self._now()
        if start is not None:
            self.durations.add(now - start)
        self.published += 1
        if received is None:
            received = now
        waited = now - received  # in this service
        lost = message.lost
        stream.health.add(
            row,
            received=round(received * 1e9),
            latency=waited if waited > TIMINGS.lateness else None,
            lost=lost,
            missing=missing,
        )
        self._event_log.add(
            address,
            row,
            clock.steady(),
            missing=missing,
            lost=lost,
            is_estimate=message.source == _ULOG_STREAM,
            source=message.source,
        )

    def publish_live(self, message: SourceMessage) -> None:
        """Publish a message of a live source; claim its address first if necessary."""
        self.lost += message.lost
        self.reboots += message.rebooted
        address = message.address
        stream = self._streams.get(address)
        if stream is None or not stream.carries(message.definition):
            stream = self._claim_live(message, stream)
            if stream is None:
                return
        received = message.arrived or self._now()
        stream.last_received = received
        stream.last = message
        if message.dropout:
            begin = clock.steady() - message.dropout
            self._event_log.add_dropout(address.vehicle, message.dropout, begin)
        self._publish(message, stream, received)

    def _claim_live(self, message: SourceMessage, known: _Stream | None) -> _Stream | None:
        """Claim the address of a message; return None if it is rejected. `known`: its stream, if it was published."""
        address = message.address
        is_resumed = known is not None and known.is_live
        is_excess = not is_resumed and len(self._streams) >= limits.LIVE_ADDRESSES
        if is_excess and not self._evict_stale():
            self._reject_excess(address, limits.LIVE_ADDRESSES)
            return None
        try:
            stream = self.claim(address, message.definition)
        except AddressInUseError as exc:
            self.reject(Rejection(str(address), str(exc)))
            return None
        if not stream.flaps:
            text = f"{address} is published again" if is_resumed else f"{address} is published"
            event = "stream_resumed" if is_resumed else "published"
            _log.info("%s: %s", self._name, text, extra=about(event, address, source=self._name))
        self._republish_retained(message)
        return stream

    def expire_stale(self) -> bool:
        """Stop publishing stale live addresses; return True if any address is still published.

        An address is stale after 3 s without a message, or three of its usual intervals if that is longer. Topics
        without a rate stay published while other messages of their vehicle arrive.
        """
        now = self._now()
        fresh = {address for address, stream in self._streams.items() if stream.is_fresh(now)}
        vehicles = {address.vehicle for address in fresh}
        for address in self._streams:
            if address.vehicle in vehicles and not get_topic(address.topic).rate:
                fresh.add(address)
        for address in self.addresses:
            if address not in fresh:
                self._note_stale(address, self._streams[address], now)
        self.release(keep=fresh)
        for address, stream in list(self._streams.items()):
            if now >= stream.settled:
                stream.flaps = 0
            if stream.publisher is None and not self._is_remembered(address, stream, now):
                del self._streams[address]
        self._is_full = False
        return bool(fresh)

    def _note_stale(self, address: Address, stream: _Stream, now: float) -> None:
        """Log that a stream is stale, but only once while it flaps."""
        stream.flaps = stream.flaps + 1 if now < stream.settled else 0
        stream.settled = now + _UNSETTLED
        if stream.flaps > 1:
            return
        silence = now - max(0.0, stream.last_received)
        text = f"{address} is stale: no message for {silence:.0f} s"
        if stream.flaps:
            text += f"; it flaps, logged again once stable for {_UNSETTLED:.0f} s"
        _log.warning("%s: %s", self._name, text, extra=about("stale", address, source=self._name))

    def _is_remembered(self, address: Address, stream: _Stream, now: float) -> bool:
        """Return whether a stale stream is kept: its vehicle has events, and its last message is recent."""
        is_recent = now - stream.last_received < TIMINGS.forgotten
        return is_recent and address.vehicle in self._event_log.vehicles

    def _evict_stale(self) -> bool:
        """Delete the address that has been stale the longest; return False if all are published."""
        if self._is_full:
            return False
        stale = {*self._streams}.difference(self.addresses)
        if not stale:
            self._is_full = True
            return False
        oldest = min(stale, key=lambda address: self._streams[address].last_received)
        del self._streams[oldest]
        return True

    def reject(self, rejection: Rejection, rule: str = _NO_MESSAGE) -> None:
        """Count invalid input, log it once per origin, and publish a rejection report if it has an address."""
        self._count_rejected(rule, rejection.count)
        where = rejection.where[: limits.PEER_TEXT]
        reason = rejection.reason[: limits.PEER_TEXT]
        if where not in self._warnings and len(self._warnings) < limits.REJECTION_ORIGINS:
            text = f"{where}: {reason}"
            self._warnings[where] = text
            if rejection.count:
                text = f"{where} rejected: {reason}"
            extra = about("rejected", rejection.address, source=self._name, reason=reason)
            _log.warning("%s: %s", self._name, text, extra=extra)
        if rejection.address is not None:
            self._event_log.reject(rejection.address, reason, clock.steady())
            report = {"source": self._text, "where": where, "reason": reason}
            self._registry.reject(rejection.address, report)

    def _reject_excess(self, address: Address, limit: int) -> None:
        reason = f"the limit is {limit}, and {address} is the first one ignored"
        self.reject(Rejection("further addresses", reason), rule=TOO_MANY)

    def note(self, unavailable: UnavailableTopics) -> None:
        """Store the unavailable topics of a live source; log each silent address once, up to the address limit."""
        self.unavailable = unavailable
        new = [address for address in unavailable.silent if address not in self._silent]
        new = new[: limits.LIVE_ADDRESSES - len(self._silent)]
        if new:
            self._silent.update(new)
            text = f"announced, nothing arrives: {', '.join(new)}; run 'nedbus doctor'"
            _log.warning("%s: %s", self._name, text, extra=about("topic_silent", source=self._name))

    def note_load(self, load: LinkLoad) -> None:
        """Store the load of a link; log the start and the end of an overload."""
        if bool(load.overload) != bool(self.load.overload):
            text = load.overload or f"the overload has ended; dropped so far: {load.dropped}"
            _log.warning("%s: %s", self._name, text, extra=about("dropped", source=self._name))
        self.load = load

    def _republish_retained(self, message: SourceMessage) -> None:
        """After an outage, republish the last messages of topics without a rate, unless the vehicle has rebooted."""
        vehicle = message.address.vehicle
        retained = dict[Address, SourceMessage]()
        for address, stream in self._streams.items():
            if address.vehicle == vehicle and stream.last is not None:
                retained[address] = stream.last
        newest = max((last.timestamp or 0 for last in retained.values()), default=0)
        has_rebooted = message.rebooted or (message.timestamp or 0) < newest
        for address, last in retained.items():
            stream = self._streams[address]
            if stream.publisher is not None or get_topic(address.topic).rate:
                continue
            if has_rebooted:
                stream.last = None
                continue
            with suppress(AddressInUseError):
                self.claim(address, last.definition)
                extra = about("stream_resumed", address, source=self._name)
                _log.info("%s: %s is published again", self._name, address, extra=extra)
                self._publish(replace(last, lost=0), stream)

    def _count_rejected(self, rule: str, count: int = 1) -> None:
        self.rejected += count
        if rule not in self.rejections and len(self.rejections) >= limits.REJECTION_RULES:
            rule = "other"
        self.rejections[rule] += count

    def _reject_invalid(self, message: SourceMessage, rule: str, reason: str) -> None:
        address = message.address
        self._count_rejected(rule)
        self._invalid += 1
        if self._invalid <= limits.LOGGED_INVALID:
            text = f"{address} rejected: {reason}"
            if self._invalid == limits.LOGGED_INVALID:
                text += "; further rejections are counted but not logged"
            extra = about("rejected", address, source=self._name, reason=reason)
            _log.warning("%s: %s", self._name, text, extra=extra)
        report = {"source": self._text, "reason": reason, "fields": dict(message.fields)}
        self._event_log.reject(address, reason, clock.steady())
        self._registry.reject(address, report)
