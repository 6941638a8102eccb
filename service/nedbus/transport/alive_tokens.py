"""Liveliness tokens: the present ones, and changes as they appear and disappear."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.log_event import about

from .queries import MAX_ANSWER_BYTES, MAX_ANSWERS, Answers, wait_for_answers, zenoh_timeout
from .session import Session, while_open

_log = logging.getLogger(__name__)

_MAX_WAITING: Final = 131_072  # answers; large, as Zenoh would hold its session lock while it waits for room
_MAX_CHANGES: Final = 4096  # waiting changes
_MAX_KEY_LENGTH: Final = MAX_ANSWER_BYTES // MAX_ANSWERS
_INCOMPLETE_PAUSE: Final = 10.0  # s until the next query, after an incomplete answer
_CONTRADICTED_PAUSE: Final = 0.2  # s until the next query, after an answer that lacks known tokens


def alive_keys(session: Session, key_expr: str, *, timeout: float) -> list[str]:
    """Return the keys of matching liveliness tokens: unique, sorted, at most 10,000."""
    replies = wait_for_answers([_ask(session, key_expr, timeout)])
    return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})[:MAX_ANSWERS]


class AliveTokens:
    """The liveliness tokens that match a key expression; used by one thread.

    A subscription costs nothing while no token changes, but a query for all tokens loads every client of a router. So
    the router is queried only on request, and after the queue of changes has overflowed. From an answer Zenoh 1.10
    omits tokens that it sends to a subscriber of the same session meanwhile, and the answer looks complete; so the
    query is repeated until an answer has all known tokens. At most 10,000 tokens are kept; more tokens, or a router
    that is too slow to list them, are logged.
    """

    def __init__(self, session: Session, key_expr: str) -> None:
        channel: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(_MAX_CHANGES)
        with while_open():
            subscriber = session.liveliness().declare_subscriber(key_expr, channel, history=True)
        self.undeclare: Callable[[], object] = subscriber.undeclare
        self._session, self._key_expr = session, key_expr
        self._handler: zenoh.Handler[zenoh.Sample] = subscriber.handler
        self._keys: set[str] = set()
        self._next_query = math.inf
        self._answers: Answers | None = None
        self._expected: set[str] = set()  # tokens known at the time of the query
        self._answered: set[str] = set()

    @property
    def is_asking(self) -> bool:
        """True while a query is open; a later `take` receives its answer."""
        return self._answers is not None

    def ask(self) -> None:
        """Query the router for all tokens at the next `take`."""
        self._next_query = -math.inf

    def take(self, *, timeout: float) -> list[tuple[str, bool]]:
        """Return the changes since the last call, in order: the key of a token, and True if it appeared.

        `timeout`: seconds for the router to answer a query.
        """
        changed = self._take_changes()
        changes: list[tuple[str, bool]] = []
        if len(changed) == _MAX_CHANGES:  # further changes were dropped
            changes += [(key, False) for key in self._keys]
            self._answers = None
            self.ask()
        if self._answers is not None:  # after the changes, as the answers may be older
            changes += self._take_answers(self._answers)
        changes = [change for change in changes + changed if self._note(*change)]
        if self._answers is None and time.monotonic() >= self._next_query:
            self._next_query = math.inf
            self._expected, self._answered = self._keys.copy(), set()
            self._answers = _ask(self._session, self._key_expr, timeout)
        return changes

    def _take_changes(self) -> list[tuple[str, bool]]:
        changed: list[tuple[str, bool]] = []
        with suppress(zenoh.ZError):  # the session is closed
            while len(changed) < _MAX_CHANGES and (sample := self._handler.try_recv()) is not None:
                changed.append((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))
        return changed

    def _take_answers(self, answers: Answers) -> list[tuple[str, bool]]:
        keys = [str(reply.ok.key_expr) for reply in answers.take() if reply.ok is not None]
        self._answered.update(keys[: MAX_ANSWERS + 1 - len(self._answered)])
        if answers.ended:
            self._answers = None
            if answers.failed or len(self._answered) > MAX_ANSWERS:
                self._ask_later()
            elif not self._expected & self._keys <= self._answered:
                self._next_query = time.monotonic() + _CONTRADICTED_PAUSE
        return [(key, True) for key in keys]

    def _note(self, key: str, alive: bool) -> bool:
        """Apply a change; return whether it made a difference."""
        if (key in self._keys) == alive or len(key) > _MAX_KEY_LENGTH:
            return False
        if alive and len(self._keys) >= MAX_ANSWERS:
            self._ask_later()
            return False
        (self._keys.add if alive else self._keys.remove)(key)
        return True

    def _ask_later(self) -> None:
        if self._next_query == math.inf:
            self._next_query = time.monotonic() + _INCOMPLETE_PAUSE
            text = "%s: not all liveliness tokens are known, only %d: some vehicles are missing"
            _log.warning(text, self._key_expr, len(self._keys), extra=about("incomplete"))


def _ask(session: Session, key_expr: str, timeout: float) -> Answers:
    """Query matching tokens and return at once; each answer without an error holds one token."""
    channel: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(_MAX_WAITING)
    timeout = zenoh_timeout(timeout)
    with while_open():
        return Answers(session.liveliness().get(key_expr, channel, timeout=timeout), timeout=timeout)
