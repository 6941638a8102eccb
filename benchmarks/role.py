"""One end of a measurement: python -m benchmarks.role FORM publish|receive ENDPOINT COUNT RATE.

It prints "ready", waits for a line, works, and prints what it measured as JSON.
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

QUIET = 3.0  # s without a message after which a receiver gives up


class Form(Protocol):
    """A module of benchmarks.forms."""

    def publish(self, endpoint: str) -> AbstractContextManager[Callable[[Any], None]]: ...
    def receive(self, endpoint: str, ready: Callable[[], None], seen: Callable[[Any], bool]) -> None: ...


def main() -> None:
    """Play the role that the arguments name."""
    form_name, role, endpoint, count, rate = sys.argv[1:6]
    form = cast("Form", importlib.import_module(f"benchmarks.forms.{form_name}"))
    play = publish if role == "publish" else receive
    play(form, endpoint, int(count), float(rate))


def publish(form: Form, endpoint: str, count: int, rate: float) -> None:
    """Send this many messages, `rate` a second or as fast as possible."""
    size = getattr(form, "BATCH", 1)
    with form.publish(endpoint) as send:
        print("ready", flush=True)
        sys.stdin.readline()
        start, cpu = time.monotonic(), time.process_time()
        if rate:
            for number in range(count):
                wait = start + number / rate - time.monotonic()
                if wait > 0:
                    time.sleep(wait)
                stamp = time.monotonic_ns()
                send(stamp if size == 1 else [stamp])
        elif size == 1:
            for number in range(count):
                send(number + 1)
        else:
            for number in range(0, count, size):
                send(range(number + 1, min(count, number + size) + 1))
        report(start, cpu, end=time.monotonic())
        sys.stdin.readline()


def receive(form: Form, endpoint: str, count: int, rate: float) -> None:
    """Take this many messages, or fewer if no more come."""
    received, first, cpu = 0, 0.0, 0.0
    delays: list[int] = []

    def seen(stamp: int | Sequence[int]) -> bool:
        nonlocal received, first, cpu
        if not received:
            first, cpu = time.monotonic(), time.process_time()
        if isinstance(stamp, int):
            received += 1
            if rate:
                delays.append(time.monotonic_ns() - stamp)
        else:
            received += len(stamp)
            if rate:
                now = time.monotonic_ns()
                delays.extend(now - int(each) for each in stamp)
        return received < count

    def watch() -> None:
        sys.stdin.readline()
        before, changed = -1, time.monotonic()
        while time.monotonic() < changed + QUIET:
            if received > before:
                before, changed = received, time.monotonic()
            time.sleep(0.05)
        finish(changed)

    def finish(end: float) -> None:
        delays.sort()
        found = {f"p{part}": delays[len(delays) * part // 100] / 1e3 for part in (50, 99)} if delays else {}
        report(first, cpu, end=end, received=received, **found)
        os._exit(0)  # it may be waiting for ever for the rest

    threading.Thread(target=watch, daemon=True).start()
    form.receive(endpoint, lambda: print("ready", flush=True), seen)
    finish(time.monotonic())


def report(start: float, cpu: float, *, end: float, **measured: float) -> None:
    """Print the result."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        json.dumps({"seconds": end - start, "cpu": time.process_time() - cpu, "peak": peak, **measured}),
        flush=True,
    )


if __name__ == "__main__":
    main()
