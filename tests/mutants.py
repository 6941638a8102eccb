"""Mutation testing with hand-written mutants: python -m tests.mutants --out build/mutants.jsonl.

`mutants.toml` lists the mutations by file, and the tests that should detect each. Each mutation is applied to a copy of
a checkout, and its tests run until the first failure: those of `make test`, then those marked slow. A timeout counts as
a failure. The exit code is 1 if a mutant survives.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[1]
TABLE: Final = Path(__file__).with_suffix(".toml")
TIERS: Final = {
    "test": "not (slow or long or compose)",
    "test-all": "(slow or long) and not compose",
}
_FAILED: Final = re.compile(r"^(?:FAILED|ERROR) (tests/.+?)(?: - .*)?$", re.MULTILINE)
_USAGE, _NO_TESTS = 4, 5  # exit codes of pytest: usage error; no tests collected
_BASELINE: Final = 7200.0  # s; timeout of all named tests without a mutation


@dataclass(frozen=True, slots=True)
class Fault:
    """A mutation: file, kind, description of the fault, replaced and new text, and tests.

    `tests`: files below `tests/`, optionally followed by -k and an expression.
    """

    path: str
    kind: str
    what: str
    old: str
    new: str
    tests: str

    @property
    def name(self) -> str:
        """The name of the fault in the table of results."""
        return f"{self.path}: {self.kind}: {self.what}"

    def arguments(self, checkout: Path) -> list[str]:
        """Return the arguments of pytest; files missing in this checkout are omitted."""
        names, _, expression = self.tests.partition(" -k ")
        files = [f"tests/{name}" for name in names.split() if (checkout / "tests" / name).is_file()]
        return [*files, "-k", expression] if files and expression else files

    def problems(self, checkout: Path) -> Iterator[str]:
        """Yield the reasons why this mutation cannot be applied to a checkout."""
        file = checkout / self.path
        count = file.read_text().count(self.old) if file.is_file() else 0
        if count != 1:
            yield f"{self.name}: the file contains its old text {count} times"
        if not self.arguments(checkout):
            yield f"{self.name}: none of its test files exists"


@dataclass(frozen=True, slots=True)
class Result:
    """The first failed test and its tier; "" if the mutant survived. `seconds`: duration of the run."""

    fault: str
    found_by: str
    tier: str
    seconds: float


def main() -> int:
    """Run all or the selected mutants, and print a table of the tests that detected them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--checkout", type=Path, default=ROOT, help="checkout to test, with its tests"
    )
    parser.add_argument(
        "--only", default="", metavar="REGEX", help="select mutants by path, kind or description"
    )
    parser.add_argument(
        "--limit", type=float, default=900.0, help="timeout of the tests of a mutant [s]"
    )
    parser.add_argument(
        "--out", type=Path, help="append results to this file; skip mutants already in it"
    )
    parser.add_argument(
        "--no-baseline", action="store_true", help="skip the run without a mutation"
    )
    arguments = parser.parse_args()
    # run the finally blocks
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    checkout = arguments.checkout.resolve()
    faults = [fault for fault in read_table() if re.search(arguments.only, fault.name)]
    problems = [problem for fault in faults for problem in fault.problems(checkout)]
    if problems or not faults:
        raise SystemExit("\n".join(problems) or "no mutant is selected")
    results: dict[str, Result] = {}
    if arguments.out is not None and arguments.out.is_file():
        lines = [Result(**json.loads(line)) for line in arguments.out.read_text().splitlines()]
        results = {result.fault: result for result in lines}
    with tempfile.TemporaryDirectory(prefix="nedbus-mutants-") as folder:
        tree = copy_tree(checkout, Path(folder))
        if not arguments.no_baseline:
            files = sorted(
                {name for fault in faults for name in fault.arguments(tree) if name.endswith(".py")}
            )
            if found := find_failure(tree, files, "not compose", _BASELINE):
                raise SystemExit(f"this test fails without a mutation: {found}")
        for number, fault in enumerate(faults, 1):
            if fault.name not in results:
                result = results[fault.name] = try_fault(tree, fault, arguments.limit, stamp=number)
                if arguments.out is not None:
                    with arguments.out.open("a") as out:
                        out.write(json.dumps(asdict(result)) + "\n")
            _print(
                f"{number}/{len(faults)} {fault.name}: {results[fault.name].found_by or 'SURVIVES'}"
            )
    return _report([results[fault.name] for fault in faults])


def read_table() -> list[Fault]:
    """Return the mutations of mutants.toml."""
    table: Mapping[str, Collection[Mapping[str, str]]] = tomllib.loads(TABLE.read_text())
    return [Fault(path, **entry) for path, entries in table.items() for entry in entries]


def copy_tree(checkout: Path, folder: Path) -> Path:
    """Copy the tracked and new files of a checkout, and link its shared data."""
    listed = [
        "git",
        "-C",
        str(checkout),
        "ls-files",
        "-z",
        "--cached",
        "--others",
        "--exclude-standard",
    ]
    tree = folder / "tree"
    for name in subprocess.run(listed, check=True, capture_output=True, text=True).stdout.split(
        "\0"
    ):
        if (checkout / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(checkout / name, tree / name)
    if (checkout.parent / "shared").is_dir():
        (folder / "shared").symlink_to((checkout.parent / "shared").resolve())
    # Pytest rejects unknown markers, and an older checkout may not declare these.
    settings = tree / "pyproject.toml"
    settings.write_text(
        settings.read_text().replace("markers = [", 'markers = [\n  "slow",\n  "long",', 1)
    )
    return tree


def try_fault(tree: Path, fault: Fault, limit: float, *, stamp: int) -> Result:
    """Apply a mutation to the tree, run its tests tier by tier until one fails, and revert it."""
    file = tree / fault.path
    text, stat, begin = file.read_text(), file.stat(), time.monotonic()
    try:
        file.write_text(text.replace(fault.old, fault.new))
        os.utime(file, (stamp, stamp))  # a new time invalidates the compiled file
        tried = (
            (find_failure(tree, fault.arguments(tree), marked, limit), tier)
            for tier, marked in TIERS.items()
        )
        found, tier = next((each for each in tried if each[0]), ("", ""))
    finally:
        file.write_text(text)
        os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    return Result(fault.name, found, tier, round(time.monotonic() - begin, 1))


def find_failure(tree: Path, arguments: list[str], marked: str, limit: float) -> str:
    """Return the first test that fails twice, the second time alone; otherwise the result of `run_tests`."""
    while (found := run_tests(tree, arguments, marked, limit)) and "::" in found:
        if run_tests(tree, [found], marked, limit):
            break
        arguments = [*arguments, "--deselect", found]  # a flaky test
    return found


def run_tests(tree: Path, arguments: list[str], marked: str, limit: float) -> str:
    """Return the first test that fails, "time" after `limit` seconds, or "" if all pass."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "-p",
        "no:cacheprovider",
        "-m",
        marked,
        *arguments,
    ]
    environment = os.environ | {"PYTHONPATH": f"{tree / 'service'}:{tree / 'schemas'}"}
    with tempfile.TemporaryFile("w+") as output:
        process = subprocess.Popen(
            command,
            cwd=tree,
            env=environment,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            code = process.wait(limit)
        except subprocess.TimeoutExpired:
            return "time"
        finally:  # with all its child processes
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        output.seek(0)
        text = output.read()
    if code == _USAGE:
        raise SystemExit(f"{shlex.join(command)}:\n{text}")
    failed = _FAILED.search(text)
    return "" if code in (0, _NO_TESTS) else failed[1] if failed else f"exit code {code} of pytest"


def _report(results: Collection[Result]) -> int:
    """Print the table, and return the exit code."""
    _print("| fault | found by | tier |\n|---|---|---|")
    for result in results:
        _print(
            f"| {result.fault} | {f'`{result.found_by}`' if result.found_by else 'survives'} | {result.tier} |"
        )
    killed = sum(bool(result.found_by) for result in results)
    _print(f"killed {killed} of {len(results)}")
    return int(killed < len(results))


def _print(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
