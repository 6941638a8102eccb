"""Threads that call periodic jobs: heartbeats, retransmission requests, acknowledgements; answers to queries."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from nedbus.log_event import about

_log = logging.getLogger(__name__)

_SHORTEST: Final = 0.002  # s between two turns
_FAILED: Final = 1.0  # s until a job that failed is called again
_JOIN_TIMEOUT: Final = 10.0  # s that a turn has to get out of Zenoh

Job = Callable[[float], float]
"""Do what is due at this time, in monotonic seconds; return the seconds until the next call, at the latest.

It is called earlier where others are, and must never wait.
"""


class Housekeeping:
    """Call all jobs in one thread, when the first of them is due; it starts with the first job."""

    def __init__(self, *, name: str = "nedbus-housekeeping") -> None:
        self.closed = False
        self._name = name
        self._jobs: list[Job] = []
        self._starting = threading.Lock()
        self._turn = threading.RLock()  # held while jobs are called
        self._woken = Wakeup()
        self._thread: threading.Thread | None = None

    def add(self, job: Job) -> Callable[[], None]:
        """Call a job from now on; return a function that ends that, and waits until it has ended."""
        with self._starting:
            self._jobs.append(job)
            if self._thread is None and not self.closed:
                self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
                self._thread.start()
        self._woken.set()
        return lambda: self._remove(job)

    def wake(self) -> None:
        """Call all jobs now."""
        self._woken.set()

    def close(self) -> None:
        """Call no job any more; one that is inside Zenoh when the interpreter ends would abort the process."""
        self.closed = True
        self._woken.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_JOIN_TIMEOUT)

    def _remove(self, job: Job) -> None:
        with self._turn, suppress(ValueError):
            self._jobs.remove(job)

    def _run(self) -> None:
        failed: set[int] = set()
        while not self.closed:
            with self._turn:
                pauses = [self._call(job, failed) for job in tuple(self._jobs)]
            self._woken.wait(max(_SHORTEST, min(pauses, default=_FAILED)))

    @staticmethod
    def _call(job: Job, failed: set[int]) -> float:
        try:
            return job(time.monotonic())
        except BaseException:  # noqa: BLE001 - Zenoh's panics are such; the others must not end with it
            if id(job) not in failed:
                failed.add(id(job))
                _log.exception("an unexpected error, which is logged once", extra=about("bug"))
            return _FAILED


class Wakeup:
    """Wake one thread that waits, as an Event does that each wait clears.

    The methods of an Event are Python: KeyboardInterrupt amid one leaves its lock taken, and the next user waits
    for ever. A SimpleQueue is C; it has one item, or none.
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
