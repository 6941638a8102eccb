"""Many vehicles at 100 Hz into one reader of every sample, and one vehicle into many readers.

Per row: messages received of those sent, what was lost, and CPU time and memory of each process.
The bar: 500 vehicles for a minute, nothing lost; the cost of a message does not grow with the vehicles.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time

import psutil

ENDPOINT = "tcp/127.0.0.1:17463"
RATE = 100  # Hz

PUBLISHER = """
import sys, time
import nedbus
from nedbus_msgs import encode_row
from benchmarks.forms.fields import FIELDS
vehicles, seconds, endpoint = int(sys.argv[1]), float(sys.argv[2]), sys.argv[3]
_, *rest = FIELDS.values()
with nedbus.connect(endpoint) as bus:
    publishers = [bus.publisher("vehicle_local_position", vehicle=f"v{number}") for number in range(vehicles)]
    print("ready", flush=True)
    sys.stdin.readline()
    start, late = time.monotonic(), 0.0
    for tick in range(int(seconds * 100)):
        wait = start + tick / 100 - time.monotonic()
        late = max(late, -wait)
        if wait > 0:
            time.sleep(wait)
        payload = encode_row((tick + 1, *rest))  # once: this process stands for as many hosts as there are vehicles
        for publisher in publishers:
            publisher._put(payload, FIELDS)
    print(f"{late:.3f}", flush=True)
    sys.stdin.readline()
"""

READER = """
import json, sys
import nedbus
from nedbus.errors import NoDataError
way, endpoint = sys.argv[1:3]
with nedbus.connect(endpoint) as bus, bus.subscribe("vehicle_local_position", mode="every") as subscription:
    print("ready", flush=True)
    sums = {}
    import threading
    def report():
        sys.stdin.readline()
        counts = subscription.counts
        print(json.dumps({"received": counts.received, "lost": counts.lost, "vehicles": len(sums)}), flush=True)
        subscription.close()
    threading.Thread(target=report, daemon=True).start()
    if way == "batches":
        for batch in subscription.batches():
            sums.update(dict.fromkeys(batch.addresses, batch.messages["x"].sum()))
    else:
        for sample in subscription.rows():
            sums[sample.address] = sample.message.x
"""


def main() -> None:
    """Measure and print."""
    print("vehicles readers  seconds  received / sent       lost  CPU us/message: publisher router reader   MB: same")
    for vehicles, readers, seconds, way in (
        (1, 1, 10, "rows"),
        (10, 1, 10, "rows"),
        (100, 1, 10, "rows"),
        (100, 1, 10, "batches"),
        (500, 1, 60, "batches"),
        (1, 10, 10, "rows"),
        (1, 50, 10, "rows"),
    ):
        print(measure(vehicles, readers, seconds, way), flush=True)


def measure(vehicles: int, readers: int, seconds: int, way: str) -> str:
    """Run one load and return a line about it."""
    router = start("-m", "nedbus", "router", "--listen", ENDPOINT)
    time.sleep(1.0)
    taking = [start("-c", READER, way, ENDPOINT) for _ in range(readers)]
    for reader in taking:
        expect(reader)
    publisher = start("-c", PUBLISHER, str(vehicles), str(seconds), ENDPOINT)
    expect(publisher)
    time.sleep(1.0)
    processes = [psutil.Process(process.pid) for process in (publisher, router, taking[0])]
    before = [sum(process.cpu_times()[:2]) for process in processes]
    tell(publisher)
    late = expect(publisher)
    time.sleep(2.0)
    sent = vehicles * seconds * RATE
    used = [(sum(process.cpu_times()[:2]) - each) / sent * 1e6 for process, each in zip(processes, before, strict=True)]
    memory = [process.memory_info().rss / 2**20 for process in processes]
    for reader in taking:
        tell(reader)
    told = [json.loads(expect(reader)) for reader in taking]
    for process in (*taking, publisher, router):
        process.kill()
        process.wait()
    received, lost = min(each["received"] for each in told), max(each["lost"] for each in told)
    return (
        f"{vehicles:8} {readers:7} {seconds:8}  {received:8} / {sent:<8} {lost:8}"
        f"  {used[0]:23.1f} {used[1]:6.1f} {used[2]:6.1f}   {memory[0]:.0f} {memory[1]:.0f} {memory[2]:.0f}"
        f"   {way}, publisher at most {late} s late"
    )


def start(*arguments: str) -> subprocess.Popen[str]:
    """Start a Python process that is told and asked by lines."""
    return subprocess.Popen(
        [sys.executable, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


def expect(process: subprocess.Popen[str]) -> str:
    """Return the next line that a process prints."""
    assert process.stdout is not None
    return process.stdout.readline().strip()


def tell(process: subprocess.Popen[str]) -> None:
    """Let a process go on."""
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()


if __name__ == "__main__":
    main()
