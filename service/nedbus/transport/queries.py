"""Queries: the answers on a key expression, and the liveliness tokens that there are.

Answers and changes wait in channels in Rust until a thread of ours takes them: a Python callback, or its drop, would
wait for the interpreter's lock on a thread of Zenoh's, for a liveliness query even while that thread holds the lock of
the session, and whatever else needs that lock stops the process.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.log_event import about

from .session import RawSample, Session, while_open

_log = logging.getLogger(__name__)

MAX_ANSWERS: Final = 10_000
"""Answers that are kept of one query; more are not sent by honest peers."""

_MAX_BYTES: Final = 2**26  # of the payloads and keys that are accepted from one query
_MAX_WAITING: Final = 1024  # answers
_MAX_TOKENS: Final = 131_072  # that wait; Zenoh must never wait for room while it holds the lock of its session
_MAX_CHANGES: Final = 4096  # of tokens, that wait
_GRACE: Final = 1.0  # s beyond the timeout that Zenoh has to report the end of a query
_PAUSES: Final = (0.0005, 0.01)  # s between two polls for answers: the first, and the longest


class Answers:
    """The answers to one query, which the thread that sent it takes by polling."""

    def __init__(self, handler: zenoh.Handler[zenoh.Reply]) -> None:
        self.ended = False
        """True once the last answer was taken: all have answered, or the timeout has passed."""
        self._handler = handler

    def take(self) -> list[zenoh.Reply]:
        """Return the answers that came since the last call."""
        taken: list[zenoh.Reply] = []
        try:
            while len(taken) < MAX_ANSWERS and (reply := self._handler.try_recv()) is not None:
                taken.append(reply)
        except zenoh.ZError:  # it is empty, and closed
            self.ended = True
        return taken


def ask(
    session: Session,
    selector: str,
    *,
    timeout: float,
    room: int = _MAX_WAITING,
    accept_replies: zenoh.ReplyKeyExpr | None = None,
    priority: zenoh.Priority | None = None,
    congestion_control: zenoh.CongestionControl | None = None,
) -> Answers:
    """Query all that answer on a selector, and return at once; while `room` answers wait, the session waits too."""
    with while_open():
        handler = session.get(
            selector,
            zenoh.handlers.FifoChannel(room),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=accept_replies,
            timeout=_zenoh_timeout(timeout),
            priority=priority,
            congestion_control=congestion_control,
        )
    return Answers(handler)


def query(session: Session, *key_exprs: str, timeout: float, newest: bool = True) -> list[RawSample]:
    """Return the answers on any of these within `timeout` seconds: the newest answer for each key, or all.

    At most 10,000 answers of 64 MB in all are accepted, from any peers; that there are more is logged.
    """
    kept: dict[object, RawSample] = {}
    size = left_out = 0
    queries = [ask(session, key_expr, timeout=timeout) for key_expr in key_exprs]
    for sample in filter(None, (reply.ok for reply in _wait(queries, timeout))):
        key: object = str(sample.key_expr) if newest else len(kept)
        other = kept.get(key)
        if other is not None and not _is_newer(sample, other):
            continue
        new_size = size + len(sample.payload) + len(str(sample.key_expr))
        if new_size > _MAX_BYTES or (other is None and len(kept) >= MAX_ANSWERS):
            left_out += 1
        else:
            kept[key], size = sample, new_size
    if left_out:
        _log.warning("%s: %d answers too many are left out", ", ".join(key_exprs), left_out, extra=about("incomplete"))
    return list(kept.values())


def _wait(queries: Sequence[Answers], timeout: float) -> Iterator[zenoh.Reply]:
    """Yield answers as they come, until all queries have ended, or their timeout has passed."""
    end = time.monotonic() + _zenoh_timeout(timeout) + _GRACE
    pause, longest = _PAUSES
    while (still := [answers for answers in queries if not answers.ended]) and time.monotonic() < end:
        taken = [reply for answers in still for reply in answers.take()]
        yield from taken
        if not taken:
            time.sleep(pause)
            pause = min(2 * pause, longest)


def _is_newer(sample: RawSample, other: RawSample) -> bool:
    mine, others = sample.timestamp, other.timestamp
    return others is None or (mine is not None and mine.get_time() > others.get_time())


def ask_alive(session: Session, key_expr: str, *, timeout: float) -> Answers:
    """Ask for the liveliness tokens that match, and return at once; one token is in each answer that has no error."""
    channel: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(_MAX_TOKENS)
    with while_open():
        return Answers(session.liveliness().get(key_expr, channel, timeout=_zenoh_timeout(timeout)))


def alive_keys(session: Session, key_expr: str, *, timeout: float) -> list[str]:
    """Return the keys of the liveliness tokens that match, each once, sorted, at most 10,000."""
    return ask_alive_keys(session, key_expr, timeout=timeout)[0]


def ask_alive_keys(session: Session, key_expr: str, *, timeout: float) -> tuple[list[str], bool]:
    """Return the same keys, and whether these are all: the router was in time, and there are no more."""
    answers = ask_alive(session, key_expr, timeout=timeout)
    keys: set[str] = set()
    size, complete = 0, True
    for reply in _wait([answers], timeout):
        key = "" if reply.ok is None else str(reply.ok.key_expr)  # Zenoh reports a timeout as an error
        size += len(key)
        if key and len(keys) < MAX_ANSWERS and size <= _MAX_BYTES:
            keys.add(key)
        else:
            complete = False
    return sorted(keys), answers.ended and complete


class AliveChanges:
    """The liveliness tokens that are there, appear and go, for one thread."""

    def __init__(self, session: Session, key_expr: str) -> None:
        channel: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(_MAX_CHANGES)
        with while_open():
            subscriber = session.liveliness().declare_subscriber(key_expr, channel, history=True)
        self.missed = False
        """True after the channel overflowed; the reader clears it when it asks for all tokens."""
        self.undeclare: Callable[[], object] = subscriber.undeclare
        self._handler: zenoh.Handler[zenoh.Sample] = subscriber.handler

    def take(self) -> list[tuple[str, bool]]:
        """Return the key of each token that changed since the last call, and whether it appeared, in order."""
        changes: list[tuple[str, bool]] = []
        with suppress(zenoh.ZError):  # the session is closed
            while len(changes) < _MAX_CHANGES and (sample := self._handler.try_recv()) is not None:
                changes.append((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))
        self.missed |= len(changes) == _MAX_CHANGES
        return changes


def _zenoh_timeout(timeout: float) -> float:
    """Return a timeout that Zenoh accepts: neither 0 nor infinity."""
    return min(max(timeout, 0.001), 86_400.0)
