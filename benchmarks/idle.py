"""CPU time of a service with one simulated vehicle while nobody reads, and with one reader of everything.

The bars: below 10 % of a core and below 120 MB.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time

import psutil

import nedbus

ENDPOINT = "tcp/127.0.0.1:17462"


def measure(process: psutil.Process, seconds: float) -> str:
    """Return CPU in percent of a core over some seconds, and memory."""
    before, start = process.cpu_times(), time.monotonic()
    time.sleep(seconds)
    after, passed = process.cpu_times(), time.monotonic() - start
    used = after.user + after.system - before.user - before.system
    return f"{100 * used / passed:.1f} % of a core, {process.memory_info().rss / 1e6:.0f} MB"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0)
    seconds = parser.parse_args().seconds
    command = [sys.executable, "-m", "nedbus", "serve", "-l", ENDPOINT, "-s", "sim:"]
    service = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        with nedbus.connect(ENDPOINT, timeout=10):
            process = psutil.Process(service.pid)
            print(f"service, one simulated vehicle, no reader: {measure(process, seconds)} (bars: 10 %, 120 MB)")
        reader = subprocess.Popen([sys.executable, "-m", "nedbus", "echo", "-c", ENDPOINT], stdout=subprocess.DEVNULL)
        print(f"service, one simulated vehicle, one reader: {measure(process, seconds)}")
        reader.terminate()
        reader.wait(10)
    finally:
        service.terminate()
        service.wait(10)


if __name__ == "__main__":
    main()
