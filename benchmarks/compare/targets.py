"""Performance targets of nedbus, as ratios of two forms in one run, and their evaluation."""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from .fields import COMPLETE
from .results import BEFORE, FULL, KHZ, TEN, Load, Results


@dataclass(frozen=True)
class Target:
    """Bound on the ratio of `form` to `other` for one figure at one load: `bound` at most, or `at_least`.

    It applies to the median of the rounds or, with `each_round`, to every round.
    """

    form: str
    other: str
    key: str
    load: Load
    bound: float
    at_least: bool = False
    each_round: bool = False

    @property
    def text(self) -> str:
        """Description of the target."""
        sign = ">=" if self.at_least else "<="
        rounds = " in each round" * self.each_round
        return f"{self.load.name}: {KEYS[self.key]} of {self.form} {sign} {self.bound} x {self.other}{rounds}"

    def figure(self, results: Results, flight: str) -> float:
        """Return the ratio for a flight: the median of the rounds, or the worst one."""
        ratios = results.round_ratios(flight, self.load, self.form, self.other, self.key)
        if not self.each_round:
            return statistics.median(ratios)
        return min(ratios) if self.at_least else max(ratios)

    def applies_to(self, flight: str) -> bool:
        """Return whether the form can send this flight: tuples cannot mark fields as missing."""
        return self.form != "rows" or flight in COMPLETE


KEYS: Final = {
    "rate": "messages/s", "receive_cpu": "reader's CPU", "total_cpu": "CPU of all three processes", "p50": "p50",
}  # fmt: skip
TARGETS: Final = (
    Target("models", "straightforward", "rate", FULL, 1.4, at_least=True, each_round=True),
    Target("rows", "straightforward", "rate", FULL, 2.0, at_least=True),
    Target("batches", "raw", "rate", FULL, 0.45, at_least=True),
    Target("models", f"models{BEFORE}", "total_cpu", FULL, 0.55),
    Target("rows", f"rows{BEFORE}", "total_cpu", FULL, 0.75),
    Target("batches", f"batches{BEFORE}", "total_cpu", FULL, 0.75),
    Target("models", "straightforward", "receive_cpu", TEN, 1.0),
    Target("rows", "straightforward", "receive_cpu", TEN, 0.85),
    Target("batches", "straightforward", "receive_cpu", TEN, 1.1),
    Target("models", "straightforward", "p50", KHZ, 1.1),
    Target("rows", "straightforward", "p50", KHZ, 1.0),
)


def evaluate(results: Results) -> Iterator[dict[str, object]]:
    """Yield each target with its figure for each flight, and whether it is met with all flights."""
    for target in TARGETS:
        measured = {
            flight: target.figure(results, flight)
            for flight in results.flights(target.load)
            if results.has(flight, target.load, target.form, target.other)
            and target.applies_to(flight)
        }
        if measured:
            worst = min(measured.values()) if target.at_least else max(measured.values())
            holds = worst >= target.bound if target.at_least else worst <= target.bound
            rounded = {flight: round(ratio, 3) for flight, ratio in measured.items()}
            yield {"bar": target.text, "measured": rounded, "holds": holds}
    kept = {
        f"{form}, {load}, {flight}": min(run["kept"] for run in runs)
        for (flight, load, form), runs in results.runs.items()
        if form in ("models", "fields_in", "rows", "batches")
    }
    if kept:
        missing = {name: share for name, share in kept.items() if share < 1.0}
        yield {
            "bar": "nothing lost by any form of nedbus",
            "measured": missing or {"all": 1.0},
            "holds": not missing,
        }


def print_targets(results: Results) -> None:
    """Print one line per target."""
    print("\ntargets, as medians of the rounds' ratios unless stated otherwise:")
    for target in evaluate(results):
        measured = target["measured"]
        assert isinstance(measured, dict)
        numbers = ", ".join(f"{value:.2f} ({flight})" for flight, value in measured.items())
        print(f"{'met   ' if target['holds'] else 'MISSED'} {target['bar']}: {numbers}")
