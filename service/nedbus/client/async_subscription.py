"""AsyncSubscription: iterate over the samples of a bus with asyncio."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Self

from typing_extensions import TypeVar

from nedbus.errors import ClosedError, NoDataError
from nedbus.samples import M_co, Sample
from nedbus.transport import require_unforked

from .closing import Finalizer
from .receiving import Inbox, Receiver, check_timeout
from .subscription import Pop, SubscriptionBase

if TYPE_CHECKING:
    from nedbus.samples import Batch

_T = TypeVar("_T")


class AsyncSubscription(SubscriptionBase[M_co]):
    """Asynchronous iterator over received samples; `bus.subscribe(...)` returns one.

    Like Subscription, with `async for`, `await receive()` and `await close()`.
    It opens on first use and is bound to the event loop running at that time.
    """

    def __init__(self, open_receiver: Callable[[], Awaitable[Receiver]], inbox: Inbox) -> None:
        super().__init__(inbox)
        self._open_receiver = open_receiver
        self._receiver: Receiver | None = None
        self._finalizer: Finalizer | None = None
        self._opening: asyncio.Task[None] | None = None
        self._arrival = asyncio.Event()
        self._received = 0

    async def receive(self, timeout: float | None = None) -> Sample[M_co]:
        """Wait for the next sample and return it; `timeout` and errors as in `Subscription.receive`."""
        check_timeout(timeout)
        return await self._next(self._pop_sample, timeout)

    async def receive_batch(
        self, timeout: float | None = None, *, max_messages: int | None = None
    ) -> Batch:
        """Wait for at least one message and return unread ones, as `Subscription.receive_batch` does."""
        check_timeout(timeout)
        return await self._next(self._pop_batch(max_messages), timeout)

    def rows(self) -> AsyncIterator[Sample[M_co]]:
        """Iterate over rows as `Subscription.rows` does."""
        return self._each(self._pop_row)

    def batches(self, *, max_messages: int | None = None) -> AsyncIterator[Batch]:
        """Iterate over NumPy arrays as `Subscription.batches` does."""
        return self._each(self._pop_batch(max_messages))

    async def drain(self) -> None:
        """End reception, as `Subscription.drain` does; a subscription that has not been opened is closed."""
        if self._receiver is None:
            await self.close()
        else:
            await _in_new_thread(partial(self._receiver.close, discard=False))

    async def close(self) -> None:
        """Close the subscription, as `Subscription.close` does; a second call does nothing."""
        self._inbox.end(discard=True)
        if self._opening is not None:
            await asyncio.wait([self._opening])
        if self._finalizer is not None:
            await _in_new_thread(self._finalizer.close_now)

    def __aiter__(self) -> AsyncIterator[Sample[M_co]]:
        return self

    async def __anext__(self) -> Sample[M_co]:
        try:
            return await self._next(self._pop_sample)
        except ClosedError:
            raise StopAsyncIteration from None

    async def __aenter__(self) -> Self:
        await self._open()
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()

    async def _next(self, pop: Pop[_T], timeout: float | None = None) -> _T:
        self._received += 1
        if self._received % 64 == 0:
            await asyncio.sleep(0)  # otherwise a reader that never waits would starve other tasks
        try:
            async with asyncio.timeout(timeout):
                await self._open()
                while True:
                    self._arrival.clear()
                    ended = self._inbox.ended  # before `pop`, as in Subscription
                    item = pop()
                    if item is not None:
                        return item
                    if ended:
                        raise self._inbox.end_error
                    await self._arrival.wait()
        except TimeoutError:
            raise NoDataError(self.name, timeout or 0.0) from None

    async def _each(self, pop: Pop[_T]) -> AsyncIterator[_T]:
        with suppress(ClosedError):
            while True:
                yield await self._next(pop)

    async def _open(self) -> None:
        """Open on first use and wait until open; cancelling the wait does not cancel the opening."""
        require_unforked()
        loop = asyncio.get_running_loop()
        opening = self._opening
        if opening is not None and opening.get_loop() is not loop:
            raise RuntimeError(
                f"the subscription to {self.name} is bound to another event loop: subscribe in this one"
            )
        if self._finalizer is not None or self._inbox.ended:
            return
        if opening is None or opening.done():
            opening = self._opening = loop.create_task(self._open_in(loop))
            # may never be awaited
            opening.add_done_callback(lambda done: done.cancelled() or done.exception())
        await asyncio.shield(opening)

    async def _open_in(self, loop: asyncio.AbstractEventLoop) -> None:
        self._inbox.on_wake = partial(_wake, loop, self._arrival)
        receiver = self._receiver = await self._open_receiver()
        receiver.pump()
        self._finalizer = Finalizer(self, receiver.close)


async def _in_new_thread(close: Callable[[], object]) -> None:
    """Close in a new thread, because the pool's threads may be blocked."""
    await asyncio.get_running_loop().run_in_executor(ThreadPoolExecutor(1, "nedbus-close"), close)


def _wake(loop: asyncio.AbstractEventLoop, arrival: asyncio.Event) -> None:
    """Wake the reader from any thread; a bound method would keep the subscription alive."""
    with suppress(RuntimeError):  # the loop is closed
        loop.call_soon_threadsafe(arrival.set)
