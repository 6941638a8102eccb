"""Bars of nedbus, each as a ratio of two forms in one run, and what was measured."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from .fields import COMPLETE
from .results import FULL, KHZ, TEN, Load, Results


@dataclass(frozen=True)
class Bar:
    """`key` of `form`, as a share of that of `other`, at this load; at least `bound`, or at most."""

    form: str
    other: str
    key: str
    load: Load
    bound: float
    at_least: bool = False

    @property
    def text(self) -> str:
        """Say what is measured."""
        sign = ">=" if self.at_least else "<="
        return f"{self.load.name}: {KEYS[self.key]} of {self.form} {sign} {self.bound} x {self.other}"

    def concerns(self, flight: str) -> bool:
        """Return whether the form sends this flight: no tuple says which fields are missing."""
        return self.form != "rows" or flight in COMPLETE


KEYS: Final = {
    "rate": "messages/s", "publish_cpu": "publisher's CPU", "receive_cpu": "reader's CPU", "p50": "p50",
}  # fmt: skip
PACED: Final = (
    ("models", "straightforward", "publish_cpu", 1.0),
    ("models", "straightforward", "receive_cpu", 1.0),
    ("models", "straightforward", "p50", 1.0),
    ("rows", "raw", "publish_cpu", 1.5),
    ("rows", "raw", "receive_cpu", 1.8),
    ("rows", "raw", "p50", 1.3),
    ("batches", "rows", "receive_cpu", 1.0),
    ("batches", "rows", "p50", 1.3),
)
BARS: Final = (
    Bar("models", "straightforward", "rate", FULL, 1.4, at_least=True),
    Bar("rows", "straightforward", "rate", FULL, 2.5, at_least=True),
    Bar("batches", "raw", "rate", FULL, 0.5, at_least=True),
    *(Bar(form, other, key, load, bound) for load in (KHZ, TEN) for form, other, key, bound in PACED),
)


def judge(results: Results) -> Iterator[dict[str, object]]:
    """Yield each bar, what was measured of it with each flight, and whether it holds with all of them."""
    for bar in BARS:
        measured = {
            flight: results.ratio(flight, bar.load, bar.form, bar.other, bar.key)
            for flight in results.flights(bar.load)
            if results.has(flight, bar.load, bar.form, bar.other) and bar.concerns(flight)
        }
        if measured:
            worst = min(measured.values()) if bar.at_least else max(measured.values())
            holds = worst >= bar.bound if bar.at_least else worst <= bar.bound
            rounded = {flight: round(ratio, 3) for flight, ratio in measured.items()}
            yield {"bar": bar.text, "measured": rounded, "holds": holds}
    kept = {
        f"{form}, {load}, {flight}": min(run["kept"] for run in runs)
        for (flight, load, form), runs in results.runs.items()
        if form in ("models", "fields_in", "rows", "batches")
    }
    if kept:
        missing = {name: share for name, share in kept.items() if share < 1.0}
        yield {"bar": "nothing lost by any form of nedbus", "measured": missing or {"all": 1.0}, "holds": not missing}


def print_bars(results: Results) -> None:
    """Print each bar in a line."""
    print("\nbars, as medians of the rounds' ratios:")
    for bar in judge(results):
        measured = bar["measured"]
        assert isinstance(measured, dict)
        numbers = ", ".join(f"{value:.2f} ({flight})" for flight, value in measured.items())
        print(f"{'holds ' if bar['holds'] else 'MISSED'} {bar['bar']}: {numbers}")
