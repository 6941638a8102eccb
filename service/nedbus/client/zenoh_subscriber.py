"""Zenoh's side of a subscription: the advanced subscriber, its channel, and the thread that empties it (the pump)."""

from __future__ import annotations

import logging
import threading
import time
from contextlib import suppress
from typing import Final, TypeVar

import zenoh

from nedbus.transport import Session, while_open
from nedbus_msgs import ack_key

from .receive_queue import ReceiveQueue

_log = logging.getLogger(__name__)

_RING: Final = 4096  # samples that wait for the pump of a `latest` reader
_FIFO: Final = 4096  # samples that wait for the pump of an `every` reader; then Zenoh holds back, drops and recovers
_MAX_RECEIVED: Final = 4096  # samples that the pump takes at once
_BUSY: Final = 8  # samples at once from which on the pump pauses, to be woken once for many
_PAUSE: Final = 0.002  # s
# A query that is dropped without a reply is answered.
_ACKNOWLEDGE: Final[zenoh.handlers.Callback[zenoh.Query]] = zenoh.handlers.Callback(lambda _: None, indirect=False)
_T = TypeVar("_T")


class ZenohSubscriber:
    """Declare an advanced subscriber, and put what it receives into a ReceiveQueue until it is closed.

    An `every` subscriber has a session of its own: its channel holds back when it is full, and so would everything
    else on that session. It closes that session. It acknowledges to publishers that it has all they sent.
    """

    def __init__(self, session: Session, key_expr: str, receive_queue: ReceiveQueue) -> None:
        every = not receive_queue.newest_only
        self._queue = receive_queue
        self._name = key_expr
        self._session = session if every else None
        self._closing = threading.Lock()
        self._closed = False
        channel: zenoh.handlers.FifoChannel[zenoh.Sample] | zenoh.handlers.RingChannel[zenoh.Sample]
        channel = zenoh.handlers.FifoChannel(_FIFO) if every else zenoh.handlers.RingChannel(_RING)
        recovery = zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None) if every else None
        # No late-publisher detection: after a router's restart its history query would win over recovery.
        history = zenoh.ext.HistoryConfig(max_samples=1)
        with while_open(session):
            self._subscriber = zenoh.ext.declare_advanced_subscriber(
                session, key_expr, channel, history=history, recovery=recovery
            )
            # Zenoh answers a query in its turn: when all that came before it is in the channel.
            self._ack = session.declare_queryable(ack_key(key_expr), _ACKNOWLEDGE) if every else None
            self._misses = self._subscriber.sample_miss_listener(
                zenoh.handlers.Callback(receive_queue.announce_loss, indirect=False)
            )
        # The pump receives on the handler: a receive on the subscriber would keep it from being undeclared.
        self._handler: zenoh.Handler[zenoh.Sample] = self._subscriber.handler
        self._pump = threading.Thread(target=self._run, name="nedbus-pump", daemon=True)
        self._pump.start()

    def close(self) -> None:
        """End the subscription; a second call does nothing."""
        with self._closing:
            if self._closed:
                return
            self._closed = True
        self._queue.end()
        # A full channel holds Zenoh's thread, which holds the lock that undeclaring needs: meanwhile the pump goes on.
        self._misses.undeclare()
        self._subscriber.undeclare()
        if self._session is not None:
            self._session.close()
        self._pump.join(1.0)

    def _run(self) -> None:
        try:
            while batch := _receive(self._handler):
                if not self._queue.ended:
                    self._put(batch)
                    self._queue.wait_for_capacity()
                    if len(batch) >= _BUSY:
                        time.sleep(_PAUSE)
        except BaseException:
            _log.exception("%s: the subscription ends after an unexpected error", self._name)
            raise
        finally:
            self._queue.end()  # nobody waits for a pump that has ended

    def _put(self, batch: list[zenoh.Sample]) -> None:
        try:
            self._queue.put(batch)
        except Exception:  # noqa: BLE001 - what one sample causes must not keep all others from the reader
            _log.exception("%s: %d samples are left out after an unexpected error", self._name, len(batch))
            self._queue.count_invalid(len(batch))


def _receive(handler: zenoh.Handler[_T]) -> list[_T]:
    """Wait for something, and return all that is there, up to 4,096; empty once the subscriber is undeclared."""
    batch: list[_T] = []
    with suppress(zenoh.ZError):
        batch.append(handler.recv())
        while len(batch) < _MAX_RECEIVED and (item := handler.try_recv()) is not None:
            batch.append(item)
    return batch
