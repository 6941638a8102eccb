"""Memory of a service that receives a long ULog stream: the data of a recorded flight, repeated with continuing times.

The stream is played eight times as fast as PX4 sent it.
Target: the memory is constant from the second tenth of the stream on, within 1 MB.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tests.peers.px4_log_stream import (  # fmt: skip
    STREAMS,
    Entry,
    Message,
    Px4LogStream,
    is_heartbeat,
    read_recording,
)

from benchmarks.processes import free_port, memory_mb, nedbus_process, wait_for_router

from .files import records_of, repeat_log
from .service import published
from .stream import NATURAL

_SIZE = 249  # bytes of ULog per LOGGING_DATA
_FLIGHT = "ulog_stream_flight1"
_STEPS = 10


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="duration of the stream at its natural rate")
    parser.add_argument("--speed", type=float, default=8.0)
    options = parser.parse_args()
    recording, port, endpoint, http = read_recording(STREAMS / f"{_FLIGHT}.bin.gz"), *(free_port() for _ in range(3))
    (heartbeat, *_) = (
        each.content for each in recording.entries if isinstance(each.content, bytes) and is_heartbeat(each.content)
    )
    begin, seconds = recording.header_end, 60 * options.minutes
    data = [
        Entry(begin + number * _SIZE / NATURAL, each) for number, each in enumerate(messages(round(seconds * NATURAL)))
    ]
    beats = [Entry(float(second), heartbeat) for second in range(round(begin + seconds))]
    recording.entries = sorted([*beats, *data], key=lambda entry: entry.time)
    source = f"mavlink:udpin:127.0.0.1:{port}?log=1&topics=*"
    arguments = "serve", "-l", f"tcp/127.0.0.1:{endpoint}", "--http", f"127.0.0.1:{http}", "-s", source
    with nedbus_process(*arguments) as service:
        wait_for_router(endpoint, service)
        with Px4LogStream(recording, port, speed=options.speed, waits=True) as peer:
            for step in range(_STEPS):
                peer.finished.wait(seconds / options.speed / _STEPS)
                print(
                    f"{step + 1:2}/{_STEPS}: {published(http):9.0f} messages, {memory_mb(service):6.1f} MB", flush=True
                )


def messages(size: int) -> Iterator[Message]:
    """Yield the LOGGING_DATA of a stream with this number of bytes, without its definitions."""
    with tempfile.TemporaryDirectory() as folder:
        log = repeat_log(STREAMS / f"{_FLIGHT}.ulg", Path(folder) / "long.ulg", size).read_bytes()
    begins, records = [], bytearray()
    for record in records_of(log, log.index(b"ULog") + 16):
        if record[2] in b"DS":
            begins.append(len(records))
            records += record
    number = 0
    first = read_recording(STREAMS / f"{_FLIGHT}.bin.gz").header[-1].sequence + 1
    for sequence, start in enumerate(range(0, len(records), _SIZE), first):
        while number < len(begins) and begins[number] < start:
            number += 1
        offset = begins[number] - start if number < len(begins) and begins[number] < start + _SIZE else 255
        yield Message(False, sequence % 2**16, offset, bytes(records[start : start + _SIZE]))


if __name__ == "__main__":
    main()
