"""Queries: what is answered on a key expression, and which liveliness tokens there are.

Replies are collected by a callback: a channel of Zenoh's holds 256 of them, and blocks the query for ever when it is
full. The wait for the last reply is Python's, so Ctrl-C ends it, and so does its timeout. Only where many questions are
asked while much arrives, in `ask_kept`, there is a channel, which somebody empties all the time.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from typing import Final

import zenoh

from .session import RawSample, Session, entity_name, while_open

Heartbeats = dict[tuple[str, str], int]
"""The number of the newest message, by the key of a stream and the name of its publisher."""

MAX_ANSWERS: Final = 10_000
"""Answers that are kept of one query; more are not sent by honest peers."""

_HEARTBEATS: Final = 16_384  # that are kept until somebody takes them
_HEARTBEAT: Final = re.compile(r"([^*$]+)/@adv/pub/([0-9a-f]{1,32})/(\d{1,10})/_")
_LONGEST: Final = 1024  # characters of the key of a heartbeat, which is remembered
_NUMBER: Final = 4  # bytes of a heartbeat
_SPARE: Final = 64  # answers that nobody asked for, of others or of more publishers
_GRACE: Final = 1.0  # s beyond the timeout that Zenoh has to report the end of a query


def query(session: Session, key_expr: str, *, timeout: float, newest: bool = True) -> list[RawSample]:
    """Return what is answered within `timeout` seconds, at most 10,000: the newest answer for each key, or all."""
    mode = zenoh.ConsolidationMode.LATEST if newest else zenoh.ConsolidationMode.NONE
    collector = _Collector()
    with while_open():
        session.get(
            key_expr,
            collector.handler,
            target=zenoh.QueryTarget.ALL,
            consolidation=mode,
            timeout=_zenoh_timeout(timeout),
        )
    return [reply.ok for reply in collector.wait(timeout) if reply.ok is not None]


class KeptAnswers:
    """What a publisher answers of its messages `numbers`; for the thread of whoever asked, which takes it by polling.

    No callback does: Zenoh's thread, on which everything arrives, would wait for the interpreter's lock at each answer.
    """

    def __init__(self, handler: zenoh.Handler[zenoh.Reply], key: str, publisher: str, numbers: range) -> None:
        self.ended = False
        """Whether the last answer was taken, or the timeout has passed."""
        self._handler = handler
        self._key = key
        self._publisher = publisher
        self._numbers = numbers

    def take(self) -> dict[int, RawSample]:
        """Return what came since the last call, by its number."""
        taken: dict[int, RawSample] = {}
        try:
            for _ in range(MAX_ANSWERS):
                reply = self._handler.try_recv()
                if reply is None:
                    break
                self._add(taken, reply.ok)
        except zenoh.ZError:  # it is empty, and closed
            self.ended = True
        return taken

    def _add(self, taken: dict[int, RawSample], sample: RawSample | None) -> None:
        info = None if sample is None else sample.source_info
        if sample is None or info is None or info.source_sn not in self._numbers:
            return
        if str(sample.key_expr) == self._key and entity_name(info.source_id) == self._publisher:  # else another's
            taken[info.source_sn] = sample


def ask_kept(session: Session, key: str, publisher: str, numbers: range, *, timeout: float) -> KeptAnswers:
    """Ask an advanced publisher for messages that it still keeps, by their numbers, and return at once.

    `publisher` is its name as `entity_name` returns it. The key is that of its cache, without wildcards: a router finds
    it at once, while a key expression is compared with the queryables of all publishers.
    """
    with while_open():
        handler = session.get(
            f"{key}/@adv/pub/{publisher.replace(':', '/')}/_?_sn={numbers.start}..{numbers.stop - 1}",
            # With room for all: a channel that is full holds up all that its session receives.
            zenoh.handlers.FifoChannel(min(len(numbers), MAX_ANSWERS) + _SPARE),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=_zenoh_timeout(timeout),
        )
    return KeptAnswers(handler, key, publisher, numbers)


def follow_heartbeats(session: Session, key_expr: str) -> tuple[Callable[[], Heartbeats], Callable[[], object]]:
    """Follow the heartbeats of advanced publishers; return a function that takes what came, and one that ends it."""
    channel: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(_HEARTBEATS)
    with while_open():
        subscriber = session.declare_subscriber(f"{key_expr}/@adv/pub/**", channel)

    def take() -> Heartbeats:
        newest: Heartbeats = {}
        with suppress(zenoh.ZError):  # ended meanwhile
            for _ in range(_HEARTBEATS):
                beat = subscriber.handler.try_recv()
                if beat is None:
                    break
                key, payload = str(beat.key_expr), beat.payload.to_bytes()
                publisher = _publisher_of(key) if len(key) <= _LONGEST else None
                if publisher is not None and len(payload) == _NUMBER:  # else it is none, whoever sent it
                    newest[publisher] = int.from_bytes(payload, "little")
        return newest

    return take, subscriber.undeclare


@lru_cache(_HEARTBEATS)
def _publisher_of(heartbeat: str) -> tuple[str, str] | None:
    """Return the stream and the name of the publisher on whose key a heartbeat came."""
    found = _HEARTBEAT.fullmatch(heartbeat)
    return None if found is None else (found[1], f"{found[2]}:{found[3]}")


def alive_keys(session: Session, key_expr: str, *, timeout: float) -> list[str]:
    """Return the keys of the liveliness tokens that match, each once, sorted, at most 10,000."""
    keys, _ = ask_alive_keys(session, key_expr, timeout=timeout)
    return keys


def ask_alive_keys(session: Session, key_expr: str, *, timeout: float) -> tuple[list[str], bool]:
    """Return what `alive_keys` returns, and whether these are all: the router was in time, and there are no more."""
    collector = _Collector()
    with while_open():
        session.liveliness().get(key_expr, collector.handler, timeout=_zenoh_timeout(timeout))
    answers = collector.wait(timeout)
    keys = sorted({str(reply.ok.key_expr) for reply in answers if reply.ok is not None})
    failed = any(reply.ok is None for reply in answers)  # Zenoh reports a timeout as an error
    return keys, collector.complete and not failed and len(answers) < MAX_ANSWERS


def follow_alive_keys(
    session: Session, key_expr: str, on_change: Callable[[str, bool], object]
) -> Callable[[], object]:
    """Call `on_change` with the key of each liveliness token that appears (True) or goes (False) from now on.

    It is called on a thread of Zenoh's, where it must not wait. Returns a function that ends it.
    """

    def on_sample(sample: zenoh.Sample) -> None:
        on_change(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

    with while_open():
        subscriber = session.liveliness().declare_subscriber(
            key_expr, zenoh.handlers.Callback(on_sample, indirect=False)
        )
    return subscriber.undeclare


class _Collector:
    """Keep the replies to one query, in a bounded amount of memory."""

    def __init__(self) -> None:
        self._replies: list[zenoh.Reply] = []
        self._ended = threading.Event()
        self.handler = zenoh.handlers.Callback(self._add, self._ended.set, indirect=False)

    @property
    def complete(self) -> bool:
        """Whether the query has ended."""
        return self._ended.is_set()

    def wait(self, timeout: float) -> list[zenoh.Reply]:
        """Return what came until the query ended, or its timeout has passed."""
        self._ended.wait(_zenoh_timeout(timeout) + _GRACE)
        return self._replies[:MAX_ANSWERS]

    def _add(self, reply: zenoh.Reply) -> None:
        if len(self._replies) < MAX_ANSWERS:
            self._replies.append(reply)


def _zenoh_timeout(timeout: float) -> float:
    """Return a timeout that Zenoh accepts: neither 0 nor infinity."""
    return min(max(timeout, 0.001), 86_400.0)
