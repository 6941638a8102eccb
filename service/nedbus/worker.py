"""One source from start to end: open, wait, pace, validate, publish or reject, and try again after a failure."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

from pydantic import ValidationError

from nedbus_msgs import Address, describe, upgrade

from .errors import ClosedError, NedbusError
from .publisher import Outbox, Publisher
from .sources import Flight, Record, Source

_log = logging.getLogger(__name__)

State = Literal["starting", "waiting", "running", "retrying", "done", "failed"]

_BACKOFF: Final = (1.0, 2.0, 4.0, 8.0, 16.0, 30.0)  # s between tries of a source that fails
_BEHIND: Final = 1.0  # s: a replay that is later than this goes on from where it is, and does not hurry
_LAP: Final = 0.1  # s that a lap takes at least: a log of one message must not be read thousands of times a second
_REJECTS_LOGGED: Final = 5  # rejected messages that the log tells of, for each source


@dataclass(frozen=True, slots=True)
class WorkerStatus:
    """What a source is doing.

    `published` and `rejected` count messages since the service started; `done` of `total` is this run's progress.
    """

    source: str
    state: State
    addresses: tuple[str, ...]
    published: int
    rejected: int
    done: int
    total: int | None
    restarts: int
    summary: str
    warnings: tuple[str, ...]
    error: str | None

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
        self._rejected = self._done = self._restarts = self._published = 0

    @property
    def status(self) -> WorkerStatus:
        """What the source is doing now."""
        flight = self._flight
        return WorkerStatus(
            source=self.text,
            state=self._state,
            addresses=tuple(map(str, flight.addresses)) if flight else (),
            published=self._published,
            rejected=self._rejected,
            done=self._done,
            total=flight.total if flight else None,
            restarts=self._restarts,
            summary=flight.summary if flight else "",
            warnings=flight.warnings if flight else (),
            error=self._error,
        )

    def run(self) -> None:
        """Fly the source, again if it loops or fails, until it is done or stopped."""
        failures = 0
        try:
            while not self._stop.is_set():
                start = time.monotonic()
                try:
                    self._fly()
                except ClosedError:
                    return
                except NedbusError as exc:
                    self._fail(str(exc))
                except Exception as exc:  # noqa: BLE001 - a fault in one source must not stop the others
                    _log.exception("%s: an unexpected error", self._name)
                    self._fail(f"an unexpected {type(exc).__name__}: {exc}")
                else:
                    if not self.source.loop:
                        self._end("done")
                        return
                    failures = 0
                    self._stop.wait(max(0.0, start + _LAP - time.monotonic()))
                    continue
                if not self._retry:
                    self._end("failed")
                    return
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

    def _fly(self) -> None:
        flight = self.source.open()
        first = self._flight is None
        if self._flight is None or self._flight.summary != flight.summary:
            _log.info("%s: %s", self._name, flight.summary)
            for warning in flight.warnings:
                _log.warning("%s: %s", self._name, warning)
        self._flight, self._done = flight, 0
        if self.source.wait and first:
            self._wait_for_reader(flight)
        self._keep(flight.addresses)
        for address in flight.addresses:
            if address not in self._publishers:
                if self._outbox.is_alive(address):
                    _log.warning("%s: %s is published by somebody else too: readers get both", self._name, address)
                self._publishers[address] = self._outbox.publisher(address, lossless=self.source.speed is None)
        self._state, self._error = "running", None
        self._replay(flight, self.source.speed)

    def _keep(self, addresses: Sequence[Address]) -> None:
        """Close the publishers of all other addresses."""
        for address in set(self._publishers) - set(addresses):
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

    def _publish(self, record: Record) -> None:
        try:
            message = upgrade(record.fields)
        except ValidationError as exc:
            self._reject(record, describe(exc))
        else:
            self._publishers[record.address].publish(message)
            self._published += 1

    def _reject(self, record: Record, reason: str) -> None:
        self._rejected += 1
        if self._rejected <= _REJECTS_LOGGED:
            last = "; further ones are only counted" if self._rejected == _REJECTS_LOGGED else ""
            _log.warning("%s: %s rejected: %s%s", self._name, record.address, reason, last)
        self._outbox.reject(record.address, {"source": self.text, "reason": reason, "fields": dict(record.fields)})
