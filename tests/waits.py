"""Wait for conditions, with a deadline and a failure message."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import Self, cast

import zenoh

from nedbus.timings import TIMINGS, Timings
from nedbus.transport import Session, token_keys

DEADLINE = 30.0
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
    wait_for(lambda: cast("zenoh.MatchingStatus", probe.matching_status).matching, what=f"a subscriber of {key}")
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
    """A clock that stands still while a busy machine does not run this process; it counts ticks of 10 ms.

    For limits that tell a wait for a timeout from none: on an idle machine it is exact to a few percent.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(0.01):
            self.seconds += 0.01
