"""Puts around the size limits of a router."""

from __future__ import annotations

from typing import Final

import zenoh

from nedbus.transport import Session
from tests.waits import wait_for, wait_for_matching

KEYS_AND_LIMITS: Final = (
    ("nedbus/@rejected/1/x", 16_384),
    ("nedbus/1/x/@adv/pub/1a/1/_", 64),
    ("nedbus/1/x/@rate/5/@adv/pub/1a/1/_", 64),
)


def received_sizes(sender: Session, reader: Session, key: str, limit: int) -> list[int]:
    """Put a payload of `limit` + 1 bytes and one of `limit`; return the sizes that the reader has received."""
    block = zenoh.CongestionControl.BLOCK
    subscriber = reader.declare_subscriber(key, zenoh.handlers.RingChannel(10))
    wait_for_matching(sender, key)
    sender.put(key, bytes(limit + 1), congestion_control=block)
    sender.put(key, bytes(limit), congestion_control=block)
    received = list[int]()

    def is_received() -> bool:
        received.extend(len(each.payload) for each in iter(subscriber.handler.try_recv, None))
        return bool(received)

    wait_for(is_received, what="the message at the limit, which was sent last")
    return received
