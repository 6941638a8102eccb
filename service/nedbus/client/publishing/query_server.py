"""Answers to Zenoh queries, from a thread of its own."""

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

_MAX_PENDING: Final = 1000  # queries that wait for an answer, on each key expression; the oldest are not answered
_MAX_TURN: Final = 64  # queries on one key expression until others have their turn
_POLL: Final = 0.01  # s between two polls for queries
_IDLE_POLL: Final = 0.05  # s, when none has come for a second
_BUSY: Final = 1.0  # s
JSON: Final = "application/json"


Reply = Callable[[zenoh.Query], object]
"""Reply to a query; it must not refer to the owner of the server, which may be dropped without a close."""


class QueryServer:
    """Answer queries on the key expressions of a session; its maker closes it before the session."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._queryables: list[zenoh.Queryable[zenoh.Handler[zenoh.Query]]] = []
        self._thread = Housekeeping(name="nedbus-queries")

    def answer(self, key_expr: str, reply: Reply) -> None:
        """Call `reply` for each query on a key expression; raise ClosedError once it is closed."""
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
        """Answer queries on a key with a JSON document, made for each; `content` gets its parameters by name."""
        self.answer(key, lambda query: query.reply(key, json.dumps(content(query.parameters.get)), encoding=JSON))

    def close(self) -> None:
        """Stop answering."""
        self._thread.close()
        for queryable in self._queryables:
            with suppress(zenoh.ZError):
                queryable.undeclare()


def _answer(query: zenoh.Query, reply: Reply) -> None:
    key_expr = str(query.key_expr)  # a query that has ended does not tell it any more
    try:
        with query:
            reply(query)
    except zenoh.ZError as exc:
        _log.debug("a query on %s could not be answered: %s", key_expr, exc)
    except Exception:  # noqa: BLE001 - a fault in one answer must not leave all others without
        _log.exception("a query on %s is not answered", key_expr, extra=about("bug"))
