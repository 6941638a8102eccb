"""Checks side by side, each in a thread, all with one deadline."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

from nedbus.errors import NedbusError

from .finding import Finding

Check = Callable[[], Sequence[Finding]]
T = TypeVar("T")


def run_together(checks: Mapping[str, Check], seconds: float) -> list[Finding]:
    """Return what all checks find, in their order; one that takes longer, or fails, is a finding by itself.

    A thread that is late is left alone: it ends with its own timeouts, and keeps no process alive.
    """
    found: dict[str, Sequence[Finding]] = {}

    def run(name: str, check: Check) -> None:
        try:
            found[name] = check()
        except (NedbusError, OSError) as exc:
            found[name] = [Finding(name, "", "unknown", f"could not be examined: {exc}")]

    threads = {
        name: threading.Thread(target=run, args=[name, check], name=f"nedbus-{name}", daemon=True)
        for name, check in checks.items()
    }
    end = time.monotonic() + seconds
    for thread in threads.values():
        thread.start()
    for thread in threads.values():
        thread.join(max(0.0, end - time.monotonic()))
    late = f"no answer within {seconds:g} s"
    advice = "try again; if it stays so, the network or a name server drops what is sent to it"
    for name, thread in threads.items():
        seen = late if thread.is_alive() else "could not be examined: a fault of nedbus, its traceback is on stderr"
        found.setdefault(name, [Finding(name, "", "unknown", seen, advice if thread.is_alive() else "report it")])
    return [finding for name in checks for finding in found[name]]


def within(seconds: float, function: Callable[[], T]) -> T:
    """Return what a function returns that has no timeout of its own; raise TimeoutError, or what it raises."""
    outcome: list[T] = []
    errors: list[Exception] = []

    def run() -> None:
        try:
            outcome.append(function())
        except Exception as exc:  # noqa: BLE001 - raised again below, in the caller's thread
            errors.append(exc)

    thread = threading.Thread(target=run, name="nedbus-within", daemon=True)
    thread.start()
    thread.join(seconds)
    if errors:
        raise errors[0]
    if not outcome:
        raise TimeoutError
    return outcome[0]
