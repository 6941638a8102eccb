"""A fork server: it has imported nedbus and forks one child per request, which saves half a second of imports each.

A child is an ordinary process with its own exit code, signals and streams. The server opens no Zenoh session, because
Zenoh does not survive a fork. `tests/peers/processes.py` is the client.
"""

from __future__ import annotations

import faulthandler
import gc
import importlib
import json
import os
import runpy
import select
import signal
import socket
import sys
import types
from contextlib import suppress
from typing import Any, Final

_PRELOADED: Final = (
    "nedbus.cli.app",
    "numpy",
    "rich.console",
    "rich.live",
    "prometheus_client",
    "http.server",
)
_DUMP_STACKS: Final = signal.SIGRTMIN
"""Signal that makes a process write the stacks of all its threads to pytest's terminal."""
_TERMINAL: Final = 100
"""File descriptor of that terminal, above the range that is closed."""


def _watch(child: int, status: int) -> None:
    """Report the child's pid and exit code; if pytest exits first (test timeout), dump its stacks and kill it."""
    os.write(status, f"{child:10}".encode())
    ended = os.pidfd_open(child)
    poller = select.poll()
    poller.register(ended, select.POLLIN)
    poller.register(status, 0)  # a hang-up is always reported
    if not any(descriptor == ended for descriptor, _ in poller.poll()):
        os.kill(child, _DUMP_STACKS)
        poller.unregister(status)
        poller.poll(1000)  # time to write the stacks; a child that waited for pytest exits here
        os.kill(child, signal.SIGKILL)
    _, code = os.waitpid(child, 0)
    with suppress(BrokenPipeError):
        os.write(status, f"{os.waitstatus_to_exitcode(code):10}".encode())


def _become(request: dict[str, Any], streams: list[int]) -> None:
    """Set up the streams, working directory and environment of a new process."""
    os.dup2(2, _TERMINAL, inheritable=False)
    faulthandler.register(_DUMP_STACKS, file=_TERMINAL)
    for number, descriptor in enumerate(streams):
        os.dup2(descriptor, number)
    os.closerange(3, _TERMINAL)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["environment"])
    sys.stdin = open(0, closefd=False)  # noqa: SIM115 - until the end
    lines = os.isatty(1) or "PYTHONUNBUFFERED" in os.environ
    sys.stdout = open(1, "w", buffering=1 if lines else -1, closefd=False)  # noqa: SIM115 - until the end
    sys.stderr = open(2, "w", buffering=1, errors="backslashreplace", closefd=False)  # noqa: SIM115 - until the end
    faulthandler.enable(sys.stderr)
    if "COVERAGE_PROCESS_CONFIG" in os.environ:
        import coverage  # noqa: PLC0415 - only if coverage is measured

        coverage.process_startup()


def _serve(requests: socket.socket) -> dict[str, Any] | None:
    """Fork for each request; return it in the child, and None in the server at the end."""
    while True:
        message, descriptors, *_ = socket.recv_fds(requests, 2**20, 4)
        if not message:
            return None
        *streams, status = descriptors
        if os.fork() == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            requests.close()
            child = os.fork()
            if child:
                _watch(child, status)
                os._exit(0)
            request: dict[str, Any] = json.loads(message)
            _become(request, streams)
            return request
        for descriptor in descriptors:
            os.close(descriptor)


def _run(request: dict[str, Any]) -> None:
    kind, *arguments = request["arguments"]
    if kind == "-m":
        sys.argv = arguments
        runpy.run_module(arguments[0], run_name="__main__", alter_sys=True)
    elif kind == "-c":
        sys.argv = ["-c", *arguments[1:]]
        sys.modules["__main__"] = script = types.ModuleType("__main__")
        exec(compile(arguments[0], "<string>", "exec"), script.__dict__)  # noqa: S102 - a script of a test
    else:
        sys.argv = [kind, *arguments]
        sys.path[0] = os.path.dirname(kind)  # noqa: PTH120 - as Python itself does
        runpy.run_path(kind, run_name="__main__")


if __name__ == "__main__":
    for _name in _PRELOADED:
        importlib.import_module(_name)
    gc.collect()
    # otherwise the final garbage collection of each child would copy all of these pages
    gc.freeze()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # reap children automatically
    # Ctrl-C is for pytest, which stops the server by closing the socket
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _request = _serve(socket.socket(fileno=int(sys.argv[1])))
    if _request is not None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _run(_request)
