"""The wakeup of a thread that waits, safe from Ctrl-C."""

from __future__ import annotations

import queue


class Wakeup:
    """Wake one thread that waits, as an Event does that each wait clears.

    The methods of an Event are Python: KeyboardInterrupt amid one leaves its lock taken, and whoever uses it next
    waits for ever. A SimpleQueue is C; it has one item, or none.
    """

    def __init__(self) -> None:
        self._items: queue.SimpleQueue[None] = queue.SimpleQueue()

    def set(self) -> None:
        """Wake a thread that waits, or the next that does."""
        if self._items.empty():
            self._items.put(None)

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is set, and clear it; return False after `timeout` seconds."""
        try:
            self._items.get(timeout=timeout)
        except queue.Empty:
            return False
        return True
