"""CPU time of a service that sends a position into a vehicle, and the delay from the publisher to the link.

A recorded flight of a real PX4 (SITL) is played in real time, with its log stream, to two services at once: one without
`position=`, and one with it. A script publishes a position at 50 Hz to both.
On a busy machine all numbers vary: compare runs in which no position is lost on its way.
Targets: delay p50 at most 3 ms and p99 at most 15 ms; at most 1.15 of the CPU time of the service without.
"""

from __future__ import annotations

import argparse
import json
import time
from contextlib import ExitStack
from typing import Any, Final

from tests.peers.px4_log_stream import Px4LogStream, Recording, read_recording

from benchmarks.processes import cpu_seconds, end, expect, free_port, nedbus_process, resume, start

from .stream import FLIGHT

SCRIPT: Final = """
import json, sys, threading, time
import nedbus
sent, stop = [], threading.Event()
with nedbus.connect(sys.argv[1], timeout=30) as bus:
    publisher = bus.publisher("vehicle_visual_odometry", vehicle="mocap", source="mocap")
    print("ready", flush=True)
    threading.Thread(target=lambda: (sys.stdin.readline(), stop.set()), daemon=True).start()
    while not stop.wait(0.02):
        sent.append(time.monotonic())
        stamp = int(1e6 * sent[-1])
        pose = {"pose_frame": 1, "position": (len(sent) / 1000, 0.0, 0.0), "q": (1.0, 0.0, 0.0, 0.0)}
        publisher.publish({"timestamp": stamp, "timestamp_sample": stamp, **pose})
print(json.dumps(sent), flush=True)
"""
POSITION: Final = "&position=mocap/vehicle_visual_odometry"
HEADER: Final = 4.0  # s


class Setup:
    """A service with a vehicle, until the ExitStack closes; `odometry`: arrival on the link, by number."""

    def __init__(self, recording: Recording, options: str, closing: ExitStack) -> None:
        self.port, self.endpoint = free_port(), f"tcp/127.0.0.1:{free_port()}"
        source = f"mavlink:udpin:127.0.0.1:{self.port}?log=1{options}"
        self.service = closing.enter_context(
            nedbus_process("serve", "-l", self.endpoint, "-s", source)
        )
        self.odometry: dict[int, float] = {}
        closing.enter_context(Px4LogStream(recording, self.port, on_message=self._on_message))

    def _on_message(self, message: Any) -> None:
        if message.get_type() == "ODOMETRY":
            self.odometry[round(1000 * message.x)] = time.monotonic()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=15.0)
    print(measure(parser.parse_args().seconds), flush=True)


def measure(seconds: float) -> str:
    """Run both services and return the result."""
    recording = read_recording(FLIGHT)
    with ExitStack() as closing:
        setups = [Setup(recording, options, closing) for options in ("", POSITION)]
        scripts = [start("-c", SCRIPT, setup.endpoint) for setup in setups]
        for script in scripts:
            closing.callback(end, script, timeout=2.0)
            expect(script)
        time.sleep(HEADER)
        services = [setup.service for setup in setups]
        before, began = cpu_seconds(*services), time.monotonic()
        time.sleep(seconds)
        after, passed = cpu_seconds(*services), time.monotonic() - began
        for script in scripts:
            resume(script)
        published = json.loads(expect(scripts[1]))
    without, sending = [(late - early) / passed for early, late in zip(before, after, strict=True)]
    arrivals = setups[1].odometry
    measured = {number: at for number, at in enumerate(published, 1) if at > began}
    delays = sorted(
        1e3 * (arrivals[number] - at) for number, at in measured.items() if number in arrivals
    )
    return (
        f"CPU of serve: {without:.1%} without position=, {sending:.1%} with it, ratio {sending / without:.2f};"
        f" {len(delays)} of {len(measured)} positions: delay p50 {delays[len(delays) // 2]:.1f} ms,"
        f" p99 {delays[int(0.99 * len(delays))]:.1f} ms, max {delays[-1]:.1f} ms"
    )


if __name__ == "__main__":
    main()
