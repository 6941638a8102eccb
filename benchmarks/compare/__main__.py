"""Compare nedbus with similar libraries: python -m benchmarks.compare [--rounds N].

Each module of `forms` sends the same 53 fields from one process to another, with Zenoh through one router: at full
speed without loss, then at 1 kHz and at 100 Hz; some also with ten vehicles in one process, and with the messages of
other flights.
Machines are shared and noisy: rounds are interleaved, medians are reported, and only ratios within one run are
meaningful. Other libraries are installed in virtual environments under build/bench; failures are reported.
A complete run is written to docs/explanation/performance.json and, as tables, to performance.md and the README; partial
results, such as those of `--forms raw models --loads 1kHz --flights "no origin"`, are only printed.
"""

from __future__ import annotations

import argparse
import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from benchmarks.processes import router

from .fields import DEFAULT_FLIGHT, FLIGHTS
from .measure import run
from .peers import CORE, find_forms, prepare
from .report import as_markdown, write
from .results import FULL, KHZ, LOADS, TEN, Load, Results
from .targets import print_targets

ROUNDS: Final = 3
DURATION: Final = 2.5  # s; desired duration of a run at full speed
TRIAL: Final = 5000  # messages of the trial that estimates their number
MIN_MESSAGES: Final = {"raw": 2_000_000, "batches": 2_000_000}  # with the default flight


@dataclass(frozen=True)
class Part:
    """The selected part of the measurement, by default all."""

    forms: Sequence[str]
    loads: Sequence[str]
    flights: Sequence[str]

    def cases(self) -> Iterable[tuple[str, Load, list[str]]]:
        """Yield flight, load and forms: other libraries only with one vehicle and the default flight."""
        core = [form for form in self.forms if form in CORE]
        for flight in self.flights:
            for load in (LOADS[name] for name in self.loads):
                if flight == DEFAULT_FLIGHT or len(self.flights) == 1:
                    yield flight, load, core if load == TEN else list(self.forms)
                elif load in (FULL, KHZ):
                    yield flight, load, core


def main() -> None:
    """Measure and print; write the results of a complete run."""
    complete = Part(find_forms(), list(LOADS), [DEFAULT_FLIGHT, *(each for each in FLIGHTS if each != DEFAULT_FLIGHT)])
    parser = argparse.ArgumentParser(description="Compare nedbus with its peers.")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    for name, known in (("forms", complete.forms), ("loads", complete.loads), ("flights", complete.flights)):
        parser.add_argument(f"--{name}", nargs="+", choices=known, default=known)
    arguments = parser.parse_args()
    part = Part(arguments.forms, arguments.loads, arguments.flights)
    results = measure(part, arguments.rounds)
    if part == complete:
        write(results, arguments.rounds)
        print(as_markdown(results, arguments.rounds))
    else:
        print_medians(results)
    print_targets(results)


def measure(part: Part, rounds: int) -> Results:
    """Measure all forms that can be installed and work."""
    results = Results()
    pythons: dict[str, str] = {}
    for form in part.forms:
        try:
            pythons[form] = prepare(form)
        except subprocess.CalledProcessError as exc:
            results.drop(form, f"cannot be installed: {exc.stderr.decode()[-200:].strip()}")
    with router() as (_, endpoint):
        counts = {form: count(form, python, endpoint, results) for form, python in pythons.items()}
        for number in range(rounds):
            for flight, load, forms in part.cases():
                for form in forms:
                    if form in results.failed:
                        continue
                    least = MIN_MESSAGES.get(form, 0) if flight == DEFAULT_FLIGHT else 0
                    sized = load if load.rate else replace(load, messages=max(counts[form], least))
                    try:
                        measured = run(form, pythons[form], sized, flight=flight, endpoint=endpoint)
                    except RuntimeError as exc:
                        results.drop(form, f"fails: {exc}")
                        continue
                    results.add(flight, load, form, measured)
                    print(f"round {number + 1}: {flight}, {load.name}: {form}: {describe(load, measured)}", flush=True)
    return results


def count(form: str, python: str, endpoint: str, results: Results) -> int:
    """Return the number of messages for a run of the desired duration; 0 if the form does not work."""
    try:
        trial = run(form, python, replace(FULL, messages=TRIAL), flight=DEFAULT_FLIGHT, endpoint=endpoint)
    except RuntimeError as exc:
        results.drop(form, f"does not work here: {exc}")
        return 0
    return min(1_000_000, max(TRIAL, round(trial["rate"] * DURATION)))


def describe(load: Load, measured: dict[str, float]) -> str:
    """Format the main figures of a run, or of the medians of several."""
    cpu = f"CPU {measured['publish_cpu']:.1f} / {measured['receive_cpu']:.1f} us"
    lost = f", {1 - measured['kept']:.2%} LOST" if measured["kept"] < 1.0 else ""
    if load.rate:
        return f"p50 {measured['p50']:.0f}, p99 {measured['p99']:.0f} us, {cpu}{lost}"
    return f"{measured['rate']:,.0f}/s, {cpu}{lost}"


def print_medians(results: Results) -> None:
    """Print the medians, and their ratios to raw Zenoh and the straightforward script."""
    print()
    for flight, name, form in results.runs:
        load = LOADS[name]
        keys = ("publish_cpu", "receive_cpu", "p50") if load.rate else ("rate", "publish_cpu", "receive_cpu")
        ratios = [
            f"of {other} " + " / ".join(f"{results.ratio(flight, load, form, other, key):.2f}" for key in keys)
            for other in ("raw", "straightforward")
            if results.has(flight, load, other) and form != other
        ]
        medians = describe(load, results.median(flight, load, form))
        print(f"{flight}, {name}, {form}: {medians}" + "".join(f"; {each}" for each in ratios))
    for form, reason in results.failed.items():
        print(f"{form}: {reason}")


if __name__ == "__main__":
    main()
