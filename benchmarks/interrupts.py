"""Ctrl-C at random moments of `serve`, `router`, `record`, `web` and `echo`, on a loaded machine.

Each process must end within 10 s, with exit code 130 (or killed by SIGINT while it starts or exits, which a shell
reports as 130). `record` ends with 0, or with 1 before its first message. A recording must be readable afterwards.
A process that does not end prints the stacks of its threads.
"""

from __future__ import annotations

import argparse
import collections
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final

from tests.flights.replays import convert_replay

import nedbus
from nedbus.errors import NoDataError

from .processes import ROOT, end, free_port, nedbus_process, router, start

LIMIT: Final = 10.0  # s from the signal to the end of the process
KILLED: Final = -signal.SIGINT  # a shell reports it as 130
COMMANDS: Final = {
    "serve-replay": "serve --source mcap:FLIGHT?loop=1&speed=max --listen ENDPOINT",
    "serve-joined": "serve --source mcap:FLIGHT?loop=1&speed=max --connect ROUTER",
    "serve-live": "serve --source mavlink:udpin:127.0.0.1:PORT --source px4-zenoh: --listen ENDPOINT",
    "router": "router --listen ENDPOINT",
    "record": "record --connect ROUTER --output RECORDING",
    "web": "web --connect ROUTER --http 127.0.0.1:PORT",
    "echo": "echo --connect ROUTER *",
}
CODES: Final = {"record": {0, 1, 130, KILLED}}
LOAD: Final = "while True: sum(range(100_000))"


def main() -> None:
    """Interrupt each command `count` times; print a line for each command, and the stacks of each that does not end."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "commands", nargs="*", default=list(COMMANDS), help=f"of {', '.join(COMMANDS)}"
    )
    parser.add_argument("--count", type=int, default=50, help="interrupts of each command")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--earliest", type=float, default=0.0, help="s after the start of the process"
    )
    parser.add_argument("--latest", type=float, default=4.0)
    parser.add_argument("--load", type=int, default=2, help="processes that load the machine")
    arguments = parser.parse_args()
    moments = random.Random(arguments.seed)
    # a background job would pass SIGINT on as ignored
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack, router() as (_, endpoint):
        flight = Path(folder) / "flight.mcap"
        convert_replay("sim:?duration=60", flight)
        loads = [start("-c", LOAD) for _ in range(arguments.load)]
        stack.callback(end, *loads)
        stack.enter_context(nedbus_process("serve", "--source", "sim:", "--connect", endpoint))
        for name in arguments.commands:
            replaced = {
                "FLIGHT": str(flight),
                "ROUTER": endpoint,
                "RECORDING": str(Path(folder) / "new.mcap"),
            }
            chosen = [
                moments.uniform(arguments.earliest, arguments.latest)
                for _ in range(arguments.count)
            ]
            measure(name, replaced, chosen)


def measure(name: str, replaced: dict[str, str], moments: list[float]) -> None:
    """Interrupt a command once at each moment [s after its start], and print the exit codes and the slowest end."""
    codes, slowest, failures = collections.Counter[int](), 0.0, 0
    for moment in moments:
        port, text = free_port(), COMMANDS[name]
        for old, new in (
            replaced | {"PORT": str(port), "ENDPOINT": f"tcp/127.0.0.1:{port}"}
        ).items():
            text = text.replace(old, new)
        code, seconds, errors = interrupt(text.split(), moment)
        codes[code], slowest = codes[code] + 1, max(slowest, seconds)
        # before that the interpreter prints a traceback
        started = "Traceback" not in errors or "nedbus/cli" in errors
        fault = f"{seconds:.1f} s" if seconds > LIMIT else ""
        fault = fault or (
            f"exit code {code}" if started and code not in CODES.get(name, {130, KILLED}) else ""
        )
        fault = fault or ("traceback" if started and "Traceback" in errors else "")
        path = Path(replaced["RECORDING"])
        if path.exists():
            fault = fault or read(path)
            path.unlink()
        if fault:
            failures += 1
            print(f"{name}: Ctrl-C {moment:.3f} s after the start: {fault}\n{errors}", flush=True)
    verdict = "MISSED" if failures else "met"
    shown = ", ".join(f"{count} x {code}" for code, count in sorted(codes.items()))
    print(
        f"{name}: {len(moments)} interrupts, exit codes {shown}; slowest end {slowest:.1f} s  {verdict}",
        flush=True,
    )


def interrupt(arguments: list[str], moment: float) -> tuple[int, float, str]:
    """Return the exit code, the seconds from the signal to the end, and stderr."""
    with tempfile.TemporaryFile("w+") as errors:
        environment = {**os.environ, "PYTHONFAULTHANDLER": "1"}
        process = subprocess.Popen(
            [sys.executable, "-m", "nedbus", *arguments],
            cwd=ROOT, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=errors, text=True,
        )  # fmt: skip
        time.sleep(moment)
        process.send_signal(signal.SIGINT)
        sent = time.monotonic()
        with suppress(subprocess.TimeoutExpired):
            process.wait(2 * LIMIT)
        seconds = time.monotonic() - sent
        if process.poll() is None:
            process.send_signal(signal.SIGABRT)  # faulthandler writes the stacks
            end(process, timeout=LIMIT)
        errors.seek(0)
        return process.returncode, seconds, errors.read()


def read(path: Path) -> str:
    """Return why a recording cannot be read, or ""."""
    try:
        nedbus.read(path)
    except NoDataError:
        return ""
    except nedbus.NedbusError as exc:
        return str(exc)
    return ""


if __name__ == "__main__":
    main()
