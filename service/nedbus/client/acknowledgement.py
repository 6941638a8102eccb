"""Acknowledgements: a publisher asks the readers of mode `every` whether they have, or have read, what it published.

It queries `<key>/@ack`. A reader answers when the message with the number of the question has arrived or, with `read`,
when its script has taken it, and in any case when it is closed.
"""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass, field
from typing import Final

import zenoh

from nedbus.log_event import about
from nedbus.transport import LEASE, Answers, Session, ask
from nedbus_msgs import ack_key

from .questions import CLOSED, write_parameters
from .readers import Readers

_log = logging.getLogger(__name__)

WINDOW: Final = 2000
"""Messages that the lossless publishers of a session send without an acknowledgement, all together: fewer than fill the
queues of a link, or of a reader."""

KEPT: Final = 8192
"""Messages that a lossless publisher keeps for readers that missed some."""

_LIMIT: Final = KEPT - WINDOW  # messages that are sent at all without an acknowledgement
_MIN_WINDOW: Final = 100  # messages that each of them sends, however many there are
_STEPS: Final = 8  # questions for each window
_TRICKLE: Final = 0.1  # s until a message is sent beyond the window, so that other readers see something
_TIMEOUT: Final = 10.0  # s until a question is given up, and another one asked
_RETRIES: Final = (0.5, 1.5, 3.5, 7.5)  # s after which a question is repeated: a full queue may have dropped it
_STALE: Final = 1.0  # s between two looks after which what came of a question tells nothing of who is there
_AGAIN: Final = 0.2  # s until readers that have gone are asked for again
_LOOK: Final = 16  # messages between two looks for answers
_POLLS: Final = (0.0005, 0.005)  # s between two looks for answers while it waits: the first, and the longest


class SharedWindow:
    """Share a window among the lossless publishers of a session, as one reader may have to hold what all of them send.

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


@dataclass(slots=True, eq=False)
class _Question:
    """A question for the last of `number` messages, and what came of it so far; times in seconds.

    `routers`: those that the publisher was connected to when it asked. `tries`: the queries that it is asked with.
    `last`: when the last reader answered.
    """

    number: int
    read: bool
    routers: frozenset[str]
    asked: float
    last: float
    tries: list[Answers] = field(default_factory=list)
    answers: dict[str, bool] = field(default_factory=dict)  # whether a reader is closed
    late: int = 0  # tries that somebody has not answered in time

    def has_ended(self, now: float) -> bool:
        """Take the answers, and return whether all readers have answered, or none will."""
        for each in self.tries:
            if each.ended:
                continue
            late = 0
            for reply in each.take():
                if reply.ok is None:
                    late = 1
                elif (reader := str(reply.replier_id)) not in self.answers:
                    self.last = now
                    self.answers[reader] = reply.ok.payload.to_bytes() == CLOSED
            self.late += late
        return sum(each.ended for each in self.tries) > self.late or self.late == len(self.tries)


class Acknowledgement:
    """Ask the readers of one key, which `publisher` publishes with this priority; one question at a time.

    `needs_router`: its readers are behind a router, whose absence tells nothing of them.
    """

    def __init__(
        self,
        session: Session,
        key: str,
        publisher: str,
        *,
        priority: zenoh.Priority,
        shared: SharedWindow,
        needs_router: bool,
    ) -> None:
        self._session = session
        self._key = ack_key(key)
        self._publisher = publisher
        self._priority = priority
        self._shared = shared
        self._needs_router = needs_router
        self._window = WINDOW
        self._lock = threading.Lock()
        self._told = False
        self._question: _Question | None = None
        self._next_ask = self._looked = 0.0
        self._asked = self._arrived = self._read = 0  # messages
        self._readers = Readers()

    def pace(self, published: int) -> None:
        """Wait while readers have more than a window to read; to be called for each message that was published.

        Raises ClosedError once the session is closed.
        """
        if published - self._asked < self._window // _STEPS and published - self._read < self._window:
            if not published % _LOOK:
                with self._lock:
                    self._settle(time.monotonic())
            return
        end, pause = time.monotonic() + _TRICKLE, _POLLS[0]
        while True:
            with self._lock:
                self._ask(published, read=True)
            ahead = published - self._read
            if ahead < self._window:
                return
            if time.monotonic() >= end:
                self._tell_once()
                if ahead < _LIMIT:
                    return
            time.sleep(pause)
            pause = min(2 * pause, _POLLS[1])

    def _tell_once(self) -> None:
        if not self._told:
            self._told = True
            _log.info("%s: waiting for a slow reader", self._key.removesuffix("/@ack"), extra=about("slow-reader"))

    def wait(self, published: int, *, timeout: float) -> bool:
        """Wait until all readers have `published` messages; return False if one has not within `timeout` seconds.

        Raises ClosedError once the session is closed.
        """
        if not published:
            return True
        end, pause = time.monotonic() + timeout, _POLLS[0]
        with self._lock:
            self._settle(time.monotonic())
            if self._question is not None and self._question.read:
                self._question = None  # what has arrived is known sooner than what is read
            arrived, self._arrived = self._arrived, min(self._arrived, published - 1)  # who reads may have changed
        while True:
            with self._lock:
                self._settle(time.monotonic())
                if self._arrived >= published:
                    return True
                if time.monotonic() >= end:
                    self._arrived = arrived
                    return False
                self._ask(published, read=False)
            time.sleep(pause)
            pause = min(2 * pause, _POLLS[1])

    def _ask(self, published: int, *, read: bool) -> None:
        """Ask for the last of these messages, unless readers were away just now, or repeat a question that is open."""
        now = time.monotonic()
        self._settle(now)
        question = self._question
        if question is None:
            if now < self._next_ask:
                return
            self._asked = published
            self._window = self._shared.part(self._key, published - self._read, now=now)
            question = self._question = _Question(published, read, self._connected(), now, now)
        elif len(question.tries) > len(_RETRIES) or now - question.asked < _RETRIES[len(question.tries) - 1]:
            return
        parameters = write_parameters(self._publisher, (question.number - 1) % 2**32, read=question.read)
        question.tries.append(
            ask(
                self._session,
                f"{self._key}?{parameters}",
                timeout=question.asked + _TIMEOUT - now,
                priority=self._priority,
                congestion_control=zenoh.CongestionControl.DROP,  # one that waits for a full queue could cut a link
            )
        )

    def _settle(self, now: float) -> None:
        """Note what came of a question that has ended."""
        question, is_stale = self._question, now - self._looked > _STALE
        self._looked = now
        if question is None or not question.has_ended(now):
            return
        self._question = None
        connected = self._connected()
        broken = self._needs_router and (not connected or connected != question.routers)
        late = question.late == len(question.tries)
        if is_stale and not self._readers.away:  # who was there may have ended since
            self._readers = Readers()
        else:
            stood_still = not is_stale and now - question.last > LEASE / 2
            self._readers.note(question.answers, late=late, stood_still=stood_still, now=now)
        if late:
            return
        if broken:
            self._readers.wait_for_link(now)
        if self._readers.away:
            self._next_ask = now + _AGAIN
        else:
            self._arrived = max(self._arrived, question.number)
            self._read = max(self._read, question.number if question.read else 0)

    def _connected(self) -> frozenset[str]:
        return frozenset(map(str, self._session.info.routers_zid()))
