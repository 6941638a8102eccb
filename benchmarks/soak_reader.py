"""A reader of every message of all topics: python -m benchmarks.soak_reader ENDPOINT.

It prints "ready", reads until a line comes and nothing arrives any more, and prints what it got as JSON.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from contextlib import suppress
from typing import Final

import nedbus

QUIET: Final = 5.0  # s without a message after which nothing more comes


def main() -> None:
    """Read, and report."""
    told = threading.Event()

    def listen() -> None:
        sys.stdin.readline()
        told.set()

    threading.Thread(target=listen, daemon=True).start()
    with nedbus.connect(sys.argv[1]) as bus, bus.subscribe(nedbus.ANY, mode="every") as subscription:
        print("ready", flush=True)
        received = disordered = 0
        times: dict[nedbus.Address, int] = {}
        while True:
            sample = None
            with suppress(nedbus.NoDataError):
                sample = subscription.receive(QUIET)
            if sample is None:
                if told.is_set():
                    break
                continue
            received += 1
            time = sample.message.timestamp
            disordered += time <= times.get(sample.address, -1)
            times[sample.address] = time
        counts = subscription.counts
        found = {"received": received, "lost": counts.lost, "dropped": counts.dropped, "out of order": disordered}
        print(json.dumps(found), flush=True)
        os._exit(0)


if __name__ == "__main__":
    main()
