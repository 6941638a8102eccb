"""Flow control: the credit of a lossless publisher, renewed by the acknowledgements of its readers of mode `every`."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Mapping
from typing import Final

from zenoh import CongestionControl

from nedbus.client.protocol import CLOSED, write_parameters
from nedbus.log_event import about
from nedbus.transport import LEASE, Answers, ask
from nedbus_msgs import ack_key

from .writer import Writer

_log = logging.getLogger(__name__)

WINDOW: Final = 2000  # messages that a session sends unacknowledged: fewer than fill the queues of a link, or a reader
CACHE: Final = 8192  # messages that a lossless publisher keeps for readers that missed some
RETURN_TIMEOUT: Final = 5.0  # s that a reader has to return that left without a close, once there is a router
FROZEN_TIMEOUT: Final = 90.0  # s that a reader has to return that froze until Zenoh's lease ended: it may be stopped
_MAX_UNACKNOWLEDGED: Final = CACHE - WINDOW  # messages that are sent at all without an acknowledgement
_MIN_WINDOW: Final = 100  # messages that each publisher sends, however many there are
_REQUESTS_PER_WINDOW: Final = 8  # requests for each window
_TRICKLE_PERIOD: Final = 0.1  # s until a message is sent beyond the window, so that other readers see something
_RETRY_PAUSE: Final = 0.5  # s until a request is repeated, as a full queue may have dropped it; then it doubles
_QUERY_TIMEOUT: Final = 10.0  # s until it is repeated at most; each of its queries is open for as long
_STALE_POLL: Final = 1.0  # s without a poll after which answers do not tell which readers there are
_AWAY_PAUSE: Final = 0.2  # s until another request while readers are away
_POLL_EVERY: Final = 16  # messages between two polls
_POLLS: Final = (0.0005, 0.005)  # s between two polls while it waits: the first, and the longest
_DROP: Final = CongestionControl.DROP  # a request that waits for a full queue could cut a link
_UNKNOWN: Final = ""  # a reader that has never answered


class SharedWindow:
    """The window of a session: each lossless publisher has its part of it, and what the others do not use."""

    def __init__(self) -> None:
        self._unread: dict[str, tuple[int, float]] = {}  # messages, and since when, by key; replaced as a whole

    def part(self, key: str, unread: int, *, now: float) -> int:
        """Return the window of a publisher with `unread` messages; one that asked no more for a second uses nothing."""
        recent = {other: each for other, each in self._unread.items() if now - each[1] < _STALE_POLL}
        self._unread = unread_by_key = recent | {key: (unread, now)}
        others = sum(number for number, _ in unread_by_key.values()) - unread
        return max(_MIN_WINDOW, WINDOW // len(unread_by_key), WINDOW - others)


class ReaderTable:
    """The readers of a publisher: there, or away until some time; those that say they close are forgotten. Pure."""

    def __init__(self) -> None:
        self._there: set[str] = set()
        self.away: dict[str, float] = {}  # until when each is waited for
        self._suspects: set[str] = set()  # readers that answered the last request, when an unknown one froze

    def note(self, answers: Mapping[str, bool], *, froze: bool, now: float) -> None:
        """Note all answers to one request: whether a reader is closed, by its id; `now` in seconds.

        `froze`: it was open long after the last answer, until the lease of a reader ended that did not answer.
        """
        if answers.keys() - self._there - self.away.keys():
            self.away.pop(_UNKNOWN, None)
        gone, until = self._there - answers.keys(), now + (FROZEN_TIMEOUT if froze else RETURN_TIMEOUT)
        if gone & self._suspects:  # it had answered, but not said that this was all
            until = self.away.pop(_UNKNOWN, until)
        self._suspects = set()
        if froze and not gone:
            gone, self._suspects = {_UNKNOWN}, set(answers)
        self._there = {reader for reader, is_closed in answers.items() if not is_closed}
        self.away = {reader: end for reader, end in self.away.items() if end > now and reader not in answers}
        self.away |= dict.fromkeys(gone, until)

    def wait_for_link(self, now: float) -> None:
        """Let no time run while the publisher has no router, or has just joined one, `now` in seconds."""
        if not self._there and not self.away:
            self.away[_UNKNOWN] = now
        self.away = {reader: max(until, now + RETURN_TIMEOUT) for reader, until in self.away.items()}


class _Request:
    """A request to acknowledge the first `number` messages, repeated until one of its queries is answered by all."""

    def __init__(self, number: int, routers: list[str], *, read: bool, now: float) -> None:
        self.number, self.read, self.routers = number, read, routers
        self.sent = self.last_answer = now
        self.queries: set[Answers] = set()  # whose timeout has not passed
        self.answers: dict[str, bool] = {}  # whether a reader is closed, by its id

    def poll(self, now: float) -> bool:
        """Take the answers, and return whether all readers have answered, or left."""
        for query in self.queries.copy():
            for reply in query.take():
                if reply.ok is None:  # its timeout has passed
                    self.queries.discard(query)
                    continue
                reader = str(reply.replier_id)
                if reader not in self.answers:
                    self.last_answer = now
                self.answers[reader] = reply.ok.payload.to_bytes() == CLOSED
        return any(query.ended for query in self.queries)


class FlowControl:
    """The credit of one writer: one request for acknowledgements at a time, on `<key>/@ack`, and the wait for them.

    `needs_router`: its readers are behind a router, whose absence tells nothing of them.
    """

    def __init__(self, writer: Writer, window: SharedWindow, *, needs_router: bool) -> None:
        self._writer, self._shared, self._needs_router = writer, window, needs_router
        self._lock = threading.Lock()
        self._readers = ReaderTable()
        self._request: _Request | None = None
        self._ask_at = self._polled = 0.0
        self._acknowledged = {False: 0, True: 0}  # messages, by whether scripts have read them
        self._window, self._due = WINDOW, WINDOW // _REQUESTS_PER_WINDOW  # messages; the number of the next request
        self._logged = False

    def wait_for_credit(self, published: int) -> None:
        """Wait, after each message, while readers have more than a window to read; raise ClosedError once closed."""
        has_credit = published < self._due and published - self._acknowledged[True] < self._window
        if has_credit and published % _POLL_EVERY:
            return
        if self._wait(published, self._window, read=True, timeout=_TRICKLE_PERIOD):
            return
        if not self._logged:
            _log.info("%s: waiting for a slow reader", self._writer.key, extra=about("slow-reader"))
        self._logged = True
        self._wait(published, _MAX_UNACKNOWLEDGED, read=True, timeout=math.inf)

    def wait(self, published: int, *, timeout: float) -> bool:
        """Wait until readers have all messages; return False if one has not within `timeout` s; raise ClosedError."""
        with self._lock:
            if self._request is not None and self._request.read:
                self._request, self._ask_at = None, 0.0  # arrival is acknowledged sooner than reading
            self._acknowledged[False] = 0  # which readers there are may have changed
        return not published or self._wait(published, 1, read=False, timeout=timeout)

    def _wait(self, published: int, window: int, *, read: bool, timeout: float) -> bool:
        end, pause = time.monotonic() + timeout, _POLLS[0]
        while True:
            with self._lock:
                now = time.monotonic()
                self._poll(now)
                is_done = published - self._acknowledged[read] < window
                if now >= self._ask_at and (published >= self._due or not is_done):
                    self._ask(published, read=read, now=now)
            if is_done or now >= end:
                return is_done
            time.sleep(pause)
            pause = min(2 * pause, _POLLS[1])

    def _ask(self, published: int, *, read: bool, now: float) -> None:
        """Request that these messages are acknowledged, or repeat the request that is open."""
        if self._request is None:
            self._window = self._shared.part(self._writer.key, published - self._acknowledged[True], now=now)
            self._due = published + self._window // _REQUESTS_PER_WINDOW
            self._request = _Request(published, self._routers(), read=read, now=now)
        request, writer = self._request, self._writer
        self._ask_at = now + min(_RETRY_PAUSE + now - request.sent, _QUERY_TIMEOUT)
        parameters = write_parameters(writer.name, (request.number - 1) % 2**32, read=request.read)
        selector = f"{ack_key(writer.key)}?{parameters}"
        query = ask(
            writer.session, selector, timeout=_QUERY_TIMEOUT, priority=writer.priority, congestion_control=_DROP
        )
        request.queries.add(query)

    def _poll(self, now: float) -> None:
        """Note the answers to a request that has ended."""
        request, is_stale, self._polled = self._request, now - self._polled > _STALE_POLL, now
        if request is None or not request.poll(now):
            return
        froze = now - request.last_answer > LEASE / 2
        if not is_stale:
            self._readers.note(request.answers, froze=froze, now=now)
        routers = self._routers()
        if self._needs_router and (not routers or routers != request.routers):
            self._readers.wait_for_link(now)
        self._request, self._ask_at = None, now
        if self._readers.away:
            self._ask_at += 0.0 if froze else _AWAY_PAUSE  # at once, before the frozen reader can be back
        else:
            self._acknowledged[request.read] = request.number

    def _routers(self) -> list[str]:
        return sorted(map(str, self._writer.session.info.routers_zid()))
