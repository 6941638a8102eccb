"""Flow control of lossless publishers, based on acknowledgements from readers in mode `every`."""

import logging
import math
import threading
import time
from collections.abc import Mapping
from typing import Final

from zenoh import CongestionControl

from nedbus.client.protocol import CLOSED
from nedbus.errors import ClosedError
from nedbus.log_event import about
from nedbus.timings import TIMINGS
from nedbus.transport import Replies, send_query
from nedbus_msgs import ack_key

from .downsampler import MatchingListener
from .writer import Writer

_log = logging.getLogger(__name__)

# unacknowledged messages of a session; this many fit into the queues of a link and of a reader
WINDOW: Final = 2000
CACHE: Final = 8192  # messages in the history cache of a lossless publisher
_UNACKNOWLEDGED: Final = CACHE - WINDOW  # messages; at this limit even the trickle stops
_MIN_WINDOW: Final = 100  # messages per publisher, however many publishers share the window
_REQUESTS_PER_WINDOW: Final = 8
_TRICKLE_PERIOD: Final = 0.1  # s between messages sent beyond the window, for the other readers
# s until a request, which a full queue may have dropped, is repeated; doubles each time
_RETRY_PAUSE: Final = 0.5
# s, timeout of each query, and the longest pause before a request is repeated
_QUERY_TIMEOUT: Final = 10.0
# s without a poll after which replies are too old to show which readers exist
_STALE_POLL: Final = 1.0
_AWAY_PAUSE: Final = 0.2  # s before the next request while readers are away
_POLL_EVERY: Final = 64  # messages between polls for replies
_MATCH_EVERY: Final = 16  # messages between checks for the first subscriber
_DROP: Final = CongestionControl.DROP  # blocking on a full queue could make Zenoh close the link
_UNKNOWN: Final = ""  # a reader that has never replied


class SharedWindow:
    """The window of a session, shared equally by lossless publishers; each may also use what others leave unused."""

    def __init__(self) -> None:
        self._unread: dict[str, tuple[int, float]] = {}  # number of messages and time, by key
        # publishers call `share` on their own threads; a signal handler may close one
        self._lock = threading.RLock()

    def share(self, key: str, unread: int, *, now: float) -> int:
        """Return the share of a publisher with `unread` messages; the entry expires after a second without a call."""
        with self._lock:
            recent = {
                other: unread
                for other, unread in self._unread.items()
                if now - unread[1] < _STALE_POLL
            }
            self._unread = recent | {key: (unread, now)}
            others = sum(number for number, _ in self._unread.values()) - unread
            return max(_MIN_WINDOW, WINDOW // len(self._unread), WINDOW - others)


class Readers:
    """A publisher's readers, each with the time until which it is awaited [s]. No I/O.

    A reader that replies is awaited without end, and one that closes is forgotten. One that is missing lost its link,
    ended without closing, or is suspended: it is awaited for a limited time.
    """

    def __init__(self) -> None:
        self._until: dict[str, float] = {}

    @property
    def is_empty(self) -> bool:
        """True if no reader is known."""
        return not self._until

    @property
    def is_one_missing(self) -> bool:
        """True while a missing reader is awaited."""
        return any(until != math.inf for until in self._until.values())

    def update(self, replies: Mapping[str, bool], *, froze: bool, now: float) -> None:
        """Update from all replies to a request. `replies`: whether each reader is closed. `now` in seconds.

        `froze`: the request ended long after its last reply, when the lease of a silent reader expired.
        """
        until = now + TIMINGS.return_wait
        if froze:
            until = now + TIMINGS.frozen_wait
        if any(self._until.get(reader) != math.inf for reader in replies):
            self._until.pop(_UNKNOWN, None)  # it is known now
        missing = [
            reader
            for reader, end in self._until.items()
            if end == math.inf and reader not in replies
        ]
        if missing:  # one may have frozen after a reply, before Zenoh finalized it
            until = max(until, self._until.pop(_UNKNOWN, now))
        elif froze:
            missing = [_UNKNOWN]
        self._until = {
            reader: end
            for reader, end in self._until.items()
            if now < end < math.inf and reader not in replies
        }
        for reader in missing:
            self._until[reader] = until
        for reader, is_closed in replies.items():
            if not is_closed:
                self._until[reader] = math.inf

    def wait_for_link(self, now: float) -> None:
        """Wait longer while the publisher has no router, or after its routers change. `now` in seconds."""
        if self.is_empty:
            self._until[_UNKNOWN] = now
        for reader, until in self._until.items():
            self._until[reader] = max(until, now + TIMINGS.return_wait)


class _Request:
    """A request to acknowledge the first `number` messages, repeated until all readers reply to one of its queries."""

    def __init__(self, number: int, routers: list[str], *, read: bool, now: float) -> None:
        self.number = number
        self.read = read
        self.routers = routers
        self.sent = self.last_reply = now
        self.queries: set[Replies] = set()  # queries that have not timed out
        self.replies: dict[str, bool] = {}  # whether each reader is closed

    def poll(self, now: float) -> bool:
        """Receive replies; return True once all readers have replied or left."""
        for query in self.queries.copy():
            for reply in query.poll():
                if reply.ok is None:  # timeout
                    self.queries.discard(query)
                    continue
                reader = str(reply.replier_id)
                if reader not in self.replies:
                    self.last_reply = now
                self.replies[reader] = reply.ok.payload.to_bytes() == CLOSED
        return any(query.ended for query in self.queries)


class FlowControl:
    """The credit of one writer, renewed by acknowledgement requests on `<key>/@ack`, one at a time.

    `check_at`: number of the next message that may have to wait, or after which replies are received.
    `listener`: matched by the subscribers of a router in this process; without any, no request is necessary.
    `needs_router`: readers are reached through a router; without one, missing replies do not mean that readers left.
    """

    def __init__(
        self,
        writer: Writer,
        window: SharedWindow,
        *,
        needs_router: bool,
        listener: MatchingListener | None = None,
    ) -> None:
        self._writer = writer
        self._shared = window
        self._needs_router = needs_router
        self._listener = listener
        self.cancelled = threading.Event()  # set to end a wait with ClosedError
        self._lock = threading.RLock()  # reentrant, because a signal handler may publish or close
        self._readers = Readers()
        self._request: _Request | None = None
        self._next_request = self._polled = 0.0  # monotonic times [s]
        # number of messages received (False) and read by scripts (True)
        self._acknowledged = {False: 0, True: 0}
        # messages; number at which a request is due
        self._window, self._due = WINDOW, WINDOW // _REQUESTS_PER_WINDOW
        self._logged = False
        self.check_at = 0

    def wait_for_credit(self, published: int) -> None:
        """Wait while readers have more than a window of unread messages; raise ClosedError once closed.

        Call it after each message from number `check_at` on.
        Below _UNACKNOWLEDGED unread messages, it returns after one trickle period.
        """
        if (
            self._listener
            and not self._listener.is_matched()
            and self._readers.is_empty
            and self._request is None
        ):
            self._acknowledged[True] = published
            self._due = published
            self.check_at = published + _MATCH_EVERY
            return
        if self._wait(published, self._window, read=True, timeout=_TRICKLE_PERIOD):
            # While a request is open, no other is due: `_due` may have passed.
            next_poll = self._due if self._request is None else published + _POLL_EVERY
            self.check_at = min(next_poll, self._acknowledged[True] + self._window)
            return
        if not self._logged:
            _log.info("%s: waiting for a slow reader", self._writer.key, extra=about("slow_reader"))
        self._logged = True
        self._wait(published, _UNACKNOWLEDGED, read=True, timeout=math.inf)

    def wait_for_reception(self, published: int, *, timeout: float) -> bool:
        """Wait until readers have received all messages; return False after `timeout` s. Raises ClosedError."""
        with self._lock:
            if self._request is not None and self._request.read:
                self._request, self._next_request = None, 0.0  # reception is acknowledged sooner
            self._acknowledged[False] = 0  # there may be new readers
        return not published or self._wait(published, 1, read=False, timeout=timeout)

    def _wait(self, published: int, window: int, *, read: bool, timeout: float) -> bool:
        end, pause = time.monotonic() + timeout, TIMINGS.credit_polls[0]
        while True:
            if self.cancelled.is_set():
                raise ClosedError
            with self._lock:
                now = time.monotonic()
                self._poll(now)
                is_done = published - self._acknowledged[read] < window
                if now >= self._next_request and (published >= self._due or not is_done):
                    self._send_request(published, read=read, now=now)
            if is_done or now >= end:
                return is_done
            time.sleep(pause)
            pause = min(2 * pause, TIMINGS.credit_polls[1])

    def _send_request(self, published: int, *, read: bool, now: float) -> None:
        """Request an acknowledgement of the first `published` messages, or repeat the open request."""
        if self._request is None:
            self._window = self._shared.share(
                self._writer.key, published - self._acknowledged[True], now=now
            )
            self._due = published + self._window // _REQUESTS_PER_WINDOW
            self._request = _Request(published, self._routers(), read=read, now=now)
        request, writer = self._request, self._writer
        self._next_request = now + min(_RETRY_PAUSE + now - request.sent, _QUERY_TIMEOUT)
        number = (request.number - 1) % 2**32
        selector = (
            f"{ack_key(writer.key)}?publisher={writer.name};number={number};read={request.read:d}"
        )
        session = writer.session
        priority = writer.priority
        timeout = _QUERY_TIMEOUT
        request.queries.add(
            send_query(
                session, selector, timeout=timeout, priority=priority, congestion_control=_DROP
            )
        )

    def _poll(self, now: float) -> None:
        request = self._request
        is_stale = now - self._polled > _STALE_POLL
        self._polled = now
        if request is None or not request.poll(now):
            return
        froze = now - request.last_reply > TIMINGS.lease / 2
        if not is_stale:
            self._readers.update(request.replies, froze=froze, now=now)
        routers = self._routers()
        if self._needs_router and (not routers or routers != request.routers):
            self._readers.wait_for_link(now)
        self._request, self._next_request = None, now
        if self._readers.is_one_missing:
            # at once, before the frozen reader can return
            self._next_request += 0.0 if froze else _AWAY_PAUSE
        else:
            self._acknowledged[request.read] = request.number

    def _routers(self) -> list[str]:
        return (
            sorted(map(str, self._writer.session.info.routers_zid())) if self._needs_router else []
        )
