"""Rate, jitter, latency and loss of each address, second by second."""

from __future__ import annotations

import statistics
from dataclasses import dataclass, field
from itertools import pairwise

from nedbus_msgs import Address

from .intake import Sample


@dataclass(slots=True)
class _Window:
    times: list[int] = field(default_factory=list)
    latencies: list[float] = field(default_factory=list)
    lost: int = 0


class Rates:
    """Collect samples, and tell of those since the last time.

    The first sample of each address does not count: it may be the last value that a subscription starts with.
    """

    def __init__(self) -> None:
        self._windows: dict[Address, _Window] = {}

    def add(self, sample: Sample) -> bool:
        """Take note of a sample; return whether it counts."""
        window = self._windows.get(sample.address)
        if window is None:
            self._windows[sample.address] = _Window()
            return False
        window.times.append(sample.received)
        if sample.latency is not None:
            window.latencies.append(sample.latency)
        window.lost += sample.lost
        return True

    def take(self) -> list[tuple[Address, dict[str, float | None]]]:
        """Return what was measured for each address, and start anew.

        `rate` [Hz], `jitter` (standard deviation of the intervals), `latency` (median) and `latency_max` [s] are of the
        time since the last call, None where there were too few samples; `lost` counts since the start.
        """
        told = []
        for address, window in sorted(self._windows.items()):
            steps = [(after - before) / 1e9 for before, after in pairwise(window.times)]
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
