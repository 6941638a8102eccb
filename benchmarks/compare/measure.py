"""One run of one form at one load, with a publisher process and a reader process."""

from __future__ import annotations

import json
import subprocess
import time

from benchmarks.processes import Process, end, expect, resume, start

from .fields import VARIABLE
from .results import Load, Measured

TRIES = 2  # a shared machine may stall for seconds


def run(name: str, python: str, load: Load, *, flight: str, endpoint: str) -> Measured:
    """Measure, with one retry; raise RuntimeError if both runs fail."""
    for tries in range(TRIES, 0, -1):
        try:
            return _run(name, python, load, flight=flight, endpoint=endpoint, quiet=tries > 1)
        except (RuntimeError, TimeoutError, subprocess.SubprocessError, ValueError) as exc:
            if tries == 1:
                raise RuntimeError(f"{load.name}, {flight}: {exc}") from exc
            print(f"{name}: {exc}; retrying", flush=True)
    raise AssertionError


def _run(name: str, python: str, load: Load, *, flight: str, endpoint: str, quiet: bool) -> Measured:
    vehicles = ",".join(str(number + 1) for number in range(load.vehicles))
    ends: list[Process] = []
    try:
        for role in ("receive", "publish"):
            process = start(
                "-m", "benchmarks.compare.role", name, role, endpoint, str(load.messages), str(load.rate), vehicles,
                python=python,
                environment={VARIABLE: flight},
                errors=subprocess.DEVNULL if quiet else None,
            )  # fmt: skip
            ends.append(process)
            if expect(process) != "ready":
                raise RuntimeError(f"{role} does not start")
        receiver, publisher = ends
        time.sleep(0.5)
        resume(publisher)
        sent = json.loads(expect(publisher))
        resume(receiver)
        got = json.loads(expect(receiver))
        resume(publisher)
    finally:
        end(*ends, timeout=2.0)
    return {
        "rate": got["received"] / got["seconds"],
        "kept": got["received"] / load.messages,
        "publish_cpu": sent["cpu"] / load.messages * 1e6,
        "receive_cpu": got["cpu"] / max(1, got["received"]) * 1e6,
        "publish_peak": sent["peak"],
        "receive_peak": got["peak"],
        **{key: value for key, value in got.items() if key in ("p50", "p99")},
    }
