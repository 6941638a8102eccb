"""The processes of a measurement, which are told and asked by lines."""

from __future__ import annotations

import os
import random
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Final, NamedTuple

import psutil

ROOT: Final = Path(__file__).parents[1]
PATIENCE: Final = 120.0  # s that a process may take to say something

Process = subprocess.Popen[str]


class Checkout(NamedTuple):
    """A checkout of nedbus; its own .venv runs it, if it has one."""

    folder: Path

    def start(self, *arguments: str) -> Process:
        """Start a Python process that imports this checkout."""
        python, packages = (
            self.folder / ".venv/bin/python",
            [str(self.folder / each) for each in ("service", "schemas")],
        )
        environment = {"PYTHONPATH": os.pathsep.join(packages)}
        return start(*arguments, python=str(python) if python.exists() else sys.executable, environment=environment)


HERE: Final = Checkout(ROOT)


def start(
    *arguments: str, python: str = sys.executable, environment: Mapping[str, str] | None = None,
    errors: int | IO[str] | None = subprocess.DEVNULL,
) -> Process:  # fmt: skip
    """Start a Python process; `errors` gets its stderr, None shows it."""
    return subprocess.Popen(
        [python, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=errors,
        text=True,
        cwd=ROOT,
        env={**os.environ, **(environment or {})},
    )


def expect(process: Process, patience: float = PATIENCE) -> str:
    """Return the next line that a process prints; raise TimeoutError if there is none yet, RuntimeError if it ended."""
    assert process.stdout is not None
    if not select.select([process.stdout], [], [], patience)[0]:
        raise TimeoutError(f"it says nothing within {patience:.0f} s")
    line = process.stdout.readline().strip()
    if not line:
        raise RuntimeError("it ended")
    return line


def tell(process: Process) -> None:
    """Let a process go on; one that has ended has said all."""
    assert process.stdin is not None
    with suppress(BrokenPipeError):
        process.stdin.write("\n")
        process.stdin.flush()


def end(*processes: Process, patience: float = 0.0) -> None:
    """Wait for processes to end by themselves, and kill those that do not."""
    deadline = time.monotonic() + patience
    for process in processes:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@contextmanager
def nedbus_process(*arguments: str, checkout: Checkout = HERE, setup: str = "") -> Iterator[Process]:
    """Run a nedbus command until the measurement is over; `setup` is Python code that runs before it."""
    process = checkout.start("-c", f"{setup}\nfrom nedbus.cli import main\nmain()", *arguments)
    try:
        yield process
    finally:
        process.terminate()
        end(process, patience=10.0)


@contextmanager
def router(checkout: Checkout = HERE) -> Iterator[tuple[Process, str]]:
    """Run a router on a free port, and give its endpoint."""
    port = free_port()
    with nedbus_process("router", "--listen", f"tcp/127.0.0.1:{port}", checkout=checkout) as process:
        wait_for_router(port, process)
        yield process, f"tcp/127.0.0.1:{port}"


def free_port() -> int:
    """Return a port of the loopback on which nothing listens, and which no client gets while a router is down."""
    while True:
        with socket.socket() as free, suppress(OSError):
            free.bind(("127.0.0.1", random.randint(20_000, 32_000)))  # below the ports of clients, from 32,768 on
            return int(free.getsockname()[1])


def cpu_seconds(*processes: Process) -> list[float]:
    """Return the CPU time that each process has used [s]."""
    return [sum(psutil.Process(process.pid).cpu_times()[:2]) for process in processes]


def memory_mb(process: Process) -> float:
    """Return what a process has in RAM (RSS) [MB]."""
    return float(psutil.Process(process.pid).memory_info().rss / 2**20)


def wait_for_router(port: int, process: Process) -> None:
    """Wait until a router listens; raise RuntimeError if it ends."""
    deadline = time.monotonic() + PATIENCE
    while process.poll() is None and time.monotonic() < deadline:
        with suppress(OSError):
            socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
            return
        time.sleep(0.1)
    raise RuntimeError(f"the router does not start on port {port}")


def wait_for_quiet(last: Callable[[], float], *, quiet: float, patience: float) -> None:
    """Wait until nothing has come for `quiet` seconds, at most `patience`; `last` is when something came."""
    start = time.monotonic()
    while (now := time.monotonic()) < start + patience and now <= max(start, last()) + quiet:
        time.sleep(0.05)
