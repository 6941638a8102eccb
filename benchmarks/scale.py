"""Many vehicles at 100 Hz into one reader of every sample, and one vehicle into many readers.

Per row: messages received of those sent, what was lost, and CPU time and memory of each process.
The bar: 500 vehicles for a minute, nothing lost; the cost of a message does not grow with the vehicles.
`python -m benchmarks.scale --seconds 3` does each for 3 s.
"""

from __future__ import annotations

import argparse
import json
import time

from .fleet import RATE
from .processes import cpu_seconds, end, expect, memory_mb, router, start, tell

READER = """
import json, sys
import nedbus
way, endpoint = sys.argv[1:3]
with nedbus.connect(endpoint) as bus, bus.subscribe("vehicle_local_position", mode="every") as subscription:
    print("ready", flush=True)
    sums = {}
    import threading
    def report():
        sys.stdin.readline()
        counts = subscription.counts
        told = {"received": counts.received, "lost": counts.lost + counts.dropped, "vehicles": len(sums)}
        print(json.dumps(told), flush=True)
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=0, help="instead of 10, and of 60 with 500 vehicles")
    chosen = parser.parse_args().seconds
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
        print(measure(vehicles, readers, chosen or seconds, way), flush=True)


def measure(vehicles: int, readers: int, seconds: int, way: str) -> str:
    """Run one load and return a line about it."""
    with router() as (routing, endpoint):
        taking = [start("-c", READER, way, endpoint) for _ in range(readers)]
        for reader in taking:
            expect(reader)
        publisher = start("-m", "benchmarks.fleet", str(vehicles), str(seconds), endpoint)
        expect(publisher)
        time.sleep(1.0)
        processes = (publisher, routing, taking[0])
        before = cpu_seconds(*processes)
        tell(publisher)
        delay = expect(publisher)
        time.sleep(2.0)
        sent = vehicles * seconds * RATE
        used = [(late - early) / sent * 1e6 for early, late in zip(before, cpu_seconds(*processes), strict=True)]
        memory = [memory_mb(process) for process in processes]
        for reader in taking:
            tell(reader)
        told = [json.loads(expect(reader)) for reader in taking]
        end(*taking, publisher)
    received, lost = min(each["received"] for each in told), max(each["lost"] for each in told)
    return (
        f"{vehicles:8} {readers:7} {seconds:8}  {received:8} / {sent:<8} {lost:8}"
        f"  {used[0]:23.1f} {used[1]:6.1f} {used[2]:6.1f}   {memory[0]:.0f} {memory[1]:.0f} {memory[2]:.0f}"
        f"   {way}, publisher at most {delay} s late"
    )


if __name__ == "__main__":
    main()
