"""Zenoh queries and their answers.

Answers wait in channels in Rust until a thread of nedbus polls them. A Python callback, or its drop, would wait for the
GIL on a thread of Zenoh's, which for a liveliness query holds the session lock meanwhile: a deadlock as soon as another
thread needs that lock.
"""

import logging
import time
from collections.abc import Iterator, Sequence
from typing import Any, Final

import zenoh

from nedbus.log_event import about

from .session import RawSample, Session, translate_zenoh_errors

_log = logging.getLogger(__name__)

MAX_ANSWERS: Final = 10_000
"""Answers accepted per query; honest peers send fewer."""

MAX_ANSWER_BYTES: Final = 2**26
"""Bytes of payloads and keys accepted per query."""

_MAX_WAITING: Final = 1024  # answers in the channel
_GRACE: Final = 1.0  # s beyond the timeout for Zenoh to report the end of a query
_PAUSES: Final = (0.0005, 0.01)  # s between polls for answers: the first pause, and the longest


class Answers:
    """The answers to one query, polled by the thread that sent it."""

    def __init__(self, handler: zenoh.Handler[zenoh.Reply], *, timeout: float) -> None:
        self.ended = False  # the last answer was taken: every queryable has answered, or the timeout has passed
        self.failed = False  # an answer was an error, such as a timeout
        self._handler = handler
        self._end = time.monotonic() + timeout + _GRACE

    def take(self) -> list[zenoh.Reply]:
        """Return the answers received since the last call."""
        taken: list[zenoh.Reply] = []
        try:
            while len(taken) < MAX_ANSWERS and (reply := self._handler.try_recv()) is not None:
                taken.append(reply)
                self.failed |= reply.ok is None
            if time.monotonic() > self._end:
                self.ended = self.failed = True
        except zenoh.ZError:  # empty and closed
            self.ended = True
        return taken


def ask(session: Session, selector: str, *, timeout: float, room: int = _MAX_WAITING, **options: Any) -> Answers:
    """Query all matching queryables and return at once; the session blocks while `room` answers wait.

    `options`: further arguments of `zenoh.Session.get`, such as `priority`.
    """
    timeout = zenoh_timeout(timeout)
    options |= {"target": zenoh.QueryTarget.ALL, "consolidation": zenoh.ConsolidationMode.NONE}
    with translate_zenoh_errors():
        answers = session.get(selector, zenoh.handlers.FifoChannel(room), timeout=timeout, **options)
    return Answers(answers, timeout=timeout)


def query(session: Session, selector: str, *, timeout: float) -> list[RawSample]:
    """Return the answers within `timeout` seconds, perhaps several for a key.

    At most 10,000 answers and 64 MB in total are accepted; the number of answers beyond that is logged.
    """
    kept: list[RawSample] = []
    size = left_out = 0
    for sample in filter(None, (reply.ok for reply in wait_for_answers([ask(session, selector, timeout=timeout)]))):
        size += len(sample.payload) + len(str(sample.key_expr))
        if size > MAX_ANSWER_BYTES or len(kept) >= MAX_ANSWERS:
            left_out += 1
        else:
            kept.append(sample)
    if left_out:
        text = "%s: %d answers left out, beyond the limits of a query"
        _log.warning(text, selector, left_out, extra=about("incomplete"))
    return kept


def wait_for_answers(queries: Sequence[Answers]) -> Iterator[zenoh.Reply]:
    """Yield answers as they arrive, until all queries have ended."""
    pause, longest = _PAUSES
    while still := [answers for answers in queries if not answers.ended]:
        taken = [reply for answers in still for reply in answers.take()]
        yield from taken
        if not taken:
            time.sleep(pause)
            pause = min(2 * pause, longest)


def zenoh_timeout(timeout: float) -> float:
    """Limit a timeout to the range that Zenoh accepts: neither 0 nor infinity."""
    return min(max(timeout, 0.001), 86_400.0)
