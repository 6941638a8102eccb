"""A server for Zenoh queries, with its own thread."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.client.housekeeping import Housekeeping
from nedbus.log_event import about
from nedbus.transport import Session, while_open

_log = logging.getLogger(__name__)

_MAX_PENDING: Final = 1000  # queued queries per key expression; beyond that the oldest are dropped
_MAX_TURN: Final = 64  # queries per key expression in one poll, so that others get their turn
_POLL: Final = 0.01  # s between polls
_IDLE_POLL: Final = 0.05  # s between polls without a query for _BUSY seconds
_BUSY: Final = 1.0
JSON: Final = "application/json"


Reply = Callable[[zenoh.Query], object]
"""Replies to a query. It must not reference the owner of the server, which may be garbage-collected without a close."""


class QueryServer:
    """Replies to queries on key expressions of a session; close it before the session."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._queryables: list[zenoh.Queryable[zenoh.Handler[zenoh.Query]]] = []
        self._thread = Housekeeping(name="nedbus-queries")

    def answer(self, key_expr: str, reply: Reply) -> None:
        """Call `reply` for each query on a key expression; raise ClosedError if the session is closed."""
        channel: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(_MAX_PENDING)
        with while_open():
            queryable = self._session.declare_queryable(key_expr, channel)
        self._queryables.append(queryable)
        busy_until, handler = 0.0, queryable.handler

        def poll(now: float) -> float:
            nonlocal busy_until
            with suppress(zenoh.ZError):  # the session is closed
                for _ in range(_MAX_TURN):
                    if self._thread.closed or (query := handler.try_recv()) is None:
                        break
                    _answer(query, reply)
                    busy_until = now + _BUSY
            return _POLL if now < busy_until else _IDLE_POLL

        self._thread.add(poll)

    def answer_json(self, key: str, content: Callable[[Callable[[str], str | None]], Mapping[str, object]]) -> None:
        """Reply to queries on a key with JSON; `content` is called with a getter of the query's parameters."""
        self.answer(key, lambda query: query.reply(key, json.dumps(content(query.parameters.get)), encoding=JSON))

    def close(self) -> None:
        """Stop the thread and undeclare all queryables."""
        self._thread.close()
        for queryable in self._queryables:
            with suppress(zenoh.ZError):
                queryable.undeclare()


def _answer(query: zenoh.Query, reply: Reply) -> None:
    key_expr = str(query.key_expr)  # not available after the query has ended
    try:
        with query:
            reply(query)
    except zenoh.ZError as exc:
        _log.debug("%s: cannot reply to a query: %s", key_expr, exc)
    except Exception:  # noqa: BLE001 - a fault in one reply must not end the server
        _log.exception("%s: failed to reply to a query", key_expr, extra=about("bug"))
