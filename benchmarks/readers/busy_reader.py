"""A reader that is busy with pure Python: python -m benchmarks.readers.busy_reader FORM SCRIPT ENDPOINT.

The reader prints "ready", and after a line on stdin and the last message prints its figures as JSON: ages of messages
in ms, from their timestamp until the script receives them.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import zenoh

import nedbus
from benchmarks.compare.case import TOPIC
from benchmarks.compare.zenoh_session import KEY, open_session
from benchmarks.processes import wait_for_quiet

QUIET = 1.0  # s without a message until the stream counts as ended
TIMEOUT = 5.0  # s after the last message was sent
PAUSE = 0.01  # s of computation between two reads

Counts = Callable[[], dict[str, int]]


@dataclass
class Ages:
    """Ages of messages [ns], time of the last one [s], and the computation steps of the script."""

    ages: list[int] = field(default_factory=list)
    last: float = 0.0
    steps: int = 0

    def add(self, stamp: int) -> None:
        """Record one message."""
        now = time.monotonic_ns()
        self.ages.append(now - stamp)
        self.last = now / 1e9

    def compute(self, seconds: float) -> None:
        """Keep the interpreter busy with pure Python."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            value = 1
            for number in range(200):
                value = value * 31 + number & 0xFFFFFF
            self.steps += 1

    def report(self, counts: dict[str, int], seconds: float) -> None:
        """Print the figures as JSON."""
        ages = sorted(self.ages) or [0]
        found = {f"p{part}": ages[len(ages) * part // 100] / 1e6 for part in (50, 99)}
        steps = self.steps / seconds
        print(
            json.dumps(
                {"received": len(self.ages), "max": ages[-1] / 1e6, "steps": steps} | found | counts
            )
        )


def main() -> None:
    """Read according to the arguments."""
    form, script, endpoint = sys.argv[1:4]
    stamps, counts = (
        open_nedbus(form, endpoint) if form in ("every", "latest") else open_raw(form, endpoint)
    )
    ages = Ages()
    print("ready", flush=True)
    threading.Thread(target=watch, args=(ages, counts), daemon=True).start()
    if script == "computes always":
        threading.Thread(target=read, args=(stamps, ages), daemon=True).start()
        ages.compute(float("inf"))
    read(stamps, ages, PAUSE if script == "computes between" else 0.0)


def read(stamps: Iterator[int], ages: Ages, pause: float = 0.0) -> None:
    """Receive messages, and compute between them."""
    for stamp in stamps:
        ages.add(stamp)
        if pause:
            ages.compute(pause)


def watch(ages: Ages, counts: Counts) -> None:
    """Print the report after the last message, or after a timeout."""
    start = time.monotonic()
    sys.stdin.readline()
    wait_for_quiet(lambda: ages.last, quiet=QUIET, timeout=TIMEOUT)
    ages.report(counts(), time.monotonic() - start)
    sys.stdout.flush()
    os._exit(0)


def open_nedbus(form: str, endpoint: str) -> tuple[Iterator[int], Counts]:
    """Subscribe with nedbus; `form` is the mode."""
    bus = nedbus.connect(endpoint)
    subscription = bus.subscribe(TOPIC, mode="every" if form == "every" else "latest")

    def counts() -> dict[str, int]:
        return {"lost": subscription.counts.lost, "dropped": subscription.counts.dropped}

    return (sample.message.timestamp for sample in subscription.rows()), counts


def open_raw(form: str, endpoint: str) -> tuple[Iterator[int], Counts]:
    """Subscribe with plain Zenoh, which counts nothing."""
    session = open_session(endpoint)
    channel: zenoh.handlers.FifoChannel[zenoh.Sample] | zenoh.handlers.RingChannel[zenoh.Sample]
    channel = (
        zenoh.handlers.FifoChannel(1024) if form == "raw fifo" else zenoh.handlers.RingChannel(1)
    )
    subscriber = session.declare_subscriber(KEY, channel)

    def stamps() -> Iterator[int]:
        for sample in subscriber:
            yield int.from_bytes(sample.payload.to_bytes()[:8], "big")
        session.close()

    return stamps(), dict


if __name__ == "__main__":
    main()
