"""Replies to Zenoh queries: the I/O thread polls for them, and a separate thread computes the replies."""

import logging
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Final

import zenoh

from nedbus import limits
from nedbus.client.io_thread import TICK, CallThread, Job
from nedbus.log_event import UnexpectedErrors
from nedbus.transport import Session, translate_zenoh_errors

_log = logging.getLogger(__name__)

_TURN: Final = 0.02  # s of replies on one key expression before others get their turn
_POLL: Final = 0.01  # s between polls; TICK after _BUSY seconds without a query
_BUSY: Final = 1.0
JSON: Final = "application/json"

# a report on many vehicles would block the I/O thread for too long
_replies = CallThread("nedbus-replies")

# Replies to a query; must not reference the server's owner, which may be garbage-collected while the server is open.
Reply = Callable[[zenoh.Query], object]


class QueryServer:
    """Reply to queries on key expressions of a session; close it before the session."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._queryables: dict[str, _Queryable] = {}

    def answer(self, key_expr: str, reply: Reply) -> None:
        """Call `reply` for each query on a key expression from now on; do nothing if it is already answered.

        Raises ClosedError if the session is closed.
        """
        if key_expr not in self._queryables:
            self._queryables[key_expr] = _Queryable(self._session, key_expr, reply)

    def answer_json(
        self, key: str, parts: Callable[[Callable[[str], str | None]], Iterable[bytes]]
    ) -> None:
        """Reply to queries on a key with the JSON documents of `parts(get)`; `get` returns a parameter of the query."""

        def reply(query: zenoh.Query) -> None:
            for part in parts(query.parameters.get):
                query.reply(key, part, encoding=JSON)

        self.answer(key, reply)

    def end(self, key_expr: str) -> None:
        """Stop replying to queries on a key expression. Idempotent."""
        if (queryable := self._queryables.pop(key_expr, None)) is not None:
            queryable.close()

    def close(self) -> None:
        """Stop replying to queries."""
        while self._queryables:
            self._queryables.popitem()[1].close()


class _Queryable:
    def __init__(self, session: Session, key_expr: str, reply: Reply) -> None:
        with translate_zenoh_errors():
            self._queryable = session.declare_queryable(
                key_expr, zenoh.handlers.RingChannel(limits.QUEUED_QUERIES)
            )
        self._try_recv, self._reply = self._queryable.handler.try_recv, reply
        self._query: zenoh.Query | None = None  # the next one to reply to
        self._busy_until = 0.0
        self._replying = threading.Lock()
        self._closed = False
        self._errors = UnexpectedErrors(
            _log, "%s: unexpected error in a query reply (logged once)", key_expr
        )
        _replies.start()
        self._job = Job(self._poll)

    def close(self) -> None:
        self._closed = True
        self._job.end()
        # a thread still in Zenoh at interpreter exit aborts the process
        with self._replying, suppress(zenoh.ZError):
            self._queryable.undeclare()

    def _poll(self, now: float) -> float:
        if self._query is None:
            with suppress(zenoh.ZError):  # the session is closed
                self._query = self._try_recv()
            if self._query is not None:
                self._busy_until = now + _BUSY
                _replies.put(self._take_turn)
        return _POLL if now < self._busy_until else TICK

    def _take_turn(self) -> None:
        query, end = self._query, time.monotonic() + _TURN
        try:
            with self._replying, suppress(zenoh.ZError):  # undeclared
                while query is not None and not self._closed:
                    with self._errors:
                        self._answer(query)
                    query = self._try_recv() if time.monotonic() < end else None
        finally:
            self._query = None  # from here `_poll` takes the next one

    def _answer(self, query: zenoh.Query) -> None:
        key_expr = str(query.key_expr)  # not available after the query has ended
        try:
            with query:
                self._reply(query)
        except zenoh.ZError as exc:
            _log.debug("%s: cannot reply to a query: %s", key_expr, exc)
