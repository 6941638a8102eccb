"""One run of one form at one load, with a publisher process and a reader process."""

from __future__ import annotations

import json
import subprocess
import time
from dataclasses import dataclass

from benchmarks.processes import Checkout, Process, cpu_seconds, end, expect, resume

from .fields import VARIABLE
from .results import Load, Measured

TRIES = 2  # a shared machine may stall for seconds


@dataclass(frozen=True)
class Subject:
    """A form, run with a Python interpreter and a checkout of nedbus, through the router of this checkout."""

    form: str
    python: str
    checkout: Checkout
    router: Process
    endpoint: str


def run(subject: Subject, load: Load, *, flight: str) -> Measured:
    """Measure, with one retry; raise RuntimeError if both runs fail."""
    for tries in range(TRIES, 0, -1):
        try:
            return _run(subject, load, flight=flight, quiet=tries > 1)
        except (RuntimeError, TimeoutError, subprocess.SubprocessError, ValueError) as exc:
            if tries == 1:
                raise RuntimeError(f"{load.name}, {flight}: {exc}") from exc
            print(f"{subject.form}: {exc}; retrying", flush=True)
    raise AssertionError


def _run(subject: Subject, load: Load, *, flight: str, quiet: bool) -> Measured:
    vehicles = ",".join(str(number + 1) for number in range(load.vehicles))
    ends: list[Process] = []
    try:
        for role in ("receive", "publish"):
            process = subject.checkout.start(
                "-m", "benchmarks.compare.role", subject.form, role, subject.endpoint,
                str(load.messages), str(load.rate), vehicles,
                python=subject.python,
                environment={VARIABLE: flight},
                errors=subprocess.DEVNULL if quiet else None,
            )  # fmt: skip
            ends.append(process)
            if expect(process) != "ready":
                raise RuntimeError(f"{role} does not start")
        receiver, publisher = ends
        time.sleep(0.5)
        [before] = cpu_seconds(subject.router)
        resume(publisher)
        sent = json.loads(expect(publisher))
        resume(receiver)
        got = json.loads(expect(receiver))
        [after] = cpu_seconds(subject.router)
        resume(publisher)
    finally:
        end(*ends, timeout=2.0)
    publish_cpu, receive_cpu = (
        sent["cpu"] / load.messages * 1e6,
        got["cpu"] / max(1, got["received"]) * 1e6,
    )
    return {
        "rate": got["received"] / got["seconds"],
        "kept": got["received"] / load.messages,
        "publish_cpu": publish_cpu,
        "receive_cpu": receive_cpu,
        "total_cpu": publish_cpu + (after - before) / load.messages * 1e6 + receive_cpu,
        "publish_peak": sent["peak"],
        "receive_peak": got["peak"],
        **{key: value for key, value in got.items() if key in ("p50", "p99")},
    }
