"""A process whose publishers come and go, while others query and subscribe, never stops."""

from __future__ import annotations

import sys

import pytest

from tests.peers.ports import free_port
from tests.peers.processes import Start


@pytest.mark.slow
def test_process_never_stands_still_while_publishers_come_and_go(start: Start) -> None:
    """No Python code runs on Zenoh's threads, and none holds the interpreter's lock while waiting for Zenoh.

    A deadlock lasts 10 s or forever; the limit of 5 s tolerates a busy machine.
    """
    options = ["--seconds", "15", "--restart", "6", "--busy", "0", "--limit", "5"]
    process = start(
        "-m", "tests.stress", *options, "--port", str(free_port()), coverage=False, PYTHONPATH=":".join(sys.path)
    )
    assert process.wait(110.0) == 0, process.out + process.err
