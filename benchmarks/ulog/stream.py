"""Delay from a datagram of PX4's ULog stream over MAVLink to the sample at a reader, and CPU time of the service.

A recorded flight of a real PX4 (SITL) is played to a service at 200 KB/s of ULog, and a reader in another process
subscribes; then the same with a source without `log=1`.
Targets: p99 of the delay at most 20 ms above that of the source without `log=1`, at most 60 % of a core.
"""

from __future__ import annotations

import argparse
import json
import struct
import time
from functools import cache, partial
from pathlib import Path
from typing import Final

from pymavlink.dialects.v20 import common as dialect
from tests.peers.px4_log_stream import (  # fmt: skip
    STREAMS,
    Px4LogStream,
    Recording,
    is_heartbeat,
    read_recording,
    stream_message,
    unpack,
)

from benchmarks.processes import cpu_seconds, end, expect, free_port, nedbus_process, resume, start
from nedbus.ulog import Data, LoggedStream, UlogParser

RATE = 200_000  # bytes of ULog per second
NATURAL = 69_800  # bytes of ULog per second of the recording in real time
READER = """
import json, sys, threading, time
import nedbus
found = []
with nedbus.connect(sys.argv[1], timeout=30) as bus, bus.subscribe("*", mode="every") as samples:
    print("ready", flush=True)
    threading.Thread(target=lambda: (sys.stdin.readline(), samples.close()), daemon=True).start()
    for sample in samples:
        found.append((str(sample.address), sample.message.timestamp, time.monotonic()))
print(json.dumps(found), flush=True)
"""

FLIGHT: Final = STREAMS / "ulog_stream_flight1.bin.gz"
Key = tuple[str, int]


class Arrivals:
    """Send time of the last datagram of each message, by address and timestamp."""

    def __init__(self) -> None:
        self.times: dict[Key, float] = {}
        self._parser = UlogParser(verify=False)
        self._stream_of = cache(partial(LoggedStream, "1"))

    def add(self, frame: bytes) -> None:
        """Record a frame before it is sent."""
        number, payload = unpack(frame)
        if message := stream_message(frame):
            for record in self._parser.feed(message.data):
                if isinstance(record, Data):
                    stream = self._stream_of(record.subscription)
                    self.times[str(stream.address), stream.decode(record.payload)["timestamp"]] = (
                        time.monotonic()
                    )
        elif number == dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
            (boot_ms,) = struct.unpack_from("<I", payload)
            self.times["1/vehicle_local_position", boot_ms * 1000] = time.monotonic()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=25.0)
    seconds = parser.parse_args().seconds
    for form in ("", "?log=1"):
        print(measure(form, seconds), flush=True)


def read_flight(path: Path, speed: float = RATE / NATURAL) -> Recording:
    """Return a recording whose telemetry is at its natural rate when the stream is played at this speed."""
    recording, step = read_recording(path), max(1, round(speed))
    recording.entries = [
        each
        for number, each in enumerate(recording.entries)
        if not isinstance(each.content, bytes) or is_heartbeat(each.content) or number % step == 0
    ]
    return recording


def measure(form: str, seconds: float) -> str:
    """Run one form of the source and return its line."""
    arrivals, port, endpoint = Arrivals(), free_port(), f"tcp/127.0.0.1:{free_port()}"
    recording, speed = read_flight(FLIGHT), RATE / NATURAL
    with nedbus_process(
        "serve", "-l", endpoint, "-s", f"mavlink:udpin:127.0.0.1:{port}{form}"
    ) as service:
        reader = start("-c", READER, endpoint)
        try:
            expect(reader)
            peer = Px4LogStream(
                recording, port, speed=speed, waits=bool(form), on_send=arrivals.add
            )
            with peer:
                time.sleep(3.0)  # the header
                (before,), began = cpu_seconds(service), time.monotonic()
                peer.finished.wait(seconds - 3.0)
                (after,), passed = cpu_seconds(service), time.monotonic() - began
            resume(reader)
            found = json.loads(expect(reader))
        finally:
            end(reader, timeout=2.0)
    delays = sorted(
        1e3 * (received - arrivals.times[address, timestamp])
        for address, timestamp, received in found
        if (address, timestamp) in arrivals.times and received > began
    )
    return (
        f"mavlink:{form:7} {len(delays)} of {len(found)} messages: delay p50 {delays[len(delays) // 2]:.1f} ms,"
        f" p99 {delays[int(0.99 * len(delays))]:.1f} ms, max {delays[-1]:.1f} ms;"
        f" {100 * (after - before) / passed:.0f} % of a core"
    )


if __name__ == "__main__":
    main()
