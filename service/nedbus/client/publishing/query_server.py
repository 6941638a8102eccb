"""Answers to Zenoh queries, from a thread of its own."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

import zenoh

from nedbus.log_event import about
from nedbus.transport import Session, while_open

_log = logging.getLogger(__name__)

_MAX_PENDING: Final = 1000  # queries that wait for an answer, on each key expression; the oldest are not answered
_TURN: Final = 64  # queries on one key expression until others have their turn
_POLL: Final = 0.01  # s between two polls for queries
_IDLE_POLL: Final = 0.05  # s, when none has come for a second
_BUSY: Final = 1.0  # s
_JOIN: Final = 10.0  # s that an answer has to get out of Zenoh: its thread would abort a process that ends
JSON: Final = "application/json"


@dataclass(frozen=True, slots=True)
class Answer:
    """One reply to a query."""

    key: str
    payload: bytes
    encoding: str
    stamp: zenoh.Timestamp | None = None
    attachment: bytes | None = None


Reply = Callable[[zenoh.Query], Iterable[Answer]]
"""Answer a query; it must not refer to the owner of the server, which may be dropped without a close."""


class QueryServer:
    """Answer queries on the key expressions of a session; its maker closes it before the session."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._replies: list[tuple[zenoh.Queryable[zenoh.Handler[zenoh.Query]], zenoh.Handler[zenoh.Query], Reply]] = []
        self._ended = threading.Event()
        self._starting = threading.Lock()
        self._thread: threading.Thread | None = None

    def answer(self, key_expr: str, reply: Reply) -> None:
        """Answer queries on a key expression with what `reply` returns; raise ClosedError once it is closed."""
        channel: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(_MAX_PENDING)
        with while_open():
            queryable = self._session.declare_queryable(key_expr, channel)
        self._replies.append((queryable, queryable.handler, reply))
        with self._starting:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="nedbus-queries", daemon=True)
                self._thread.start()

    def answer_json(
        self, key: str, content: Callable[[], Mapping[str, object]],
        **instead: Callable[[str], Mapping[str, object]],
    ) -> None:  # fmt: skip
        """Answer queries on a key with a JSON document, made anew for each.

        `instead`: what is answered to a query with this parameter, given its value.
        """

        def reply(query: zenoh.Query) -> list[Answer]:
            given = query.parameters
            asked = next((name for name in instead if name in given), None)
            document = content() if asked is None else instead[asked](given.get(asked) or "")
            return [Answer(key, json.dumps(document).encode(), JSON)]

        self.answer(key, reply)

    def close(self) -> None:
        """Stop answering."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join(_JOIN)
        for queryable, _, _ in self._replies:
            with suppress(zenoh.ZError):
                queryable.undeclare()

    def _run(self) -> None:
        busy_until = 0.0
        while not self._ended.wait(_POLL if time.monotonic() < busy_until else _IDLE_POLL):
            for _, handler, reply in list(self._replies):
                with suppress(zenoh.ZError):  # the session is closed
                    for _ in range(_TURN):
                        query = handler.try_recv()
                        if query is None or self._ended.is_set():
                            break
                        _answer(query, reply)
                        busy_until = time.monotonic() + _BUSY


def _answer(query: zenoh.Query, reply: Reply) -> None:
    key_expr = str(query.key_expr)  # a query that has ended does not tell it any more
    try:
        with query:
            for each in reply(query):
                query.reply(
                    each.key, each.payload, encoding=each.encoding, timestamp=each.stamp, attachment=each.attachment
                )
    except zenoh.ZError as exc:
        _log.debug("a query on %s could not be answered: %s", key_expr, exc)
    except Exception:  # noqa: BLE001 - a fault in one answer must not leave all others without
        _log.exception("a query on %s is not answered", key_expr, extra=about("bug"))
