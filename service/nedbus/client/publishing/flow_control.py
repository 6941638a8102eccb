"""Flow control: how far a lossless publisher may be ahead of its readers, by what these acknowledge.

It queries `<key>/@ack`. A reader of mode `every` answers when the message with the number of the query has arrived or,
with `read`, when its script has taken it, and in any case when it is closed.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from zenoh import CongestionControl

from nedbus.client.questions import CLOSED, write_parameters
from nedbus.log_event import about
from nedbus.transport import LEASE, Answers, ask
from nedbus_msgs import ack_key

from .writer import Writer

_log = logging.getLogger(__name__)

WINDOW: Final = 2000  # messages that a session sends unacknowledged: fewer than fill the queues of a link, or a reader
KEPT: Final = 8192  # messages that a lossless publisher keeps for readers that missed some
RETURN: Final = 5.0  # s that a reader has to return that left without a close, once there is a router
THAW: Final = 90.0  # s that a reader has to return that froze until Zenoh's lease ended: it may be stopped
_LIMIT: Final = KEPT - WINDOW  # messages that are sent at all without an acknowledgement
_MIN_WINDOW: Final = 100  # messages that each publisher sends, however many there are
_STEPS: Final = 8  # requests for each window
_TRICKLE: Final = 0.1  # s until a message is sent beyond the window, so that other readers see something
_TIMEOUT: Final = 10.0  # s until a request is given up, and another one sent
_RETRIES: Final = (0.5, 1.5, 3.5, 7.5)  # s after which a request is repeated: a full queue may have dropped it
_STALE: Final = 1.0  # s without a poll after which a request tells nothing of which readers there are
_AGAIN: Final = 0.2  # s until another request while readers are away
_LOOK: Final = 16  # messages between two polls
_POLLS: Final = (0.0005, 0.005)  # s between two polls while it waits: the first, and the longest
_UNKNOWN: Final = ""  # a reader that has never answered


class SharedWindow:
    """The window of a session, shared by its lossless publishers: one reader may have to hold what all of them send.

    Each has its part of it, and what the others do not use; one that has not asked for a second uses nothing.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._unread: dict[str, tuple[int, float]] = {}  # messages, and when they were told, by key

    def part(self, key: str, unread: int, *, now: float) -> int:
        """Return how many messages may be unread of a publisher that has this number of them."""
        with self._lock:
            self._unread = {other: each for other, each in self._unread.items() if now - each[1] < _STALE}
            others = sum(number for other, (number, _) in self._unread.items() if other != key)
            self._unread[key] = unread, now
            return max(_MIN_WINDOW, WINDOW // len(self._unread), WINDOW - others)


class ReaderTable:
    """The readers of a publisher: there, or away until some time; those that say they close are forgotten. Pure."""

    def __init__(self) -> None:
        self._there: dict[str, float] = {}  # s that each has to return once it has gone
        self.away: dict[str, float] = {}  # until when each is waited for

    def note(self, answers: Mapping[str, bool], *, late: bool, froze: bool, now: float) -> None:
        """Note the answers to one request, by reader: whether it is closed; `now` in seconds.

        `late`: a reader has not answered in time, and is still connected. `froze`: the request was open for long after
        the last answer, until the lease of one that did not answer ended.
        """
        if answers.keys() - self._there.keys() - self.away.keys():
            self._there.pop(_UNKNOWN, None)
            self.away.pop(_UNKNOWN, None)
        if late or froze:
            self._there |= dict.fromkeys(self._there.keys() - answers.keys() or {_UNKNOWN}, THAW)
        for reader, is_closed in answers.items():
            self.away.pop(reader, None)
            self._there[reader] = RETURN
            if is_closed:
                del self._there[reader]
        if not late:
            self.away = {reader: until for reader, until in self.away.items() if until > now}
            self.away |= {reader: now + self._there.pop(reader) for reader in self._there.keys() - answers.keys()}

    def wait_for_link(self, now: float) -> None:
        """Let no time run while the publisher has no router, or has just joined one, `now` in seconds."""
        if not self._there and not self.away:
            self.away[_UNKNOWN] = now
        self.away = {reader: max(until, now + RETURN) for reader, until in self.away.items()}


@dataclass(slots=True, eq=False)
class _Request:
    """A request to acknowledge the first `number` messages, and its answers: whether a reader is closed, by its id."""

    number: int
    read: bool
    routers: frozenset[str]  # of the publisher when it was sent
    sent: float
    last_answer: float
    queries: dict[Answers, bool] = field(default_factory=dict)  # whether a reader has not answered in time
    answers: dict[str, bool] = field(default_factory=dict)

    def poll(self, now: float) -> bool:
        """Take the answers, and return whether all readers have answered, or no more will."""
        for query in self.queries:
            for reply in [] if query.ended else query.take():
                if reply.ok is None:
                    self.queries[query] = True
                elif (reader := str(reply.replier_id)) not in self.answers:
                    self.answers[reader], self.last_answer = reply.ok.payload.to_bytes() == CLOSED, now
        return self.late or any(query.ended and not late for query, late in self.queries.items())

    @property
    def late(self) -> bool:
        return all(self.queries.values())


class FlowControl:
    """The credit of one writer: request acknowledgements, one request at a time, and wait for them.

    `needs_router`: its readers are behind a router, whose absence tells nothing of them.
    """

    def __init__(self, writer: Writer, window: SharedWindow, *, needs_router: bool) -> None:
        self._writer = writer
        self._shared = window
        self._needs_router = needs_router
        self._lock = threading.Lock()
        self._window = WINDOW
        self._logged = False
        self._request: _Request | None = None
        self._next_request = self._polled = 0.0
        self._requested = self._arrived = self._read = 0  # messages
        self._readers = ReaderTable()

    def pace(self, published: int) -> None:
        """Wait while readers have more than a window to read; to be called for each message that was published.

        Raises ClosedError once the session is closed.
        """
        if published - self._requested < self._window // _STEPS and published - self._read < self._window:
            if not published % _LOOK:
                with self._lock:
                    self._poll(time.monotonic())
            return
        if not self._wait(lambda: published - self._read < self._window, published, read=True, timeout=_TRICKLE):
            if not self._logged:
                _log.info("%s: waiting for a slow reader", self._writer.key, extra=about("slow-reader"))
            self._logged = True
            self._wait(lambda: published - self._read < _LIMIT, published, read=True, timeout=math.inf)

    def wait(self, published: int, *, timeout: float) -> bool:
        """Wait until all readers have `published` messages; return False if one has not within `timeout` seconds.

        Raises ClosedError once the session is closed.
        """
        with self._lock:
            self._poll(time.monotonic())
            if self._request is not None and self._request.read:
                self._request = None  # what has arrived is known sooner than what is read
            self._arrived = min(self._arrived, published - 1)  # which readers there are may have changed
        return not published or self._wait(lambda: self._arrived >= published, published, read=False, timeout=timeout)

    def _wait(self, done: Callable[[], bool], published: int, *, read: bool, timeout: float) -> bool:
        end, pause = time.monotonic() + timeout, _POLLS[0]
        while True:
            with self._lock:
                self._poll(time.monotonic())
                is_done = done()
                if read or not is_done:
                    self._ask(published, read=read)
            if is_done or time.monotonic() >= end:
                return is_done
            time.sleep(pause)
            pause = min(2 * pause, _POLLS[1])

    def _ask(self, published: int, *, read: bool) -> None:
        """Request that these messages are acknowledged, or repeat a request that is open; later if readers are away."""
        now = time.monotonic()
        self._poll(now)
        request = self._request
        if request is None:
            if now < self._next_request:
                return
            self._requested = published
            self._window = self._shared.part(self._writer.key, published - self._read, now=now)
            request = self._request = _Request(published, read, self._routers(), now, now)
        elif len(request.queries) > len(_RETRIES) or now - request.sent < _RETRIES[len(request.queries) - 1]:
            return
        parameters = write_parameters(self._writer.name, (request.number - 1) % 2**32, read=request.read)
        answers = ask(
            self._writer.session,
            f"{ack_key(self._writer.key)}?{parameters}",
            timeout=request.sent + _TIMEOUT - now,
            priority=self._writer.priority,
            congestion_control=CongestionControl.DROP,  # a query that waits for a full queue could cut a link
        )
        request.queries[answers] = False

    def _poll(self, now: float) -> None:
        """Note what came of a request that has ended."""
        request, is_stale = self._request, now - self._polled > _STALE
        self._polled = now
        if request is None or not request.poll(now):
            return
        self._request = None
        if is_stale and not self._readers.away:  # those that were there may have ended since
            self._readers = ReaderTable()
        else:
            froze = not is_stale and now - request.last_answer > LEASE / 2
            self._readers.note(request.answers, late=request.late, froze=froze, now=now)
        if request.late:
            return
        routers = self._routers()
        if self._needs_router and (not routers or routers != request.routers):
            self._readers.wait_for_link(now)
        if self._readers.away:
            self._next_request = now + _AGAIN
        else:
            self._arrived = max(self._arrived, request.number)
            self._read = max(self._read, request.number if request.read else 0)

    def _routers(self) -> frozenset[str]:
        return frozenset(map(str, self._writer.session.info.routers_zid()))
