"""Publisher or reader process of a measurement.

Usage: `python -m benchmarks.compare.role FORM publish|receive ENDPOINT COUNT RATE [VEHICLE,VEHICLE...]`.
COUNT is the total number of messages; RATE is per vehicle in Hz, 0 for full speed; all vehicles send simultaneously.
The process prints "ready", waits for a line, runs, and prints its figures as JSON.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol, cast

from .case import Case

QUIET = 3.0  # s without a message after which a receiver gives up

Send = Callable[[Any], None]


class Form(Protocol):
    """A module of benchmarks.compare.forms."""

    def publish(self, case: Case) -> AbstractContextManager[list[Send]]: ...
    def receive(
        self, case: Case, ready: Callable[[], None], seen: Callable[[Any], bool]
    ) -> None: ...


def main() -> None:
    """Run the publisher or the reader."""
    form_name, role, endpoint, count, rate, *vehicles = sys.argv[1:7]
    form = cast("Form", importlib.import_module(f"benchmarks.compare.forms.{form_name}"))
    ids = tuple(vehicles[0].split(",")) if vehicles else ("1",)
    run = publish if role == "publish" else receive
    run(form, Case(endpoint, ids, paced=float(rate) > 0), int(count), float(rate))


def publish(form: Form, case: Case, count: int, rate: float) -> None:
    """Send `count` messages."""
    size = getattr(form, "BATCH", 1)
    with form.publish(case) as senders:
        print("ready", flush=True)
        sys.stdin.readline()
        start = now()
        if case.paced:
            send_paced(senders, count // len(senders), rate)
        elif size == 1:
            (send,) = senders
            for number in range(count):
                send(number + 1)
        else:
            (send,) = senders
            for number in range(0, count, size):
                send(range(number + 1, min(count, number + size) + 1))
        report(start, now())
        sys.stdin.readline()


def send_paced(senders: Sequence[Send], ticks: int, rate: float) -> None:
    """Send one message per vehicle and tick."""
    start = time.monotonic()
    for tick in range(ticks):
        wait = start + tick / rate - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        for send in senders:
            send(time.monotonic_ns())


def receive(form: Form, case: Case, count: int, rate: float) -> None:
    """Receive `count` messages, or fewer if no more arrive."""
    received, start, end = 0, (0.0, 0.0), (0.0, 0.0)
    delays: list[int] = []

    def seen(stamp: Any) -> bool:
        """Count a message, or those of an array of times; return whether more are expected."""
        nonlocal received, start, end
        if not received:
            start = now()
        if isinstance(stamp, int):
            received += 1
            if rate:
                delays.append(time.monotonic_ns() - stamp)
        else:
            received += len(stamp)
            if rate:
                delays.extend((time.monotonic_ns() - stamp).tolist())
        if received < count:
            return True
        end = now()  # before closing
        return False

    def watch() -> None:
        sys.stdin.readline()
        before, changed = -1, now()
        while time.monotonic() < changed[0] + QUIET:
            if received > before:
                before, changed = received, now()
            time.sleep(0.05)
        finish(changed)

    def finish(end: tuple[float, float]) -> None:
        delays.sort()
        found = (
            {f"p{part}": delays[len(delays) * part // 100] / 1e3 for part in (50, 99)}
            if delays
            else {}
        )
        report(start, end, received=received, **found)
        os._exit(0)  # the form may wait forever for missing messages

    threading.Thread(target=watch, daemon=True).start()
    form.receive(case, lambda: print("ready", flush=True), seen)
    finish(end)


def now() -> tuple[float, float]:
    """Return the time and the CPU time of this process, in seconds."""
    return time.monotonic(), time.process_time()


def report(start: tuple[float, float], end: tuple[float, float], **measured: float) -> None:
    """Print the result."""
    seconds, cpu = end[0] - start[0], end[1] - start[1]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"seconds": seconds, "cpu": cpu, "peak": peak, **measured}), flush=True)


if __name__ == "__main__":
    main()
