"""The README and the pages in docs/: the script is the example, the commands exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from nedbus.sources import SOURCE_KINDS, parse_source
from tests.command_line import run_command

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = README + "".join(page.read_text() for page in sorted(ROOT.glob("docs/*.md")))


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGES, re.DOTALL)


BASH = "\n".join(blocks("bash"))
COMMANDS = sorted(re.findall(r"^nedbus ((?:pki )?\w+)([^#\n]*)", BASH, re.MULTILINE))


def test_first_script_is_the_example() -> None:
    """Each listing in the README is run by the tests."""
    example = (ROOT / "examples" / "position.py").read_text()
    assert example in blocks("python")
    assert len(example.splitlines()) == 10


@pytest.mark.parametrize("command", sorted({command for command, _ in COMMANDS}))
def test_shown_command_exists(command: str) -> None:
    """Every command that is shown exists, with its flags; every source can be parsed, every file is there."""
    overview = run_command(*command.split(), "--help", COLUMNS="200")
    assert overview.exit_code == 0
    arguments = "\n".join(shown for name, shown in COMMANDS if name == command)
    for flag in re.findall(r"--[a-z-]+", arguments):
        assert flag in overview.out
    for source in re.findall(r"(?:--source )\"?([^\s\"]+)", arguments):
        parse_source(source)
    for file in re.findall(r"config/\S+", arguments):
        assert (ROOT / file).is_file()


def test_shown_targets_exist() -> None:
    """Every make target of the README is in the Makefile."""
    makefile = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"^make (\w+)", BASH, re.MULTILINE))
    assert targets == {"run", "test", "wheel"}
    assert all(f"\n{target}:" in makefile for target in targets)


def test_shown_stacks_exist() -> None:
    """Every compose command names files, profiles and services that are there; every variable is in a file."""
    stacks = {file.name: file.read_text() for file in ROOT.glob("docker-compose*.yml")}
    commands = re.findall(r"^docker compose ([^#\n]*)", BASH, re.MULTILINE)
    assert len(commands) > 4
    for command in commands:
        files = re.findall(r"-f (\S+)", command)
        assert set(files) <= set(stacks)
        for profile in re.findall(r"--profile (\S+)", command):
            assert f"profiles: [{profile}]" in stacks["docker-compose.yml"]
    for variable in re.findall(r"`(NEDBUS_[A-Z]+_IMAGE|NEDBUS_PUBLISH|NEDBUS_PKI|NEDBUS_USER)`", PAGES):
        assert any(variable in text for text in stacks.values())


def test_shown_options_exist() -> None:
    """Every option of ulog: in the table is one."""
    rows = re.findall(r"^\| `(\w+)=\S+` \|", README, re.MULTILINE)
    assert set(rows) == set(SOURCE_KINDS["ulog"].options.model_fields)


BARE_EXTRA = re.compile(r"(?<![\w./])nedbus\[[^\]\n]*\](?! @ )")
INSTALL = re.compile(r"\b(?:pip3?|pipx|uv)\b.*\b(?:install|download|run|add)\b(.*)")
BARE_NAME = re.compile(r"""(?<![^\s"'`])nedbus(?=[\s"'`=<>~!]|$)(?! @ )""")


def bare_names(text: str) -> list[str]:
    """Return what a text shows to pip by our name alone, without a path or an address."""
    commands = [(match[0], match[1]) for match in INSTALL.finditer(text)]
    return BARE_EXTRA.findall(text) + [whole for whole, arguments in commands if BARE_NAME.search(arguments)]


def test_nothing_is_installed_by_our_name() -> None:
    """On PyPI the name is not ours: whatever is installed is named with a path or an address."""
    for refused in ('"nedbus[web]"', "-U nedbus", "nedbus==1"):
        assert bare_names(f"pip install {refused}"), refused
    assert bare_names("extra `nedbus[all]`")
    for allowed in ('".[web]"', "./nedbus-1.whl", "'nedbus[web] @ git+ssh://host/x'"):
        assert not bare_names(f"pip install {allowed}"), allowed
    folders = ("docs", "service", "schemas", "examples", "packaging", "config")
    files = [file for folder in folders for file in (ROOT / folder).rglob("*") if file.is_file()]
    files += [*ROOT.glob("*.md"), *ROOT.glob("*.yml"), ROOT / "Dockerfile", ROOT / "Makefile"]
    texts = {file: file.read_text() for file in files if file.suffix not in (".png", ".pyc")}
    assert {str(file): names for file, text in texts.items() if (names := bare_names(text))} == {}


def test_links_lead_somewhere() -> None:
    """Every link to a file of this project has a file at its end."""
    for page in (ROOT / "README.md", *ROOT.glob("docs/*.md"), ROOT / "CONTRIBUTING.md"):
        for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
