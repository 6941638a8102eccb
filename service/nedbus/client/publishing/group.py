"""Groups: messages in quick succession are handed to Zenoh together, so its threads wake once for all of them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from time import monotonic
from typing import TYPE_CHECKING, Final

import zenoh

from nedbus import limits
from nedbus.errors import NedbusError

if TYPE_CHECKING:
    from .writer import Heartbeats, Writer

HOLD: Final = 0.005
"""Seconds for which a lossless publisher waits for more messages of a group; longer on a busy machine only."""

_QUICK: Final = 0.0002  # s between two messages of a quick succession
# messages of a succession that are handed over at once, before the first group
_AT_ONCE: Final = 16

Outgoing = tuple[bytes, zenoh.Timestamp, zenoh.Encoding]
"""Payload, time of publication and encoding of a message."""


class Group:
    """The messages of one publisher that have not been handed to Zenoh yet.

    `put`: puts messages in order, with `writer`. One thread calls `add` and `begin`; the other methods are thread-safe.
    """

    def __init__(
        self, writer: Writer, put: Callable[[Sequence[Outgoing]], object], heartbeats: Heartbeats
    ) -> None:
        self._writer = writer
        self._put = put
        self._heartbeats = heartbeats
        self._held: list[Outgoing] = []  # each until it has been put
        self._left = 1  # messages until the group is complete
        # messages since a pause; monotonic time of the last one [s]
        self._successive, self._last = 0, 0.0
        self._lock = threading.RLock()  # held while messages are put, so their order is kept
        # by the thread that holds the lock; True for a signal handler that interrupts it
        self._is_putting = False
        self.is_watched = False  # by `heartbeats`

    def __len__(self) -> int:
        return len(self._held)

    @property
    def published(self) -> int:
        """The number of messages published, including those not handed over."""
        with self._lock:
            return self._writer.published + len(self._held)

    def add(self, message: Outgoing) -> bool:
        """Add a message; return True if the group is complete, else it is handed over within HOLD."""
        now = monotonic()
        if now - self._last > _QUICK:
            self._successive, self._left = 0, 1
        self._last = now
        self._held.append(message)
        self._successive += 1
        # also if the last messages were handed over meanwhile: flow control must be asked in time
        self._left -= 1
        return self._left <= 0 or not (self.is_watched or self._heartbeats.watch(self))

    def begin(self, room: int) -> None:
        """Begin the next group, of up to `room` messages."""
        self._left = 1 if self._successive < _AT_ONCE else max(1, min(limits.GROUP_MESSAGES, room))

    def hand_over(self) -> None:
        """Put all messages. They are discarded if the bus is closed. Raises the errors of `put`."""
        with self._lock:
            self._put_held()

    def try_hand_over(self) -> None:
        """Put all messages, unless another thread is doing so; otherwise like `hand_over`."""
        if self._lock.acquire(blocking=False):
            try:
                self._put_held()
            finally:
                self._lock.release()

    def _put_held(self) -> None:
        # this is a signal handler; the interrupted call puts what it has added
        if self._is_putting:
            return
        try:
            self._is_putting = True
            while self._held:
                before = self._writer.published
                try:
                    self._put(tuple(self._held))
                finally:
                    # Ctrl-C may have interrupted it; Python handles no signal between here and the deletion
                    del self._held[: self._writer.published - before]
        except NedbusError:
            self._held.clear()
            raise
        finally:
            self._is_putting = False
