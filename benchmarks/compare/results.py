"""The measured loads, and the results of all rounds with medians and ratios."""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

BEFORE: Final = " before"
"""End of the name of a form that runs with the checkout of `--vs`."""

Measured = dict[str, float]
"""Figures of one run: rate [messages/s], CPU times and delays [us/message], memory peaks [MB]."""


@dataclass(frozen=True)
class Load:
    """Load of a run: `rate` per vehicle [Hz], 0 for full speed; `messages` in total."""

    name: str
    rate: int
    vehicles: int
    messages: int


FULL: Final = Load("full", 0, 1, 0)
KHZ: Final = Load("1kHz", 1000, 1, 4000)
SLOW: Final = Load("100Hz", 100, 1, 600)
TEN: Final = Load("10x100Hz", 100, 10, 4000)
LOADS: Final = {load.name: load for load in (FULL, KHZ, SLOW, TEN)}


@dataclass
class Results:
    """The runs of all rounds in order, by flight, load and form; `failed`: reason for each failed form."""

    runs: dict[tuple[str, str, str], list[Measured]] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)

    def add(self, flight: str, load: Load, form: str, measured: Measured) -> None:
        """Add one run."""
        self.runs.setdefault((flight, load.name, form), []).append(measured)

    def drop(self, form: str, reason: str) -> None:
        """Remove a form that failed."""
        self.failed[form] = reason
        self.runs = {key: runs for key, runs in self.runs.items() if key[2] != form}

    def has(self, flight: str, load: Load, *forms: str) -> bool:
        """Return whether all of these forms were measured."""
        return all((flight, load.name, form) in self.runs for form in forms)

    def forms(self, flight: str, load: Load) -> list[str]:
        """Return the forms that were measured."""
        return [form for other, name, form in self.runs if (other, name) == (flight, load.name)]

    def flights(self, load: Load) -> list[str]:
        """Return the flights that were measured."""
        return list(dict.fromkeys(flight for flight, name, _ in self.runs if name == load.name))

    def median(self, flight: str, load: Load, form: str) -> Measured:
        """Return the medians of the rounds, but the minimum of `kept`, the fraction of messages that arrived."""
        runs = self.runs[flight, load.name, form]
        medians = {key: statistics.median(run[key] for run in runs) for key in runs[0]}
        return medians | {"kept": min(run["kept"] for run in runs)}

    def ratio(self, flight: str, load: Load, form: str, other: str, key: str) -> float:
        """Return the median of the ratios of two forms in the same round, when the machine had the same speed."""
        return statistics.median(self.round_ratios(flight, load, form, other, key))

    def round_ratios(self, flight: str, load: Load, form: str, other: str, key: str) -> list[float]:
        """Return the ratio of two forms in each round."""
        pairs = zip(
            self.runs[flight, load.name, form], self.runs[flight, load.name, other], strict=True
        )
        return [one[key] / two[key] for one, two in pairs]

    def ratios(self, flight: str, load: Load, form: str, other: str) -> Iterator[tuple[str, float]]:
        """Yield the ratios of all figures that are not 0."""
        for key in self.runs[flight, load.name, form][0]:
            if all(run[key] for run in self.runs[flight, load.name, other]):
                yield key, self.ratio(flight, load, form, other, key)
