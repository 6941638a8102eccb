"""Record a fleet, 200 vehicles at 100 Hz into one file, for a number of seconds: loss, memory, CPU, bytes.

The bar: 20,000 messages a second, nothing lost, and flat memory for 10 minutes: `python -m benchmarks.record 600`.
The values have noise, so that the file is not compressed better than that of a real flight.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
from mcap.reader import make_reader

from .scale import ENDPOINT, expect, start, tell

VEHICLES = 200
RATE = 100  # Hz

PUBLISHER = """
import sys, time
import numpy as np
import nedbus
from nedbus_msgs import DEFAULT_TOPIC, FIELD_TYPES, PAYLOAD_SIZE
from nedbus_msgs.arrays import encode_array
from benchmarks.forms.fields import FIELDS
vehicles, seconds, endpoint = int(sys.argv[1]), float(sys.argv[2]), sys.argv[3]
messages = np.repeat(nedbus.to_array([nedbus.VehicleLocalPosition(**FIELDS)]), vehicles)
rng = np.random.default_rng(1)
noisy = ("x", "y", "z", "vx", "vy", "vz", "z_deriv", "ax", "ay", "az", "unaided_heading", "heading_var", "eph", "epv")
with nedbus.connect(endpoint) as bus:
    publishers = [bus.publisher(DEFAULT_TOPIC, vehicle=f"v{number}") for number in range(vehicles)]
    print("ready", flush=True)
    sys.stdin.readline()
    start, late = time.monotonic(), 0.0
    for tick in range(int(seconds * 100)):
        messages["timestamp"] = 10_000_000 + tick * 10_000
        messages["timestamp_sample"] = messages["timestamp"] - 5_000
        for name in noisy:
            messages[name] = rng.random(vehicles, np.float32)
        payloads = encode_array(messages)
        wait = start + tick / 100 - time.monotonic()
        late = max(late, -wait)
        if wait > 0:
            time.sleep(wait)
        for index, publisher in enumerate(publishers):
            publisher._put(payloads[index * PAYLOAD_SIZE : (index + 1) * PAYLOAD_SIZE], FIELD_TYPES)
    print(f"{late:.3f}", flush=True)
    sys.stdin.readline()
"""


def main() -> None:
    """Measure and print."""
    seconds = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "fleet.mcap"
        router = start("-m", "nedbus", "router", "--listen", ENDPOINT)
        time.sleep(1.0)
        log = (Path(folder) / "log").open("w+")
        command = [sys.executable, "-m", "nedbus", "record", "-c", ENDPOINT, "-o", str(path)]
        recorder = subprocess.Popen(command, stderr=log)
        publisher = start("-c", PUBLISHER, str(VEHICLES), str(seconds), ENDPOINT)
        expect(publisher)
        time.sleep(1.0)
        measured = psutil.Process(recorder.pid)
        before = sum(measured.cpu_times()[:2])
        begin = time.monotonic()
        tell(publisher)
        memory = []
        while time.monotonic() - begin < seconds:
            time.sleep(max(1.0, seconds / 10))
            memory.append(measured.memory_info().rss / 2**20)
            print(f"{time.monotonic() - begin:6.0f} s  {memory[-1]:6.1f} MB", flush=True)
        delay = expect(publisher)
        time.sleep(3.0)
        used = sum(measured.cpu_times()[:2]) - before
        recorder.terminate()
        recorder.wait(30)
        sent = VEHICLES * seconds * RATE
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        written = summary.statistics.message_count if summary and summary.statistics else 0
        print(
            f"{written} of {sent} messages in the file, {path.stat().st_size / written:.0f} bytes each;"
            f" recorder {used / sent * 1e6:.1f} us a message, {memory[0]:.0f} to {memory[-1]:.0f} MB;"
            f" publisher at most {delay} s late"
        )
        log.seek(0)
        print(f"its log: {log.read().strip()}")
        for process in (publisher, router):
            process.kill()
            process.wait()


if __name__ == "__main__":
    main()
