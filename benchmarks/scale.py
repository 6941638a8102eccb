"""Many vehicles at 100 Hz with one reader of every message, and one vehicle with many readers.

Per row: messages received, sent and lost, and CPU time and memory of each process.
Target: no loss with 500 vehicles for a minute; the cost of a message does not grow with the number of vehicles.
`python -m benchmarks.scale --seconds 3` limits each row to 3 s.

`python -m benchmarks.scale --names 2100` instead opens and closes subscriptions and publishers of that many vehicles,
one after the other in one session, and prints the median time per opening of the first and the last 100 of them;
`zenoh` declares the same to Zenoh without nedbus. A session keeps each key that it has declared to its router.
Target: the last ones take at most 1.3 times as long as with `zenoh`, or 1.5 times as long as the first.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from .fleet import RATE
from .processes import HERE, Checkout, cpu_seconds, end, expect, memory_mb, resume, router, start

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

OPENING = """
import statistics, sys, time
way, endpoint, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
times = []
for number in range(count):
    start = time.perf_counter()
    close = OPEN[way](f"v{number}")
    times.append(1e6 * (time.perf_counter() - start))
    close()
print(round(statistics.median(times[:100])), round(statistics.median(times[-100:])), flush=True)
"""
NEDBUS = """
import sys
import nedbus
bus, vlp = nedbus.connect(sys.argv[2]), "vehicle_local_position"
OPEN = {
    "latest": lambda vehicle: bus.subscribe(vlp, vehicle=vehicle).close,
    "every": lambda vehicle: bus.subscribe(vlp, vehicle=vehicle, mode="every").close,
    "publisher": lambda vehicle: bus.publisher(vlp, vehicle=vehicle).close,
}
"""
ZENOH = """
import sys, time
import zenoh
from zenoh.ext import CacheConfig, HistoryConfig, MissDetectionConfig
from zenoh.handlers import FifoChannel, RingChannel
from benchmarks.compare.zenoh_session import open_session
session = open_session(sys.argv[2])
def closing(*opened):
    opened = [*opened]
    def close():
        while opened:
            if hasattr(each := opened.pop(), "undeclare"):
                each.undeclare()
    return close
def subscribe(vehicle):
    key, last = f"nedbus/{vehicle}/vehicle_local_position", HistoryConfig(max_samples=1)
    return zenoh.ext.declare_advanced_subscriber(session, key, RingChannel(16384), history=last)
def subscribe_every(vehicle):
    key = f"nedbus/{vehicle}/vehicle_local_position"
    return (
        subscribe(vehicle), session.declare_queryable(f"{key}/@ack", RingChannel(64)),
        session.info.declare_transport_events_listener(RingChannel(1), history=False),
        session.declare_subscriber(f"{key}/@adv/pub/**", RingChannel(16384)),
    )
def publish(vehicle):
    key, none = f"nedbus/{vehicle}/vehicle_local_position", MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None)
    probe = session.declare_publisher(f"nedbus/{vehicle}/*/@rate/*")
    opened = [
        session.declare_queryable(f"nedbus/{vehicle}/**", RingChannel(1000)),
        session.declare_queryable(f"nedbus/{vehicle}/@schema/*", RingChannel(1000)),
        probe, probe.declare_matching_listener(RingChannel(1)),
        [zenoh.ext.declare_advanced_publisher(session, key, cache=CacheConfig(100), sample_miss_detection=none)],
        session.liveliness().declare_token(key),
        session.liveliness().declare_token(f"nedbus/{vehicle}/@alive/1/vehicle_local_position"),
    ]
    replies, pause = session.liveliness().get(f"nedbus/{vehicle}/@alive", FifoChannel(10)), 0.0005
    while True:  # until the router has processed the declarations
        try:
            replies.try_recv()
        except zenoh.ZError:
            return opened
        time.sleep(pause)
        pause *= 1.25
OPEN = {
    "latest": lambda vehicle: closing(subscribe(vehicle)), "every": lambda vehicle: closing(*subscribe_every(vehicle)),
    "publisher": lambda vehicle: closing(*publish(vehicle)),
}
"""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seconds", type=int, default=0, help="default: 10, and 60 with 500 vehicles"
    )
    parser.add_argument("--names", type=int, help="measure the opening of this many names instead")
    parser.add_argument(
        "--vs", type=Path, help="a second checkout of nedbus, measured in the same run"
    )
    arguments = parser.parse_args()
    limit = arguments.seconds
    if arguments.names:
        measure_names(arguments.names, Checkout(arguments.vs) if arguments.vs else None)
        return
    print(
        "vehicles readers  seconds  received / sent       lost  CPU us/message: publisher router reader   MB: same"
    )
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


def measure_names(count: int, other: Checkout | None) -> None:
    """Print the time per opening [us] at the start and at the end, of Zenoh and of each checkout."""
    print("opened     by          first 100  last 100")
    for way in ("latest", "every", "publisher"):
        for name, checkout, code in (
            ("zenoh", HERE, ZENOH),
            ("nedbus", HERE, NEDBUS),
            ("other", other, NEDBUS),
        ):
            if checkout is not None:
                with router(checkout) as (_, endpoint):
                    process = checkout.start("-c", code + OPENING, way, endpoint, str(count))
                    first, last = expect(process).split()
                    end(process, timeout=5.0)
                print(f"{way:10} {name:10} {first:>9} us {last:>6} us", flush=True)


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
        used = [
            (late - early) / sent * 1e6
            for early, late in zip(before, cpu_seconds(*processes), strict=True)
        ]
        memory = [memory_mb(process) for process in processes]
        for reader in receiving:
            resume(reader)
        results = [json.loads(expect(reader)) for reader in receiving]
        end(*receiving, publisher)
    received, lost = (
        min(result["received"] for result in results),
        max(result["lost"] for result in results),
    )
    return (
        f"{vehicles:8} {readers:7} {seconds:8}  {received:8} / {sent:<8} {lost:8}"
        f"  {used[0]:23.1f} {used[1]:6.1f} {used[2]:6.1f}   {memory[0]:.0f} {memory[1]:.0f} {memory[2]:.0f}"
        f"   {way}, publisher at most {delay} s late"
    )


if __name__ == "__main__":
    main()
