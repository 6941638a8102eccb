"""CPU time of a realistic load, compared with raw Zenoh: 10 vehicles, all position topics at PX4's rates, one reader.

The load is 2,040 messages a second. The publisher validates every message; the reader receives validated messages.
"""

from __future__ import annotations

import argparse
import time

from .processes import cpu_seconds, end, expect, resume, router, start

VEHICLES = 10

PLAN = """
import sys, time
from benchmarks.compare.fields import PROVIDED
vehicles, seconds, endpoint = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
STREAMS = {"vehicle_local_position": 1, "vehicle_local_position_groundtruth": 2, "external_ins_local_position": 2,
           "estimator_local_position/0": 50, "estimator_local_position/1": 50}  # every how many ticks of 10 ms
def play(send):
    print("ready", flush=True)
    sys.stdin.readline()
    start = time.monotonic()
    for tick in range(seconds * 100):
        wait = start + tick / 100 - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        for vehicle in range(vehicles):
            for stream, every in STREAMS.items():
                if tick % every == 0:
                    send(vehicle, stream, tick + 1)
    print("done", flush=True)
    sys.stdin.readline()
"""
RAW_PUBLISHER = """
from benchmarks.compare.zenoh_session import open_session
session = open_session(endpoint)
publishers = {(v, s): session.declare_publisher(f"raw/{v}/{s}") for v in range(vehicles) for s in STREAMS}
payload = bytes(244)
play(lambda vehicle, stream, stamp: publishers[vehicle, stream].put(payload))
session.close()
"""
RAW_READER = """
import sys, zenoh
from benchmarks.compare.zenoh_session import open_session
session = open_session(sys.argv[1])
subscriber = session.declare_subscriber("raw/**", zenoh.handlers.FifoChannel(1024))
print("ready", flush=True)
for sample in subscriber:
    sample.payload.to_bytes()
"""
PUBLISHER = """
import nedbus
with nedbus.connect(endpoint) as bus:
    publishers = {}
    for v in range(vehicles):
        for s in STREAMS:
            topic, _, instance = s.partition("/")
            publishers[v, s] = bus.publisher(topic, vehicle=str(v), instance=int(instance) if instance else None)
    play(lambda vehicle, stream, stamp: publishers[vehicle, stream].publish({**PROVIDED, "timestamp": stamp}))
"""
READER = """
import sys, nedbus
with nedbus.connect(sys.argv[1]) as bus, bus.subscribe() as subscription:
    print("ready", flush=True)
    for sample in subscription:
        sample.message.x
"""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=int, default=20)
    seconds = parser.parse_args().seconds
    print(f"{VEHICLES} vehicles, four topics, {seconds} s      CPU: publisher  router  reader")
    raw = measure("raw Zenoh", PLAN + RAW_PUBLISHER, RAW_READER, seconds)
    ours = measure("nedbus", PLAN + PUBLISHER, READER, seconds)
    ratios = [one / other for one, other in zip(ours, raw, strict=True)]
    print(
        f"{'nedbus / raw':40} {ratios[0]:10.2f} {ratios[1]:7.2f} {ratios[2]:7.2f}, all {sum(ours) / sum(raw):.2f}"
    )


def measure(name: str, publish: str, read: str, seconds: int) -> list[float]:
    """Return the CPU time of publisher, router and reader, as fractions of a core."""
    with router() as (routing, endpoint):
        reader = start("-c", read, endpoint)
        expect(reader)
        publisher = start("-c", publish, str(VEHICLES), str(seconds), endpoint)
        expect(publisher)
        time.sleep(1.0)
        before = cpu_seconds(publisher, routing, reader)
        resume(publisher)
        expect(publisher)
        after = cpu_seconds(publisher, routing, reader)
        end(reader, publisher)
    used = [(late - early) / seconds for early, late in zip(before, after, strict=True)]
    print(f"{name:40} {used[0]:10.1%} {used[1]:7.1%} {used[2]:7.1%}", flush=True)
    return used


if __name__ == "__main__":
    main()
