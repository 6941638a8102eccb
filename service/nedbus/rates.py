"""Rate, jitter, latency and loss of each address, second by second."""

from __future__ import annotations

import statistics
from dataclasses import dataclass, field

from nedbus_msgs import Address

from .subscriber import Sample


@dataclass(slots=True)
class _Window:
    times: list[int] = field(default_factory=list)
    latencies: list[float] = field(default_factory=list)
    lost: int = 0


class Rates:
    """Collect samples, and tell of those since the last time.

    `since` [ns since the epoch]: what was sent before, a last value that a subscription starts with, does not count.
    """

    def __init__(self, *, since: int) -> None:
        self._since = since
        self._windows: dict[Address, _Window] = {}

    def add(self, sample: Sample) -> None:
        """Take note of a sample."""
        if sample.sent is not None and sample.sent < self._since:
            return
        window = self._windows.setdefault(sample.address, _Window())
        window.times.append(sample.received)
        if sample.latency is not None:
            window.latencies.append(sample.latency)
        window.lost += sample.lost

    def take(self) -> list[tuple[Address, dict[str, float | None]]]:
        """Return what was measured for each address, and start anew.

        `rate` [Hz], `jitter` (standard deviation of the intervals), `latency` (median) and `latency_max` [s] are of the
        time since the last call, None where there were too few samples; `lost` counts since the start.
        """
        told = []
        for address, window in sorted(self._windows.items()):
            steps = [(after - before) / 1e9 for before, after in zip(window.times, window.times[1:], strict=False)]
            rate = {
                "rate": len(steps) / sum(steps) if steps and sum(steps) > 0 else None,
                "jitter": statistics.pstdev(steps) if steps else None,
                "latency": statistics.median(window.latencies) if window.latencies else None,
                "latency_max": max(window.latencies, default=None),
                "lost": window.lost,
            }
            told.append((address, rate))
            window.times, window.latencies = window.times[-1:], []
        return told
