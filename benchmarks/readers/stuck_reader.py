"""A reader of every message that may be stuck: python -m benchmarks.readers.stuck_reader HABIT ENDPOINT VEHICLE...

HABIT is `reads`, `never` (does not read) or `slowly` (one message a second); each vehicle has a subscription and a
thread of its own.
It prints "ready", reads on from the first line on, and after the second, once nothing more comes, prints for each
vehicle what it got, as JSON.
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

QUIET: Final = 3.0  # s without a message after which nothing more comes
PATIENCE: Final = 60.0  # s for it
PAUSE: Final = 1.0  # s between two messages of a reader that is slow


@dataclass
class Got:
    """Messages of one vehicle: `gap` is the longest time without a message, in s."""

    received: int = 0
    last: float = 0.0
    gap: float = 0.0
    stamp: int = 0
    in_order: bool = True

    def take(self, stamp: int) -> None:
        """Note one message."""
        now = time.monotonic()
        if self.received:
            self.gap = max(self.gap, now - self.last)
        self.in_order &= stamp > self.stamp
        self.received, self.last, self.stamp = self.received + 1, now, stamp


def main() -> None:
    """Read as the arguments say."""
    habit, endpoint, *vehicles = sys.argv[1:]
    reads_on = threading.Event()
    if habit == "reads":
        reads_on.set()
    with nedbus.connect(endpoint) as bus:
        subscriptions = {vehicle: bus.subscribe(TOPIC, vehicle=vehicle, mode="every") for vehicle in vehicles}
        got = {vehicle: Got() for vehicle in vehicles}
        for vehicle, subscription in subscriptions.items():
            threading.Thread(target=read, args=(subscription, got[vehicle], habit, reads_on), daemon=True).start()
        print("ready", flush=True)
        sys.stdin.readline()
        reads_on.set()
        sys.stdin.readline()
        wait_for_quiet(lambda: max(each.last for each in got.values()), quiet=QUIET, patience=PATIENCE)
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


def read(subscription: nedbus.Subscription, got: Got, habit: str, reads_on: threading.Event) -> None:
    """Read one subscription."""
    if habit == "never":
        reads_on.wait()
    for sample in subscription.rows():
        got.take(sample.message.timestamp)
        if not reads_on.is_set():
            reads_on.wait(PAUSE)


if __name__ == "__main__":
    main()
