"""Ask publishers for what is missing in a subscription of mode `every`: each by its exact key, and again.

Zenoh's own recovery asks once, with the key expression of the subscription, which a router compares with the caches of
all publishers: the restart of a router with 1,000 of them became a storm in which questions went unanswered. Here at
most 64 questions are open, whatever there is to ask, and one without an answer is asked again for 20 s. Meanwhile only
what comes after it from the same publisher waits.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.errors import NedbusError
from nedbus.log_event import about
from nedbus.transport import Heartbeats, Session, ask_kept, follow_heartbeats, while_open

from .publisher_sequence import Hole
from .receive_queue import CAPACITY, ReceiveQueue
from .search import Search

_log = logging.getLogger(__name__)

_OPEN: Final = 64  # questions at a time,
_OPEN_BEGINNINGS: Final = 16  # of these for what a publisher sent before it was heard,
_OPEN_OF_KEY: Final = 4  # and for one key: whoever publishes there may leave them unanswered
_BEHIND: Final = CAPACITY // 2  # messages to be read beyond which nothing is asked for: it would push out others
_HELD: Final = 2 * CAPACITY  # messages that wait for others, some 90 MB,
_HELD_OF_KEY: Final = CAPACITY // 2  # and of these on one key: whoever may publish there pushes out nobody else
_TIMEOUT: Final = 3.0  # s until a question is given up
_PATIENCE: Final = 20.0  # s of questions after which what is still missing is lost: so long publishers keep it
_POLL: Final = 0.005  # s between two looks for answers
_PAUSES: Final = (0.05, 0.1, 0.2, 0.4, 0.8)  # s before asking again; then the last one
_MAX_SILENT: Final = 1000
_LOOK: Final = 0.25  # s between two looks at heartbeats
_UNSETTLED: Final = 10.0  # s after a link broke or came back in which a new publisher may have sent something before


class Recovery:
    """Fill the holes of a queue; it has a thread that asks, and calls `on_fill` with the key of each that was filled.

    `begins`: of a publisher that is heard for the first time by a heartbeat the newest message is asked for.
    """

    def __init__(
        self,
        session: Session,
        receive_queue: ReceiveQueue,
        *,
        name: str,
        begins: bool,
        on_fill: Callable[[str], object],
    ) -> None:
        self._session = session
        self._queue = receive_queue
        self._name = name
        self._begins = begins
        self._on_fill = on_fill
        self._waiting: deque[Search] = deque()
        self._searching: dict[Hole, Search] = {}
        self._asked: list[Search] = []  # those with an open question
        self._silent: dict[str, None] = {}  # publishers that were asked in vain
        self._holes: queue.SimpleQueue[Hole | None] = queue.SimpleQueue()
        self._closed = False
        self._watched: dict[str, Callable[[], Heartbeats]] = {}
        self._behind: Heartbeats = {}
        self._drains = 0  # of the queue, when these were taken
        with while_open():
            links: zenoh.handlers.RingChannel[zenoh.TransportEvent] = zenoh.handlers.RingChannel(1)
            self._links = session.info.declare_transport_events_listener(links, history=False)
            self._link_events = self._links.handler
        receive_queue.recover(self._holes.put)
        self._thread = threading.Thread(target=self._run, name="nedbus-recovery", daemon=True)
        self._thread.start()

    def watch(self, key_expr: str) -> Callable[[], object]:
        """Notice by heartbeats that the newest messages on these keys are missing; return what ends it."""
        take, undeclare = follow_heartbeats(self._session, key_expr)
        self._watched = {**self._watched, key_expr: take}  # the thread may be iterating over the other

        def end() -> None:
            self._watched = {key: each for key, each in self._watched.items() if key != key_expr}
            undeclare()

        return end

    def notice_links(self) -> None:
        """Note that a link broke or came back; to be called before what arrived since is put into the queue."""
        with suppress(zenoh.ZError):  # closed
            while self._link_events.try_recv() is not None:
                self._queue.unsettled_until = time.monotonic() + _UNSETTLED
                self._silent.clear()  # they could not answer, perhaps

    def close(self) -> None:
        """Ask no more: what is missing now is lost."""
        self._closed = True
        self._holes.put(None)
        with suppress(zenoh.ZError):  # closed already with the session
            self._links.undeclare()
        if threading.current_thread() is not self._thread:
            self._thread.join(_TIMEOUT)

    def _run(self) -> None:
        try:
            next_look = time.monotonic() + _LOOK
            while not self._closed:
                self._take_holes()
                self._take_answers()
                self.notice_links()
                now = time.monotonic()
                if now >= next_look:
                    next_look = now + _LOOK
                    self._look()
                self._ask(now)
                self._give_up(_HELD, _HELD_OF_KEY)
        except BaseException:
            _log.exception("%s: recovery ends after an unexpected error", self._name, extra=about("error"))
            raise
        finally:
            self._queue.recover(None)  # nothing is held from now on
            self._give_up(-1, -1)
            self._asked.clear()  # nobody takes answers any more, and a full channel would hold up the session

    def _take_holes(self) -> None:
        """Wait for holes, at most until something else is due, and note them."""
        with suppress(queue.Empty):
            hole = self._holes.get(timeout=_POLL if self._asked else _PAUSES[0] if self._waiting else _LOOK)
            while True:
                if hole is not None:
                    patience = 0.0 if hole.publisher in self._silent else _PATIENCE
                    self._searching[hole] = search = Search(hole, patience)
                    self._waiting.append(search)
                hole = self._holes.get_nowait()

    def _take_answers(self) -> None:
        for search in [each for each in self._asked if each.take()]:
            self._asked.remove(search)
            self._judge(search)

    def _ask(self, now: float) -> None:
        shares = Counter(_share(each.hole) for each in self._asked)
        for _ in range(len(self._waiting)):
            if len(self._asked) >= _OPEN or self._queue.waiting > _BEHIND:
                return
            search = self._waiting.popleft()
            if search.ended:
                continue
            hole, share = search.hole, _share(search.hole)
            if search.due > now or shares[share] >= (_OPEN_OF_KEY if share else _OPEN_BEGINNINGS):
                self._waiting.append(search)
                continue
            search.tries += 1
            search.until = search.until or now + search.patience  # not while others were asked before
            try:
                search.answers = ask_kept(self._session, hole.stream, hole.publisher, search.numbers, timeout=_TIMEOUT)
            except NedbusError:  # the session is closed
                self._fill(search)
            else:
                self._asked.append(search)
                shares[share] += 1

    def _judge(self, search: Search) -> None:
        """Decide what follows from the end of a question."""
        if search.ended:
            return
        now = time.monotonic()
        publisher = search.hole.publisher
        if search.complete:
            self._silent.pop(publisher, None)
            self._fill(search)
        elif search.until is not None and now < search.until:
            search.due = now + _PAUSES[min(search.tries, len(_PAUSES)) - 1]
            self._waiting.append(search)
        else:
            # Perhaps it keeps nothing. The next hole is asked for once, and nothing waits for that.
            if not search.found and len(self._silent) < _MAX_SILENT:
                self._silent[publisher] = None
            self._fill(search)

    def _fill(self, search: Search) -> None:
        search.ended = True
        self._searching.pop(search.hole, None)
        try:
            self._queue.fill(search.hole, list(search.found.values()))
        except Exception:  # noqa: BLE001 - what one sample causes must not keep all others from the reader
            _log.exception(
                "%s: what was recovered is left out after an unexpected error", self._name, extra=about("bug")
            )
            self._queue.fill(search.hole, [])
        self._on_fill(search.hole.stream)

    def _give_up(self, total: int, of_key: int) -> None:
        """Fill holes with what was found so far, until no more messages wait in all, and on one key."""
        for hole in self._queue.excess(total, of_key):
            self._fill(self._searching.get(hole) or Search(hole, 0.0))

    def _look(self) -> None:
        """Ask for the newest messages that heartbeats of the look before told of, if they have not come since."""
        if self._behind and not (self._queue.idle or self._queue.drains >= self._drains + 2):
            return  # what they tell of may be in the channel still
        for (key, publisher), number in self._behind.items():
            self._queue.beat(key, publisher, number, begins=self._begins)
        newest: Heartbeats = {}
        for take in self._watched.values():
            newest |= take()
        self._behind, self._drains = newest, self._queue.drains


def _share(hole: Hole) -> str:
    """Return which share of the open questions one for this hole is of: that of its key, or "", of beginnings."""
    return hole.stream if hole.exact else ""
