"""Receiver: the advanced subscriber, its ring buffer, and the threads that drain the ring.

The ring lives in Rust and never blocks Zenoh, so a slow reader delays neither its session nor other readers.
A reader that waits without a timeout drains the ring on its own thread. The first wait with a timeout, or from asyncio,
starts a pump thread that takes over. While no reader waits, the I/O thread drains the ring.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from functools import partial
from itertools import islice
from typing import Final

import zenoh

from nedbus import limits
from nedbus.client.closing import join_thread
from nedbus.client.io_thread import TICK, Job
from nedbus.client.protocol import CLOSED
from nedbus.log_event import UnexpectedErrors, about
from nedbus.transport import Session, translate_zenoh_errors
from nedbus_msgs import ack_key

from .arrival import Arrival
from .decoder import WAKE_UP
from .downsampled import Downsampled
from .inbox import AckRequest, Inbox
from .retransmission import Retransmission

_log = logging.getLogger(__name__)

# keys declared to Zenoh per poll; with 5,000 keys, one takes 3 ms
_DECLARATIONS: Final = 8
_POLL: Final = 2 * TICK  # s between polls by the I/O thread
_ACK_POLL: Final = 0.005  # s between polls while publishers request acknowledgements
_ACK_POLL_AFTER: Final = 1.0  # s after the last such request until polling slows down again
# samples; after such a batch a short pause makes the next one larger and cheaper
_BUSY_BATCH: Final = 64
_BUSY_PAUSE: Final = 0.0003  # s
_DIGITS: Final = 10  # of a sequence number
_JOIN_TIMEOUT: Final = 3.0  # s, long enough on a busy machine


class _Ring:
    """The ring of one key expression, and the thread that receives on it."""

    def __init__(self, handler: zenoh.Handler[zenoh.Sample]) -> None:
        self.handler = handler  # a blocking receive on the subscriber would prevent undeclaring it
        # held by the thread that drains the ring; a Ctrl-C may leave it held
        self.lock = threading.RLock()
        self.idle = False  # the holder is blocked on an empty ring
        self.busy = False
        self.pump: threading.Thread | None = None


class Receiver:
    """Declare advanced subscribers on an Inbox's key expressions, and put samples into the inbox until closed.

    In mode `every` it also requests retransmissions and answers acknowledgement requests.
    The first samples are the last message of each publisher; `downsampled` asks for them if there is a maximum rate.
    """

    def __init__(
        self, session: Session, inbox: Inbox, downsampled: Downsampled | None = None
    ) -> None:
        self._session = session
        self._inbox = inbox
        self._errors = UnexpectedErrors(
            _log, "%s: unexpected error, discarded a batch (logged once)", inbox.name
        )
        self._changing = threading.Lock()
        self._closed = False
        # No late-publisher detection: after a router restart it would duplicate our retransmission requests.
        last = None
        if downsampled is None:
            last = zenoh.ext.HistoryConfig(max_samples=1)
        self._rings: list[_Ring] = []
        self._undeclares: list[Callable[[], object]] = []
        if downsampled is not None:
            self._undeclares.append(downsampled.close)
        # this and the next two: mode `every` only
        self._take_queries: list[Callable[[], zenoh.Query | None]] = []
        self._take_link: Callable[[], zenoh.TransportEvent | None] = lambda: None
        self._retransmission: Retransmission | None = None
        self._ack_poll_until = 0.0
        self._declared: dict[str, zenoh.KeyExpr] = {}
        with translate_zenoh_errors(), ExitStack() as undo:
            undo.callback(self._undeclare)
            for key_expr in inbox.key_exprs:
                ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(
                    limits.RING
                )
                subscriber = zenoh.ext.declare_advanced_subscriber(
                    session, key_expr, ring, history=last
                )
                self._rings.append(_Ring(subscriber.handler))
                self._undeclares.append(subscriber.undeclare)
                if not inbox.newest_only:
                    channel: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(
                        limits.ACK_REQUESTS
                    )
                    queryable = session.declare_queryable(ack_key(key_expr), channel)
                    self._undeclares.append(queryable.undeclare)
                    self._take_queries.append(queryable.handler.try_recv)
            if not inbox.newest_only:
                links = session.info.declare_transport_events_listener(
                    zenoh.handlers.RingChannel(1), history=False
                )
                self._undeclares.append(links.undeclare)
                self._take_link = links.handler.try_recv
                self._retransmission = Retransmission(session, inbox)
            undo.pop_all()
        self._job = Job(self._poll)
        self._inbox.on_gap = self._job.wake
        if downsampled is not None:
            self.pump()  # last messages bypass the ring, so no reader may block on it

    def receive(self) -> bool:
        """Drain the rings into the inbox, except those that other threads drain; return True if all were empty then."""
        drained = True
        for ring in self._rings:
            if not ring.lock.acquire(blocking=False):
                drained = drained and ring.idle
                continue
            try:
                self._put(drain(ring.handler, []))
            finally:
                ring.lock.release()
        return drained

    def receive_next(self) -> Arrival | None:
        """Wait until the inbox may have a sample, or return the next message to be read, for `Inbox.pop`."""
        ring = self._rings[0]
        if ring.pump is not None or self._closed or len(self._rings) > 1:
            self.wait(None)
            return None
        if ring.busy:
            time.sleep(_BUSY_PAUSE)
        # the I/O thread holds the lock for a shorter time
        if not ring.lock.acquire(timeout=_BUSY_PAUSE):
            self._inbox.wait(None)
            return None
        try:
            batch = self._receive(ring, if_empty=True)
            if len(batch) != 1:
                self._put(batch)
                return None
            self._take_link_changes()
            try:  # not `with`, which costs two calls per message
                return self._inbox.take(batch[0])
            except BaseException as exc:  # noqa: BLE001 - `_discard` raises what is not to be survived
                self._discard(batch, exc)
                return None
        finally:
            ring.lock.release()

    def wait(self, timeout: float | None) -> bool:
        """Wait until the inbox may have a sample; return False after `timeout` seconds."""
        self.pump()
        return self._inbox.wait(timeout)

    def pump(self) -> None:
        """Start the pump threads, which drain the rings from now on; a second call does nothing."""
        with self._changing:
            for ring in self._rings:
                if ring.pump is None and not self._closed:
                    ring.pump = threading.Thread(
                        target=self._run, args=(ring,), name="nedbus-pump", daemon=True
                    )
                    ring.pump.start()

    def close(self, *, discard: bool = True) -> None:
        """End the subscription; a second call does nothing, except to drop what a call without `discard` has left.

        `discard`: drop and count what is unread; otherwise readers get it first.
        """
        with self._changing:
            is_first, self._closed = not self._closed, True
        if discard:
            self._inbox.end(discard=True)
        if not is_first:
            return
        self._job.end()
        self.receive()  # samples in the ring have been received
        if self._retransmission is not None:
            self._retransmission.close()
        self._undeclare()
        for ring in self._rings:
            # a thread still in Zenoh at interpreter exit aborts the process
            if ring.pump is not None:
                join_thread(ring.pump, _JOIN_TIMEOUT)
            if ring.lock.acquire(timeout=_JOIN_TIMEOUT):  # a reader may be in Zenoh as well
                ring.lock.release()
        self._inbox.give_up()
        self._inbox.end()

    def _undeclare(self) -> None:
        for undeclare in self._undeclares:
            with suppress(zenoh.ZError):  # the session is already closed
                undeclare()
        self._forget_keys(list(self._declared))

    def _run(self, ring: _Ring) -> None:
        try:
            while not (self._closed or self._inbox.ended):
                if ring.busy:
                    time.sleep(_BUSY_PAUSE)
                with ring.lock:
                    self._put(self._receive(ring))
        except BaseException as exc:  # noqa: BLE001 - readers raise it; they must not wait for a dead pump
            _log.exception(
                "%s: unexpected error, subscription ended", self._inbox.name, extra=about("error")
            )
            self._inbox.end(f"unexpected {type(exc).__name__}: {exc}")

    def _receive(self, ring: _Ring, *, if_empty: bool = False) -> list[zenoh.Sample]:
        """Wait for a sample, and return what the ring holds; end the inbox if the subscriber is gone.

        With `if_empty`, return at once if the inbox already has a sample; if one is added later, `_poll` ends the wait.
        """
        handler = ring.handler
        ring.idle = True
        try:
            if if_empty and self._inbox.waiting:
                return []
            batch = [handler.recv()]
            ring.idle = False
            drain(handler, batch)
        except zenoh.ZError:
            if not self._closed:  # else `close` ends the inbox, once it has everything
                self._inbox.give_up()
                self._inbox.end("its Zenoh session was closed")
            return []
        finally:
            ring.idle = False
        ring.busy = len(batch) >= _BUSY_BATCH
        return batch

    def _put(self, batch: list[zenoh.Sample]) -> None:
        if not batch:
            return
        self._take_events()
        try:  # not `with`, which costs two calls per batch
            self._inbox.put(batch, overflowed=len(batch) >= limits.RING)
        except BaseException as exc:  # noqa: BLE001 - `_discard` raises what is not to be survived
            self._discard(batch, exc)

    def _discard(self, batch: list[zenoh.Sample], exc: BaseException) -> None:
        """Log an unexpected error and count its messages as invalid; raise one that is not to be survived."""
        if not self._errors.survives(exc):
            raise exc
        self._inbox.decoder.count_invalid(len(batch))

    def _poll(self, now: float) -> float:
        """Job of the I/O thread: drain the ring, acknowledge and recover; return the seconds until the next call."""
        self._take_events()
        drained = self.receive()
        self._declare_keys()
        if self._retransmission is None:
            return _POLL
        if drained:
            self._inbox.acknowledge(drained=True)
        recovered_key, pause = self._retransmission.poll(now, drained=drained)
        if recovered_key:
            self._inbox.wake()
            # only a session-local sample, which the decoder discards, ends a blocking receive
            if any(ring.idle for ring in self._rings):
                here = zenoh.Locality.SESSION_LOCAL
                with suppress(zenoh.ZError):  # the session is closed
                    self._session.put(
                        recovered_key, b"", encoding=WAKE_UP, allowed_destination=here
                    )
        return min(pause, _ACK_POLL if now < self._ack_poll_until else _POLL)

    def _take_events(self) -> None:
        """Handle link changes and acknowledgement requests."""
        self._take_link_changes()
        try:  # not `suppress`, which costs three calls per batch
            for take in self._take_queries:
                # a flood must not hold the I/O thread
                for query in islice(iter(take, None), limits.ACK_REQUESTS):
                    self._on_ack_request(query)
        except zenoh.ZError:  # undeclared
            return

    def _take_link_changes(self) -> None:
        """Handle link changes, which must precede the samples received since."""
        try:
            while self._take_link() is not None:
                self._inbox.on_link_change()
        except zenoh.ZError:  # undeclared
            pass

    def _on_ack_request(self, query: zenoh.Query) -> None:
        self._ack_poll_until = time.monotonic() + _ACK_POLL_AFTER
        key = str(query.key_expr)
        get = query.parameters.get
        publisher = get("publisher")
        number = get("number") or ""
        if not (publisher and number.isdecimal() and len(number) <= _DIGITS):
            return  # dropping the query ends it
        reply = partial(_reply, query, key, self._inbox)
        stream_key = key.removesuffix(ack_key(""))
        request = AckRequest(stream_key, publisher, int(number), get("read") == "1", reply)
        self._inbox.acknowledge(request, drained=all(ring.idle for ring in self._rings))

    def _declare_keys(self) -> None:
        """Declare the exact keys of new streams: Zenoh then looks up the route of their messages once, not for each."""
        streams = self._inbox.streams
        self._forget_keys([streams.evicted.popleft() for _ in range(len(streams.evicted))])
        with suppress(zenoh.ZError, IndexError):  # the session is closed; no more new keys
            for _ in range(_DECLARATIONS):
                key = streams.opened.popleft()
                if len(self._declared) < limits.DECLARED_KEYS:
                    self._declared[key] = self._session.declare_keyexpr(key)

    def _forget_keys(self, keys: Iterable[str]) -> None:
        for key in keys:
            declared = self._declared.pop(key, None)
            if declared is not None:
                with suppress(zenoh.ZError):  # the session is closed
                    self._session.undeclare(declared)


def drain(handler: zenoh.Handler[zenoh.Sample], batch: list[zenoh.Sample]) -> list[zenoh.Sample]:
    """Append all received items to `batch`, up to the capacity of the ring, and return it."""
    try:  # noqa: SIM105 - `suppress` takes three calls per batch
        batch.extend(islice(iter(handler.try_recv, None), limits.RING - len(batch)))
    except zenoh.ZError:  # undeclared; the next blocking receive raises as well
        pass
    return batch


def _reply(query: zenoh.Query, key: str, inbox: Inbox) -> None:
    try:
        with query:
            query.reply(key, CLOSED if inbox.ended else b"")
    except zenoh.ZError as exc:  # the query timed out, or the publisher is gone
        _log.debug("%s: cannot answer an acknowledgement request: %s", key, exc)
