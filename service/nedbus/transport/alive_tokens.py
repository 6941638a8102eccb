"""Liveliness tokens: those that there are, and those that appear and go."""

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

_MAX_WAITING: Final = 131_072  # answers; Zenoh must never wait for room while it holds the lock of its session
_MAX_CHANGES: Final = 4096  # that wait
_MAX_KEY_LENGTH: Final = MAX_ANSWER_BYTES // MAX_ANSWERS
_INCOMPLETE_PAUSE: Final = 10.0  # s after an incomplete answer
_CONTRADICTED_PAUSE: Final = 0.2  # s after one that looks complete, and lacks known tokens


def alive_keys(session: Session, key_expr: str, *, timeout: float) -> list[str]:
    """Return the keys of the liveliness tokens that match, each once, sorted, at most 10,000."""
    replies = wait_for_answers([_ask(session, key_expr, timeout)])
    return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})[:MAX_ANSWERS]


class AliveTokens:
    """The liveliness tokens that match a key expression, followed by one thread.

    A query for all tokens costs all clients of a router, and following them costs nothing while nothing changes: the
    router is asked on request of the caller, and after an overflow of the changes. Zenoh 1.10 leaves out of an answer
    any tokens that it sends to the subscriber of the same session meanwhile, and the answer looks complete: it is asked
    again until the answer has all known tokens. At most 10,000 tokens are kept; more of them, or a router that is too
    slow to list them, are logged.
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
        self._expected: set[str] = set()  # known when the router was asked
        self._answered: set[str] = set()

    @property
    def is_asking(self) -> bool:
        """True while an answer has not come: another `take` gets it."""
        return self._answers is not None

    def ask(self) -> None:
        """Ask the router for all tokens with the next `take`."""
        self._next_query = -math.inf

    def take(self, *, timeout: float) -> list[tuple[str, bool]]:
        """Return the key of each token that changed since the last call, and whether it appeared, in order.

        A router that is asked for all has `timeout` seconds to answer.
        """
        changed = self._take_changes()
        changes: list[tuple[str, bool]] = []
        if len(changed) == _MAX_CHANGES:  # others were dropped, of tokens that appeared or went
            changes += [(key, False) for key in self._keys]
            self._answers = None
            self.ask()
        if self._answers is not None:  # taken after the changes, and older than they are
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
        """Return whether this changes anything."""
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
            text = "%s: not all liveliness tokens are known, after %d: some vehicles are missing"
            _log.warning(text, self._key_expr, len(self._keys), extra=about("incomplete"))


def _ask(session: Session, key_expr: str, timeout: float) -> Answers:
    """Ask for the tokens that match, and return at once; one token is in each answer that has no error."""
    channel: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(_MAX_WAITING)
    timeout = zenoh_timeout(timeout)
    with while_open():
        return Answers(session.liveliness().get(key_expr, channel, timeout=timeout), timeout=timeout)
