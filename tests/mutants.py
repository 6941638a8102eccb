"""Deliberate faults, each of which the tests must find: python -m tests.mutants --out build/mutants.jsonl.

`mutants.toml` beside this file names them, by the file that each is in, and the tests that should find it.
One fault at a time is put into a copy of a checkout, and its tests run there until the first fails: at first those of
`make test`, then those marked slow. One that makes them stand still is found too, by the limit of time.
The exit code is 1 when a fault survives.
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
TIERS: Final = {"test": "not slow and not compose", "test-all": "slow and not compose"}
_FAILED: Final = re.compile(r"^(?:FAILED|ERROR) (tests/.+?)(?: - .*)?$", re.MULTILINE)
_USAGE, _NO_TESTS = 4, 5  # exit codes of pytest: it cannot begin; none was chosen
_GROUNDWORK: Final = 7200.0  # s that all named tests together may take without any fault


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: its file, its kind, what is wrong then, the text that is replaced, and its tests.

    `tests`: files below `tests/`, and perhaps an expression after -k.
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
        """Return what pytest is given; files that this checkout does not have are left out."""
        names, _, chosen = self.tests.partition(" -k ")
        files = [f"tests/{name}" for name in names.split() if (checkout / "tests" / name).is_file()]
        return [*files, "-k", chosen] if files and chosen else files

    def problems(self, checkout: Path) -> Iterator[str]:
        """Yield why this fault cannot be tried on a checkout."""
        file = checkout / self.path
        count = file.read_text().count(self.old) if file.is_file() else 0
        if count != 1:
            yield f"{self.name}: its old text is there {count} times"
        if not self.arguments(checkout):
            yield f"{self.name}: none of its tests is there"


@dataclass(frozen=True, slots=True)
class Result:
    """The first test that failed of a fault, and in which tier; "" where it survived. `seconds` is what it took."""

    fault: str
    found_by: str
    tier: str
    seconds: float


def main() -> int:
    """Try all faults, or those that are chosen, and print a table of what found them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkout", type=Path, default=ROOT, help="try another checkout, with its own tests")
    parser.add_argument("--only", default="", metavar="REGEX", help="faults whose path, kind or words match")
    parser.add_argument("--limit", type=float, default=900.0, help="seconds that the tests of a fault have")
    parser.add_argument("--out", type=Path, help="add each result to this file; what is there is not tried again")
    parser.add_argument("--no-groundwork", action="store_true", help="trust that the tests pass without any fault")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))  # so that what it started ends with it
    checkout = arguments.checkout.resolve()
    faults = [fault for fault in read_table() if re.search(arguments.only, fault.name)]
    problems = [problem for fault in faults for problem in fault.problems(checkout)]
    if problems or not faults:
        raise SystemExit("\n".join(problems) or "no fault is chosen")
    results: dict[str, Result] = {}
    if arguments.out is not None and arguments.out.is_file():
        lines = [Result(**json.loads(line)) for line in arguments.out.read_text().splitlines()]
        results = {result.fault: result for result in lines}
    with tempfile.TemporaryDirectory(prefix="nedbus-mutants-") as folder:
        tree = copy_tree(checkout, Path(folder))
        if not arguments.no_groundwork:
            files = sorted({name for fault in faults for name in fault.arguments(tree) if name.endswith(".py")})
            if found := find_failure(tree, files, "not compose", _GROUNDWORK):
                raise SystemExit(f"this fails without any fault: {found}")
        for number, fault in enumerate(faults, 1):
            if fault.name not in results:
                result = results[fault.name] = try_fault(tree, fault, arguments.limit, stamp=number)
                if arguments.out is not None:
                    with arguments.out.open("a") as out:
                        out.write(json.dumps(asdict(result)) + "\n")
            _say(f"{number}/{len(faults)} {fault.name}: {results[fault.name].found_by or 'SURVIVES'}")
    return _report([results[fault.name] for fault in faults])


def read_table() -> list[Fault]:
    """Return the faults of the table, in which they stand below the path of what they change."""
    table: Mapping[str, Collection[Mapping[str, str]]] = tomllib.loads(TABLE.read_text())
    return [Fault(path, **entry) for path, entries in table.items() for entry in entries]


def copy_tree(checkout: Path, folder: Path) -> Path:
    """Copy what git knows of a checkout, and what is new in it, and show it the data beside it."""
    listed = ["git", "-C", str(checkout), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    tree = folder / "tree"
    for name in subprocess.run(listed, check=True, capture_output=True, text=True).stdout.split("\0"):
        if (checkout / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(checkout / name, tree / name)
    if (checkout.parent / "shared").is_dir():
        (folder / "shared").symlink_to((checkout.parent / "shared").resolve())
    # An older checkout has no test that is slow, and pytest takes no marker that it does not know.
    settings = tree / "pyproject.toml"
    settings.write_text(settings.read_text().replace("markers = [", 'markers = [\n  "slow",', 1))
    return tree


def try_fault(tree: Path, fault: Fault, limit: float, *, stamp: int) -> Result:
    """Put a fault into the tree, run its tests tier by tier until one fails, and take it out again."""
    file = tree / fault.path
    text, stat, begin = file.read_text(), file.stat(), time.monotonic()
    try:
        file.write_text(text.replace(fault.old, fault.new))
        os.utime(file, (stamp, stamp))  # Python knows by its time whether what it compiled is still true
        tried = ((find_failure(tree, fault.arguments(tree), marked, limit), tier) for tier, marked in TIERS.items())
        found, tier = next((each for each in tried if each[0]), ("", ""))
    finally:
        file.write_text(text)
        os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    return Result(fault.name, found, tier, round(time.monotonic() - begin, 1))


def find_failure(tree: Path, arguments: list[str], marked: str, limit: float) -> str:
    """Return the first test that fails, and fails again alone; else, as `run_tests` does, why they do not pass."""
    while (found := run_tests(tree, arguments, marked, limit)) and "::" in found:
        if run_tests(tree, [found], marked, limit):
            break
        arguments = [*arguments, "--deselect", found]  # it failed by chance
    return found


def run_tests(tree: Path, arguments: list[str], marked: str, limit: float) -> str:
    """Return the first test that fails, "time" when there is no end within `limit` seconds, "" when all pass."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-m", marked, *arguments]
    environment = os.environ | {"PYTHONPATH": f"{tree / 'service'}:{tree / 'schemas'}"}
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(
            command, cwd=tree, env=environment, stdout=said, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            code = process.wait(limit)
        except subprocess.TimeoutExpired:
            return "time"
        finally:  # with whatever it started
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        said.seek(0)
        text = said.read()
    if code == _USAGE:
        raise SystemExit(f"{shlex.join(command)}:\n{text}")
    failed = _FAILED.search(text)
    return "" if code in (0, _NO_TESTS) else failed[1] if failed else f"the end of pytest, with {code}"


def _report(results: Collection[Result]) -> int:
    """Print the table, and return the exit code."""
    _say("| fault | found by | tier |\n|---|---|---|")
    for result in results:
        _say(f"| {result.fault} | {f'`{result.found_by}`' if result.found_by else 'survives'} | {result.tier} |")
    killed = sum(bool(result.found_by) for result in results)
    _say(f"killed {killed} of {len(results)}")
    return int(killed < len(results))


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
