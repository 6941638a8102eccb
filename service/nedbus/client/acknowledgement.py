"""Acknowledgements: a publisher asks the readers of mode `every` whether they have, or have read, what it published.

It queries `<key>/@ack`. A reader answers when the message with the number of the question has arrived or, with `read`,
when its script has taken it, and in any case when it is closed.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Set
from dataclasses import dataclass, field
from typing import Final

import zenoh

from nedbus.log_event import about
from nedbus.transport import LEASE, Session, entity_name, while_open
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
_STEPS: Final = 8  # questions for each window
_TRICKLE: Final = 0.1  # s until a message is sent beyond the window, so that other readers see something
_PATIENCE: Final = 10.0  # s until the same is asked again
_STALE: Final = 1.0  # s after which what came of a question tells nothing of who is there
_AGAIN: Final = 0.2  # s until readers that have gone are asked for again


@dataclass(slots=True, eq=False)
class _Question:
    """A question for the last of `number` messages, and what came of it so far; times in seconds.

    `routers`: whom the publisher was connected to when this question was asked, and when the one before was.
    """

    number: int
    read: bool
    routers: Set[frozenset[str]]
    last: float
    answers: dict[str, bool] = field(default_factory=dict)
    late: bool = False
    ended: float = 0.0


class Acknowledgement:
    """Ask the readers of one key, which `publisher` publishes with this priority; one question at a time.

    `window` is how many messages may be sent without an acknowledgement.
    """

    def __init__(
        self, session: Session, key: str, publisher: zenoh.ext.AdvancedPublisher, *, priority: zenoh.Priority
    ) -> None:
        self.window = WINDOW
        self._session = session
        self._key = ack_key(key)
        self._publisher = publisher
        self._priority = priority
        self._changed = threading.Condition()
        self._told = False
        self._question: _Question | None = None
        self._next_ask = 0.0
        self._asked = self._arrived = self._read = 0  # messages
        self._routers: frozenset[str] = frozenset()  # when the last question was asked
        self._readers = Readers()

    def pace(self, published: int) -> None:
        """Wait while readers have more than a window to read; to be called for each message that was published.

        Raises ClosedError once the session is closed.
        """
        if published - self._asked < self.window // _STEPS and published - self._read < self.window:
            return
        end = time.monotonic() + _TRICKLE
        with self._changed:
            self._ask(published, read=True)
            while published - self._read >= self.window:
                left = end - time.monotonic()
                if left <= 0:
                    self._tell_once()
                    if published - self._read < _LIMIT:
                        return
                self._changed.wait(left if left > 0 else _AGAIN)
                self._ask(published, read=True)

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
        end = time.monotonic() + timeout
        with self._changed:
            self._settle()
            if self._question is not None and self._question.read:
                self._question = None  # what has arrived is known sooner than what is read
            arrived, self._arrived = self._arrived, min(self._arrived, published - 1)  # who reads may have changed
            while self._arrived < published:
                left = end - time.monotonic()
                if left <= 0:
                    self._arrived = arrived
                    return False
                self._ask(published, read=False)
                self._changed.wait(min(left, _AGAIN))
                self._settle()
        return True

    def _ask(self, published: int, *, read: bool) -> None:
        """Ask for the last of so many messages, unless a question is open, or readers were away just now."""
        self._settle()
        asked = time.monotonic()
        if self._question is not None or asked < self._next_ask:
            return
        before, self._routers = self._routers, self._connected()
        question = self._question = _Question(published, read, {before, self._routers}, asked)

        def on_reply(reply: zenoh.Reply) -> None:
            question.last = time.monotonic()
            if reply.ok is None:
                question.late = True
            else:
                question.answers[str(reply.replier_id)] = reply.ok.payload.to_bytes() == CLOSED

        def on_end() -> None:
            with self._changed:
                question.ended = time.monotonic()
                self._changed.notify_all()

        parameters = write_parameters(entity_name(self._publisher.id), (published - 1) % 2**32, read=read)
        self._asked = published
        with while_open():
            self._session.get(
                f"{self._key}?{parameters}",
                zenoh.handlers.Callback(on_reply, on_end, indirect=False),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=_PATIENCE,
                priority=self._priority,
                congestion_control=zenoh.CongestionControl.DROP,  # one that waits for a full queue could cut a link
            )

    def _settle(self) -> None:
        """Note what came of a question that has ended; here, as Zenoh's thread must not ask for its routers."""
        question = self._question
        if question is None or not question.ended:
            return
        self._question = None
        stood_still = question.ended - question.last > LEASE / 2
        is_stale = time.monotonic() - question.ended > _STALE
        if is_stale and not stood_still and not self._readers.away:  # who was there may have ended since
            self._readers = Readers()
        else:
            self._readers.note(
                question.answers,
                late=question.late,
                stood_still=stood_still,
                broken=question.routers != {self._connected()},
                now=question.ended,
            )
        if self._readers.away:
            self._next_ask = question.ended + _AGAIN
        elif not question.late:
            self._arrived = max(self._arrived, question.number)
            self._read = max(self._read, question.number if question.read else 0)

    def _connected(self) -> frozenset[str]:
        return frozenset(map(str, self._session.info.routers_zid()))
