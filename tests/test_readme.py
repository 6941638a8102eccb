"""The README: its script is the example, its commands exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from nedbus.sources import SOURCE_KINDS, parse_source
from tests.conftest import Start

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_first_script_is_the_example() -> None:
    """What is shown is what the tests run."""
    example = (ROOT / "examples" / "position.py").read_text()
    assert example in blocks("python")
    assert len(example.splitlines()) == 8


COMMANDS = sorted(set(re.findall(r"^nedbus ((?:pki )?\w+)([^#\n]*)", "\n".join(blocks("bash")), re.MULTILINE)))


@pytest.mark.parametrize(("command", "arguments"), COMMANDS)
def test_shown_command_exists(run_nedbus: Start, command: str, arguments: str) -> None:
    """Every command of the README exists, with the flags that are shown; every source can be parsed."""
    overview = run_nedbus(*command.split(), "--help", COLUMNS="200")
    assert overview.wait() == 0
    for flag in re.findall(r"--[a-z-]+", arguments):
        assert flag in overview.out
    for source in re.findall(r"(?:--source )\"?([^\s\"]+)", arguments):
        parse_source(source)


def test_shown_targets_exist() -> None:
    """Every make target of the README is in the Makefile."""
    makefile = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"^make (\w+)", "\n".join(blocks("bash")), re.MULTILINE))
    assert targets == {"run", "test"}
    assert all(f"\n{target}:" in makefile for target in targets)


def test_shown_options_exist() -> None:
    """Every option of ulog: in the table is one."""
    rows = re.findall(r"^\| `(\w+)=\S+` \|", README, re.MULTILINE)
    assert set(rows) == set(SOURCE_KINDS["ulog"].options.model_fields)
