"""Heartbeats and cache queries of zenoh-ext's advanced publishers.

Source: the code of zenoh-ext 1.10.2; Zenoh does not document the formats as stable. With them, advanced subscribers
in any language recover samples from nedbus publishers, and nedbus recovers samples from any advanced publisher.
"""

import re
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from itertools import islice
from typing import Final

import zenoh

from nedbus import limits

from .queries import send_query
from .session import RawSample, Session, entity_name, translate_zenoh_errors

Heartbeats = dict[tuple[str, str], int]  # newest sequence number by key and publisher

_KEY: Final = re.compile(r"([^*$]+)/@adv/pub/([0-9a-f]{1,32})/(\d{1,10})/_")
_PAYLOAD_BYTES: Final = 4
_SPARE: Final = 64  # slots for unexpected replies of other publishers


def heartbeat_key(key: str, publisher: str) -> str:
    """Return the key of the heartbeats and the cache of a publisher, given by its `entity_name`."""
    return f"{key}/@adv/pub/{publisher.replace(':', '/')}/_"


def heartbeat_payload(published: int) -> bytes:
    """Return the heartbeat payload after `published` messages (at least 1): the last sequence number."""
    return ((published - 1) % 2**32).to_bytes(_PAYLOAD_BYTES, "little")


def follow_heartbeats(
    session: Session, key_expr: str
) -> tuple[Callable[[], Heartbeats], Callable[[], object]]:
    """Subscribe to the heartbeats of advanced publishers; return functions to drain them and to unsubscribe."""
    with translate_zenoh_errors():
        key = f"{key_expr}/@adv/pub/**"
        subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(limits.HEARTBEATS))

    def drain() -> Heartbeats:
        newest: Heartbeats = {}
        with suppress(zenoh.ZError):  # already undeclared
            for heartbeat in islice(iter(subscriber.handler.try_recv, None), limits.HEARTBEATS):
                key = str(heartbeat.key_expr)
                payload = heartbeat.payload.to_bytes()
                publisher = None
                if len(key) <= limits.KEY_TEXT:
                    publisher = _parse_key(key)
                # peers may send malformed heartbeats
                if publisher is not None and len(payload) == _PAYLOAD_BYTES:
                    newest[publisher] = int.from_bytes(payload, "little")
        return newest

    return drain, subscriber.undeclare


@lru_cache(1024)
def _parse_key(heartbeat: str) -> tuple[str, str] | None:
    match = _KEY.fullmatch(heartbeat)
    if match is None:
        return None
    return match[1], f"{match[2]}:{match[3]}"


class RetransmitRequest:
    """A request to the cache of one advanced publisher to retransmit samples. Not thread-safe.

    `publisher`: its `entity_name`; `numbers`: sequence numbers. The key has no wildcards, so a router looks it up
    instead of matching it against the queryables of all publishers.
    """

    def __init__(
        self, session: Session, key: str, publisher: str, numbers: range, *, timeout: float
    ) -> None:
        self._key = key
        self._publisher = publisher
        self._numbers = numbers
        selector = f"{heartbeat_key(key, publisher)}?_sn={numbers.start}..{numbers.stop - 1}"
        capacity = min(len(numbers), limits.REPLIES) + _SPARE
        any_key = zenoh.ReplyKeyExpr.ANY
        self._replies = send_query(
            session, selector, timeout=timeout, capacity=capacity, accept_replies=any_key
        )

    @property
    def ended(self) -> bool:
        """True once all replies were returned, or the timeout has passed."""
        return self._replies.ended

    def poll(self) -> dict[int, RawSample]:
        """Return the samples received since the last call, by sequence number."""
        samples: dict[int, RawSample] = {}
        for sample in filter(None, (reply.ok for reply in self._replies.poll())):
            info = sample.source_info
            if (
                info is None
                or info.source_sn not in self._numbers
                or str(sample.key_expr) != self._key
            ):
                continue
            if entity_name(info.source_id) == self._publisher:
                samples[info.source_sn] = sample
        return samples
