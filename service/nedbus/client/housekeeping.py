"""Housekeeping thread for periodic jobs: heartbeats, retransmission, acknowledgements and answers to queries."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Final

from nedbus.client.closing import join_thread
from nedbus.log_event import about

_log = logging.getLogger(__name__)

_MIN_PAUSE: Final = 0.002  # s between two rounds
_RETRY_PAUSE: Final = 1.0  # s until the retry of a failed job
_JOIN_TIMEOUT: Final = 10.0  # s for a round to return from Zenoh

Job = Callable[[float], float]
"""Job: takes the time in monotonic seconds and returns the seconds until its next call is due.

It may be called earlier, along with other jobs, and must never block.
"""


class Housekeeping:
    """Call all jobs on one thread whenever one of them is due; the first job starts the thread."""

    def __init__(self, *, name: str = "nedbus-housekeeping") -> None:
        self.closed = False
        self._name = name
        self._jobs: list[Job] = []
        self._starting = threading.Lock()
        self._round = threading.RLock()  # held during a round
        # At most one item. Not an Event, which is written in Python: Ctrl-C inside one leaves its lock held forever.
        self._woken: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def add(self, job: Job) -> Callable[[], None]:
        """Add a job; return a function that removes it and waits until it no longer runs."""
        with self._starting:
            self._jobs.append(job)
            if self._thread is None and not self.closed:
                self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
                self._thread.start()
        self.wake()
        return partial(self._remove, job)

    def wake(self) -> None:
        """Call all jobs soon, without waiting for the next due time."""
        if self._woken.empty():
            self._woken.put(None)

    def close(self) -> None:
        """Stop the thread and wait for it: a thread still in Zenoh at interpreter exit aborts the process."""
        self.closed = True
        self.wake()
        if self._thread is not None and self._thread is not threading.current_thread():
            join_thread(self._thread, _JOIN_TIMEOUT)

    def _remove(self, job: Job) -> None:
        with self._round, suppress(ValueError):
            self._jobs.remove(job)

    def _run(self) -> None:
        failed: set[int] = set()
        while not self.closed:
            with self._round:
                pauses = [self._call(job, failed) for job in tuple(self._jobs)]
            with suppress(queue.Empty):
                self._woken.get(timeout=max(_MIN_PAUSE, min(pauses, default=_RETRY_PAUSE)))

    @staticmethod
    def _call(job: Job, failed: set[int]) -> float:
        try:
            return job(time.monotonic())
        except BaseException:  # noqa: BLE001 - includes Zenoh's panics; other jobs must go on
            if id(job) not in failed:
                failed.add(id(job))
                _log.exception("unexpected error in a background job (logged once)", extra=about("bug"))
            return _RETRY_PAUSE
