"""Deadlocks between Python and Zenoh in a process that subscribes, queries, and opens and closes publishers."""

from __future__ import annotations

import sys

import pytest

from tests.peers.ports import free_port
from tests.peers.processes import Start


@pytest.mark.long
def test_opening_and_closing_publishers_does_not_deadlock(start: Start) -> None:
    """Python code neither runs on Zenoh's threads nor holds the GIL while it waits for Zenoh.

    A deadlock lasts 10 s or forever; the limit of 5 s tolerates a busy machine.
    """
    options = ["--seconds", "15", "--restart", "6", "--busy", "0", "--limit", "5"]
    process = start(
        "-m",
        "tests.stress",
        *options,
        "--port",
        str(free_port()),
        coverage=False,
        PYTHONPATH=":".join(sys.path),
    )
    assert process.wait(110.0) == 0, process.out + process.err
