"""Groups: messages in quick succession are handed to Zenoh together, so its threads wake once for all of them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from time import monotonic
from typing import TYPE_CHECKING, Final

import zenoh

from nedbus.errors import NedbusError

if TYPE_CHECKING:
    from .writer import Heartbeats, Writer

MAX_GROUP: Final = 64
"""Messages that a lossless publisher hands to Zenoh together, at full speed."""

MAX_HOLD: Final = 0.005
"""Seconds for which a lossless publisher waits for more messages of a group; longer on a busy machine only."""

_QUICK: Final = 0.0002  # s between two messages of a quick succession
_AT_ONCE: Final = 16  # messages of a succession that are handed over at once, before the first group

Outgoing = tuple[bytes, zenoh.Timestamp, str]
"""Payload, time of publication and encoding of a message."""


class Group:
    """The messages of one publisher that have not been handed to Zenoh yet.

    `put`: puts messages in order, with `writer`. One thread calls `add` and `begin`; the other methods are thread-safe.
    """

    def __init__(self, writer: Writer, put: Callable[[Sequence[Outgoing]], object], heartbeats: Heartbeats) -> None:
        self._writer, self._put, self._heartbeats = writer, put, heartbeats
        self._held: deque[Outgoing] = deque()  # each until it has been put
        self._size = 1  # messages of a complete group
        self._successive, self._last = 0, 0.0  # messages since a pause; monotonic time of the last one [s]
        self._lock = threading.RLock()  # held while messages are put, so their order is kept
        self.is_watched = False  # by `heartbeats`

    def __len__(self) -> int:
        return len(self._held)

    @property
    def published(self) -> int:
        """The number of messages published, including those not handed over."""
        with self._lock:
            return self._writer.published + len(self._held)

    def add(self, message: Outgoing) -> bool:
        """Add a message; return True if the group is complete, else it is handed over within MAX_HOLD."""
        now, held = monotonic(), self._held
        if now - self._last > _QUICK:
            self._successive, self._size = 0, 1
        self._last = now
        held.append(message)
        if len(held) >= self._size:
            return True
        if not self.is_watched:
            self._heartbeats.watch(self)
        return False

    def begin(self, room: int) -> None:
        """Begin the next group, of up to `room` messages."""
        self._successive += self._size
        self._size = 1 if self._successive < _AT_ONCE else max(1, min(MAX_GROUP, room))

    def hand_over(self, *, wait: bool = True) -> None:
        """Put all messages. `wait`: also if another thread is doing so. They are discarded if the bus is closed.

        Raises the errors of `put`.
        """
        if not self._lock.acquire(blocking=wait):
            return
        try:
            while self._held:
                before = self._writer.published
                try:
                    self._put(tuple(self._held))
                finally:  # Ctrl-C may interrupt it
                    for _ in range(self._writer.published - before):
                        self._held.popleft()
        except NedbusError:
            self._held.clear()
            raise
        finally:
            self._lock.release()
