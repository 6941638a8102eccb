"""CPU time of event detection per message: python -m benchmarks.events [FILE]... [--vs CHECKOUT].

Two checkouts are measured alternately in one run. Target: a change adds at most 10 %.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from pathlib import Path
from typing import Final

from tests.flights.replays import convert_replay

from .processes import HERE, Checkout, end, expect, resume

ADD: Final = """
import sys, time
from pathlib import Path
from nedbus.vehicle_events import EventLog
from nedbus.flights import format_of
from nedbus.sources import parse_source
from nedbus.errors import InvalidMessageError
from nedbus_msgs import BY_TOPIC, upgrade_fields

def read():
    source = parse_source(f"{format_of(sys.argv[1])}:{sys.argv[1]}?topics=*")
    for message in source.open_source(vehicle="1").open().messages:
        try:
            fields = upgrade_fields(message.definition or BY_TOPIC[message.address.topic], message.fields)
        except InvalidMessageError:
            continue
        yield message.address, fields, message.at

messages = list(read())
print(len(messages), flush=True)
for _ in sys.stdin:
    event_log, start = EventLog(), time.process_time()
    for address, fields, due in messages:
        event_log.add(address, fields, due)
    event_log.settle(due)
    print(1e6 * (time.process_time() - start) / len(messages), flush=True)
"""  # prints us per message for each line on stdin


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "files",
        nargs="*",
        type=Path,
        metavar="FILE",
        help="logs, recordings (default: a simulation)",
    )
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument(
        "--vs", type=Path, help="a second checkout of nedbus, measured in the same run"
    )
    arguments = parser.parse_args()
    checkouts = (HERE, Checkout(arguments.vs)) if arguments.vs else (HERE,)
    with tempfile.TemporaryDirectory() as folder:
        simulated = Path(folder) / "simulation.mcap"
        if not arguments.files:
            convert_replay("sim:?duration=120", simulated)
        for path in arguments.files or [simulated]:
            measure(path.resolve(), checkouts, arguments.rounds)


def measure(path: Path, checkouts: tuple[Checkout, ...], rounds: int) -> None:
    """Detect the events of a file with each checkout, and print the times and their ratio."""
    running = [checkout.start("-c", ADD, str(path)) for checkout in checkouts]
    try:
        (count, *_), times = (
            [int(expect(process)) for process in running],
            [list[float]() for _ in running],
        )
        for _ in range(rounds):
            for process, measured in zip(running, times, strict=True):
                resume(process)
                measured.append(float(expect(process)))
    finally:
        end(*running)
    costs = [
        f"{min(measured):.2f} us (median {statistics.median(measured):.2f})" for measured in times
    ]
    ratio = f", {min(times[0]) / min(times[1]) - 1:+.1%}" if len(times) > 1 else ""
    print(f"{path.name}, {count} messages: {' vs. '.join(costs)} per message{ratio}", flush=True)


if __name__ == "__main__":
    main()
