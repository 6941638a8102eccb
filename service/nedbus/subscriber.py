"""Typed iteration over what arrives, sync and async: the newest of each key, or every sample.

`Feed` is the Zenoh side, with a thread that pumps what arrives into an `Intake`; the two subscriptions differ only in
how they wait for it.
"""

from __future__ import annotations

import asyncio
import math
import threading
import time
import weakref
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Final, Self, TypeVar

import zenoh

from nedbus_msgs import decode_row, taken_key

from .errors import ClosedError, NoDataError
from .intake import Counts, Intake, Sample
from .session import receive, while_open

if TYPE_CHECKING:
    from .batches import Batch

_RING: Final = 4096  # samples that wait for the pump of a `latest` reader
_FIFO: Final = 4096  # samples that wait for the pump of an `every` reader; then Zenoh holds back, drops and recovers
_BUSY: Final = 8  # samples at once from which on a pump waits a little, to be woken once for many
_PAUSE: Final = 0.002  # s
_TURNS: Final = 64  # samples after which an asyncio reader gives way to others
# A query that nobody keeps is answered.
_ANSWER: Final[zenoh.handlers.Callback[zenoh.Query]] = zenoh.handlers.Callback(lambda _: None, indirect=False)
_T = TypeVar("_T")


class Feed:
    """The Zenoh side of one subscription: a channel, the listener for losses, and the thread that empties it.

    An `every` subscription has a session of its own: its channel holds back when it is full, and so would everything
    else on that session. The feed closes it. It answers publishers that want to know whether it has all they sent.
    """

    def __init__(self, session: zenoh.Session, key_expr: str, intake: Intake) -> None:
        every = not intake.newest_only
        self._intake = intake
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
            # Zenoh answers a question in its turn: when all that came before it found room here.
            self._taken = session.declare_queryable(taken_key(key_expr), _ANSWER) if every else None
            self._misses = self._subscriber.sample_miss_listener(zenoh.handlers.Callback(intake.miss, indirect=False))
        # The handler is asked, never the subscriber: a receive on that one would keep it from being undeclared.
        self._handler: zenoh.Handler[zenoh.Sample] = self._subscriber.handler
        self._pump = threading.Thread(target=self._run, name="nedbus-pump", daemon=True)
        self._pump.start()

    def close(self) -> None:
        """End the subscription; a second call does nothing."""
        with self._closing:
            if self._closed:
                return
            self._closed = True
        self._intake.end()
        # A full channel holds Zenoh's thread, which holds the lock that undeclaring needs: meanwhile the pump goes on.
        self._misses.undeclare()
        self._subscriber.undeclare()
        if self._session is not None:
            self._session.close()
        self._pump.join(1.0)

    def _run(self) -> None:
        while batch := receive(self._handler):
            if not self._intake.ended:
                self._intake.put(self._intake.screen(batch))
                self._intake.wait_for_room()
                if len(batch) >= _BUSY:
                    time.sleep(_PAUSE)
        self._intake.end()


class Subscription:
    """Iterate over the samples of a subscription; get one from `bus.subscribe(...)`.

    Iteration waits for the next sample and ends when the subscription or the bus is closed.
    Forgetting it closes it, and so does the end of the process.
    """

    def __init__(self, feed: Feed, intake: Intake, *, name: str) -> None:
        self.name = name
        self._intake = intake
        self._finalizer = weakref.finalize(self, feed.close)

    @property
    def counts(self) -> Counts:
        """What became of the messages so far."""
        return self._intake.counts

    def receive(self, timeout: float | None = None) -> Sample:
        """Wait for the next sample and return it.

        Raises NoDataError when none came within `timeout` seconds, ClosedError when the subscription is closed.
        """
        return self._next(self._intake.pop, timeout)

    def receive_batch(self, timeout: float | None = None) -> Batch:
        """Wait for something, and return all that has arrived, as one array; errors are those of `receive`."""
        return self._next(self._intake.pop_batch, timeout)

    def rows(self) -> Iterator[Sample]:
        """Iterate over the same samples with a Row, a named tuple, as `message`: faster, with the same checks."""
        return self._each(partial(self._intake.pop, decode_row))

    def batches(self) -> Iterator[Batch]:
        """Iterate over NumPy arrays of what arrived meanwhile, up to 4096 messages at once, with the same checks."""
        return self._each(self._intake.pop_batch)

    def close(self) -> None:
        """End the subscription; a second call does nothing."""
        self._finalizer()

    def __iter__(self) -> Iterator[Sample]:
        return self

    def __next__(self) -> Sample:
        try:
            return self.receive()
        except ClosedError:
            raise StopIteration from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _next(self, pop: Callable[[], _T | None], timeout: float | None) -> _T:
        deadline = None if timeout is None or timeout == math.inf else time.monotonic() + timeout
        while True:
            if self._intake.ended:
                raise ClosedError
            item = pop()
            if item is not None:
                return item
            if not self._intake.wait(None if deadline is None else max(0.0, deadline - time.monotonic())):
                raise NoDataError(self.name, timeout or 0.0)

    def _each(self, pop: Callable[[], _T | None]) -> Iterator[_T]:
        while not self._intake.ended:
            item = pop()
            if item is not None:
                yield item
            else:
                self._intake.wait(None)


class AsyncSubscription:
    """Iterate over the samples of a subscription from asyncio; get one from `bus.subscribe(...)`.

    The twin of Subscription, with `async for`, `await receive()` and `await close()`; it opens at its first use, and
    belongs to the event loop of that moment.
    """

    def __init__(self, open_feed: Callable[[], Feed], intake: Intake, *, name: str) -> None:
        self.name = name
        self._open_feed = open_feed
        self._intake = intake
        self._finalizer: Callable[[], object] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._opening = asyncio.Lock()
        self._arrival = asyncio.Event()
        self._turns = 0

    @property
    def counts(self) -> Counts:
        """What became of the messages so far."""
        return self._intake.counts

    async def receive(self, timeout: float | None = None) -> Sample:
        """Wait for the next sample and return it.

        Raises NoDataError when none came within `timeout` seconds, ClosedError when the subscription is closed.
        """
        return await self._next(self._intake.pop, timeout)

    async def receive_batch(self, timeout: float | None = None) -> Batch:
        """Wait for something, and return all that has arrived, as one array; errors are those of `receive`."""
        return await self._next(self._intake.pop_batch, timeout)

    async def rows(self) -> AsyncIterator[Sample]:
        """Iterate over the same samples with a Row, a named tuple, as `message`: faster, with the same checks."""
        with suppress(ClosedError):
            while True:
                yield await self._next(partial(self._intake.pop, decode_row))

    async def batches(self) -> AsyncIterator[Batch]:
        """Iterate over NumPy arrays of what arrived meanwhile, up to 4096 messages at once, with the same checks."""
        with suppress(ClosedError):
            while True:
                yield await self._next(self._intake.pop_batch)

    async def close(self) -> None:
        """End the subscription; a second call does nothing."""
        async with self._opening:
            self._intake.end()
            if self._finalizer is not None:
                await asyncio.to_thread(self._finalizer)

    def __aiter__(self) -> AsyncIterator[Sample]:
        return self

    async def __anext__(self) -> Sample:
        try:
            return await self.receive()
        except ClosedError:
            raise StopAsyncIteration from None

    async def __aenter__(self) -> Self:
        await self._open()
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()

    async def _next(self, pop: Callable[[], _T | None], timeout: float | None = None) -> _T:
        await self._open()
        self._turns += 1
        if self._turns % _TURNS == 0:
            await asyncio.sleep(0)  # a reader that always finds a sample would never give way
        try:
            async with asyncio.timeout(timeout):
                while True:
                    self._arrival.clear()
                    if self._intake.ended:
                        raise ClosedError
                    item = pop()
                    if item is not None:
                        return item
                    await self._arrival.wait()
        except TimeoutError:
            raise NoDataError(self.name, timeout or 0.0) from None

    async def _open(self) -> None:
        loop = asyncio.get_running_loop()
        if self._loop is None:
            await self._open_in(loop)
        elif self._loop is not loop:
            raise RuntimeError(f"the subscription to {self.name} belongs to another event loop: subscribe in this one")

    async def _open_in(self, loop: asyncio.AbstractEventLoop) -> None:
        async with self._opening:
            if self._loop is not None or self._intake.ended:
                return
            self._intake.wake = _waker(loop, self._arrival)
            feed = await asyncio.to_thread(self._open_feed)
            self._finalizer = weakref.finalize(self, feed.close)
            self._loop = loop


def _waker(loop: asyncio.AbstractEventLoop, arrival: asyncio.Event) -> Callable[[], None]:
    """Return a function for any thread that wakes the reader; it does not keep the subscription alive."""

    def wake() -> None:
        with suppress(RuntimeError):  # the loop is closed: nobody waits any more
            loop.call_soon_threadsafe(arrival.set)

    return wake
