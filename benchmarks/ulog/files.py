"""Reading speed of ULog files compared with pyulog, and start time and memory of a replay.

nedbus and pyulog alternately read each log in full, and the medians are compared. The last log is then repeated up to
200 MB (--megabytes) and replayed at full speed.
Targets: no slower than pyulog, the first message within 0.3 s, less than 100 MB of resident memory.
"""

from __future__ import annotations

import argparse
import os
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path

from pyulog import ULog
from tests.flights.ulogs import LOGS

from nedbus.flights import ReadOptions
from nedbus.tables import open_arrays

_TIMESTAMP = 5  # offset in a record with a message
REPLAY = """
import resource, sys, time
from nedbus.sources import parse_source
start = time.perf_counter()
messages = iter(parse_source(f"ulog:{sys.argv[1]}?topics=*").open_source(vehicle="1").open().messages)
next(messages)
first = time.perf_counter() - start
count = 1 + sum(1 for _ in messages)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(first, count, time.perf_counter() - start, peak)
"""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", nargs="*", type=Path, help="default: the logs of the tests")
    parser.add_argument("--megabytes", type=int, default=200)
    parser.add_argument("--repeat", type=int, default=5)
    options = parser.parse_args()
    logs = options.logs or sorted(LOGS.parent.rglob("*.ulg"))
    total = [0.0, 0.0]
    for path in logs:
        ours, theirs = [], []
        for _ in range(options.repeat):
            ours.append(
                seconds(partial(open_arrays, [path], ReadOptions(topics=None), lambda _: True))
            )
            theirs.append(seconds(partial(ULog, str(path))))
        medians = [statistics.median(ours), statistics.median(theirs)]
        total = [so_far + median for so_far, median in zip(total, medians, strict=True)]
        first = measure_replay(path)[0]
        ratio = medians[0] / medians[1]
        print(
            f"{path.name}: {ratio:.2f} of pyulog's time, first message after {first:.3f} s (target: 0.3 s)"
        )
    print(f"all logs: {total[0] / total[1]:.2f} of pyulog's time (target: 1)")
    with tempfile.TemporaryDirectory() as folder:
        big = repeat_log(logs[-1], Path(folder) / "big.ulg", options.megabytes * 1_000_000)
        first, count, duration, peak = measure_replay(big)
        print(
            f"{big.stat().st_size / 1e6:.0f} MB: first message after {first:.3f} s, {count:.0f} messages",
            end="",
        )
        print(f" in {duration:.0f} s, {peak:.0f} MB of resident memory (target: below 100 MB)")


def seconds(call: Callable[[], object]) -> float:
    """Return the CPU time of a call [s]."""
    start = time.process_time()
    call()
    return time.process_time() - start


def measure_replay(path: Path) -> list[float]:
    """Replay a log in a subprocess; return time to the first message [s], count, total time [s], peak memory [MB]."""
    command = [sys.executable, "-c", REPLAY, os.fspath(path)]
    return [
        float(word)
        for word in subprocess.run(
            command, check=True, capture_output=True, text=True
        ).stdout.split()
    ]


def repeat_log(path: Path, target: Path, size: int) -> Path:
    """Write a log with the data section of another one repeated up to `size` bytes, with continuing timestamps."""
    data = path.read_bytes()
    at = 16
    while data[at + 2] != ord("A"):  # the first subscription ends the definitions
        at += 3 + int.from_bytes(data[at : at + 2], "little")
    records, head = [*records_of(data, at)], data[:at]
    times = [time for record in records if (time := timestamp_of(record))]
    span = max(times) - min(times) + 1000
    with target.open("wb") as file:
        file.write(head)
        for repetition in count():
            for record in records:
                time = timestamp_of(record)
                shifted = struct.pack("<Q", time + repetition * span)
                file.write(
                    record[:_TIMESTAMP] + shifted + record[_TIMESTAMP + 8 :] if time else record
                )
            if file.tell() >= size:
                return target
    raise AssertionError


def records_of(data: bytes, at: int) -> Iterator[bytes]:
    """Yield the complete records of a log from a position on."""
    while at + 3 <= len(data) and (
        stop := at + 3 + int.from_bytes(data[at : at + 2], "little")
    ) <= len(data):
        yield data[at:stop]
        at = stop


def timestamp_of(record: bytes) -> int:
    """Return the timestamp of a message [us], with which PX4 begins each one; 0 for another record."""
    is_message = record[2] == ord("D") and len(record) >= _TIMESTAMP + 8
    return int.from_bytes(record[_TIMESTAMP : _TIMESTAMP + 8], "little") if is_message else 0


if __name__ == "__main__":
    main()
