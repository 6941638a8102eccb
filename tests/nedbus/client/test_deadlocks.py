"""Deadlocks between Python and Zenoh while a process opens and closes publishers, queries and subscribes."""

from __future__ import annotations

import sys

import pytest

from tests.peers.ports import free_port
from tests.peers.processes import Start


@pytest.mark.slow
def test_opening_and_closing_publishers_does_not_deadlock(start: Start) -> None:
    """No Python code runs on Zenoh's threads, and none holds the GIL while waiting for Zenoh.

    A deadlock lasts 10 s or forever; the limit of 5 s tolerates a busy machine.
    """
    options = ["--seconds", "15", "--restart", "6", "--busy", "0", "--limit", "5"]
    process = start(
        "-m", "tests.stress", *options, "--port", str(free_port()), coverage=False, PYTHONPATH=":".join(sys.path)
    )
    assert process.wait(110.0) == 0, process.out + process.err
