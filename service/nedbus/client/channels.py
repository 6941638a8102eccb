"""Zenoh's channels: rings in Rust, in which what arrives waits until a thread of ours takes it.

No callback takes it: on Zenoh's thread, on which everything arrives, each would wait for the interpreter's lock.
"""

from __future__ import annotations

from typing import Final, TypeVar

import zenoh

from nedbus.transport import Session

from .receive_queue import ReceiveQueue

CHANNEL: Final = 16_384
"""Samples that may arrive until somebody looks; more than 0.2 s of the largest fleet."""

_T = TypeVar("_T")


def declare_reader(
    session: Session,
    key_expr: str,
    channel: zenoh.handlers.RingChannel[zenoh.Sample],
    *,
    history: zenoh.ext.HistoryConfig | None = None,
) -> tuple[zenoh.ext.AdvancedSubscriber[zenoh.Handler[zenoh.Sample]], Misses]:
    """Declare a subscriber, and what notes the gaps in what it receives."""
    subscriber = zenoh.ext.declare_advanced_subscriber(session, key_expr, channel, history=history)
    return subscriber, Misses(subscriber)


class Misses:
    """The gaps in what a subscriber receives, until somebody passes them on."""

    def __init__(self, subscriber: zenoh.ext.AdvancedSubscriber[zenoh.Handler[zenoh.Sample]]) -> None:
        channel: zenoh.handlers.RingChannel[zenoh.ext.Miss] = zenoh.handlers.RingChannel(CHANNEL)
        self._listener = subscriber.sample_miss_listener(channel)
        self._handler = iter(self._listener)

    def announce(self, receive_queue: ReceiveQueue) -> None:
        """Let a queue know which gaps are those of the network, before what arrived behind them is put."""
        for miss in take_all(self._handler, []):
            receive_queue.announce_loss(miss)

    def undeclare(self) -> None:
        """Note no more; a second call raises ZError."""
        self._listener.undeclare()


def take_all(handler: zenoh.Handler[_T], batch: list[_T]) -> list[_T]:
    """Add all that is there to a batch, up to a full channel, and return it."""
    try:
        while len(batch) < CHANNEL and (item := handler.try_recv()) is not None:
            batch.append(item)
    except zenoh.ZError:  # undeclared: the next wait notices
        pass
    return batch
