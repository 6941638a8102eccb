"""Processes of tests: output in files, a deadline for each wait, killed at the end of the test."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import weakref
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import pytest

from tests.waits import DEADLINE

_MAX_SHOWN = 10_000  # characters of stdout and of stderr in a failure message


class ForkedProcess:
    """A process forked by the fork server, with the interface of subprocess.Popen."""

    def __init__(self, command: Sequence[str], status: int) -> None:
        self.args = command
        self.returncode: int | None = None
        self._status = status
        self._close = weakref.finalize(self, os.close, status)
        self.pid = int(os.read(status, 10))

    def poll(self) -> int | None:
        return self._look(0)

    def wait(self, timeout: float | None = None) -> int:
        code = self._look(timeout)
        if code is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0)
        return code

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def _look(self, timeout: float | None) -> int | None:
        if self.returncode is None and select.select([self._status], [], [], timeout)[0]:
            self.returncode = int(os.read(self._status, 10))
            self._close()
        return self.returncode


class ForkServer:
    """Client of a `fork_server.py` process; one per pytest worker, started on first use."""

    def __init__(self) -> None:
        self._requests, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.peers.fork_server", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                cwd=Path(__file__).parents[2],
                # Coverage starts in the child, if at all: a process with threads cannot be forked.
                env=without_coverage() | {"OPENBLAS_NUM_THREADS": "1"},
            )

    def start(
        self,
        arguments: Sequence[str],
        *,
        cwd: Path,
        environment: dict[str, str],
        streams: tuple[int, int, int],
    ) -> ForkedProcess:
        """Fork a process with these arguments of `python`, and these standard streams."""
        request = {"arguments": arguments, "cwd": str(cwd), "environment": environment}
        ours, theirs = os.pipe()
        socket.send_fds(self._requests, [json.dumps(request).encode()], [*streams, theirs])
        os.close(theirs)
        return ForkedProcess([sys.executable, *arguments], ours)

    def close(self) -> None:
        self._requests.close()
        self._process.wait(DEADLINE)


class Process:
    """A process that a test starts, with its output in files."""

    def __init__(
        self,
        command: Sequence[str],
        where: Path,
        environment: dict[str, str],
        fork_server: ForkServer | None = None,
    ) -> None:
        self._measured = any(name.startswith("COVERAGE_") for name in environment)
        self._out = where / "stdout"
        self._err = where / "stderr"
        self.popen: ForkedProcess | subprocess.Popen[bytes]
        with (
            self._out.open("wb") as out,
            self._err.open("wb") as err,
            Path(os.devnull).open("rb") as null,
        ):
            if fork_server is not None:
                streams = null.fileno(), out.fileno(), err.fileno()
                self.popen = fork_server.start(
                    command[1:], cwd=where, environment=environment, streams=streams
                )
            else:
                self.popen = subprocess.Popen(
                    command, stdin=null, stdout=out, stderr=err, cwd=where, env=environment
                )

    @property
    def out(self) -> str:
        return self._out.read_text()

    @property
    def err(self) -> str:
        return self._err.read_text()

    def wait(self, seconds: float = DEADLINE) -> int:
        """Return the exit code; fail with the output and the stacks of all threads if the process does not end."""
        try:
            return self.popen.wait(seconds)
        except subprocess.TimeoutExpired:
            self.popen.send_signal(signal.SIGABRT)  # Python writes the stacks of all threads
            with suppress(subprocess.TimeoutExpired):
                self.popen.wait(DEADLINE)
            output = f"{self.out[-_MAX_SHOWN:]}{self.err[-_MAX_SHOWN:]}"
            pytest.fail(
                f"{self.popen.args!r} did not end within {seconds} s; its output:\n{output}"
            )

    def signal(self, number: signal.Signals) -> None:
        if self._measured and number == signal.SIGINT:
            pytest.fail("start a process that SIGINT will end with coverage=False")
        self.popen.send_signal(number)

    def kill(self) -> None:
        self.popen.kill()
        self.popen.wait(DEADLINE)


def without_coverage() -> dict[str, str]:
    """Return the environment without coverage, for processes ended by SIGINT, which may interrupt coverage's lock."""
    return {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE_")}


Start = Callable[..., Process]
