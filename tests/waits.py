"""Waiting for conditions, with a deadline and words for when it passes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import cast

import zenoh

from nedbus.timings import TIMINGS, Timings
from nedbus.transport import Session, token_keys

DEADLINE = 30.0
"""Seconds that a test waits for a condition before it fails."""


def wait_for(condition: Callable[[], object], *, what: str, seconds: float = DEADLINE) -> None:
    """Wait until a condition holds, and fail with words when it never does."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"waited {seconds} s in vain for {what}"
        time.sleep(0.01)


def wait_for_reader(raw: Session, key: str) -> None:
    """Wait until a session knows of a subscriber of this key: what it publishes before goes nowhere."""
    probe = raw.declare_publisher(key)
    wait_for(lambda: cast("zenoh.MatchingStatus", probe.matching_status).matching, what=f"a subscriber of {key}")
    probe.undeclare()


def wait_for_router(raw: Session) -> None:
    """Wait until the router knows what a session has declared: it answers in the order in which it is told."""
    token_keys(raw, "nowhere", timeout=DEADLINE)


@contextmanager
def changing_timings() -> Iterator[Timings]:
    """Yield the timings of this process, to change fields of them, and restore them at the end."""
    before = replace(TIMINGS)
    try:
        yield TIMINGS
    finally:
        for each in fields(before):
            setattr(TIMINGS, each.name, getattr(before, each.name))


@contextmanager
def repeating(action: Callable[[], object]) -> Iterator[None]:
    """Do something fifty times a second, as a vehicle does."""
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
