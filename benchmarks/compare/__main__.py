"""nedbus beside its peers, in one run: python -m benchmarks.compare [--rounds N].

Each form of `forms` sends the same 53 fields from one process to another, through one router where it uses
Zenoh: as fast as it can without losing any, then at 1 kHz and at 100 Hz; some with ten vehicles in one process, and
with the messages of other flights.
Rounds are interleaved, and medians taken, as machines are shared and noisy; only the ratios of one run mean something.
Peers are installed in environments of their own under build/bench; one that cannot be is named as such.
The results are written to docs/explanation/performance.json and, as tables, into the page beside it and the README;
those of a part, as with `--forms raw models --loads 1kHz --flights "no origin"`, are only printed.
"""

from __future__ import annotations

import argparse
import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from benchmarks.processes import router

from .bars import print_bars
from .fields import DEFAULT_FLIGHT, FLIGHTS
from .measure import run
from .peers import CORE, find_forms, prepare
from .report import as_markdown, write
from .results import FULL, KHZ, LOADS, TEN, Load, Results

ROUNDS: Final = 3
LASTS: Final = 2.5  # s that a run at full speed should last
TRIAL: Final = 5000  # messages that say how many that are
MANY: Final = {"raw": 2_000_000, "batches": 2_000_000}  # messages of these in any case, with the default flight


@dataclass(frozen=True)
class Part:
    """The part that is measured: all of it, unless the arguments name less."""

    forms: Sequence[str]
    loads: Sequence[str]
    flights: Sequence[str]

    def cases(self) -> Iterable[tuple[str, Load, list[str]]]:
        """Yield flight, load and forms: peers with one vehicle, and beside other flights with the default one only."""
        core = [form for form in self.forms if form in CORE]
        for flight in self.flights:
            for load in (LOADS[name] for name in self.loads):
                if flight == DEFAULT_FLIGHT or len(self.flights) == 1:
                    yield flight, load, core if load == TEN else list(self.forms)
                elif load in (FULL, KHZ):
                    yield flight, load, core


def main() -> None:
    """Measure, print, and write what is complete."""
    whole = Part(find_forms(), list(LOADS), [DEFAULT_FLIGHT, *(each for each in FLIGHTS if each != DEFAULT_FLIGHT)])
    parser = argparse.ArgumentParser(description="Compare nedbus with its peers.")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    for name, known in (("forms", whole.forms), ("loads", whole.loads), ("flights", whole.flights)):
        parser.add_argument(f"--{name}", nargs="+", choices=known, default=known)
    arguments = parser.parse_args()
    part = Part(arguments.forms, arguments.loads, arguments.flights)
    results = measure(part, arguments.rounds)
    if part == whole:
        write(results, arguments.rounds)
        print(as_markdown(results, arguments.rounds))
    else:
        print_medians(results)
    print_bars(results)


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
                    many = MANY.get(form, 0) if flight == DEFAULT_FLIGHT else 0
                    chosen = load if load.rate else replace(load, messages=max(counts[form], many))
                    try:
                        measured = run(form, pythons[form], chosen, flight=flight, endpoint=endpoint)
                    except RuntimeError as exc:
                        results.drop(form, f"fails: {exc}")
                        continue
                    results.add(flight, load, form, measured)
                    print(f"round {number + 1}: {flight}, {load.name}: {form}: {describe(load, measured)}", flush=True)
    return results


def count(form: str, python: str, endpoint: str, results: Results) -> int:
    """Return how many messages last for a while; 0 if the form does not work."""
    try:
        trial = run(form, python, replace(FULL, messages=TRIAL), flight=DEFAULT_FLIGHT, endpoint=endpoint)
    except RuntimeError as exc:
        results.drop(form, f"does not work here: {exc}")
        return 0
    return min(1_000_000, max(TRIAL, round(trial["rate"] * LASTS)))


def describe(load: Load, measured: dict[str, float]) -> str:
    """Return the most important numbers of a run, or of several."""
    cpu = f"CPU {measured['publish_cpu']:.1f} / {measured['receive_cpu']:.1f} us"
    lost = f", {1 - measured['kept']:.2%} LOST" if measured["kept"] < 1.0 else ""
    if load.rate:
        return f"p50 {measured['p50']:.0f}, p99 {measured['p99']:.0f} us, {cpu}{lost}"
    return f"{measured['rate']:,.0f}/s, {cpu}{lost}"


def print_medians(results: Results) -> None:
    """Print the medians of a part, and their ratios to raw and to the straightforward script."""
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
