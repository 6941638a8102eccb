"""Memory of a service that receives a long ULog stream: the data of a recorded flight, repeated with continuing times.

The stream has the 14 topics of a flight, or PX4's default topics (`--recording default_topics`). It is played faster
than PX4 sent it, so the histories of 20 s are full after a smaller part of the flight; no message may be lost.
Target: the memory is constant from two minutes of the stream on, within 1 MB; 90 MB with PX4's default topics.
"""

from __future__ import annotations

import argparse
import re
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from tests.peers.px4_log_stream import (  # fmt: skip
    STREAMS,
    Entry,
    Message,
    Px4LogStream,
    Recording,
    is_heartbeat,
    read_recording,
)

from benchmarks.processes import cpu_seconds, free_port, memory_mb, nedbus_process, wait_for_router

from .files import records_of, repeat_log
from .service import published

_SIZE: Final = 249  # bytes of ULog per LOGGING_DATA
_STEPS: Final = 10
_LOST: Final = re.compile(
    r"^nedbus_(?:source_lost|log_stream_messages_lost)\w*\{[^}]*\} (\S+)", re.MULTILINE
)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--recording", default="flight1", choices=("flight1", "default_topics"))
    parser.add_argument(
        "--minutes", type=float, default=10.0, help="duration of the stream at its natural rate"
    )
    parser.add_argument(
        "--speed", type=float, default=8.0, help="1.3: 2,770 messages/s of the default topics"
    )
    parser.add_argument(
        "--setup", default="", help="Python code that the service runs first, for experiments"
    )
    options = parser.parse_args()
    recording, port, endpoint, http = (
        read_stream(options.recording),
        *(free_port() for _ in range(3)),
    )
    seconds = 60 * options.minutes
    prolong(recording, options.recording, seconds)
    source = f"mavlink:udpin:127.0.0.1:{port}?log=1&topics=*"
    arguments = (
        "serve",
        "-l",
        f"tcp/127.0.0.1:{endpoint}",
        "--http",
        f"127.0.0.1:{http}",
        "-s",
        source,
    )
    with nedbus_process(*arguments, setup=options.setup) as service:
        wait_for_router(endpoint, service)
        print(f"       before the stream {memory_mb(service):6.1f} MB", flush=True)
        deadline = 2 * seconds / options.speed + 60
        with Px4LogStream(
            recording, port, speed=options.speed, waits=True, deadline=deadline
        ) as peer:
            for step in range(_STEPS):
                (cpu_before,), before, began = (
                    cpu_seconds(service),
                    published(http),
                    time.monotonic(),
                )
                peer.finished.wait(seconds / options.speed / _STEPS)
                (cpu,), count, passed = (
                    cpu_seconds(service),
                    published(http),
                    time.monotonic() - began,
                )
                rate, share = (count - before) / passed, 100 * (cpu - cpu_before) / passed
                print(
                    f"{step + 1:2}/{_STEPS}: {count:9.0f} messages ({rate:5.0f}/s), {lost(http)} lost,"
                    f" {memory_mb(service):6.1f} MB, {share:3.0f} % of a core",
                    flush=True,
                )


def read_stream(name: str) -> Recording:
    """Read a recording of a stream."""
    return read_recording(STREAMS / f"ulog_stream_{name}.bin.gz")


def prolong(recording: Recording, name: str, seconds: float) -> None:
    """Replace the messages after the header by as many as PX4 sends in this time, and by heartbeats."""
    data = [entry for entry in recording.entries if isinstance(entry.content, Message)]
    rate = _SIZE * len(data) / (data[-1].time - data[0].time)  # bytes of ULog per second
    begin = recording.header_end
    heartbeat = next(
        entry.content
        for entry in recording.entries
        if isinstance(entry.content, bytes) and is_heartbeat(entry.content)
    )
    stream = [
        Entry(begin + number * _SIZE / rate, message)
        for number, message in enumerate(messages(name, round(seconds * rate)))
    ]
    beats = [Entry(float(second), heartbeat) for second in range(round(begin + seconds))]
    recording.entries = sorted([*beats, *stream], key=lambda entry: entry.time)


def messages(recording: str, size: int) -> Iterator[Message]:
    """Yield the LOGGING_DATA of a stream with this number of bytes, without its definitions."""
    with tempfile.TemporaryDirectory() as folder:
        source = STREAMS / f"ulog_stream_{recording}.ulg"
        log = repeat_log(source, Path(folder) / "long.ulg", size).read_bytes()
    begins, records = [], bytearray()
    for record in records_of(log, log.index(b"ULog") + 16):
        if record[2] in b"DS":
            begins.append(len(records))
            records += record
    number = 0
    first = read_stream(recording).header[-1].sequence + 1
    for sequence, start in enumerate(range(0, len(records), _SIZE), first):
        while number < len(begins) and begins[number] < start:
            number += 1
        offset = (
            begins[number] - start
            if number < len(begins) and begins[number] < start + _SIZE
            else 255
        )
        yield Message(False, sequence % 2**16, offset, bytes(records[start : start + _SIZE]))


def lost(http: int) -> int:
    """Return the number of messages that the source has lost."""
    with urllib.request.urlopen(f"http://127.0.0.1:{http}/metrics", timeout=10) as reply:
        return round(sum(map(float, _LOST.findall(reply.read().decode()))))


if __name__ == "__main__":
    main()
