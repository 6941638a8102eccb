"""Costs of metrics: the time of a page with 200 streams, and what a scrape every second takes from publishing.

The bars: /metrics with 200 streams in under 50 ms (the median of 20 requests), and less than 2 % of effect on what is
published: on its rate, and on the CPU time of the threads that publish, for each message.
One service publishes 40 simulated vehicles of 5 streams each. Some seconds with scrapes and some without take turns,
so that what else the machine does hits both: each pair of neighbours gives one ratio, of which the median counts.
"""

from __future__ import annotations

import argparse
import statistics
import time
import urllib.request
from contextlib import suppress
from typing import Final, NamedTuple

import psutil

from .processes import PATIENCE, Process, end, free_port, start

VEHICLES: Final = 40
STREAMS: Final = 200
SPEED: Final = 0.25  # 2,040 messages a second of all together: the service keeps its pace on a busy machine too
REQUESTS: Final = 20
_PUBLISHED: Final = "nedbus_messages_published_total{"


class Turn(NamedTuple):
    """Measurement of some seconds: messages a second, and CPU time of the threads that publish [us/message]."""

    rate: float
    cpu: float


class Service:
    """A service under measurement."""

    def __init__(self) -> None:
        ports = [free_port(), free_port()]
        self.url = f"http://127.0.0.1:{ports[0]}"
        sources = [f"--source=sim:?vehicle={number}&seed={number}&speed={SPEED}" for number in range(1, VEHICLES + 1)]
        self.process: Process = start(
            "-m", "nedbus", "serve", "-l", f"tcp/127.0.0.1:{ports[1]}", "--http", self.url.removeprefix("http://"),
            *sources,
        )  # fmt: skip

    def get(self) -> str:
        """Return the metrics."""
        with urllib.request.urlopen(f"{self.url}/metrics", timeout=PATIENCE) as answer:  # noqa: S310 - http, on loopback
            return str(answer.read().decode())

    def wait(self) -> None:
        """Wait until all streams have been measured for a while."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline and self.process.poll() is None:
            with suppress(OSError):
                if self.get().count("nedbus_stream_usual_rate_hertz{") == STREAMS:
                    return
            time.sleep(1.0)
        raise RuntimeError(f"the service does not publish {STREAMS} streams")

    def measure(self, seconds: int, *, scraped: bool) -> Turn:
        """Measure for some seconds, with or without a scrape in each."""
        before, published, begin = self._cpu(), self._published(), time.monotonic()
        for second in range(1, seconds + 1):
            time.sleep(max(0.0, begin + second - time.monotonic()))
            if scraped and second < seconds:
                self.get()
        after, passed = self._cpu(), time.monotonic() - begin
        messages = self._published() - published
        # Threads that answer requests are not there before and after.
        used = sum(after[thread] - before[thread] for thread in before.keys() & after.keys())
        return Turn(messages / passed, used / messages * 1e6)

    def _cpu(self) -> dict[int, float]:
        return {each.id: each.user_time + each.system_time for each in psutil.Process(self.process.pid).threads()}

    def _published(self) -> float:
        return sum(float(line.rpartition(" ")[2]) for line in self.get().splitlines() if line.startswith(_PUBLISHED))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--turns", type=int, default=6, help="pairs of turns, without and with scrapes")
    parser.add_argument("--seconds", type=int, default=6, help="of a turn")
    arguments = parser.parse_args()
    service = Service()
    try:
        service.wait()
        times = [_time_of(service) for _ in range(REQUESTS)]
        size = len(service.get())
        print(
            f"/metrics with {STREAMS} streams: {statistics.median(times) * 1e3:.1f} ms, at most"
            f" {max(times) * 1e3:.1f} ms of {REQUESTS}, {size / 1e3:.0f} kB (bar: 50 ms)",
            flush=True,
        )
        rates, costs = [], []
        for pair in range(arguments.turns):
            order = (False, True) if pair % 2 else (True, False)  # a drift is in both
            turns = {scraped: service.measure(arguments.seconds, scraped=scraped) for scraped in order}
            rates.append(1 - turns[True].rate / turns[False].rate)
            costs.append(turns[True].cpu / turns[False].cpu - 1)
            print(
                f"{turns[False].rate:7.1f} messages/s, {turns[False].cpu:6.1f} us of CPU each;"
                f" with a scrape every second {turns[True].rate:7.1f} messages/s, {turns[True].cpu:6.1f} us",
                flush=True,
            )
        print(
            f"effect, the median of {len(rates)}: {100 * statistics.median(rates):.2f} % fewer messages a second,"
            f" {100 * statistics.median(costs):.2f} % more CPU for each (bar: 2 %)"
        )
    finally:
        service.process.terminate()
        end(service.process, patience=10.0)


def _time_of(service: Service) -> float:
    begin = time.perf_counter()
    service.get()
    return time.perf_counter() - begin


if __name__ == "__main__":
    main()
