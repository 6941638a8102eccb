"""Timing error of a replay at speed=1.

A service in another process replays a log of 20 s (--seconds) at 100 Hz; times are the publisher's timestamps.
Target: 99 % of the errors below 5 ms on an idle machine.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from pathlib import Path

from tests.flights.ulogs import write_log

import nedbus

from .compare.fields import FIELDS
from .processes import free_port, nedbus_process

PERIOD = 10_000  # us


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=int, default=20)
    count = parser.parse_args().seconds * 1_000_000 // PERIOD
    fields = {name: value for name, value in FIELDS.items() if name != "timestamp"}
    with tempfile.TemporaryDirectory() as folder:
        path = write_log(Path(folder) / "flight.ulg", range(0, count * PERIOD, PERIOD), **fields)
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        with (
            nedbus_process("serve", "-l", endpoint, "--until-done", "-s", f"ulog:{path}?wait=1"),
            nedbus.connect(endpoint, timeout=10) as bus,
            bus.subscribe(mode="every") as subscription,
        ):
            samples = [subscription.receive(10) for _ in range(count)]
    sent = [(sample.sent or 0) / 1e3 - sample.message.timestamp for sample in samples]
    start = min(sent)
    errors = sorted((moment - start) / 1e3 for moment in sent)
    print(
        f"pacing at speed=1: error of {count} messages: median {statistics.median(errors):.2f} ms,"
        f" p99 {errors[int(0.99 * count)]:.2f} ms, max {errors[-1]:.2f} ms (target: p99 below 5 ms)"
    )


if __name__ == "__main__":
    main()
