"""A reader in mode `every` that may be stuck: python -m benchmarks.readers.stuck_reader HABIT ENDPOINT VEHICLE...

HABIT is `reads`, `never` (does not read) or `slowly` (one message a second); each vehicle has a subscription and a
thread. The reader prints "ready", reads normally after the first line on stdin, and after the second line and the last
message prints its counts per vehicle as JSON.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from dataclasses import dataclass
from typing import Final

import nedbus
from benchmarks.compare.case import TOPIC
from benchmarks.processes import wait_for_quiet

QUIET: Final = 3.0  # s without a message until the stream counts as ended
TIMEOUT: Final = 60.0  # s; maximum wait for that end
PAUSE: Final = 1.0  # s between two messages of a slow reader


@dataclass
class Received:
    """Received messages of one vehicle; `gap`: longest time without a message [s]."""

    received: int = 0
    last: float = 0.0
    gap: float = 0.0
    stamp: int = 0
    in_order: bool = True

    def add(self, stamp: int) -> None:
        """Record one message."""
        now = time.monotonic()
        if self.received:
            self.gap = max(self.gap, now - self.last)
        self.in_order &= stamp > self.stamp
        self.received, self.last, self.stamp = self.received + 1, now, stamp


def main() -> None:
    """Read according to the arguments."""
    habit, endpoint, *vehicles = sys.argv[1:]
    reads_on = threading.Event()
    if habit == "reads":
        reads_on.set()
    with nedbus.connect(endpoint) as bus:
        subscriptions = {
            vehicle: bus.subscribe(TOPIC, vehicle=vehicle, mode="every") for vehicle in vehicles
        }
        got = {vehicle: Received() for vehicle in vehicles}
        for vehicle, subscription in subscriptions.items():
            threading.Thread(
                target=read, args=(subscription, got[vehicle], habit, reads_on), daemon=True
            ).start()
        print("ready", flush=True)
        sys.stdin.readline()
        reads_on.set()
        sys.stdin.readline()
        wait_for_quiet(
            lambda: max(reader.last for reader in got.values()), quiet=QUIET, timeout=TIMEOUT
        )
        report = {
            vehicle: {
                "received": got[vehicle].received,
                "lost": subscription.counts.lost,
                "dropped": subscription.counts.dropped,
                "in order": got[vehicle].in_order,
                "gap": got[vehicle].gap,
            }
            for vehicle, subscription in subscriptions.items()
        }
        print(json.dumps(report), flush=True)
        os._exit(0)


def read(
    subscription: nedbus.Subscription, got: Received, habit: str, reads_on: threading.Event
) -> None:
    """Read one subscription."""
    if habit == "never":
        reads_on.wait()
    for sample in subscription.rows():
        got.add(sample.message.timestamp)
        if not reads_on.is_set():
            reads_on.wait(PAUSE)


if __name__ == "__main__":
    main()
