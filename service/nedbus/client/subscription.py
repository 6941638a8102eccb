"""Subscription: iterate over the samples of a bus."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, suppress
from functools import partial
from typing import TYPE_CHECKING, Generic

from typing_extensions import TypeVar

from nedbus.errors import ClosedError, NoDataError
from nedbus.samples import Counts, M_co, Sample
from nedbus.transport import require_unforked

from .closing import Finalizer
from .receiving import Inbox, Receiver, check_count, check_timeout

if TYPE_CHECKING:
    from nedbus.samples import Batch

_T = TypeVar("_T")

# returns the next item, first that of the given message; None if there is none
Pop = Callable[..., _T | None]


class SubscriptionBase(Generic[M_co]):
    """State and counts of a subscription, blocking or asynchronous."""

    def __init__(self, inbox: Inbox) -> None:
        self.name = inbox.name
        self._inbox = inbox
        # By position: a partial with keywords takes 0.3 us more for each message.
        self._pop_sample = partial(inbox.pop, False)
        self._pop_row = partial(inbox.pop, True)

    @property
    def closed(self) -> bool:
        """True once the subscription or its bus is closed, or receiving has failed."""
        return self._inbox.ended

    @property
    def counts(self) -> Counts:
        """Received, lost, dropped, invalid and discarded messages so far."""
        return self._inbox.counts

    @property
    def waiting(self) -> int:
        """Number of received messages not yet read."""
        return self._inbox.waiting

    def _pop_batch(self, max_messages: int | None) -> Pop[Batch]:
        check_count("max_messages", max_messages)
        return partial(self._inbox.pop_batch, max_messages)


class Subscription(SubscriptionBase[M_co], AbstractContextManager["Subscription[M_co]"]):
    """Iterator over received samples; `bus.subscribe(...)` returns one.

    Iteration waits for the next sample and ends when the subscription or the bus is closed. If the session or the
    receiving thread fails, it raises ReceiveError after the last sample received.
    The subscription closes itself when it is no longer referenced and when the process exits.
    """

    def __init__(self, receiver: Receiver, inbox: Inbox, *, owner: object) -> None:
        super().__init__(inbox)
        self._receiver, self._owner = receiver, owner  # the owner keeps the bus open
        self._finalizer = Finalizer(self, receiver.close)

    def receive(self, timeout: float | None = None) -> Sample[M_co]:
        """Wait for the next sample and return it.

        Raises NoDataError if none arrives within `timeout` seconds, ClosedError if the subscription is closed,
        ReceiveError if it has failed, ArgumentError if `timeout` is no number.
        """
        check_timeout(timeout)
        return self._next(self._pop_sample, timeout)

    def receive_batch(
        self, timeout: float | None = None, *, max_messages: int | None = None
    ) -> Batch:
        """Wait for at least one message and return unread ones as arrays, as `batches` does.

        Raises the errors of `receive`.
        """
        check_timeout(timeout)
        return self._next(self._pop_batch(max_messages), timeout)

    def rows(self) -> Iterator[Sample[M_co]]:
        """Iterate over samples whose `message` is a Row, a named tuple: faster, with the same validation."""
        return self._each(self._pop_row)

    def batches(self, *, max_messages: int | None = None) -> Iterator[Batch]:
        """Iterate over batches of unread messages of one type as NumPy arrays, with the same validation.

        `max_messages`: the default is 4096 in mode `every`, in mode `latest` all: the newest of each key.
        Raises ArgumentError if it is below 1.
        """
        return self._each(self._pop_batch(max_messages))

    def drain(self) -> None:
        """End reception: received samples can still be read, then iteration ends, and `receive` raises ClosedError.

        In mode "every", gaps that are being recovered count as lost.
        """
        self._receiver.close(discard=False)

    def close(self) -> None:
        """Close the subscription; unread messages count as dropped. A second call does nothing."""
        self._finalizer.close_now()

    def __iter__(self) -> Iterator[Sample[M_co]]:
        return self

    def __next__(self) -> Sample[M_co]:
        try:
            return self._next(self._pop_sample)
        except ClosedError:
            raise StopIteration from None

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _next(self, pop: Pop[_T], timeout: float | None = None) -> _T:
        require_unforked()
        deadline = None
        if timeout is not None and timeout < threading.TIMEOUT_MAX:
            deadline = time.monotonic() + timeout
        if self._inbox.newest_only:
            self._receiver.receive()  # newer samples may be in the ring
        arrival = None
        while True:
            ended = self._inbox.ended  # before `pop`: all that was received is in the inbox then
            item = pop(arrival)
            if item is not None:
                return item
            if ended:
                raise self._inbox.end_error
            if deadline is None:
                arrival = self._receiver.receive_next()
            elif not self._receiver.wait(max(0.0, deadline - time.monotonic())):
                raise NoDataError(self.name, timeout or 0.0)

    def _each(self, pop: Pop[_T]) -> Iterator[_T]:
        with suppress(ClosedError):
            while True:
                yield self._next(pop)
