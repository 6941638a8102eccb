"""Answers to Zenoh queries, from a thread of its own."""

from __future__ import annotations

import json
import logging
import queue
import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

import zenoh

from nedbus.log_event import about
from nedbus.transport import Session, while_open

_log = logging.getLogger(__name__)

_MAX_PENDING: Final = 1000  # queries that wait for an answer
JSON: Final = "application/json"
"""Encoding of answers that are JSON documents."""


@dataclass(frozen=True, slots=True)
class Answer:
    """One reply to a query."""

    key: str
    payload: bytes
    encoding: str
    stamp: zenoh.Timestamp | None = None
    attachment: bytes | None = None


Reply = Callable[[zenoh.Query], Iterable[Answer]]
"""What answers a query; it must not refer to the owner of the server, which may be dropped without a close."""


class QueryServer:
    """Answer queries on the key expressions of a session; whoever makes one closes it before the session."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._pending: queue.Queue[tuple[zenoh.Query, Reply] | None]
        self._pending = queue.Queue(_MAX_PENDING)
        self._queryables: list[zenoh.Queryable[None]] = []
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def answer(self, key_expr: str, reply: Reply) -> None:
        """Answer queries on a key expression with what `reply` returns; raise ClosedError once it is closed."""
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="nedbus-queries", daemon=True)
                self._thread.start()

        def enqueue(query: zenoh.Query) -> None:
            # On Zenoh's own thread, which must not wait; queries beyond the limit are not answered.
            with suppress(queue.Full):
                self._pending.put_nowait((query, reply))

        # A Python thread of Zenoh's would keep the process from exiting: the callback is a direct one.
        callback = zenoh.handlers.Callback(enqueue, indirect=False)
        with while_open():
            self._queryables.append(self._session.declare_queryable(key_expr, callback))

    def answer_json(self, key: str, content: Callable[[], Mapping[str, object]]) -> None:
        """Answer queries on a key with a JSON document, made anew for each."""
        self.answer(key, lambda _: [Answer(key, json.dumps(content()).encode(), JSON)])

    def close(self) -> None:
        """Stop answering."""
        for queryable in self._queryables:
            with suppress(zenoh.ZError):
                queryable.undeclare()
        if self._thread is not None:
            with suppress(queue.Full):
                self._pending.put(None, timeout=0.5)
            self._thread.join(0.5)

    def _run(self) -> None:
        while (item := self._pending.get()) is not None:
            query, reply = item
            key_expr = str(query.key_expr)  # a query that has ended does not tell it any more
            try:
                with query:
                    for each in reply(query):
                        query.reply(
                            each.key,
                            each.payload,
                            encoding=each.encoding,
                            timestamp=each.stamp,
                            attachment=each.attachment,
                        )
            except zenoh.ZError as exc:
                _log.debug("a query on %s could not be answered: %s", key_expr, exc)
            except Exception:  # noqa: BLE001 - a fault in one answer must not leave all others without
                _log.exception("a query on %s is not answered", key_expr, extra=about("bug"))
