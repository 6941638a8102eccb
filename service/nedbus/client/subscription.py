"""A subscription as a script iterates over it, blocking."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Self, TypeVar

from nedbus.errors import ClosedError, NoDataError
from nedbus.transport import require_unforked
from nedbus_msgs import Row, VehicleLocalPosition, decode, decode_row

from .closing import Finalizer
from .receive_queue import ReceiveQueue
from .sample import Counts, Sample
from .zenoh_subscriber import ZenohSubscriber

if TYPE_CHECKING:
    from .batch import Batch

_T = TypeVar("_T")


class Subscription:
    """Iterate over the samples of a subscription; get one from `bus.subscribe(...)`.

    Iteration waits for the next sample and ends when the subscription or the bus is closed.
    It is closed when it is no longer referenced, and at the end of the process.
    """

    def __init__(self, subscriber: ZenohSubscriber, receive_queue: ReceiveQueue, *, name: str, owner: object) -> None:
        self.name = name
        self._queue = receive_queue
        self._subscriber = subscriber
        self._owner = owner  # the bus stays open for as long as somebody may read
        self._finalizer = Finalizer(self, subscriber.close)

    @property
    def counts(self) -> Counts:
        """What became of the messages so far."""
        return self._queue.counts

    @property
    def waiting(self) -> int:
        """How many messages have arrived and wait to be read."""
        return self._queue.waiting

    def receive(self, timeout: float | None = None) -> Sample[VehicleLocalPosition]:
        """Wait for the next sample and return it.

        Raises NoDataError when none came within `timeout` seconds, ClosedError when the subscription is closed.
        """
        return self._next(partial(self._queue.pop, decode), timeout)

    def receive_batch(self, timeout: float | None = None) -> Batch:
        """Wait for at least one message, and return all that have arrived, as one array; errors as of `receive`."""
        return self._next(self._queue.pop_batch, timeout)

    def rows(self) -> Iterator[Sample[Row]]:
        """Iterate over the same samples with a Row, a named tuple, as `message`: faster, with the same checks."""
        return self._each(partial(self._queue.pop, decode_row))

    def batches(self) -> Iterator[Batch]:
        """Iterate over NumPy arrays of what arrived meanwhile, up to 4096 messages at once, with the same checks."""
        return self._each(self._queue.pop_batch)

    def close(self) -> None:
        """End the subscription; a second call does nothing."""
        self._finalizer.close_now()

    def __iter__(self) -> Iterator[Sample[VehicleLocalPosition]]:
        return self

    def __next__(self) -> Sample[VehicleLocalPosition]:
        try:
            return self.receive()
        except ClosedError:
            raise StopIteration from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _next(self, pop: Callable[[], _T | None], timeout: float | None) -> _T:
        require_unforked()
        deadline = None if timeout is None or timeout == math.inf else time.monotonic() + timeout
        if self._queue.newest_only:
            self._subscriber.receive()  # what is queued may not be the newest any more
        while True:
            if self._queue.ended:
                raise ClosedError
            item = pop()
            if item is not None:
                return item
            if not self._subscriber.wait(None if deadline is None else max(0.0, deadline - time.monotonic())):
                raise NoDataError(self.name, timeout or 0.0)

    def _each(self, pop: Callable[[], _T | None]) -> Iterator[_T]:
        receive_queue, subscriber = self._queue, self._subscriber
        require_unforked()
        while not receive_queue.ended:
            if receive_queue.newest_only:
                subscriber.receive()  # what is queued may not be the newest any more
            item = pop()
            if item is None:
                subscriber.wait(None)
            else:
                yield item
