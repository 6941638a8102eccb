"""Zenoh's side of a subscription: the advanced subscriber, its ring, and the threads that empty it.

The ring lies in Rust: Zenoh never waits for it, so that no reader holds up its session or other readers.
A reader that waits without a timeout empties it in its own thread. From the first wait with a timeout on, or in
asyncio, the pump does, a thread of its own. While the reader does something else, housekeeping does.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Final, TypeVar

import zenoh

from nedbus.client.housekeeping import Housekeeping
from nedbus.client.protocol import CLOSED, read_parameters
from nedbus.log_event import about
from nedbus.transport import Session, while_open
from nedbus_msgs import ack_key

from .decoder import WAKE_UP
from .pending_queue import MAX_ACK_REQUESTS, AckRequest, PendingQueue
from .retransmission import Retransmission

_log = logging.getLogger(__name__)

RING_CAPACITY: Final = 16_384
"""Samples that may arrive until the next poll; more than 0.2 s of the largest fleet."""

_POLL: Final = 0.1  # s between two polls of the ring by housekeeping, and of heartbeats
_ACK_POLL: Final = 0.005  # s between them while publishers request acknowledgements,
_ACK_POLL_AFTER: Final = 1.0  # s from the last such request on
_MIN_BUSY_BATCH: Final = 64  # samples at once after which a pause pays: the next wait then takes many
_BUSY_PAUSE: Final = 0.001  # s
_JOIN_TIMEOUT: Final = 3.0  # s that a busy machine has to end a thread
_T = TypeVar("_T")


class Receiver:
    """Declare an advanced subscriber, and put what it receives into a PendingQueue until it is closed.

    A subscriber of mode `every` requests retransmissions of publishers, and acknowledges their messages on request.
    With `history` it begins with the last message of each publisher.
    """

    def __init__(
        self,
        session: Session,
        key_expr: str,
        pending_queue: PendingQueue,
        *,
        housekeeping: Housekeeping,
        history: bool = True,
    ) -> None:
        self._session = session
        self._queue = pending_queue
        self._name = key_expr
        self._changing = threading.Lock()
        self._closed = False
        self._receiving = threading.RLock()  # its holder empties the ring; a reader may keep it by a Ctrl-C
        self._idle = False  # its holder waits for the ring, in which nothing is left
        self._busy = False
        self._pump: threading.Thread | None = None
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(RING_CAPACITY)
        # No late-publisher detection: after a router's restart it would ask for what retransmission asks for.
        last = zenoh.ext.HistoryConfig(max_samples=1) if history else None
        with while_open():
            subscriber = zenoh.ext.declare_advanced_subscriber(session, key_expr, ring, history=last)
        # Receiving on the handler: a receive on the subscriber would keep it from being undeclared.
        self._handler: zenoh.Handler[zenoh.Sample] = subscriber.handler
        self._undeclares: list[Callable[[], object]] = [subscriber.undeclare]
        self._take_query: Callable[[], zenoh.Query | None] | None = None  # these three in mode `every`
        self._take_link: Callable[[], zenoh.TransportEvent | None] | None = None
        self._retransmission: Retransmission | None = None
        self._ack_poll_until = 0.0
        if not pending_queue.newest_only:
            self._declare_every(housekeeping)
        self._end_job = housekeeping.add(self._keep_house)

    def receive(self) -> bool:
        """Queue what has arrived by now; return False, at once, if another thread does so already."""
        if not self._receiving.acquire(blocking=False):
            return False
        try:
            if batch := drain(self._handler, []):
                self._put(batch)
        finally:
            self._receiving.release()
        return True

    def wait(self, timeout: float | None) -> bool:
        """Wait until there may be something in the queue; return False after `timeout` seconds."""
        if timeout is not None or self._pump is not None:
            self.pump()
            return self._queue.wait(timeout)
        if self._busy:
            time.sleep(_BUSY_PAUSE)
        if not self._receiving.acquire(timeout=_BUSY_PAUSE):  # housekeeping has it for less
            return self._queue.wait(None)
        try:
            self._receive(if_empty=True)
        finally:
            self._receiving.release()
        return True

    def pump(self) -> None:
        """Let a thread empty the ring from now on."""
        with self._changing:
            if self._pump is None and not self._closed:
                self._pump = threading.Thread(target=self._run, name="nedbus-pump", daemon=True)
                self._pump.start()

    def close(self) -> None:
        """End the subscription; a second call does nothing."""
        with self._changing:
            if self._closed:
                return
            self._closed = True
        self._queue.end()
        self._end_job()
        if self._retransmission is not None:
            self._retransmission.close()
        self._queue.give_up()
        for undeclare in self._undeclares:
            with suppress(zenoh.ZError):  # closed already with the session
                undeclare()
        if self._pump is not None:  # one that is inside Zenoh when the interpreter ends aborts the process
            self._pump.join(_JOIN_TIMEOUT)
        if self._receiving.acquire(timeout=_JOIN_TIMEOUT):  # nor may a reader be
            self._receiving.release()

    def _declare_every(self, housekeeping: Housekeeping) -> None:
        requests: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(MAX_ACK_REQUESTS)
        events: zenoh.handlers.RingChannel[zenoh.TransportEvent] = zenoh.handlers.RingChannel(1)
        with while_open():
            queryable = self._session.declare_queryable(ack_key(self._name), requests)
            links = self._session.info.declare_transport_events_listener(events, history=False)
        self._undeclares += [queryable.undeclare, links.undeclare]
        self._take_query, self._take_link = queryable.handler.try_recv, links.handler.try_recv
        self._retransmission = Retransmission(self._session, self._name, self._queue)
        self._queue.on_gap = housekeeping.wake

    def _run(self) -> None:
        try:
            while not self._queue.ended:
                if self._busy:
                    time.sleep(_BUSY_PAUSE)
                with self._receiving:
                    self._receive()
        except BaseException:
            _log.exception("%s: the subscription ends after an unexpected error", self._name, extra=about("error"))
            raise
        finally:
            self._queue.end()  # a reader must not wait for a pump that has ended

    def _receive(self, *, if_empty: bool = False) -> None:
        """Wait for a sample, and queue all that have arrived; the queue ends with the subscriber.

        `if_empty`: return at once if there is something in the queue already; later `_wake` ends the wait.
        """
        handler = self._handler
        self._idle = True
        try:
            if if_empty and self._queue.waiting:
                return
            batch = [handler.recv()]
            self._idle = False
            if (item := handler.try_recv()) is not None:
                batch.append(item)
                drain(handler, batch)
        except zenoh.ZError:
            self._queue.end()
            return
        finally:
            self._idle = False
        self._busy = len(batch) >= _MIN_BUSY_BATCH
        self._put(batch)

    def _put(self, batch: list[zenoh.Sample]) -> None:
        if self._queue.ended:
            return
        self._take_events()
        try:
            self._queue.put(batch, overflowed=len(batch) >= RING_CAPACITY)
        except Exception:  # noqa: BLE001 - what one sample causes must not keep all others from the reader
            extra = about("bug")
            _log.exception("%s: %d samples are left out after an unexpected error", self._name, len(batch), extra=extra)
            self._queue.count_invalid(len(batch))

    def _keep_house(self, now: float) -> float:
        """Do what is due beside receiving; return the seconds until the next time."""
        self._take_events()
        drained = self.receive() or self._idle
        if self._retransmission is None:
            return _POLL
        if drained:
            self._queue.acknowledge(drained=True)
        filled, pause = self._retransmission.turn(now, drained=drained)
        if filled:
            self._wake(filled)
        return min(pause, _ACK_POLL if now < self._ack_poll_until else _POLL)

    def _wake(self, key: str) -> None:
        """Wake the reader, even one that waits for the ring, by a sample on one of its keys.

        Nothing else ends a wait for Zenoh's ring; only this session gets it, and no reader sees it.
        """
        self._queue.wake()
        if self._idle:
            with suppress(zenoh.ZError):  # the session is closed
                here = zenoh.Locality.SESSION_LOCAL
                self._session.put(key, b"", encoding=WAKE_UP, allowed_destination=here)

    def _take_events(self) -> None:
        """Note that links broke or came back, before what arrived since is queued; take acknowledgement requests."""
        if self._take_link is None or self._take_query is None:
            return
        try:
            while self._take_link() is not None:
                self._queue.on_link()
            while (query := self._take_query()) is not None:
                self._take_request(query)
        except zenoh.ZError:  # undeclared
            pass

    def _take_request(self, query: zenoh.Query) -> None:
        self._ack_poll_until = time.monotonic() + _ACK_POLL_AFTER
        parameters = read_parameters(query.parameters.get)
        if parameters is not None:  # else it is dropped, and so answered: from a publisher that asks in another way
            key = str(query.key_expr)
            request = AckRequest(key.removesuffix(ack_key("")), *parameters, partial(_reply, query, key, self._queue))
            self._queue.add(request, drained=self._idle)


def drain(handler: zenoh.Handler[_T], batch: list[_T]) -> list[_T]:
    """Add all that has arrived to a batch, up to a full ring, and return it."""
    try:
        while len(batch) < RING_CAPACITY and (item := handler.try_recv()) is not None:
            batch.append(item)
    except zenoh.ZError:  # undeclared: the next wait notices
        pass
    return batch


def _reply(query: zenoh.Query, key: str, pending_queue: PendingQueue) -> None:
    try:
        with query:
            query.reply(key, CLOSED if pending_queue.ended else b"")
    except zenoh.ZError as exc:  # it asked with a timeout, or is gone
        _log.debug("%s: an acknowledgement request could not be answered: %s", key, exc)
