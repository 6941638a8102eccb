"""Replies to queries of a service's status and events."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from nedbus.client import QueryServer, ServiceStatus
from nedbus.daemon.status_replies import StatusReplies
from nedbus.transport import Session
from nedbus.vehicle_events import AccountReport


class Clock:
    """Replaces the module `time` by a clock that a test advances."""

    def __init__(self, monotonic: Callable[[], float]) -> None:
        self.monotonic = monotonic


@pytest.mark.parametrize(("cost", "age", "made"), [
    pytest.param(0.0, 0.4, 1, id="cheap and fresh"),
    pytest.param(0.0, 0.6, 2, id="cheap and old"),
    pytest.param(1.0, 3.9, 1, id="expensive and fresh"),
    pytest.param(1.0, 4.1, 2, id="expensive and old"),
])  # fmt: skip
def test_expensive_report_is_kept_for_longer(
    zenoh_session: Session, monkeypatch: pytest.MonkeyPatch, *, cost: float, age: float, made: int
) -> None:
    """A report is kept for half a second, and at least four times as long as it took to make."""
    now = 100.0
    calls = 0

    def make_report(_: float) -> AccountReport:
        nonlocal now, calls
        now += cost
        calls += 1
        return AccountReport(service="s", host="h", now=0.0, vehicles={})

    def make_status() -> ServiceStatus:
        return ServiceStatus(service="s", host="h", version="0")

    queries = QueryServer(zenoh_session)
    replies = StatusReplies(queries, "s", prefix="nedbus", status=make_status, report=make_report)
    monkeypatch.setattr("nedbus.daemon.status_replies.time", Clock(lambda: now))
    replies._current_report(60.0)
    now += age
    replies._current_report(60.0)
    assert calls == made
    queries.close()
