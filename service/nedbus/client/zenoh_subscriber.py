"""Zenoh's side of a subscription: the advanced subscriber, its channel, and who empties it.

The channel is a ring in Rust: Zenoh never waits for it, so that no reader holds up its session or anybody else.
A reader that waits without a timeout empties it in its own thread. While it does something else, or waits with a
timeout or in asyncio, the pump does: a thread that otherwise only looks ten times a second whether it is needed.
"""

from __future__ import annotations

import logging
import threading
import time
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.log_event import about
from nedbus.transport import Session, while_open
from nedbus_msgs import ack_key

from .channels import CHANNEL, declare_reader, take_all
from .decoder import WAKE_UP
from .questions import CLOSED, MAX_PENDING, Question, read_parameters
from .receive_queue import ReceiveQueue
from .recovery import Recovery

_log = logging.getLogger(__name__)

_LOOK: Final = 0.1  # s until the pump looks whether the reader has gone
_BUSY: Final = 64  # samples at once after which a pause pays: whoever receives is woken once for many
_PAUSE: Final = 0.001  # s
_JOIN: Final = 3.0  # s that a busy machine has to end a thread


class ZenohSubscriber:
    """Declare an advanced subscriber, and put what it receives into a ReceiveQueue until it is closed.

    A subscriber of mode `every` answers publishers that ask whether it has what they sent.
    One of `thinned` streams does not, as these do not wait for it, and it begins with what is published from now on.
    """

    def __init__(self, session: Session, key_expr: str, receive_queue: ReceiveQueue, *, thinned: bool = False) -> None:
        every = not receive_queue.newest_only
        self._session = session
        self._queue = receive_queue
        self._name = key_expr
        self._closing = threading.Lock()
        self._closed = False
        self._receiving = threading.Lock()  # whoever has it empties the channel
        self._by_reader = False  # the reader has waited by itself since the pump looked
        self._reader_waits = False  # for the channel
        self._reader: int | None = None  # the thread that did so last
        self._busy = False
        self._needed = threading.Event()  # the pump is
        channel: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(CHANNEL)
        # No late-publisher detection: after a router's restart it would ask for what recovery asks for.
        history = None if thinned else zenoh.ext.HistoryConfig(max_samples=1)
        with while_open():
            self._subscriber, self._misses = declare_reader(session, key_expr, channel, history=history)
            asked: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(MAX_PENDING)
            answers = every and not thinned
            self._asked = session.declare_queryable(ack_key(key_expr), asked) if answers else None
        # Receiving on the handler: a receive on the subscriber would keep it from being undeclared.
        self._handler: zenoh.Handler[zenoh.Sample] = self._subscriber.handler
        self._recovery: Recovery | None = None
        if every:
            self._recovery = Recovery(session, receive_queue, name=key_expr, begins=not thinned, on_fill=self._wake)
            self._unwatch = self._recovery.watch(key_expr)
        self._pump = threading.Thread(target=self._run, name="nedbus-pump", daemon=True)
        self._pump.start()
        self._threads = [self._pump]
        if self._asked is not None:
            answering = threading.Thread(
                target=self._listen, args=[self._asked.handler], name="nedbus-ack", daemon=True
            )
            answering.start()
            self._threads.append(answering)

    def receive(self) -> None:
        """Queue what has arrived by now, unless the pump does so; it does not wait."""
        self._by_reader = True
        if self._receiving.acquire(blocking=False):
            try:
                if batch := take_all(self._handler, []):
                    self._put(batch)
            finally:
                self._receiving.release()

    def wait(self, timeout: float | None) -> bool:
        """Wait until there may be something in the queue; return False after `timeout` seconds."""
        if timeout is not None or self._queue.incomplete:  # what comes next may come from recovery
            self._by_reader = False
            self._needed.set()
            return self._queue.wait(timeout)
        self._by_reader = True
        if not self._receiving.acquire(blocking=False):
            return self._queue.wait(None)
        try:
            self._reader, self._reader_waits = threading.get_ident(), True
            if not self._queue.waiting:  # nothing was recovered since the caller looked
                self._receive()
        finally:
            self._reader_waits = False
            self._receiving.release()
        self._queue.wakeups.wake()  # another thread, that could not receive
        return True

    def close(self) -> None:
        """End the subscription; a second call does nothing."""
        with self._closing:
            if self._closed:
                return
            self._closed = True
        self._queue.end()
        self._misses.undeclare()
        if self._asked is not None:
            self._asked.undeclare()
        if self._recovery is not None:
            self._unwatch()
            self._recovery.close()
        self._subscriber.undeclare()
        self._needed.set()
        for thread in self._threads:  # one that is inside Zenoh when the interpreter ends aborts the process
            thread.join(_JOIN)
        if self._reader != threading.get_ident() and self._receiving.acquire(timeout=_JOIN):
            self._receiving.release()

    def _run(self) -> None:
        try:
            while not self._closed:
                if self._by_reader or not self._receiving.acquire(blocking=False):
                    self._by_reader = False
                    self._needed.wait(_LOOK)
                    self._needed.clear()
                    continue
                try:
                    self._receive()
                finally:
                    self._receiving.release()
                self._queue.wakeups.wake()
        except BaseException:
            _log.exception("%s: the subscription ends after an unexpected error", self._name, extra=about("error"))
            raise
        finally:
            self._queue.end()  # nobody waits for a pump that has ended

    def _receive(self) -> None:
        """Wait for something, and queue all that is there; the queue ends with Zenoh's side."""
        receive_queue, handler = self._queue, self._handler
        if self._busy:
            time.sleep(_PAUSE)
        receive_queue.idle = True
        try:
            batch = [handler.recv()]
            item = handler.try_recv()
            if item is not None:
                batch.append(item)
                take_all(handler, batch)
        except zenoh.ZError:
            receive_queue.end()
            return
        finally:
            receive_queue.idle = False
        self._busy = len(batch) >= _BUSY
        self._put(batch)

    def _put(self, batch: list[zenoh.Sample], *, full: int = CHANNEL) -> None:
        if self._queue.ended:
            return
        self._misses.announce(self._queue)
        if self._recovery is not None:
            self._recovery.notice_links()
        try:
            self._queue.put(batch, overflowed=len(batch) >= full)
        except Exception:  # noqa: BLE001 - what one sample causes must not keep all others from the reader
            extra = about("bug")
            _log.exception("%s: %d samples are left out after an unexpected error", self._name, len(batch), extra=extra)
            self._queue.count_invalid(len(batch))

    def _wake(self, key: str) -> None:
        """Let the reader look into the queue, even one that waits for the channel, by something on one of its keys."""
        self._queue.wakeups.wake()
        if self._reader_waits:
            with suppress(zenoh.ZError):  # the session is closed
                here = zenoh.Locality.SESSION_LOCAL
                self._session.put(key, b"", encoding=WAKE_UP, allowed_destination=here)

    def _listen(self, asked: zenoh.Handler[zenoh.Query]) -> None:
        """Take the questions of publishers, in a thread of its own: Zenoh's would wait for the interpreter's lock."""
        with suppress(zenoh.ZError):  # undeclared
            while True:
                self._ask(asked.recv())

    def _ask(self, query: zenoh.Query) -> None:
        parameters = read_parameters(query.parameters.get)
        if parameters is None:
            return  # dropped, and so answered: it is from a publisher that asks in another way
        key = str(query.key_expr)

        def reply() -> None:
            try:
                with query:
                    query.reply(key, CLOSED if self._queue.ended else b"")
            except zenoh.ZError as exc:  # it asked with a timeout, or is gone
                _log.debug("%s: a question could not be answered: %s", key, exc)

        self._queue.ask(Question(*parameters, reply))
