"""Output of a source: validate, publish or reject its messages, and track the health of each stream."""

import logging
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
    last_received: float | None = None
    last: SourceMessage | None = None
    settled: float = 0.0  # a stream that is stale again before then flaps, which is logged once
    flaps: int = 0

    @property
    def patience(self) -> float:
        """Seconds without a message until the stream is stale."""
        return max(TIMINGS.stale, 3 * (self.health.usual_interval or 0.0))


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
        self.published = self.rejected = self.lost = self.reboots = 0
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
        streams = list(self._streams.items())
        return [
            address
            for address, stream in streams
            if stream.publisher is None and stream.last_received is not None
        ]

    def streams(self, limit: int | None = None) -> tuple[StreamStatus, ...]:
        """Return the health of all streams, or of the first `limit`."""
        streams, now = list(self._streams.items())[:limit], round(self._now() * 1e9)
        return tuple(
            StreamStatus(str(address), stream.health.snapshot(now)) for address, stream in streams
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """First rejection of each origin."""
        return tuple(self._warnings.values())

    def claim_all(self, run: ReplayRun, *, lossless: bool) -> None:
        """Claim all addresses known at the start of a run, or none, so two sources cannot block each other.

        Raises AddressInUseError if another source of this service publishes one of them.
        """
        for address in run.addresses.keys() - set(self.addresses):
            if address in self._registry.publishers:
                raise AddressInUseError(address)
        for address, definition in islice(run.addresses.items(), limits.REPLAYED_ADDRESSES):
            self.claim(address, definition, lossless=lossless)

    def claim(
        self, address: Address, definition: Definition[Any] | None = None, *, lossless: bool = False
    ) -> _Stream:
        """Open a publisher, or keep one with this definition; raise AddressInUseError if another source has one."""
        stream = self._streams.get(address)
        if stream is None:
            stream = self._streams[address] = _Stream(StreamHealth(address.topic))
        if stream.publisher is not None:
            if not _differs(definition, stream.publisher.definition):
                return stream
            stream.publisher.close()  # another layout, for example of new firmware
            stream.publisher = None
        stream.publisher = self._registry.publisher(
            address, definition, lossless=lossless, short_history=True, source=self._kind
        )
        return stream

    def release(self, *, keep: Container[Address] = ()) -> None:
        """Close the publishers of all addresses except `keep`."""
        for address, stream in self._streams.items():
            if address not in keep and stream.publisher is not None:
                stream.publisher.close()
                stream.publisher = None

    def publish_replay(self, message: SourceMessage, *, lossless: bool) -> None:
        """Publish a message of a replay; claim its address first if it was unknown at the start."""
        stream, definition = self._streams.get(message.address), message.definition
        if stream is None and len(self._streams) >= limits.REPLAYED_ADDRESSES:
            self._reject_excess(message.address, limits.REPLAYED_ADDRESSES)
            return
        if (
            stream is None
            or stream.publisher is None
            or definition is not stream.publisher.definition
        ):
            try:
                stream = self.claim(message.address, definition, lossless=lossless)
            except AddressInUseError as exc:
                self.reject(Rejection(str(message.address), str(exc)))
                return
        self._publish(message, stream)

    def _publish(
        self, message: SourceMessage, stream: _Stream, received: float | None = None
    ) -> None:
        """Validate a message of a claimed address, and publish or reject it; `received`: time, by default now."""
        address = message.address
        publisher = stream.publisher
        lost = message.lost
        if publisher is None:
            raise KeyError(address)
        if message.error is not None:
            self._reject_invalid(message, _NO_MESSAGE, message.error)
            return
        if (source := message.source or self._kind) != publisher.source:
            publisher.relabel(source)
        start = None if self.published % _TIMED else self._now()
        try:
            row, payload, provided, missing = message.encode()
            publisher.publish_encoded(payload, provided)
        except InvalidMessageError as exc:
            field, violation = exc.violations[0]
            # without values
            self._reject_invalid(message, f"{field}: {violation.partition(' (')[0]}", exc.reason)
            return
        now = self._now()
        if start is not None:
            self.durations.add(now - start)
        self.published += 1
        received = now if received is None else received
        # it waited in this service
        latency = now - received if now - received > TIMINGS.lateness else None
        stream.health.add(
            row, received=round(received * 1e9), latency=latency, lost=lost, missing=missing
        )
        if message.dropout:
            self._event_log.add_dropout(
                address.vehicle, message.dropout, clock.steady() - message.dropout
            )
        is_estimate = message.source == _ULOG_STREAM
        self._event_log.add(
            address,
            row,
            clock.steady(),
            missing=missing,
            lost=lost,
            is_estimate=is_estimate,
            source=message.source,
        )

    def publish_live(self, message: SourceMessage) -> None:
        """Publish a message of a live source; claim its address first if necessary."""
        self.lost += message.lost
        self.reboots += message.rebooted
        address = message.address
        stream = self._streams.get(address)
        publisher = stream.publisher if stream is not None else None
        if (
            stream is None
            or publisher is None
            or _differs(message.definition, publisher.definition)
        ):
            resumed = stream is not None and stream.last_received is not None
            if (
                not resumed
                and len(self._streams) >= limits.LIVE_ADDRESSES
                and not self._evict_stale()
            ):
                self._reject_excess(address, limits.LIVE_ADDRESSES)
                return
            try:
                stream = self.claim(address, message.definition)
            except AddressInUseError as exc:
                self.reject(Rejection(str(address), str(exc)))
                return
            if not stream.flaps:
                text = f"{address} is published{' again' if resumed else ''}"
                event = "stream_resumed" if resumed else "published"
                _log.info(
                    "%s: %s", self._name, text, extra=about(event, address, source=self._name)
                )
            self._republish_retained(message)
        stream.last_received, stream.last = message.arrived or self._now(), message
        self._publish(message, stream, stream.last_received)

    def expire_stale(self) -> bool:
        """Stop publishing stale live addresses; return True if any address is still published.

        An address is stale after 3 s without a message, or three of its usual intervals if that is longer. Topics
        without a rate stay published while other messages of their vehicle arrive.
        """
        now = self._now()
        fresh = {
            address
            for address, stream in self._streams.items()
            if stream.last_received is not None and now - stream.last_received < stream.patience
        }
        vehicles = {address.vehicle for address in fresh}
        fresh |= {
            each
            for each in self._streams
            if each.vehicle in vehicles and not get_topic(each.topic).rate
        }
        for address in [each for each in self.addresses if each not in fresh]:
            stream = self._streams[address]
            stream.flaps = stream.flaps + 1 if now < stream.settled else 0
            stream.settled = now + _UNSETTLED
            if stream.flaps < 2:
                text = f"{address} is stale: no message for {now - (stream.last_received or 0.0):.0f} s"
                text += (
                    f"; it flaps, logged again once stable for {_UNSETTLED:.0f} s" * stream.flaps
                )
                _log.warning(
                    "%s: %s", self._name, text, extra=about("stale", address, source=self._name)
                )
        self.release(keep=fresh)
        for address, stream in list(self._streams.items()):
            stream.flaps *= now < stream.settled
            is_known = (
                address.vehicle in self._event_log.vehicles and stream.last_received is not None
            )
            if stream.publisher is None and not (
                is_known and now - (stream.last_received or 0.0) < TIMINGS.forgotten
            ):
                del self._streams[address]
        self._is_full = False
        return bool(fresh)

    def _evict_stale(self) -> bool:
        """Delete the address that has been stale the longest; return False if all are published."""
        stale = () if self._is_full else {*self._streams}.difference(self.addresses)
        if stale:
            del self._streams[min(stale, key=lambda each: self._streams[each].last_received or 0.0)]
        self._is_full = not stale
        return not self._is_full

    def reject(self, rejection: Rejection, rule: str = _NO_MESSAGE) -> None:
        """Count invalid input, log it once per origin, and publish a rejection report if it has an address."""
        self._count_rejected(rule, rejection.count)
        where, reason = rejection.where[: limits.PEER_TEXT], rejection.reason[: limits.PEER_TEXT]
        if where not in self._warnings and len(self._warnings) < limits.REJECTION_ORIGINS:
            self._warnings[where] = f"{where}: {reason}"
            text = f"{where} rejected: {reason}" if rejection.count else f"{where}: {reason}"
            extra = about("rejected", rejection.address, source=self._name, reason=reason)
            _log.warning("%s: %s", self._name, text, extra=extra)
        if rejection.address is not None:
            self._event_log.reject(rejection.address, reason, clock.steady())
            self._registry.reject(
                rejection.address, {"source": self._text, "where": where, "reason": reason}
            )

    def _reject_excess(self, address: Address, limit: int) -> None:
        reason = f"the limit is {limit}, and {address} is the first one ignored"
        self.reject(Rejection("further addresses", reason), rule=TOO_MANY)

    def note(self, unavailable: UnavailableTopics) -> None:
        """Store the unavailable topics of a live source; log each silent address once, up to the address limit."""
        self.unavailable = unavailable
        new = [address for address in unavailable.silent if address not in self._silent]
        if new := new[: limits.LIVE_ADDRESSES - len(self._silent)]:
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
        streams = [
            (address, stream)
            for address, stream in self._streams.items()
            if address.vehicle == vehicle
        ]
        known = [
            (address, stream, stream.last) for address, stream in streams if stream.last is not None
        ]
        newest = max((last.timestamp or 0 for *_, last in known), default=0)
        rebooted = message.rebooted or (message.timestamp or 0) < newest
        for address, stream, last in known:
            if stream.publisher is not None or get_topic(address.topic).rate:
                continue
            if rebooted:
                stream.last = None
                continue
            with suppress(AddressInUseError):
                claimed = self.claim(address, last.definition)
                extra = about("stream_resumed", address, source=self._name)
                _log.info("%s: %s is published again", self._name, address, extra=extra)
                self._publish(replace(last, lost=0), claimed)

    def _count_rejected(self, rule: str, count: int = 1) -> None:
        self.rejected += count
        self.rejections[
            rule
            if rule in self.rejections or len(self.rejections) < limits.REJECTION_RULES
            else "other"
        ] += count

    def _reject_invalid(self, message: SourceMessage, rule: str, reason: str) -> None:
        self._count_rejected(rule)
        self._invalid += 1
        if self._invalid <= limits.LOGGED_INVALID:
            last = (
                "; further rejections are counted but not logged"
                if self._invalid == limits.LOGGED_INVALID
                else ""
            )
            text = f"{message.address} rejected: {reason}{last}"
            extra = about("rejected", message.address, source=self._name, reason=reason)
            _log.warning("%s: %s", self._name, text, extra=extra)
        report = {"source": self._text, "reason": reason, "fields": dict(message.fields)}
        self._event_log.reject(message.address, reason, clock.steady())
        self._registry.reject(message.address, report)


def _differs(new: Definition[Any] | None, known: Definition[Any]) -> bool:
    """Return True if a definition has different fields, or the same fields in another order."""
    return new is not None and new is not known and [*new.types.items()] != [*known.types.items()]
