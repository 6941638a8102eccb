"""Stress test for deadlocks and stalls: python -m tests.stress --seconds 600.

One thread opens and closes publishers, while others publish, call `vehicles()` and `latest()`, and subscribe, some with
`max_rate`. The router is killed and restarted, and other processes load the processor. A thread ticks every 50 ms, and
so does an idle control process, which on a shared machine may itself be late by seconds.
Pass criteria: no tick is delayed by over a second more than the control's maximum, and the process ends.

When no tick arrives for a second, faulthandler writes the stacks of all threads to stderr.
"""

from __future__ import annotations

import argparse
import faulthandler
import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Final

import nedbus
from nedbus import NedbusError
from nedbus.transport import open_router, token_keys
from nedbus_msgs import Selection

TICK: Final = 0.05  # s
GRACE: Final = 60.0  # s; timeout for the process to end
VEHICLES: Final = 8


def main() -> None:
    """Run for `--seconds`, print the counts, and exit with 1 after a stall."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument(
        "--restart", type=float, default=20.0, help="interval between kills of the router [s]"
    )
    parser.add_argument("--busy", type=int, default=2, help="number of busy processes")
    parser.add_argument("--limit", type=float, default=1.0, help="maximum delay of a tick [s]")
    parser.add_argument("--port", type=int, default=17_447)
    parser.add_argument("--part", choices=["router", "control", "stress"], help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.part == "router":
        with open_router(listen=(f"tcp/127.0.0.1:{arguments.port}",)):
            signal.pause()
    elif arguments.part == "control":
        json.dump(_tick(arguments.seconds, dump_stacks=False), sys.stdout)
    elif arguments.part == "stress":
        json.dump(_stress(f"tcp/127.0.0.1:{arguments.port}", arguments.seconds), sys.stdout)
    else:
        found = measure(arguments.seconds, arguments.restart, arguments.busy, arguments.port)
        sys.stdout.write(json.dumps(found) + "\n")
        limit = arguments.limit + found["maximum tick delay of control"]
        sys.exit(found.get("maximum tick delay", float("inf")) >= limit)


def measure(seconds: float, restart: float, busy_count: int, port: int) -> dict[str, float]:
    """Run the process with a router that is killed and restarted; return its counts and the maximum tick delays [s].

    If the process does not end, its thread stacks are printed, and only the result of the control is returned.
    """
    busy = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"], text=True)
        for _ in range(busy_count)
    ]
    router = _start("router", port)
    control = _start("control", port, "--seconds", str(seconds), stdout=subprocess.PIPE)
    stress = _start("stress", port, "--seconds", str(seconds), stdout=subprocess.PIPE)
    deadline, next_restart = time.monotonic() + seconds + GRACE, time.monotonic() + restart
    try:
        while stress.poll() is None and time.monotonic() < deadline:
            with suppress(subprocess.TimeoutExpired):
                stress.wait(0.1)
            if not _listens(port):
                next_restart = time.monotonic() + restart
            elif time.monotonic() >= next_restart:
                _kill(router)
                router = _start("router", port)
        if stress.poll() is None:
            stress.send_signal(signal.SIGABRT)  # Python writes the stacks of all threads
        with suppress(subprocess.TimeoutExpired):
            stress.wait(5.0)
        counts = stress.communicate()[0] if stress.returncode == 0 else ""
        late = control.communicate(timeout=GRACE)[0]
    finally:
        _kill(stress, control, router, *busy)
    return {
        **json.loads(counts or "{}"),
        "maximum tick delay of control": round(json.loads(late), 3),
    }


def _listens(port: int) -> bool:
    with suppress(OSError):
        socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
        return True
    return False


def _start(
    part: str, port: int, *arguments: str, stdout: int | None = None
) -> subprocess.Popen[str]:
    command = [
        sys.executable,
        "-X",
        "faulthandler",
        "-m",
        "tests.stress",
        "--part",
        part,
        "--port",
        str(port),
    ]
    return subprocess.Popen([*command, *arguments], stdout=stdout, text=True)


def _kill(*processes: subprocess.Popen[str]) -> None:
    for process in processes:
        process.kill()
        process.wait()


def _stress(endpoint: str, seconds: float) -> dict[str, float]:
    counts: Counter[str] = Counter()
    stop = threading.Event()
    with nedbus.connect(endpoint, timeout=30.0) as bus:

        def repeat(what: str, action: Callable[[], object]) -> None:
            while not stop.is_set():
                with suppress(NedbusError):
                    action()
                    counts[what] += 1

        publishers = [
            bus.publisher("vehicle_local_position", vehicle=f"p{number}")
            for number in range(VEHICLES)
        ]
        message = nedbus.VehicleLocalPosition(timestamp=1)

        def put() -> None:
            for publisher in publishers:
                publisher.publish(message)
            stop.wait(0.01)

        def open_and_close() -> None:
            with bus.publisher(
                "vehicle_local_position", vehicle=f"c{counts['closed'] % VEHICLES}"
            ) as publisher:
                publisher.publish(message)

        def receive_some(mode: nedbus.Mode = "latest", max_rate: float | None = None) -> None:
            with bus.subscribe(vehicle="*", mode=mode, max_rate=max_rate) as samples:
                for _ in range(20):
                    samples.receive(timeout=0.5)

        actions: dict[str, Callable[[], object]] = {
            "closed": open_and_close,
            "put": put,
            "vehicles": lambda: token_keys(
                bus._session, Selection().alive_key_exprs(prefix=bus.prefix)[0], timeout=1.0
            ),
            "followed": lambda: (bus.vehicles(timeout=1.0), stop.wait(0.01)),
            "latest": lambda: bus.latest(timeout=1.0),
            "subscribed": receive_some,
            "every": lambda: receive_some("every"),
            "downsampled": lambda: receive_some(max_rate=5.0),
        }
        threads = [
            threading.Thread(target=repeat, args=each, name=each[0], daemon=True)
            for each in actions.items()
        ]
        for thread in threads:
            thread.start()
        max_delay = _tick(seconds, dump_stacks=True)
        stop.set()
        for thread in threads:
            thread.join(GRACE / 2)
            counts["threads that did not end"] += thread.is_alive()
    return {**counts, "maximum tick delay": round(max_delay, 3)}


def _tick(seconds: float, *, dump_stacks: bool) -> float:
    """Tick for `seconds` and return the maximum delay of a tick [s]; `dump_stacks`: on a late tick."""
    end, max_delay, last = time.monotonic() + seconds, 0.0, time.monotonic()
    while last < end:
        if dump_stacks:
            faulthandler.dump_traceback_later(1.0 + TICK, exit=False)
        time.sleep(TICK)
        now = time.monotonic()
        max_delay, last = max(max_delay, now - last - TICK), now
    faulthandler.cancel_dump_traceback_later()
    return max_delay


if __name__ == "__main__":
    main()
