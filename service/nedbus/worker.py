"""One source from start to end: open, wait, pace, validate, publish or reject, and try again after a failure.

A replay is flown; a live source is listened to, and what it says no more for 3 s is no longer published.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Final, Literal

from pydantic import ValidationError

from nedbus_msgs import Address, describe, upgrade

from .errors import AddressInUseError, ClosedError, NedbusError
from .health import Health, StreamHealth
from .publisher import Outbox, Publisher
from .sources import Flight, Live, Record, Refusal, Replay, Source

_log = logging.getLogger(__name__)

State = Literal["starting", "waiting", "running", "retrying", "done", "failed"]

_BACKOFF: Final = (1.0, 2.0, 4.0, 8.0, 16.0, 30.0)  # s between tries of a source that fails
_BEHIND: Final = 1.0  # s: a replay that is later than this goes on from where it is, and does not hurry
_LAP: Final = 0.1  # s that a lap takes at least: a log of one message must not be read thousands of times a second
_REJECTS_LOGGED: Final = 5  # rejected messages that the log tells of, for each source
_SILENCE: Final = 3.0  # s without a word after which a live address is no longer published
_LOOK: Final = 0.5  # s between two looks for silence
_ADDRESSES: Final = 1000  # that one live source may have
_STREAMS: Final = 100  # that a status tells of: it must fit a message
_PLACES: Final = 50  # whose refusals are told of
_WORDS: Final = 300  # characters of a refusal that are told: it may be anybody's


@dataclass(frozen=True, slots=True)
class StreamStatus:
    """How one stream is that is published."""

    address: str
    health: Health


@dataclass(frozen=True, slots=True)
class WorkerStatus:
    """What a source is doing.

    `published` and `rejected` count messages since the service started; `done` of `total` is this run's progress.
    `lost`: messages that did not reach a live source, as far as it can tell; `reboots` of its vehicles.
    `silent`: addresses that a live source published, until nothing came for 3 s.
    `streams`: how each stream is that is published, of up to 100 of them.
    """

    source: str
    state: State
    addresses: tuple[str, ...]
    silent: tuple[str, ...]
    published: int
    rejected: int
    lost: int
    reboots: int
    done: int
    total: int | None
    restarts: int
    summary: str
    warnings: tuple[str, ...]
    error: str | None
    streams: tuple[StreamStatus, ...]

    @property
    def ended(self) -> bool:
        """Whether it will publish no more."""
        return self.state in {"done", "failed"}


class Worker:
    """Run one source until it ends or `stop` is set; `run` is meant for a thread of its own."""

    def __init__(
        self,
        text: str,
        source: Source,
        outbox: Outbox,
        *,
        stop: threading.Event,
        retry: bool,
        on_end: Callable[[], object],
    ) -> None:
        self.text = text.encode(errors="backslashreplace").decode()  # a file name may hold what no text can
        self.source = source
        self._name = self.text.rstrip(":")  # as the log says it
        self._outbox = outbox
        self._stop = stop
        self._retry = retry
        self._on_end = on_end
        self._publishers: dict[Address, Publisher] = {}
        self._flight: Flight | None = None
        self._state: State = "starting"
        self._error: str | None = None
        self._rejected = self._done = self._restarts = self._published = self._lost = self._reboots = 0
        self._kind = text.partition(":")[0]
        self._streams: dict[Address, StreamHealth] = {}
        self._heard: dict[Address, float] = {}  # when each live address was heard last
        self._refused: dict[str, str] = {}  # why, by where it came from

    @property
    def status(self) -> WorkerStatus:
        """What the source is doing now."""
        flight = self._flight
        return WorkerStatus(
            source=self.text,
            state=self._state,
            addresses=tuple(map(str, flight.addresses if flight else list(self._publishers))),
            silent=tuple(str(address) for address in list(self._heard) if address not in self._publishers),
            published=self._published,
            rejected=self._rejected,
            lost=self._lost,
            reboots=self._reboots,
            done=self._done,
            total=flight.total if flight else None,
            restarts=self._restarts,
            summary=flight.summary if flight else "",
            warnings=flight.warnings if flight else tuple(self._refused.values()),
            error=self._error,
            streams=tuple(
                StreamStatus(str(address), stream.tell()) for address, stream in list(self._streams.items())[:_STREAMS]
            ),
        )

    def run(self) -> None:
        """Fly the source, again if it loops or fails, until it is done or stopped."""
        failures = 0
        try:
            while not self._stop.is_set():
                start = time.monotonic()
                try:
                    if isinstance(self.source, Live):
                        self._listen(self.source)
                    else:
                        self._fly(self.source)
                except ClosedError:
                    return
                except NedbusError as exc:
                    self._fail(str(exc))
                except Exception as exc:  # noqa: BLE001 - a fault in one source must not stop the others
                    _log.exception("%s: an unexpected error", self._name)
                    self._fail(f"an unexpected {type(exc).__name__}: {exc}")
                else:
                    if isinstance(self.source, Live) or not self.source.loop:
                        self._end("done")
                        return
                    failures = 0
                    self._stop.wait(max(0.0, start + _LAP - time.monotonic()))
                    continue
                if not self._retry:
                    self._end("failed")
                    return
                if time.monotonic() - start > _BACKOFF[-1]:
                    failures = 0  # it worked for a while
                self._stop.wait(_BACKOFF[min(failures, len(_BACKOFF) - 1)])
                failures += 1
        finally:
            self._on_end()

    def _end(self, state: State) -> None:
        if not self._stop.is_set():
            self._state = state
            _log.info("%s: %s, %d published, %d rejected", self._name, state, self._published, self._rejected)

    def _fail(self, reason: str) -> None:
        """Take note, and let go of all addresses: another source may have a use for them meanwhile."""
        self._error = reason
        self._state = "retrying"
        self._restarts += 1
        _log.error("%s", reason)
        self._keep(())

    def _fly(self, source: Replay) -> None:
        flight = source.open()
        first = self._flight is None
        if self._flight is None or self._flight.summary != flight.summary:
            _log.info("%s: %s", self._name, flight.summary)
            for warning in flight.warnings:
                _log.warning("%s: %s", self._name, warning)
        self._flight, self._done = flight, 0
        if source.wait and first:
            self._wait_for_reader(flight)
        self._keep(flight.addresses)
        for address in flight.addresses:
            self._claim(address, lossless=source.speed is None)
        self._state, self._error = "running", None
        self._replay(flight, source.speed)

    def _claim(self, address: Address, *, lossless: bool = False) -> None:
        """Make sure that there is a publisher."""
        if address in self._publishers:
            return
        if self._outbox.is_alive(address):
            _log.warning("%s: %s is published by somebody else too: readers get both", self._name, address)
        self._publishers[address] = self._outbox.publisher(address, lossless=lossless, source=self._kind)
        self._streams.setdefault(address, StreamHealth(address.topic))

    def _keep(self, addresses: Iterable[Address]) -> None:
        """Close the publishers of all other addresses."""
        for address in self._publishers.keys() - set(addresses):
            self._publishers.pop(address).close()

    def _wait_for_reader(self, flight: Flight) -> None:
        self._state = "waiting"
        _log.info("%s: waiting for a subscriber", self._name)
        while not self._outbox.is_read(flight.addresses) and not self._stop.wait(0.05):
            pass

    def _replay(self, flight: Flight, speed: float | None) -> None:
        start = time.monotonic()
        for record in flight.records:
            if speed is not None:
                early = start + record.due / speed - time.monotonic()
                if early < -_BEHIND:
                    _log.warning("%s: %.1f s late, going on from here", self._name, -early)
                    start -= early
                elif early > 0:
                    self._stop.wait(early)
            if self._stop.is_set():
                return
            self._publish(record)
            self._done += 1

    def _listen(self, source: Live) -> None:
        """Publish what a live source says, for as long as it says something."""
        with ExitStack() as closing:
            items = source.listen()
            closing.callback(getattr(items, "close", lambda: None))
            look = 0.0
            for number, item in enumerate(items):
                if not number:
                    self._state, self._error = "waiting", None
                    _log.info("%s: listening", self._name)
                if self._stop.is_set():
                    return
                now = time.monotonic()
                if isinstance(item, Refusal):
                    self._refuse(item)
                elif item is not None:
                    self._take(item, now)
                if now >= look:
                    look = now + _LOOK
                    self._part_from_silent(now)

    def _take(self, record: Record, now: float) -> None:
        """Publish a live record, and begin to publish its address if need be."""
        self._lost += record.lost
        self._reboots += record.restarted
        if record.address not in self._publishers:
            if record.address not in self._heard and len(self._heard) >= _ADDRESSES:
                self._refuse(Refusal("vehicles", f"more than {_ADDRESSES} addresses: {record.address} is left out"))
                return
            try:
                self._claim(record.address)
            except AddressInUseError as exc:
                self._refuse(Refusal(str(record.address), str(exc)))
                return
            _log.info(
                "%s: %s %s", self._name, record.address, "is back" if record.address in self._heard else "is here"
            )
        self._heard[record.address] = now
        self._state = "running"
        self._publish(record)

    def _part_from_silent(self, now: float) -> None:
        speaking = {address for address, heard in self._heard.items() if now - heard < _SILENCE}
        for address in self._publishers.keys() - speaking:
            _log.warning("%s: %s is silent: nothing came for %.0f s", self._name, address, _SILENCE)
        self._keep(speaking)
        if not speaking:
            self._state = "waiting"

    def _refuse(self, refusal: Refusal) -> None:
        """Count something that is no message; tell of each place once."""
        self._rejected += refusal.count
        where, reason = refusal.where[:_WORDS], refusal.reason[:_WORDS]
        if where not in self._refused and len(self._refused) < _PLACES:
            self._refused[where] = f"{where}: {reason}"
            _log.warning("%s: %s: refused: %s", self._name, where, reason)
        if refusal.address is not None:
            report = {"source": self.text, "where": where, "reason": reason}
            self._outbox.reject(refusal.address, report)

    def _publish(self, record: Record) -> None:
        try:
            message = upgrade(record.fields)
        except ValidationError as exc:
            self._reject(record, describe(exc))
        else:
            self._publishers[record.address].publish(message)
            self._published += 1
            self._streams[record.address].add(message, received=time.time_ns(), lost=record.lost)

    def _reject(self, record: Record, reason: str) -> None:
        self._rejected += 1
        if self._rejected <= _REJECTS_LOGGED:
            last = "; further ones are only counted" if self._rejected == _REJECTS_LOGGED else ""
            _log.warning("%s: %s rejected: %s%s", self._name, record.address, reason, last)
        self._outbox.reject(record.address, {"source": self.text, "reason": reason, "fields": dict(record.fields)})
