"""Threads that call periodic jobs: heartbeats, retransmission requests, acknowledgements; answers to queries."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
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
        # One item, or none. The methods of an Event are Python: a Ctrl-C amid one leaves its lock taken for good.
        self._woken: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def add(self, job: Job) -> Callable[[], None]:
        """Call a job from now on; return a function that ends that, and waits until it has ended."""
        with self._starting:
            self._jobs.append(job)
            if self._thread is None and not self.closed:
                self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
                self._thread.start()
        self.wake()
        return partial(self._remove, job)

    def wake(self) -> None:
        """Call all jobs now."""
        if self._woken.empty():
            self._woken.put(None)

    def close(self) -> None:
        """Call no job any more; one that is inside Zenoh when the interpreter ends would abort the process."""
        self.closed = True
        self.wake()
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
            with suppress(queue.Empty):
                self._woken.get(timeout=max(_SHORTEST, min(pauses, default=_FAILED)))

    @staticmethod
    def _call(job: Job, failed: set[int]) -> float:
        try:
            return job(time.monotonic())
        except BaseException:  # noqa: BLE001 - Zenoh's panics are such; the others must not end with it
            if id(job) not in failed:
                failed.add(id(job))
                _log.exception("an unexpected error, which is logged once", extra=about("bug"))
            return _FAILED
