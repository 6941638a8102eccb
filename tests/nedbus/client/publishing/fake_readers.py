"""A fake session of a lossless publisher and its readers, with a fake clock that advances only in waits."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from operator import itemgetter
from types import SimpleNamespace
from typing import Final, cast

import pytest
import zenoh

from nedbus.client.protocol import CLOSED
from nedbus.client.publishing import flow_control as module
from nedbus.client.publishing.downsampler import MatchingListener
from nedbus.client.publishing.flow_control import FlowControl, SharedWindow
from nedbus.client.publishing.writer import Writer
from nedbus.timings import TIMINGS, Timings
from tests.nedbus.client.receiving.raw_samples import Payload

KEY: Final = "nedbus/1/vehicle_local_position"
_TICK: Final = 0.01  # s
END: Final = 600.0  # s of simulated time after which a wait counts as stuck


class Stuck(Exception):  # noqa: N818 - not an error, but an expected outcome
    """Raised when a wait does not end within ten minutes."""


@dataclass(eq=False)
class Reader:
    """A reader that reads `rate` messages per second; its lease expires 5 s after it is suspended."""

    name: str
    rate: float = math.inf
    read: float = 0.0
    alive: bool = True
    closed: bool = False
    stopped: float | None = None  # time of the suspension
    stops_in_answer: bool = False  # suspended after its next reply, before the query is finalized

    def is_linked(self, now: float) -> bool:
        return self.alive and (self.stopped is None or now - self.stopped < TIMINGS.lease)

    def is_running(self) -> bool:
        return self.alive and self.stopped is None


@dataclass(eq=False)
class Query:
    """A query of the publisher, and the readers that have not replied yet."""

    number: int
    read: bool
    end: float
    waiting: list[Reader]
    replies: deque[SimpleNamespace] = field(default_factory=deque)
    ended: bool = False
    lost: bool = False  # dropped by a full queue

    def try_recv(self) -> SimpleNamespace | None:
        """Return the next reply, like the channel of a query."""
        if not self.replies and self.ended:
            raise zenoh.ZError("ended")
        return self.replies.popleft() if self.replies else None


@dataclass(eq=False)
class FakeSession:
    """The fake session of a publisher, its readers and its clock; all run in the waiting thread."""

    readers: list[Reader] = field(default_factory=list)
    now: float = 0.0
    published: int = 0
    sent: list[float] = field(default_factory=list)  # time of each message
    requests: list[dict[str, str]] = field(default_factory=list)  # parameters of each query
    pending: list[Query] = field(default_factory=list)
    scheduled: list[tuple[float, Callable[[], object]]] = field(default_factory=list)
    routers: list[str] = field(default_factory=lambda: ["r1"])
    closed: bool = False
    dropping: bool = False  # a full queue drops all requests

    def flow_control(
        self,
        monkeypatch: pytest.MonkeyPatch,
        timings: Timings,
        *,
        needs_router: bool = True,
        is_matched: Callable[[], bool] | None = None,
    ) -> FlowControl:
        """Return a FlowControl on this session and clock; `is_matched`: whether the router has subscribers."""
        timings.credit_polls = 0.0005, _TICK
        monkeypatch.setattr(
            module, "time", SimpleNamespace(monotonic=lambda: self.now, sleep=self.advance)
        )
        writer = SimpleNamespace(session=self, key=KEY, name="p:1", priority=zenoh.Priority.DATA)
        listener = (
            cast("MatchingListener", SimpleNamespace(is_matched=is_matched)) if is_matched else None
        )
        return FlowControl(
            cast("Writer", writer), SharedWindow(), needs_router=needs_router, listener=listener
        )

    def publish(self, control: FlowControl, count: int, *, rate: float = 10_000.0) -> None:
        """Publish `count` messages, at `rate` [Hz] while there is credit."""
        for _ in range(count):
            self.advance(1 / rate)
            self.published += 1
            self.sent.append(self.now)
            if self.published >= control.check_at:
                control.wait_for_credit(self.published)

    def schedule(self, seconds: float, action: Callable[[], object]) -> None:
        """Schedule an action after `seconds`."""
        self.scheduled.append((self.now + seconds, action))
        self.scheduled.sort(key=itemgetter(0))

    def cut(self, reader: Reader, at: float, *, until: float) -> None:
        """Break the link of a reader for the time from `at` to `until` [s]."""
        self.schedule(at, lambda: setattr(reader, "alive", False))
        self.schedule(until, lambda: setattr(reader, "alive", True))

    def restart_router(self, reader: Reader, at: float, *, until: float) -> None:
        """Break the publisher's link for a second, and a reader's link for longer."""
        self.cut(reader, at, until=until)
        self.schedule(at, self.routers.clear)
        self.schedule(at + 1.0, lambda: self.routers.append("r2"))

    def stop(self, reader: Reader, at: float, *, until: float) -> None:
        """Suspend the process of a reader (SIGSTOP)."""
        self.schedule(at, lambda: setattr(reader, "stopped", self.now))
        self.schedule(until, lambda: setattr(reader, "stopped", None))

    def advance(self, seconds: float) -> None:
        """Advance the clock and the readers, and reply to queries; raise Stuck after ten minutes."""
        self.now += seconds
        if self.now > END:
            raise Stuck
        while self.scheduled and self.scheduled[0][0] <= self.now:
            self.scheduled.pop(0)[1]()
        for reader in self.readers:
            if reader.is_running():
                reader.read = min(self.published, reader.read + reader.rate * seconds)
        for query in self.pending.copy():
            self._answer(query)

    def is_linked(self, reader: Reader) -> bool:
        """Return True if a query reaches this reader."""
        return bool(self.routers) and reader.is_linked(self.now)

    def longest_pause(self, since: float = 0.0) -> float:
        """Return the longest time between two sent messages [s]."""
        times = [since, *(each for each in self.sent if each >= since)]
        return max(later - earlier for earlier, later in pairwise(times))

    # The methods of a session that FlowControl uses.

    @property
    def info(self) -> SimpleNamespace:
        return SimpleNamespace(routers_zid=self.routers.copy)

    def get(
        self,
        selector: str,
        channel: zenoh.handlers.FifoChannel[zenoh.Reply],
        *,
        timeout: float,
        **options: object,
    ) -> Query:
        if self.closed:
            raise zenoh.ZError("session closed")
        key, _, parameters = selector.partition("?")
        assert key == f"{KEY}/@ack"
        parsed = dict(each.split("=") for each in parameters.split(";"))
        self.requests.append(parsed)
        linked = [reader for reader in self.readers if self.is_linked(reader) and not reader.closed]
        query = Query(int(parsed["number"]), parsed["read"] == "1", self.now + timeout, linked)
        query.lost = self.dropping and bool(self.routers)
        self.pending.append(query)
        return query

    def _answer(self, query: Query) -> None:
        for reader in list(query.waiting):
            if not self.is_linked(reader):
                query.waiting.remove(reader)
            elif query.lost:
                continue
            elif reader.closed:
                self._reply(query, reader, CLOSED)
            elif reader.is_running() and (not query.read or reader.read > query.number):
                self._reply(query, reader, b"")
        is_open = bool(query.waiting) or query.lost
        if is_open and self.now < query.end:
            return
        self.pending.remove(query)
        if is_open:
            query.replies.append(SimpleNamespace(ok=None))
        query.ended = True

    def _reply(self, query: Query, reader: Reader, payload: bytes) -> None:
        if reader.stops_in_answer:
            reader.stops_in_answer, reader.stopped = False, self.now
        else:
            query.waiting.remove(reader)
        sample = SimpleNamespace(payload=Payload(payload))
        query.replies.append(SimpleNamespace(ok=sample, replier_id=reader.name))
