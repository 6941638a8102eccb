"""The I/O thread of the process, which polls the channels of all sessions, and worker threads with a call queue.

Idle jobs are due at common ticks: a hundred idle sessions wake the process as often as one.
"""

from __future__ import annotations

import logging
import math
import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from nedbus.log_event import UnexpectedErrors

_log = logging.getLogger(__name__)

TICK: Final = 0.06
"""Pauses of at least this length [s] are shortened to end at a multiple of it, so jobs are due at common times."""

_MIN_PAUSE: Final = 0.002  # s between two calls of a job
_RETRY_PAUSE: Final = 1.0  # s until the retry of a failed job

_jobs: dict[Job, None] = {}
_start = threading.Lock()
# At most one item. Not an Event, which is Python code: Ctrl-C inside it can leave its lock held forever.
_woken: queue.SimpleQueue[None] = queue.SimpleQueue()
_sleeps_until = math.inf


class Job:
    """A function that the I/O thread calls repeatedly until `end`.

    The function receives the monotonic time [s] and returns the seconds until its next call. It must not block, because
    a blocked job delays all sessions of the process.
    """

    def __init__(self, call: Callable[[float], float]) -> None:
        self._call = call
        self._running = threading.RLock()  # a job may end itself
        self._due = 0.0
        # ticks; changed by single atomic calls, because any thread may add one
        self._requested: set[float] = set()
        self._errors = UnexpectedErrors(
            _log, "unexpected error in an I/O job, retrying (logged once)"
        )
        self._ended = False
        _jobs[self] = None
        _thread.start()
        self.wake()

    @property
    def runs_at(self) -> float:
        """The monotonic time of the next call [s]."""
        if self._requested:
            return min((self._due, *self._requested))
        return self._due

    def wake(self, at: float = 0.0) -> None:
        """Call the job now, or at the first tick after a monotonic time [s]; any thread may call this."""
        at = math.ceil(at / TICK) * TICK
        self._requested.add(at)
        if at < _sleeps_until and _woken.empty():
            _woken.put(None)

    def end(self) -> None:
        """Stop the job, and wait until a running call has returned. Idempotent."""
        self._ended = True
        _jobs.pop(self, None)
        with self._running:
            pass

    def run(self, now: float) -> None:
        """Call the job; only for the I/O thread."""
        if self._requested:
            self._requested.difference_update([at for at in tuple(self._requested) if at <= now])
        try:  # not `with self._errors`, which costs two calls
            with self._running:
                if self._ended:
                    pause = math.inf
                else:
                    pause = max(_MIN_PAUSE, self._call(now))
        except BaseException as exc:  # noqa: BLE001 - not even SystemExit may end this thread
            self._errors.survives(exc)
            pause = _RETRY_PAUSE
        if pause < TICK or pause == math.inf:
            self._due = now + pause
        else:
            self._due = math.floor((now + pause) / TICK) * TICK


class CallThread:
    """A daemon thread that calls queued functions one after another."""

    def __init__(self, name: str) -> None:
        self._name = name
        # `put` must be reentrant
        self._calls: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._errors = UnexpectedErrors(_log, "unexpected error in thread %s (logged once)", name)

    def start(self) -> None:
        """Start the thread unless it is running."""
        with _start:
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
                self._thread.start()

    def put(self, call: Callable[[], object]) -> None:
        """Queue a call; the thread must have been started."""
        self._calls.put(call)

    def drain(self, timeout: float) -> None:
        """Wait up to `timeout` seconds until all queued calls have returned."""
        if self._thread is not None and self._thread.is_alive():
            drained = threading.Event()
            self.put(drained.set)
            drained.wait(timeout)

    def _run(self) -> None:
        while True:
            call = self._calls.get()
            with self._errors:
                call()
            del call  # release its references before blocking


def _run_jobs() -> None:
    global _sleeps_until  # noqa: PLW0603 - a process has one I/O thread
    while True:
        now = time.monotonic()
        _sleeps_until = 0.0
        for job in tuple(_jobs):
            if job.runs_at <= now:
                job.run(now)
        # from here `wake` puts an item; after the next line only for an earlier time
        _sleeps_until = math.inf
        _sleeps_until = due = min((job.runs_at for job in tuple(_jobs)), default=math.inf)
        timeout = None
        if due != math.inf:
            timeout = max(0.0, due - time.monotonic())
        with suppress(queue.Empty):
            _woken.get(timeout=timeout)


_thread = CallThread("nedbus-io")
_thread.put(_run_jobs)
