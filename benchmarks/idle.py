"""CPU time, wake-ups and threads of idle processes: python -m benchmarks.idle [--vs CHECKOUT].

Targets: a service with one simulated vehicle and no reader: below 10 % of a core and below 120 MB;
100 buses with a publisher at 1 Hz each: at most 4 % of a core, 400 context switches a second, 5 Python threads, and a
median of 50 ms for `latest()`;
a service with nothing to publish, and an idle subscription: at most 25 wake-ups a second each.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any, Final

import psutil
from tests.flights.ulogs import write_log

import nedbus

from . import processes
from .processes import HERE, Checkout, Process, expect

NAMES: Final = """
import json, os, threading
def resume():
    while os.read(0, 1):
        print(json.dumps({thread.native_id: thread.name for thread in threading.enumerate()}), flush=True)
threading.Thread(target=resume, name="benchmark", daemon=True).start()
"""  # print the names of the Python threads for each line on stdin: Linux knows only Zenoh's thread names
BUSES: Final = """
import sys, time
import nedbus
endpoint, count, name = sys.argv[1], int(sys.argv[2]), sys.argv[3]
buses = [nedbus.connect(endpoint, timeout=30) for _ in range(count)]
publishers = [bus.publisher("vehicle_local_position", vehicle=f"{name}{n}") for n, bus in enumerate(buses)]
start = time.monotonic()
print("ready", flush=True)
for second in range(1, 1_000_000):
    message = nedbus.VehicleLocalPosition(timestamp=second)
    for publisher in publishers:
        publisher.publish(message)
    time.sleep(max(0.0, start + second - time.monotonic()))
"""
WAITING: Final = """
import sys
import nedbus
with nedbus.connect(sys.argv[1]) as bus, bus.subscribe() as subscription:
    print("ready", flush=True)
    next(iter(subscription))
"""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument(
        "--vs", type=Path, help="a second checkout of nedbus, measured in the same run"
    )
    arguments = parser.parse_args()
    for checkout in (HERE, Checkout(arguments.vs)) if arguments.vs else (HERE,):
        print(f"\n{checkout.folder}")
        measure_idle(checkout, arguments.seconds)


def measure_idle(checkout: Checkout, seconds: float) -> None:
    """Measure services without readers, an idle subscription, and many buses."""
    with tempfile.TemporaryDirectory() as folder:
        ended = f"ulog:{write_log(Path(folder) / 'flight.ulg', range(0, 100_000, 10_000), x=1.0)}"
        for source, name in (
            ("sim:", "one simulated vehicle"),
            (ended, "ended replay"),
            ("px4-zenoh:", "no PX4 yet"),
        ):
            endpoint = f"tcp/127.0.0.1:{processes.free_port()}"
            arguments = ("serve", "-l", endpoint, "-s", source)
            with processes.nedbus_process(*arguments, checkout=checkout, setup=NAMES) as service:
                nedbus.connect(endpoint, timeout=10).close()
                print(f"service, {name}: {measure(service, seconds)}", flush=True)
    with processes.router(checkout) as (_, endpoint), nedbus.connect(endpoint) as bus:
        waiting = checkout.start("-c", NAMES + WAITING, endpoint)
        expect(waiting)
        print(f"one idle subscription: {measure(waiting, seconds)}", flush=True)
        processes.end(waiting)
        process, times = checkout.start("-c", NAMES + BUSES, endpoint, "100", "v"), []
        expect(process)
        print(f"100 buses with a publisher at 1 Hz each: {measure(process, seconds)}")
        for number in range(20):
            begin = time.perf_counter()
            assert bus.latest(vehicle=f"v{number}"), "latest() found nothing"
            times.append(1e3 * (time.perf_counter() - begin))
            time.sleep(0.37)  # not a multiple of any thread's period
        processes.end(process)
        print(
            f"    latest(): {statistics.median(times):.1f} ms, at most {max(times):.1f} ms",
            flush=True,
        )


def measure(process: Process, seconds: float) -> str:
    """Measure for `seconds`: CPU in percent of a core, memory, threads, and wake-ups per second and thread."""
    time.sleep(2.0)  # until the work at startup has ended
    (used,), before, start = processes.cpu_seconds(process), switches(process), time.monotonic()
    time.sleep(seconds)
    (used_after,), after, passed = (
        processes.cpu_seconds(process),
        switches(process),
        time.monotonic() - start,
    )
    processes.resume(process)
    python = {
        int(thread): name
        for thread, name in json.loads(expect(process)).items()
        if name != "benchmark"
    }
    threads, wakes, forced = Counter[str](), Counter[str](), 0
    for thread in before.keys() & after.keys():
        name = python.get(thread) or f"{psutil.Process(thread).name()} (not Python)"
        threads[name] += 1
        wakes[name] += after[thread].voluntary - before[thread].voluntary
        forced += after[thread].involuntary - before[thread].involuntary
    lines = [
        f"\n    {count / passed:8.1f} a second: {threads[name]} {name}"
        for name, count in wakes.most_common(9)
    ]
    return (
        f"{100 * (used_after - used) / passed:.1f} % of a core, {processes.memory_mb(process):.0f} MB,"
        f" {(wakes.total() + forced) / passed:.0f} context switches a second, {wakes.total() / passed:.1f} of them"
        f" wake-ups, {len(python)} Python threads{''.join(lines)}"
    )


def switches(process: Process) -> dict[int, Any]:
    """Return the context switches of each thread so far; voluntary switches are wake-ups."""
    return {
        thread.id: psutil.Process(thread.id).num_ctx_switches()
        for thread in psutil.Process(process.pid).threads()
    }


if __name__ == "__main__":
    main()
