"""A subscription as asyncio iterates over it: the twin of Subscription."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Final, Self, TypeVar

from nedbus.errors import ClosedError, NoDataError
from nedbus.transport import require_unforked
from nedbus_msgs import Row, VehicleLocalPosition, decode, decode_row

from .closing import Finalizer
from .receive_queue import ReceiveQueue
from .sample import Counts, Sample
from .zenoh_subscriber import ZenohSubscriber

if TYPE_CHECKING:
    from .batch import Batch

_YIELD_AFTER: Final = 64  # samples after which other tasks of the event loop run
_T = TypeVar("_T")


class AsyncSubscription:
    """Iterate over the samples of a subscription from asyncio; get one from `bus.subscribe(...)`.

    The twin of Subscription, with `async for`, `await receive()` and `await close()`; it opens at its first use, and
    belongs to the event loop of that moment.
    """

    def __init__(
        self, open_subscriber: Callable[[], ZenohSubscriber], receive_queue: ReceiveQueue, *, name: str
    ) -> None:
        self.name = name
        self._open_subscriber = open_subscriber
        self._queue = receive_queue
        self._finalizer: Finalizer | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._opening: asyncio.Task[None] | None = None
        self._arrival = asyncio.Event()
        self._taken = 0

    @property
    def counts(self) -> Counts:
        """What became of the messages so far."""
        return self._queue.counts

    @property
    def waiting(self) -> int:
        """How many messages have arrived and wait to be read."""
        return self._queue.waiting

    async def receive(self, timeout: float | None = None) -> Sample[VehicleLocalPosition]:
        """Wait for the next sample and return it.

        Raises NoDataError when none came within `timeout` seconds, ClosedError when the subscription is closed.
        """
        return await self._next(partial(self._queue.pop, decode), timeout)

    async def receive_batch(self, timeout: float | None = None) -> Batch:
        """Wait for at least one message, and return all that have arrived, as one array; errors as of `receive`."""
        return await self._next(self._queue.pop_batch, timeout)

    async def rows(self) -> AsyncIterator[Sample[Row]]:
        """Iterate over the same samples with a Row, a named tuple, as `message`: faster, with the same checks."""
        with suppress(ClosedError):
            while True:
                yield await self._next(partial(self._queue.pop, decode_row))

    async def batches(self) -> AsyncIterator[Batch]:
        """Iterate over NumPy arrays of what arrived meanwhile, up to 4096 messages at once, with the same checks."""
        with suppress(ClosedError):
            while True:
                yield await self._next(self._queue.pop_batch)

    async def close(self) -> None:
        """End the subscription; a second call does nothing."""
        self._queue.end()
        if self._opening is not None:
            await asyncio.wait([self._opening])
        if self._finalizer is not None:
            await asyncio.to_thread(self._finalizer.close_now)

    def __aiter__(self) -> AsyncIterator[Sample[VehicleLocalPosition]]:
        return self

    async def __anext__(self) -> Sample[VehicleLocalPosition]:
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
        self._taken += 1
        if self._taken % _YIELD_AFTER == 0:
            await asyncio.sleep(0)  # a reader that always finds a sample would never yield to other tasks
        try:
            async with asyncio.timeout(timeout):
                await self._open()
                while True:
                    self._arrival.clear()
                    if self._queue.ended:
                        raise ClosedError
                    item = pop()
                    if item is not None:
                        return item
                    await self._arrival.wait()
        except TimeoutError:
            raise NoDataError(self.name, timeout or 0.0) from None

    async def _open(self) -> None:
        """Wait until it is open; giving up the wait does not end the opening, which others, or `close`, wait for."""
        require_unforked()
        loop = asyncio.get_running_loop()
        if self._finalizer is not None and self._loop is loop:
            return
        if self._loop not in (None, loop):
            raise RuntimeError(f"the subscription to {self.name} belongs to another event loop: subscribe in this one")
        if self._queue.ended:
            return
        if self._opening is None or (self._opening.done() and self._finalizer is None):
            self._loop = loop
            self._opening = loop.create_task(self._open_in(loop))
            self._opening.add_done_callback(_retrieve)
        await asyncio.shield(self._opening)

    async def _open_in(self, loop: asyncio.AbstractEventLoop) -> None:
        self._queue.wakeups.callback = _waker(loop, self._arrival)
        subscriber = await asyncio.to_thread(self._open_subscriber)
        self._finalizer = Finalizer(self, subscriber.close)


def _retrieve(opening: asyncio.Task[None]) -> None:
    """Mark an error as seen: whoever waits gets it, and perhaps nobody waits any more."""
    if not opening.cancelled():
        opening.exception()


def _waker(loop: asyncio.AbstractEventLoop, arrival: asyncio.Event) -> Callable[[], None]:
    """Return a function for any thread that wakes the reader; it does not keep the subscription alive."""

    def wake() -> None:
        with suppress(RuntimeError):  # the loop is closed: nobody waits any more
            loop.call_soon_threadsafe(arrival.set)

    return wake
