"""Probe whether a vehicle may be written: Zenoh drops what is not allowed, without an error at its sender.

One session subscribes to a key under the vehicle that is nobody's topic, another one publishes there.
The publisher sees whether the router told it of that subscriber. If it did, and nothing arrives, it may not write.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from typing import Final, Literal, cast

import zenoh

from nedbus.transport import Session, while_open

Verdict = Literal["allowed", "denied", "unknown"]

_ANNOUNCED: Final = 1.0  # s until the router has told of a subscriber
_ARRIVED: Final = 1.0  # s until a message has arrived that is allowed
_POLL: Final = 0.02  # s
_AGAIN: Final = 0.2  # s until it is published again: the declarations of a key may still be under way


def probe_key(vehicle: str, *, prefix: str) -> str:
    """Return a key that is used once; `**` of a reader does not match its chunk with @."""
    return f"{prefix}/{vehicle}/@doctor/{secrets.token_hex(8)}"


def probe_write(reader: Session, writer: Session, vehicle: str, *, prefix: str) -> Verdict:
    """Return whether `writer` may publish the keys of a vehicle; unknown if `reader` may not look."""
    key = probe_key(vehicle, prefix=prefix)
    channel: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(1)
    with while_open():
        subscriber = reader.declare_subscriber(key, channel)
        publisher = writer.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        try:
            # Zenoh's stubs call the status a bool; it is an object, always true.
            announced = _wait(lambda: cast("zenoh.MatchingStatus", publisher.matching_status).matching, _ANNOUNCED)
            for _ in range(round(_ARRIVED / _AGAIN)):
                publisher.put(b"doctor")
                if _wait(lambda: subscriber.handler.try_recv() is not None, _AGAIN):
                    return "allowed"
        finally:
            publisher.undeclare()
            subscriber.undeclare()
    return "denied" if announced else "unknown"


def _wait(condition: Callable[[], bool], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while not (met := condition()) and time.monotonic() < end:
        time.sleep(_POLL)
    return met
