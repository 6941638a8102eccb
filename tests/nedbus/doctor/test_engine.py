"""The engine of checks: parallel, in order, each with a timeout; a failure is a finding."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial

import pytest

from nedbus.doctor.engine import Check, run_checks
from nedbus.doctor.finding import Finding
from nedbus.errors import NedbusError
from tests.waits import DEADLINE


def ok(name: str, subject: str = "") -> Finding:
    return Finding(name, subject, "ok", "seen")


def test_checks_run_in_parallel_and_findings_keep_their_order() -> None:
    """Three checks that wait for each other end; their findings have the order of the checks, with their place."""
    together = threading.Barrier(3)

    def check(subject: str) -> Iterator[Finding]:
        together.wait(DEADLINE)
        yield ok("endpoint", subject)
        yield ok("tls", subject)

    checks = [
        Check("endpoint", subject, partial(check, subject), place=f"at {subject}")
        for subject in ("a", "b", "c")
    ]
    results = list(run_checks(checks, DEADLINE))
    assert [(check.place, finding.check) for check, finding in results] == [
        (f"at {subject}", name) for subject in ("a", "b", "c") for name in ("endpoint", "tls")
    ]


def test_late_check_is_a_finding_and_delays_no_others() -> None:
    """A check beyond the time limit yields one finding: an endpoint is wrong, anything else is unknown."""
    stop = threading.Event()

    def wait() -> list[Finding]:
        stop.wait(DEADLINE)
        return []

    checks = [
        Check("endpoint", "slow", wait),
        Check("settings", "", wait),
        Check("tls", "x", lambda: [ok("tls")]),
    ]
    findings = [finding for _, finding in run_checks(checks, 0.2)]
    stop.set()
    assert [(finding.check, finding.state) for finding in findings] == [
        ("endpoint", "wrong"),
        ("settings", "unknown"),
        ("tls", "ok"),
    ]
    assert findings[0].seen == "no result within 0.2 s"


def test_failure_of_a_check_is_a_finding(caplog: pytest.LogCaptureFixture) -> None:
    """An expected error makes the subject wrong; an unexpected one, even a panic, is logged and names a bug."""

    def fail() -> list[Finding]:
        raise NedbusError("no router")

    def panic() -> list[Finding]:
        raise BaseException("panic")  # noqa: TRY002 - like pyo3's PanicException, it is not an Exception

    checks = [Check("network", "", fail), Check("mavlink", "udpin", panic)]
    expected, unexpected = [finding for _, finding in run_checks(checks, DEADLINE)]
    assert (expected.state, expected.seen) == ("wrong", "check failed: no router")
    assert (unexpected.state, unexpected.seen) == (
        "unknown",
        "check failed: unexpected BaseException: panic",
    )
    assert "a bug in nedbus" in unexpected.advice
    assert "unexpected error in check mavlink udpin" in caplog.text
