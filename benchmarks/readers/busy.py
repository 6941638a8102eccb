"""Readers in scripts that are busy with pure Python: python -m benchmarks.readers.busy [--seconds N].

One vehicle is published live at 2,000 messages a second. A script is idle, or computes all the time and reads in a
second thread, or computes for 10 ms between two reads.
Targets: mode `every` loses and drops nothing, and messages in mode `latest` are at most 50 ms old (p99).
"""

from __future__ import annotations

import argparse
import json
from typing import Final

from benchmarks.processes import end, expect, resume, router, start

RATE: Final = 2000  # Hz
MAX_AGE: Final = 50.0  # ms
TIMEOUT: Final = 60.0  # s beyond the measurement
CASES: Final = [
    *(
        (form, script)
        for script in ("idle", "computes always")
        for form in ("raw fifo", "raw ring", "every", "latest")
    ),
    *((form, "computes between") for form in ("raw fifo", "raw ring", "latest")),
]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=int, default=20)
    forms = list(dict.fromkeys(form for form, _ in CASES))
    parser.add_argument("--forms", nargs="+", choices=forms, default=forms)
    arguments = parser.parse_args()
    print(
        "form      script            received / sent     lost  dropped   age ms: p50     p99     max   steps/s"
    )
    for form, script in CASES:
        if form in arguments.forms:
            print(measure(form, script, arguments.seconds), flush=True)


def measure(form: str, script: str, seconds: int) -> str:
    """Run one reader and return its line."""
    sent = RATE * seconds
    with router() as (_, endpoint):
        reader = start("-m", "benchmarks.readers.busy_reader", form, script, endpoint)
        sender = "raw" if form.startswith("raw") else "rows"
        publisher = start(
            "-m", "benchmarks.compare.role", sender, "publish", endpoint, str(sent), str(RATE)
        )
        try:
            expect(reader)
            expect(publisher)
            resume(publisher)
            expect(publisher, seconds + TIMEOUT)
            resume(reader)
            found = json.loads(expect(reader, seconds + TIMEOUT))
            resume(publisher)
        finally:
            end(reader, publisher, timeout=2.0)
    lost, dropped = (
        f"{found[key]:8}" if key in found else "       -" for key in ("lost", "dropped")
    )
    line = (
        f"{form:9} {script:17} {found['received']:8} / {sent:<8} {lost} {dropped}"
        f"   {found['p50']:12.2f} {found['p99']:7.2f} {found['max']:7.1f} {found['steps']:9.0f}"
    )
    if form == "every":
        complete = found["received"] == sent and not found["lost"] and not found["dropped"]
        return f"{line}   {'met' if complete else 'MISSED'}: nothing lost or dropped"
    if form == "latest":
        return f"{line}   {'met' if found['p99'] <= MAX_AGE else 'MISSED'}: p99 at most {MAX_AGE:.0f} ms"
    return line


if __name__ == "__main__":
    main()
