"""The clock of a worker; a test gives it another one."""

from __future__ import annotations

import threading
import time
from typing import Protocol


class Clock(Protocol):
    """Time, and waiting that ends early when the service is stopped."""

    @property
    def stopped(self) -> bool:
        """Whether the service is stopped."""
        ...

    def now(self) -> float:
        """Return monotonic seconds."""
        ...

    def time_ns(self) -> int:
        """Return the time of the wall clock, ns since the epoch."""
        ...

    def wait(self, seconds: float) -> bool:
        """Wait so long, or until the service is stopped; return whether it is."""
        ...


class SystemClock:
    """The clock of this host, stopped by an event."""

    def __init__(self, stop: threading.Event) -> None:
        self._stop = stop
        self.wait = stop.wait
        self.now = time.monotonic
        self.time_ns = time.time_ns

    @property
    def stopped(self) -> bool:
        """Whether the event is set."""
        return self._stop.is_set()
