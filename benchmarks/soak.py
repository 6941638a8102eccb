"""Soak test with short-lived vehicles, eight at a time: memory of all processes, /metrics, time to open a publisher.

`python -m benchmarks.soak` runs at full speed, `--names 1800 --interval 2` for an hour.
Targets from the first fifth of the vehicles to the last: memory grows at most 10 % more than that of `raw`, a reader
with eclipse-zenoh alone; the time to open a publisher is constant; /metrics takes under 50 ms at the end.
The publisher is also the router, like a service with many vehicles, and is restarted after 1,000 vehicles: Zenoh 1.10
keeps every key declared over a link as long as the link lasts, and each declaration takes longer than the last.
"""

from __future__ import annotations

import argparse
import json
import threading
import time
import urllib.request
from collections import deque
from functools import partial
from pathlib import Path
from typing import Final

from .processes import ROOT, TIMEOUT, Checkout, Process, end, expect, free_port, memory_mb, resume

STAGES: Final = 5
PUBLISHER: Final = """
import collections, json, os, statistics, sys, time
import nedbus
from nedbus.client import PublisherRegistry, QueryServer
from nedbus.transport import open_router
from nedbus_msgs import Address
endpoint, count, interval = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
types = {"vehicle_local_position": nedbus.VehicleLocalPosition, "vehicle_status": nedbus.VehicleStatus}
messages = {topic: model(timestamp=1) for topic, model in types.items()}
here, name, opening = collections.deque(), 0, collections.deque(maxlen=500)
def start(readers):
    session = open_router(listen=(endpoint,))
    while len(session.info.transports()) < readers:
        time.sleep(0.1)
    queries = QueryServer(session)
    return session, queries, PublisherRegistry(session, queries, prefix="nedbus", is_client=False)
session, queries, registry = start(0)
print("ready", flush=True)
while os.read(0, 1):
    begin = time.monotonic()
    for number in range(1, count + 1):
        name, opens = name + 1, time.perf_counter()
        here.append([registry.publisher(Address(str(name), topic)) for topic in messages])
        opening.append(500 * (time.perf_counter() - opens))
        for publisher, message in zip(here[-1], messages.values()):
            publisher.publish(message)
        while len(here) > (0 if name % 1000 == 0 else 8):
            for publisher in here.popleft():
                publisher.close()
        if name % 1000 == 0:
            readers = len(session.info.transports())
            queries.close(), registry.heartbeats.close(), session.close()
            session, queries, registry = start(readers)
        time.sleep(max(0.0, begin + number * interval - time.monotonic()) if interval else 0.0)
    print(json.dumps([statistics.median(opening), time.monotonic() - begin]), flush=True)
"""
READER: Final = """
import sys, nedbus
with nedbus.connect(sys.argv[1]) as bus, bus.subscribe("*", mode="every") as subscription:
    bus.vehicles()  # subscribes to the liveliness tokens, like raw
    print("ready", flush=True)
    for sample in subscription:
        pass
"""
RAW: Final = """
import sys, zenoh
from nedbus.transport import open_client
from nedbus_msgs import Selection
session, ring = open_client([sys.argv[1]], timeout=10.0), zenoh.handlers.RingChannel(16384)
history = zenoh.ext.HistoryConfig(max_samples=1)
subscriber = zenoh.ext.declare_advanced_subscriber(session, "nedbus/**", ring, history=history)
alive = session.liveliness().declare_subscriber(Selection().alive_key_exprs(prefix="nedbus")[0], ring, history=True)
print("ready", flush=True)
while subscriber.handler.recv():
    pass
"""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--names", type=int, default=50_000, help="number of vehicles")
    parser.add_argument(
        "--interval", type=float, default=0.0, help="interval between two vehicles [s]"
    )
    parser.add_argument(
        "--checkout", type=Path, default=ROOT, help="checkout to measure (default: this one)"
    )
    arguments = parser.parse_args()
    checkout, stage = Checkout(arguments.checkout), arguments.names // STAGES
    pages = {name: f"127.0.0.1:{free_port()}" for name in ("service", "export", "web")}
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    publisher = checkout.start("-c", PUBLISHER, endpoint, str(stage), str(arguments.interval))
    expect(publisher)
    run = partial(checkout.start, "-m", "nedbus")
    processes = {
        "service": run("serve", "-c", endpoint, "--http", pages["service"], "-s", "px4-zenoh:"),
        "export": run("export", "-c", endpoint, "--http", pages["export"]),
        "web": run("web", "-c", endpoint, "--http", pages["web"]),
        "events": run("events", "-c", endpoint),
        "reader": checkout.start("-c", READER, endpoint),
        "raw": checkout.start("-c", RAW, endpoint),
        "publisher": publisher,
    }
    try:
        expect(processes["reader"])
        expect(processes["raw"])
        threading.Thread(target=deque, args=(processes["events"].stdout, 0), daemon=True).start()
        measure(processes, pages, stage, TIMEOUT + stage * max(1.0, 2 * arguments.interval))
    finally:
        end(*processes.values())


def measure(
    processes: dict[str, Process], pages: dict[str, str], stage: int, timeout: float
) -> None:
    """Run all stages, print the state after each, and the growth from the first to the last."""
    print("vehicles    per s  open ms  MB: " + " ".join(f"{name:>9}" for name in processes))
    stages = []
    for number in range(1, STAGES + 1):
        resume(processes["publisher"])
        opening, seconds = json.loads(expect(processes["publisher"], timeout))
        time.sleep(3.0)
        stages.append([memory_mb(process) for process in processes.values()])
        memory = " ".join(f"{megabytes:9.1f}" for megabytes in stages[-1])
        scrapes = "; ".join(f"{name} {scrape(pages[name])}" for name in ("service", "export"))
        print(
            f"{number * stage:8} {stage / seconds:8.1f} {opening:8.2f}      {memory}   {scrapes}",
            flush=True,
        )
    growth = dict(
        zip(
            processes,
            (late - early for early, late in zip(stages[0], stages[-1], strict=True)),
            strict=True,
        )
    )
    for name, first in zip(processes, stages[0], strict=True):
        kilobytes, beyond = (
            1024 * growth[name] / stage / (STAGES - 1),
            (growth[name] - growth["raw"]) / first,
        )
        verdict = "" if name in {"raw", "publisher"} else "met" if beyond <= 0.1 else "MISSED: 10 %"
        print(f"{name:10} {kilobytes:8.2f} kB per vehicle, {beyond:.0%} more than raw  {verdict}")


def scrape(address: str) -> str:
    """Return size and response time of /metrics."""
    begin = time.perf_counter()
    with urllib.request.urlopen(f"http://{address}/metrics", timeout=TIMEOUT) as answer:
        return f"{len(answer.read()) / 1e3:.0f} kB in {1e3 * (time.perf_counter() - begin):.0f} ms"


if __name__ == "__main__":
    main()
