"""Cost of metrics: the response time with 200 streams, and the effect of one scrape a second on publishing.

Targets: /metrics with 200 streams in under 50 ms (median of 20 requests), and less than 2 % effect on the rate and on
the CPU time per message of the publishing threads.
One service publishes 40 simulated vehicles with 5 streams each. Intervals with and without scrapes alternate, so other
load affects both; the result is the median of the ratios of adjacent intervals.
"""

from __future__ import annotations

import argparse
import statistics
import time
import urllib.request
from contextlib import suppress
from typing import Final, NamedTuple

import psutil

from .processes import TIMEOUT, Process, end, free_port, start

VEHICLES: Final = 40
STREAMS: Final = 200
# 2,040 messages a second in total, which the service sustains on a busy machine too
SPEED: Final = 0.25
REQUESTS: Final = 20
_PUBLISHED: Final = "nedbus_messages_published_total{"


class Interval(NamedTuple):
    """Measurements of an interval: messages per second, and CPU time of the publishing threads [us/message]."""

    rate: float
    cpu: float


class Service:
    """A service under measurement."""

    def __init__(self) -> None:
        ports = [free_port(), free_port()]
        self.url = f"http://127.0.0.1:{ports[0]}"
        sources = [
            f"--source=sim:?vehicle={number}&seed={number}&speed={SPEED}"
            for number in range(1, VEHICLES + 1)
        ]
        self.process: Process = start(
            "-m", "nedbus", "serve", "-l", f"tcp/127.0.0.1:{ports[1]}", "--http", self.url.removeprefix("http://"),
            *sources,
        )  # fmt: skip

    def get(self) -> str:
        """Return the metrics."""
        with urllib.request.urlopen(f"{self.url}/metrics", timeout=TIMEOUT) as answer:  # noqa: S310 - http, on loopback
            return str(answer.read().decode())

    def wait(self) -> None:
        """Wait until the usual rate of all streams is known."""
        deadline = time.monotonic() + TIMEOUT
        while time.monotonic() < deadline and self.process.poll() is None:
            with suppress(OSError):
                if self.get().count("nedbus_stream_usual_rate_hertz{") == STREAMS:
                    return
            time.sleep(1.0)
        raise RuntimeError(f"the service does not publish {STREAMS} streams")

    def measure(self, seconds: int, *, scraped: bool) -> Interval:
        """Measure for `seconds`, with or without one scrape a second."""
        before, published, begin = self._cpu(), self._published(), time.monotonic()
        for second in range(1, seconds + 1):
            time.sleep(max(0.0, begin + second - time.monotonic()))
            if scraped and second < seconds:
                self.get()
        after, passed = self._cpu(), time.monotonic() - begin
        messages = self._published() - published
        # Threads that answer a request end before the second reading, and are not counted.
        used = sum(after[thread] - before[thread] for thread in before.keys() & after.keys())
        return Interval(messages / passed, used / messages * 1e6)

    def _cpu(self) -> dict[int, float]:
        return {
            thread.id: thread.user_time + thread.system_time
            for thread in psutil.Process(self.process.pid).threads()
        }

    def _published(self) -> float:
        return sum(
            float(line.rpartition(" ")[2])
            for line in self.get().splitlines()
            if line.startswith(_PUBLISHED)
        )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--pairs", type=int, default=6, help="pairs of intervals, without and with scrapes"
    )
    parser.add_argument("--seconds", type=int, default=6, help="duration of an interval [s]")
    arguments = parser.parse_args()
    service = Service()
    try:
        service.wait()
        times = [_time_of(service) for _ in range(REQUESTS)]
        size = len(service.get())
        print(
            f"/metrics with {STREAMS} streams: {statistics.median(times) * 1e3:.1f} ms, at most"
            f" {max(times) * 1e3:.1f} ms of {REQUESTS}, {size / 1e3:.0f} kB (target: 50 ms)",
            flush=True,
        )
        rates, costs = [], []
        for pair in range(arguments.pairs):
            # alternating, so drift affects both
            order = (False, True) if pair % 2 else (True, False)
            intervals = {
                scraped: service.measure(arguments.seconds, scraped=scraped) for scraped in order
            }
            rates.append(1 - intervals[True].rate / intervals[False].rate)
            costs.append(intervals[True].cpu / intervals[False].cpu - 1)
            print(
                f"{intervals[False].rate:7.1f} messages/s, {intervals[False].cpu:6.1f} us of CPU each;"
                f" with a scrape every second {intervals[True].rate:7.1f} messages/s, {intervals[True].cpu:6.1f} us",
                flush=True,
            )
        print(
            f"effect (median of {len(rates)}): {100 * statistics.median(rates):.2f} % fewer messages a second,"
            f" {100 * statistics.median(costs):.2f} % more CPU per message (target: 2 %)"
        )
    finally:
        service.process.terminate()
        end(service.process, timeout=10.0)


def _time_of(service: Service) -> float:
    begin = time.perf_counter()
    service.get()
    return time.perf_counter() - begin


if __name__ == "__main__":
    main()
