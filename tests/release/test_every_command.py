"""Every command in an environment without optional packages, as a wheel without extras and `make run` install."""

from __future__ import annotations

import re

import pytest

from tests.peers.processes import Start
from tests.release.every_command import ROOT, Case, problem_of

# The extras that `make run` installs.
MAKE_RUN = re.findall(r'--editable "\.\[(\w+)\]"', (ROOT / "Makefile").read_text())


@pytest.mark.long
@pytest.mark.parametrize("extras", [[], MAKE_RUN], ids=["wheel", "make run"])
def test_commands_run_without_optional_packages(start: Start, extras: list[str]) -> None:
    """Help needs no extra; a command whose extra is missing ends with one line that names it, and exit code 2."""
    process = start(str(ROOT / "tests/release/every_command.py"), *extras, "--block", fresh=True)
    assert process.wait(90) == 0, process.err  # 40 runs: six seconds on an idle machine


@pytest.mark.parametrize(
    ("extra", "code", "err"),
    [
        ("mcap", 2, "Traceback (most recent call last):\nModuleNotFoundError: .[mcap]\n"),
        ("mcap", 1, "nedbus: mcap: not installed; run pip install -e '.[mcap]'\n"),
        ("mcap", 2, "nedbus: mcap: not installed\n"),
        ("mcap", 2, "warning\nnedbus: run pip install -e '.[mcap]'\n"),
        ("", 2, "nedbus: mcap: not installed; run pip install -e '.[mcap]'\n"),
    ],
)
def test_faults_of_a_run_are_found(extra: str, code: int, err: str) -> None:
    """A traceback, another exit code, a second line, and a line without the extra are faults."""
    assert problem_of(Case(("record",), frozenset({2}), extra), code, "", err)
    assert not problem_of(
        Case(("record",), frozenset({2}), "mcap"), 2, "", "nedbus: run pip install -e '.[mcap]'\n"
    )
