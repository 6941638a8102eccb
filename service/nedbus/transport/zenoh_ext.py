"""Formats of zenoh-ext: heartbeats of its advanced publishers, and queries for what their caches keep.

Read in zenoh-ext 1.10.2. They are no stable interface of Zenoh's: with them advanced subscribers of any language
recover from our publishers, and ours from any advanced publisher.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from itertools import islice
from typing import Final

import zenoh

from .queries import MAX_ANSWERS, Answers, zenoh_timeout
from .session import RawSample, Session, entity_name, while_open

Heartbeats = dict[tuple[str, str], int]
"""The number of the newest message, by the key of a stream and the name of its publisher."""

_HEARTBEATS: Final = 16_384  # that are kept until somebody takes them
_HEARTBEAT: Final = re.compile(r"([^*$]+)/@adv/pub/([0-9a-f]{1,32})/(\d{1,10})/_")
_LONGEST: Final = 1024  # characters of the key of a heartbeat, which is remembered
_NUMBER: Final = 4  # bytes of a heartbeat
_SPARE: Final = 64  # answers that nobody asked for, of others or of more publishers


def heartbeat_key(key: str, publisher: str) -> str:
    """Return the key of a publisher's heartbeats and of its cache; `publisher` is its name from `entity_name`."""
    return f"{key}/@adv/pub/{publisher.replace(':', '/')}/_"


def heartbeat_payload(published: int) -> bytes:
    """Return the heartbeat of a publisher that has published this number of messages, 1 or more."""
    return ((published - 1) % 2**32).to_bytes(_NUMBER, "little")


def follow_heartbeats(session: Session, key_expr: str) -> tuple[Callable[[], Heartbeats], Callable[[], object]]:
    """Follow the heartbeats of advanced publishers; return a function that takes what came, and one that ends it."""
    channel: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(_HEARTBEATS)
    with while_open():
        subscriber = session.declare_subscriber(f"{key_expr}/@adv/pub/**", channel)

    def take() -> Heartbeats:
        newest: Heartbeats = {}
        with suppress(zenoh.ZError):  # ended meanwhile
            for beat in islice(iter(subscriber.handler.try_recv, None), _HEARTBEATS):
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


class KeptAnswers:
    """What a publisher answers of its messages `numbers`, for the thread of whoever asked."""

    def __init__(self, answers: Answers, key: str, publisher: str, numbers: range) -> None:
        self._answers = answers
        self._key = key
        self._publisher = publisher
        self._numbers = numbers

    @property
    def ended(self) -> bool:
        """Whether the last answer was taken, or the timeout has passed."""
        return self._answers.ended

    def take(self) -> dict[int, RawSample]:
        """Return what came since the last call, by its number."""
        taken: dict[int, RawSample] = {}
        for reply in self._answers.take():
            self._add(taken, reply.ok)
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
            f"{heartbeat_key(key, publisher)}?_sn={numbers.start}..{numbers.stop - 1}",
            # With room for all: a channel that is full holds up all that its session receives.
            zenoh.handlers.FifoChannel(min(len(numbers), MAX_ANSWERS) + _SPARE),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=zenoh_timeout(timeout),
        )
    return KeptAnswers(Answers(handler), key, publisher, numbers)
