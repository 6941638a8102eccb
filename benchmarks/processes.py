"""Processes of a measurement, which are controlled and queried through lines on stdin and stdout."""

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
TIMEOUT: Final = 120.0  # s until the next line of a process

Process = subprocess.Popen[str]


class Checkout(NamedTuple):
    """A checkout of nedbus, run with its .venv if it has one."""

    folder: Path

    @property
    def python(self) -> str:
        """Its Python interpreter."""
        python = self.folder / ".venv/bin/python"
        return str(python) if python.exists() else sys.executable

    def start(
        self, *arguments: str, python: str = "", environment: Mapping[str, str] | None = None,
        errors: int | None = subprocess.DEVNULL,
    ) -> Process:  # fmt: skip
        """Start a Python process that imports this checkout; `errors`: target of its stderr."""
        packages = {
            "PYTHONPATH": os.pathsep.join(
                str(self.folder / name) for name in ("service", "schemas")
            )
        }
        return start(
            *arguments,
            python=python or self.python,
            environment={**packages, **(environment or {})},
            errors=errors,
        )


HERE: Final = Checkout(ROOT)


def start(
    *arguments: str, python: str = sys.executable, environment: Mapping[str, str] | None = None,
    errors: int | IO[str] | None = subprocess.DEVNULL,
) -> Process:  # fmt: skip
    """Start a Python process; `errors`: target of its stderr, None to inherit."""
    return subprocess.Popen(
        [python, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=errors,
        text=True,
        cwd=ROOT,
        env={**os.environ, **(environment or {})},
    )


def expect(process: Process, timeout: float = TIMEOUT) -> str:
    """Return the next line of a process; raise TimeoutError if there is none in time, RuntimeError if it has ended."""
    assert process.stdout is not None
    if not select.select([process.stdout], [], [], timeout)[0]:
        raise TimeoutError(f"no output within {timeout:.0f} s")
    line = process.stdout.readline().strip()
    if not line:
        raise RuntimeError("the process has ended")
    return line


def resume(process: Process) -> None:
    """Send a line to a process, which lets it continue; ignore one that has ended."""
    assert process.stdin is not None
    with suppress(BrokenPipeError):
        process.stdin.write("\n")
        process.stdin.flush()


def end(*processes: Process, timeout: float = 0.0) -> None:
    """Wait until processes end, and kill them after the timeout."""
    deadline = time.monotonic() + timeout
    for process in processes:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@contextmanager
def nedbus_process(
    *arguments: str, checkout: Checkout = HERE, setup: str = ""
) -> Iterator[Process]:
    """Run a nedbus command inside a `with` block; `setup`: Python code that runs before it."""
    process = checkout.start("-c", f"{setup}\nfrom nedbus.cli import main\nmain()", *arguments)
    try:
        yield process
    finally:
        process.terminate()
        end(process, timeout=10.0)


@contextmanager
def router(checkout: Checkout = HERE) -> Iterator[tuple[Process, str]]:
    """Run a router on a free port; yield its process and endpoint."""
    port = free_port()
    with nedbus_process(
        "router", "--listen", f"tcp/127.0.0.1:{port}", checkout=checkout
    ) as process:
        wait_for_router(port, process)
        yield process, f"tcp/127.0.0.1:{port}"


def free_port() -> int:
    """Return a free port of loopback that no outgoing connection takes while a router is down."""
    while True:
        with socket.socket() as free, suppress(OSError):
            # outgoing connections use ports from 32,768 up
            free.bind(("127.0.0.1", random.randint(20_000, 32_000)))
            return int(free.getsockname()[1])


def cpu_seconds(*processes: Process) -> list[float]:
    """Return the CPU time that each process has used [s]."""
    return [sum(psutil.Process(process.pid).cpu_times()[:2]) for process in processes]


def memory_mb(process: Process) -> float:
    """Return the resident memory (RSS) of a process [MB]."""
    return float(psutil.Process(process.pid).memory_info().rss / 2**20)


def wait_for_router(port: int, process: Process) -> None:
    """Wait until a router listens; raise RuntimeError if it ends."""
    deadline = time.monotonic() + TIMEOUT
    while process.poll() is None and time.monotonic() < deadline:
        with suppress(OSError):
            socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
            return
        time.sleep(0.1)
    raise RuntimeError(f"the router does not start on port {port}")


def wait_for_quiet(last: Callable[[], float], *, quiet: float, timeout: float) -> None:
    """Wait until `last`, the time of the last message, is `quiet` seconds ago, at most `timeout` seconds."""
    start = time.monotonic()
    while (now := time.monotonic()) < start + timeout and now <= max(start, last()) + quiet:
        time.sleep(0.05)
