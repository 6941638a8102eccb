"""How a reader that waits is woken, cheaper than with a Condition."""

from __future__ import annotations

import queue
from collections.abc import Callable


class Wakeups:
    """Wake one thread that waits and, with `callback`, an event loop."""

    def __init__(self) -> None:
        self.callback: Callable[[], object] | None = None
        self._tokens: queue.SimpleQueue[None] = queue.SimpleQueue()

    def wake(self) -> None:
        """Let whoever waits look again, or whoever waits next."""
        if self._tokens.empty():
            self._tokens.put(None)
        if self.callback is not None:
            self.callback()

    def wait(self, timeout: float | None) -> bool:
        """Wait to be woken; return False after `timeout` seconds."""
        try:
            self._tokens.get(timeout=timeout)
        except queue.Empty:
            return False
        return True
