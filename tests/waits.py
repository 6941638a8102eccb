"""Wait for conditions, with a deadline and a failure message."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Self, cast

import zenoh

from nedbus.timings import TIMINGS, Timings
from nedbus.transport import Session, token_keys

DEADLINE = 60.0
"""Seconds that a test waits for a condition before it fails."""


def wait_for(condition: Callable[[], object], *, what: str, seconds: float = DEADLINE) -> None:
    """Wait until a condition holds; fail with `what` after the deadline."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"timed out after {seconds} s waiting for {what}"
        time.sleep(0.01)


def wait_for_matching(zenoh_session: Session, key: str) -> None:
    """Wait until the session has a matching subscriber of this key; Zenoh drops earlier puts."""
    probe = zenoh_session.declare_publisher(key)
    wait_for(
        lambda: cast("zenoh.MatchingStatus", probe.matching_status).matching,
        what=f"a subscriber of {key}",
    )
    probe.undeclare()


def wait_for_router(zenoh_session: Session) -> None:
    """Wait until the router has processed the session's declarations; it answers this query only after them."""
    token_keys(zenoh_session, "nowhere", timeout=DEADLINE)


@contextmanager
def changing_timings() -> Iterator[Timings]:
    """Yield the timings of this process for changes, and restore them at the end."""
    before = replace(TIMINGS)
    try:
        yield TIMINGS
    finally:
        for each in fields(before):
            setattr(TIMINGS, each.name, getattr(before, each.name))


@contextmanager
def repeating(action: Callable[[], object]) -> Iterator[None]:
    """Repeat an action at 50 Hz, as a vehicle publishes."""
    stop = threading.Event()

    def run() -> None:
        while not stop.wait(0.02):
            action()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(DEADLINE)


class Stopwatch:
    """The time that the main thread of a process sleeps, or the thread that enters this; it counts ticks of 10 ms.

    For limits that tell a wait for a timeout from none: time in which the thread works, or waits for a CPU of a busy
    machine, does not count.
    """

    def __init__(self, pid: int | None = None) -> None:
        self.seconds = 0.0
        self._pid = pid
        self._state = Path()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        thread = threading.get_native_id() if self._pid is None else self._pid
        self._state = Path(f"/proc/{self._pid or 'self'}/task/{thread}/stat")
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(0.01):
            if self._is_asleep():
                self.seconds += 0.01

    def _is_asleep(self) -> bool:
        """Return whether the thread sleeps: not while it runs or waits for a CPU, nor once it has ended."""
        try:
            state = self._state.read_text().rpartition(")")[2].split()[0]
        except OSError:
            return False
        return state in {"S", "D"}
