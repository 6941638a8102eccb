"""Many vehicles at 100 Hz with one reader of every message, and one vehicle with many readers.

Per row: messages received, sent and lost, and CPU time and memory of each process.
Target: no loss with 500 vehicles for a minute; the cost of a message does not grow with the number of vehicles.
`python -m benchmarks.scale --seconds 3` limits each row to 3 s.
"""

from __future__ import annotations

import argparse
import json
import time

from .fleet import RATE
from .processes import cpu_seconds, end, expect, memory_mb, resume, router, start

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
        result = {"received": counts.received, "lost": counts.lost + counts.dropped, "vehicles": len(sums)}
        print(json.dumps(result), flush=True)
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
    parser.add_argument("--seconds", type=int, default=0, help="default: 10, and 60 with 500 vehicles")
    limit = parser.parse_args().seconds
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
        print(measure(vehicles, readers, limit or seconds, way), flush=True)


def measure(vehicles: int, readers: int, seconds: int, way: str) -> str:
    """Run one load and return its row."""
    with router() as (routing, endpoint):
        receiving = [start("-c", READER, way, endpoint) for _ in range(readers)]
        for reader in receiving:
            expect(reader)
        publisher = start("-m", "benchmarks.fleet", str(vehicles), str(seconds), endpoint)
        expect(publisher)
        time.sleep(1.0)
        processes = (publisher, routing, receiving[0])
        before = cpu_seconds(*processes)
        resume(publisher)
        delay = expect(publisher)
        time.sleep(2.0)
        sent = vehicles * seconds * RATE
        used = [(late - early) / sent * 1e6 for early, late in zip(before, cpu_seconds(*processes), strict=True)]
        memory = [memory_mb(process) for process in processes]
        for reader in receiving:
            resume(reader)
        results = [json.loads(expect(reader)) for reader in receiving]
        end(*receiving, publisher)
    received, lost = min(each["received"] for each in results), max(each["lost"] for each in results)
    return (
        f"{vehicles:8} {readers:7} {seconds:8}  {received:8} / {sent:<8} {lost:8}"
        f"  {used[0]:23.1f} {used[1]:6.1f} {used[2]:6.1f}   {memory[0]:.0f} {memory[1]:.0f} {memory[2]:.0f}"
        f"   {way}, publisher at most {delay} s late"
    )


if __name__ == "__main__":
    main()
