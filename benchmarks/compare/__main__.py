"""Compare nedbus with similar libraries: python -m benchmarks.compare [--rounds N].

Each module of `forms` sends the same 53 fields from one process to another, with Zenoh through one router: at full
speed without loss, then at 1 kHz and at 100 Hz; some also with ten vehicles in one process, and with the messages of
other flights.
With `--vs CHECKOUT` the forms of nedbus also run with another checkout of it, which has its own .venv and router.
Machines are shared and noisy: rounds are interleaved, medians are reported, and only ratios within one run are
meaningful. Other libraries are installed in virtual environments under build/bench; failures are reported.
A complete run is written to docs/explanation/performance.json and, as tables, to performance.md and the README; partial
results, such as those of `--forms raw models --loads 1kHz --flights "no origin"`, are only printed.
"""

from __future__ import annotations

import argparse
import subprocess
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from benchmarks.processes import HERE, Checkout, router

from .fields import DEFAULT_FLIGHT, FLIGHTS
from .measure import Subject, run
from .peers import CORE, NEDBUS, find_forms, prepare
from .report import as_markdown, write
from .results import BEFORE, FULL, KHZ, LOADS, TEN, Load, Results
from .targets import print_targets

ROUNDS: Final = 5
DURATION: Final = 2.5  # s; desired duration of a run at full speed
TRIAL: Final = 5000  # messages of the trial that estimates their number
MIN_MESSAGES: Final = {"raw": 2_000_000, "batches": 2_000_000}  # with the default flight


@dataclass
class Part:
    """The selected part of the measurement, by default all."""

    forms: Sequence[str]
    loads: Sequence[str]
    flights: Sequence[str]

    def cases(self) -> Iterable[tuple[str, Load, list[str]]]:
        """Yield flight, load and forms: other libraries only with one vehicle and the default flight."""
        core = [form for form in self.forms if form.removesuffix(BEFORE) in CORE]
        for flight in self.flights:
            for load in (LOADS[name] for name in self.loads):
                if flight == DEFAULT_FLIGHT or len(self.flights) == 1:
                    yield flight, load, core if load == TEN else list(self.forms)
                elif load in (FULL, KHZ):
                    yield flight, load, core


def main() -> None:
    """Measure and print; write the results of a complete run."""
    complete = Part(
        find_forms(),
        list(LOADS),
        [DEFAULT_FLIGHT, *(flight for flight in FLIGHTS if flight != DEFAULT_FLIGHT)],
    )
    parser = argparse.ArgumentParser(description="Compare nedbus with its peers.")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument(
        "--vs", type=Path, metavar="CHECKOUT", help="another checkout of nedbus to compare with"
    )
    for name, known in (
        ("forms", complete.forms),
        ("loads", complete.loads),
        ("flights", complete.flights),
    ):
        parser.add_argument(f"--{name}", nargs="+", choices=known, default=known)
    arguments = parser.parse_args()
    part = Part(arguments.forms, arguments.loads, arguments.flights)
    if arguments.vs:
        part.forms = [
            name
            for form in part.forms
            for name in (form, *([form + BEFORE] if form in NEDBUS else []))
        ]
    results = measure(part, arguments.rounds, before=arguments.vs)
    if part == complete:
        write(results, arguments.rounds)
        print(as_markdown(results, arguments.rounds))
    else:
        print_medians(results)
    print_targets(results)


def measure(part: Part, rounds: int, *, before: Path | None = None) -> Results:
    """Measure all forms that can be installed and work; `before`: checkout of the forms whose name ends with BEFORE."""
    results = Results()
    subjects: dict[str, Subject] = {}
    with ExitStack() as routers:
        builds = {"": (HERE, *routers.enter_context(router()))}
        if before is not None:
            other = Checkout(before.resolve())
            builds[BEFORE] = (other, *routers.enter_context(router(other)))
        for name in part.forms:
            form, mark, _ = name.partition(BEFORE)
            try:
                python = builds[mark][0].python if form in NEDBUS else prepare(form)
            except subprocess.CalledProcessError as exc:
                results.drop(name, f"cannot be installed: {exc.stderr.decode()[-200:].strip()}")
            else:
                subjects[name] = Subject(form, python, *builds[mark])
        counts = {name: count(name, subject, results) for name, subject in subjects.items()}
        for number in range(rounds):
            for flight, load, names in part.cases():
                for name in names:
                    if name in results.failed:
                        continue
                    least = MIN_MESSAGES.get(name, 0) if flight == DEFAULT_FLIGHT else 0
                    sized = load if load.rate else replace(load, messages=max(counts[name], least))
                    try:
                        measured = run(subjects[name], sized, flight=flight)
                    except RuntimeError as exc:
                        results.drop(name, f"fails: {exc}")
                        continue
                    results.add(flight, load, name, measured)
                    print(
                        f"round {number + 1}: {flight}, {load.name}: {name}: {describe(load, measured)}",
                        flush=True,
                    )
    return results


def count(name: str, subject: Subject, results: Results) -> int:
    """Return the number of messages for a run of the desired duration; 0 if the form does not work."""
    try:
        trial = run(subject, replace(FULL, messages=TRIAL), flight=DEFAULT_FLIGHT)
    except RuntimeError as exc:
        results.drop(name, f"does not work here: {exc}")
        return 0
    return min(1_000_000, max(TRIAL, round(trial["rate"] * DURATION)))


def describe(load: Load, measured: dict[str, float]) -> str:
    """Format the main figures of a run, or of the medians of several."""
    cpu = f"CPU {measured['publish_cpu']:.1f} / {measured['receive_cpu']:.1f} us"
    cpu += f", with the router {measured['total_cpu']:.1f} us"
    lost = f", {1 - measured['kept']:.2%} LOST" if measured["kept"] < 1.0 else ""
    if load.rate:
        return f"p50 {measured['p50']:.0f}, p99 {measured['p99']:.0f} us, {cpu}{lost}"
    return f"{measured['rate']:,.0f}/s, {cpu}{lost}"


def print_medians(results: Results) -> None:
    """Print the medians, and their ratios to raw Zenoh and the straightforward script."""
    print()
    for flight, name, form in results.runs:
        load = LOADS[name]
        keys = (
            ("publish_cpu", "receive_cpu", "p50")
            if load.rate
            else ("rate", "publish_cpu", "receive_cpu")
        )
        ratios = [
            f"of {other} "
            + " / ".join(f"{results.ratio(flight, load, form, other, key):.2f}" for key in keys)
            for other in ("raw", "straightforward")
            if results.has(flight, load, other) and form != other
        ]
        medians = describe(load, results.median(flight, load, form))
        print(f"{flight}, {name}, {form}: {medians}" + "".join(f"; {ratio}" for ratio in ratios))
    for form, reason in results.failed.items():
        print(f"{form}: {reason}")


if __name__ == "__main__":
    main()
