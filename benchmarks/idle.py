"""CPU time of a service with one simulated vehicle while nobody reads, and with one reader of everything.

The bars: below 10 % of a core and below 120 MB.
"""

from __future__ import annotations

import argparse
import threading
import time
from collections import deque

import nedbus

from .processes import Process, cpu_seconds, free_port, memory_mb, nedbus_process


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0)
    seconds = parser.parse_args().seconds
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with nedbus_process("serve", "-l", endpoint, "-s", "sim:") as service:
        with nedbus.connect(endpoint, timeout=10):
            print(f"service, one simulated vehicle, no reader: {measure(service, seconds)} (bars: 10 %, 120 MB)")
        with nedbus.connect(endpoint) as bus, bus.subscribe() as subscription:
            threading.Thread(target=deque, args=(subscription, 0), daemon=True).start()  # reads all, keeps none
            print(f"service, one simulated vehicle, one reader: {measure(service, seconds)}")


def measure(process: Process, seconds: float) -> str:
    """Return CPU in percent of a core over some seconds, and memory."""
    (before,), start = cpu_seconds(process), time.monotonic()
    time.sleep(seconds)
    (after,), passed = cpu_seconds(process), time.monotonic() - start
    return f"{100 * (after - before) / passed:.1f} % of a core, {memory_mb(process):.0f} MB"


if __name__ == "__main__":
    main()
