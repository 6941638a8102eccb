"""Record a fleet to one file: loss, resident memory over time, CPU time and bytes: python -m benchmarks.record.

Target: 200 vehicles at 100 Hz, 20,000 messages a second, no loss and constant memory for 10 minutes:
`python -m benchmarks.record --seconds 600`.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Final

from mcap.reader import make_reader

from .fleet import RATE
from .processes import Process, cpu_seconds, end, expect, memory_mb, resume, router, start

SAMPLES: Final = 20  # memory samples
ENDS: Final = 60.0  # s; timeout of the recorder for writing the rest


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--vehicles", type=int, default=200)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, router() as (_, endpoint):
        path, log = Path(folder) / "fleet.mcap", Path(folder) / "log"
        with log.open("w") as errors:
            recorder = start(
                "-m", "nedbus", "record", "-c", endpoint, "-o", str(path), errors=errors
            )
        count, seconds = arguments.vehicles, arguments.seconds
        publisher = start("-m", "benchmarks.fleet", str(count), str(seconds), endpoint, "noise")
        try:
            record(recorder, publisher, path, sent=count * seconds * RATE)
        finally:
            end(recorder, publisher)
        print(f"log of the recorder: {log.read_text().strip()}")


def record(recorder: Process, publisher: Process, path: Path, *, sent: int) -> None:
    """Start the publisher, watch the recorder, and print the recorded and lost messages."""
    expect(publisher)
    time.sleep(1.0)
    (before,) = cpu_seconds(recorder)
    resume(publisher)
    memory, late = watch(recorder, publisher)
    time.sleep(3.0)
    used = cpu_seconds(recorder)[0] - before
    recorder.terminate()
    recorder.wait(ENDS)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    written = summary.statistics.message_count if summary and summary.statistics else 0
    print(
        f"{written} of {sent} messages in the file, {sent - written} lost"
        f" ({'met' if written == sent else 'MISSED'}), {path.stat().st_size / max(1, written):.0f} bytes each;"
        f" recorder {used / sent * 1e6:.1f} us a message, {memory[0]:.0f} to {memory[-1]:.0f} MB,"
        f" at most {max(memory):.0f} MB; publisher at most {late} s late"
    )


def watch(recorder: Process, publisher: Process) -> tuple[list[float], str]:
    """Return the recorder's memory over time [MB], and the last output of the publisher."""
    begin = time.monotonic()
    memory: list[float] = []
    interval = 1.0
    while True:
        try:
            return memory, expect(publisher, interval)
        except TimeoutError:
            memory.append(memory_mb(recorder))
            print(f"{time.monotonic() - begin:6.0f} s  {memory[-1]:6.1f} MB", flush=True)
            interval = max(1.0, (time.monotonic() - begin) / SAMPLES * 2)


if __name__ == "__main__":
    main()
