"""CPU time of `nedbus serve` per published message: a log at full speed, and a recorded ULog stream over MAVLink.

With --vs CHECKOUT, both are measured alternately, and the median of the ratios is printed. The logs are repeated, so
the start of the process counts little. No reader subscribes.
Target: a change adds at most 10 %.
"""

from __future__ import annotations

import argparse
import re
import resource
import statistics
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Callable
from functools import partial
from pathlib import Path

from tests.flights.ulogs import LOGS
from tests.peers.px4_log_stream import Px4LogStream

from benchmarks.processes import (
    HERE,
    Checkout,
    cpu_seconds,
    free_port,
    nedbus_process,
    wait_for_router,
)

from .files import repeat_log
from .stream import FLIGHT, NATURAL, RATE, read_flight

_PUBLISHED = re.compile(r"^nedbus_messages_published\w*\{[^}]*\} (\S+)", re.MULTILINE)
_HEADER = 4.0  # s in which the definitions are sent


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", nargs="*", type=Path, help="default: the logs of the tests")
    parser.add_argument(
        "--vs", type=Path, help="a second checkout of nedbus, measured in the same run"
    )
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--megabytes", type=int, default=30)
    parser.add_argument("--seconds", type=float, default=15.0, help="longest duration of a stream")
    parser.add_argument(
        "--stream",
        type=Path,
        help="a recording to play at its own speed, instead of one at 200 KB/s",
    )
    parser.add_argument("--no-logs", action="store_true", help="measure only the stream")
    options = parser.parse_args()
    checkouts = (HERE, Checkout(options.vs)) if options.vs else (HERE,)
    with tempfile.TemporaryDirectory() as folder:
        for path in [] if options.no_logs else options.logs or sorted(LOGS.glob("*.ulg")):
            big = repeat_log(path, Path(folder) / path.name, options.megabytes * 1_000_000)
            compare(path.name, partial(replay, big), checkouts, options.rounds)
            big.unlink()
    path, speed = (options.stream, 1.0) if options.stream else (FLIGHT, RATE / NATURAL)
    compare(path.name, partial(receive, path, speed, options.seconds), checkouts, options.rounds)


def compare(
    name: str, measure: Callable[[Checkout], float], checkouts: tuple[Checkout, ...], rounds: int
) -> None:
    """Measure each checkout in turn, and print the times and the median of their ratios."""
    times = [[measure(checkout) for checkout in checkouts] for _ in range(rounds)]
    medians = [statistics.median(checkout_times) for checkout_times in zip(*times, strict=True)]
    costs = " vs. ".join(f"{median:.1f} us" for median in medians)
    ratios = [round_times[0] / round_times[1] for round_times in times if len(round_times) > 1]
    ratio = (
        f", ratio {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
        if ratios
        else ""
    )
    print(f"{name}: {costs} of CPU time per message{ratio}", flush=True)


def replay(log: Path, checkout: Checkout) -> float:
    """Replay a log at full speed; return the CPU time per message [us]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    source, listen = f"ulog:{log}?speed=max&topics=*", f"tcp/127.0.0.1:{free_port()}"
    command = "serve", "--until-done", "-l", listen, "-s", source
    process = checkout.start(
        "-c", "from nedbus.cli import main\nmain()", *command, errors=subprocess.PIPE
    )
    _, text = process.communicate(timeout=600)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    found = re.search(r"(\d+) published", text)
    if found is None:
        raise RuntimeError(text)
    return 1e6 * seconds / int(found[1])


def receive(path: Path, speed: float, seconds: float, checkout: Checkout) -> float:
    """Play a recorded stream to a service; return its CPU time per message after the header [us]."""
    port, endpoint, http = free_port(), free_port(), free_port()
    recording = read_flight(path, speed)
    arguments = (
        "--http",
        f"127.0.0.1:{http}",
        "-s",
        f"mavlink:udpin:127.0.0.1:{port}?log=1&topics=*",
    )
    with nedbus_process(
        "serve", "-l", f"tcp/127.0.0.1:{endpoint}", *arguments, checkout=checkout
    ) as service:
        wait_for_router(endpoint, service)
        with Px4LogStream(recording, port, speed=speed, waits=True) as peer:
            time.sleep(_HEADER)
            (before,), first = cpu_seconds(service), published(http)
            peer.finished.wait(seconds)
            (after,), last = cpu_seconds(service), published(http)
    return 1e6 * (after - before) / (last - first)


def published(http: int) -> float:
    """Return the number of messages that a service has published."""
    with urllib.request.urlopen(f"http://127.0.0.1:{http}/metrics", timeout=10) as reply:
        return sum(map(float, _PUBLISHED.findall(reply.read().decode())))


if __name__ == "__main__":
    main()
