"""Probe for the permission to publish vehicles: Zenoh drops forbidden messages without an error at the sender.

One session subscribes to keys under the vehicles that are no topic, another one publishes there.
The publisher sees a match if the router announced that subscriber. With a match and no message it may not write.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Collection
from typing import Final, Literal, cast

import zenoh

from nedbus_msgs import ANY

from .session import Session, while_open

Verdict = Literal["allowed", "denied", "unknown"]

_POLL: Final = 0.02  # s
_RETRY: Final = 0.2  # s until it is published again: the declarations of a key may still be under way
_SPARE: Final = 16  # room of the channel beyond one probe of each vehicle


def probe_writes(
    reader: Session, writer: Session, vehicles: Collection[str], *, prefix: str, timeout: float = 1.0
) -> dict[str, Verdict]:
    """Return the verdict for each vehicle that `writer` may publish or not; unknown if `reader` may not subscribe.

    `timeout`: seconds until the router has announced the subscriber, and then until an allowed message arrives.
    """
    probe = f"@doctor/{secrets.token_hex(8)}"  # `**` of a reader does not match its chunk with @
    keys = {f"{prefix}/{vehicle}/{probe}": vehicle for vehicle in vehicles}
    channel: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(len(keys) + _SPARE)
    missing = dict(keys)

    def receive() -> bool:
        while (sample := subscriber.handler.try_recv()) is not None:
            missing.pop(str(sample.key_expr), None)
        return not missing

    with while_open():
        subscriber = reader.declare_subscriber(f"{prefix}/{ANY}/{probe}", channel)
        # It ends when nothing refers to it: `undeclare` keeps the interpreter's lock while it waits.
        publisher = writer.declare_publisher(next(iter(keys)))
        # Zenoh's stubs call the status a bool; it is an object, always true.
        matched = _wait(lambda: cast("zenoh.MatchingStatus", publisher.matching_status).matching, timeout)
        for _ in range(round(timeout / _RETRY)):
            for key in missing:
                # Not behind the data in a queue that is full, where it would be dropped.
                writer.put(
                    key,
                    b"probe",
                    congestion_control=zenoh.CongestionControl.DROP,
                    priority=zenoh.Priority.INTERACTIVE_HIGH,
                    express=True,
                )
            if _wait(receive, _RETRY):
                break
    refused: Verdict = "denied" if matched else "unknown"
    return {vehicle: refused if key in missing else "allowed" for key, vehicle in keys.items()}


def _wait(condition: Callable[[], bool], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while not (met := condition()) and time.monotonic() < end:
        time.sleep(_POLL)
    return met
