"""A histogram with fixed limits: how many measurements were at most so large."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence


class Histogram:
    """Count measurements by size; `limits` are the largest of each bucket but the last, which has no limit."""

    def __init__(self, limits: Sequence[float]) -> None:
        self.limits = tuple(limits)
        self.sum = 0.0
        self._counts = [0] * (len(self.limits) + 1)

    def add(self, value: float) -> None:
        """Count one measurement."""
        self._counts[bisect_left(self.limits, value)] += 1
        self.sum += value

    @property
    def counts(self) -> tuple[int, ...]:
        """How many measurements each bucket has, the one without a limit last."""
        return tuple(self._counts)
