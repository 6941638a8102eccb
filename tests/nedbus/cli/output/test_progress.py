"""Progress reports of `nedbus serve`."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any, cast

import pytest

from nedbus.cli.output.progress import log_progress
from nedbus.daemon import Daemon
from nedbus.health import SourceStatus
from nedbus.timings import Timings
from tests.flights.messages import VLP


def test_report_has_the_rate_since_the_last_one(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, timings: Timings
) -> None:
    """Each running source is reported with its rate since the last report, and with what went wrong, if anything."""
    caplog.set_level("INFO", "nedbus")
    timings.reports = (10.0,)
    now = [0.0]
    clock = SimpleNamespace(monotonic=lambda: now[0])
    monkeypatch.setattr("nedbus.cli.output.progress.time", clock)
    daemon: Any = SimpleNamespace(ready=threading.Event(), until_done=True, sources=[])
    progress = log_progress(cast("Daemon", daemon))
    next(progress)  # the daemon is not ready
    daemon.ready.set()
    waiting = SourceStatus("mavlink:x", "waiting")
    reports = [
        SourceStatus("sim:", "running", published=100),
        SourceStatus(
            "sim:",
            "running",
            published=150,
            done=1,
            total=4,
            rejected=2,
            lost=3,
            stale=(f"1/{VLP}",),
        ),
    ]
    for seconds, report in zip((10.0, 20.0), reports, strict=True):
        next(progress)
        daemon.sources = [report, waiting]
        now[0] = seconds
    next(progress)
    assert caplog.messages == [
        "sim: 100 messages, 10/s",
        f"sim: 150 messages (25%), 5/s, 2 rejected, 3 lost (gone: 1/{VLP})",
    ]
