"""What a service with one simulated vehicle costs while nobody reads, and with one reader of everything.

The bars: below 10 % of a core and below 120 MB.
"""

from __future__ import annotations

import subprocess
import sys
import time

import psutil

import nedbus

ENDPOINT = "tcp/127.0.0.1:17462"
SECONDS = 15.0


def measure(process: psutil.Process) -> str:
    """Return CPU in percent of a core over some seconds, and memory."""
    before, start = process.cpu_times(), time.monotonic()
    time.sleep(SECONDS)
    after, seconds = process.cpu_times(), time.monotonic() - start
    used = after.user + after.system - before.user - before.system
    return f"{100 * used / seconds:.1f} % of a core, {process.memory_info().rss / 1e6:.0f} MB"


def main() -> None:
    """Measure and print."""
    command = [sys.executable, "-m", "nedbus", "serve", "-l", ENDPOINT, "-s", "sim:"]
    service = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        with nedbus.connect(ENDPOINT, timeout=10):
            process = psutil.Process(service.pid)
            print(f"service, one simulated vehicle, no reader: {measure(process)} (bars: 10 %, 120 MB)")
        reader = subprocess.Popen([sys.executable, "-m", "nedbus", "echo", "-c", ENDPOINT], stdout=subprocess.DEVNULL)
        print(f"service, one simulated vehicle, one reader: {measure(process)}")
        reader.terminate()
        reader.wait(10)
    finally:
        service.terminate()
        service.wait(10)


main()
