"""Parse the snippets of README and docs.

A comment above a block marks how it is tested; the site and git hosts hide it:

    <!-- not run: REASON -->            only syntax, commands, options and files are checked
    <!-- run by: tests/... -->          likewise; the named test runs it
    <!-- continues -->                  Python that continues the previous blocks of its page
    <!-- output -->                     output of the previous block; numbers may differ
    <!-- all sh not run: REASON -->     default marker of all blocks of this language on the page
"""

from __future__ import annotations

import re
import shlex
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import typer

from nedbus.cli.app import make_app
from nedbus.extras import EXTRAS
from nedbus.sources import SOURCE_KINDS

ROOT: Final = Path(__file__).parents[1]
PAGES: Final = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs").glob("[!mr]*/**/*.md")),
]
"""README and the hand-written pages: all but docs/messages and docs/reference."""

_MARKER = r"(?: *<!-- ([a-z ]+?)(?:: ([^\n]*?))? -->\n)?"
_BLOCK = re.compile(rf"^{_MARKER}^( *)```([\w{{}}]*)\n(.*?)^\3```$", re.DOTALL | re.MULTILINE)
_ALL = re.compile(r"<!-- all (\w+) (not run|run by): (.*?) -->")
_SHELL = re.compile(r"[|<>&;$`\\*{}]|^(?!nedbus )")


@dataclass(frozen=True, eq=False)
class Block:
    """A code block: page and line, language, text, and the marker and reason of the comment above it."""

    page: Path
    line: int
    language: str
    text: str
    marker: str = ""
    reason: str = ""

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    @property
    def is_run(self) -> bool:
        """True if test_documents runs the block."""
        return self.marker not in {"not run", "run by"}

    @property
    def commands(self) -> list[str]:
        """The shell commands, without comments; continuation lines are joined."""
        text = re.sub(r"(^|\s)#.*$", "", self.text, flags=re.MULTILINE).replace("\\\n", " ")
        return [line.strip() for line in text.splitlines() if line.strip()]

    @property
    def is_plain(self) -> bool:
        """True if the block consists of nedbus commands that need no shell."""
        return not any(
            _SHELL.search(re.sub(r"\"[^\"]*\"|'[^']*'", "", each)) for each in self.commands
        )


def blocks_of(page: Path) -> Iterator[Block]:
    """Yield the blocks of a page."""
    text = page.read_text()
    defaults = {language: (marker, reason) for language, marker, reason in _ALL.findall(text)}
    for found in _BLOCK.finditer(text):
        line = text.count("\n", 0, found.start(5))
        marker, reason = (
            (found[1] or "", found[2] or "") if found[1] else defaults.get(found[4], ("", ""))
        )
        yield Block(page, line, found[4], textwrap.dedent(found[5]), marker, reason)


BLOCKS: Final = [block for page in PAGES for block in blocks_of(page)]


def check_options(command: str) -> None:
    """Assert that a command named in a sentence exists and has the options named with it."""
    group: Any = typer.main.get_command(make_app())
    options = {name for option in group.params for name in option.opts}
    for word in shlex.split(command)[1:]:
        if word.startswith("-"):
            assert word.partition("=")[0] in {*options, "--help"}, command
        elif hasattr(group, "commands") and not word.isdigit():
            assert word in group.commands or word == "json", command
            group = group.commands.get(word, group)
            options |= {name for option in group.params for name in option.opts}


def parse_command(command: str) -> None:
    """Parse a nedbus command line with Typer, which raises for an unknown command, option or value."""
    group: Any = typer.main.get_command(make_app())
    arguments = [each for each in shlex.split(command)[1:] if each != "..."]
    context = group.make_context("nedbus", arguments, resilient_parsing=False)
    while hasattr(group, "commands"):
        name, group, arguments = group.resolve_command(
            context, [*context._protected_args, *context.args]
        )
        if "--help" in arguments:
            return
        context = group.make_context(name, arguments, parent=context)


def nedbus_commands(block: Block) -> list[str]:
    """Return the nedbus command lines in a block, without shell pipes and redirections."""
    found = [
        re.search(r"(?:^|[|&] ?)(nedbus (?:\"[^\"]*\"|[^|&>])*)", each) for each in block.commands
    ]
    return [match[1].strip() for match in found if match]


def shape_of(line: str) -> re.Pattern[str]:
    """Return a pattern that matches lines with other numbers and spaces."""
    parts = re.split(r"(-?\d[\d.,:]*|\s+)", line.strip())
    return re.compile("".join(
        r"\s+" if part.isspace() else r"-?\d[\d.,:]*" if re.fullmatch(r"-?\d[\d.,:]*", part) else re.escape(part)
        for part in parts
    ))  # fmt: skip


_CORE: Final = {
    "nedbus",
    "nedbus_msgs",
    "numpy",
    "pydantic",
    "msgpack",
    "zenoh",
    *sys.stdlib_module_names,
}
_COMMAND_EXTRAS: Final = {
    "web": "web", "foxglove": "foxglove", "plot": "plot", "record": "mcap", "convert": "mcap", "pki": "pki",
    "export": "metrics",
}  # fmt: skip
_CALL_EXTRAS: Final = {"nedbus.plot(": "plot", "nedbus.convert(": "mcap", ".to_parquet(": "pyarrow"}
_SUFFIX_EXTRAS: Final = {".mcap": "mcap", ".tlog": "mavlink"}
_MADE_BY_README: Final = {"metrics"}  # by `make run`, in which all pages begin


def needed_packages(page: Path) -> set[str]:
    """Return the extras and packages that the commands and snippets of a page need."""
    text = page.read_text()
    needed = {extra for call, extra in _CALL_EXTRAS.items() if call in text}
    needed |= set(re.findall(r"dataframe=\"(\w+)\"", text))
    for block in blocks_of(page):
        if block.language == "python":
            imported = re.findall(r"^ *(?:import|from) (\w+)", block.text, re.MULTILINE)
            needed |= set(imported) - _CORE
        for command in nedbus_commands(block) if block.language in {"bash", "sh"} else ():
            words = shlex.split(command)
            needed |= {_COMMAND_EXTRAS[word] for word in words if word in _COMMAND_EXTRAS}
            needed |= {extra for suffix, extra in _SUFFIX_EXTRAS.items() if suffix in command}
            kinds = [SOURCE_KINDS.get(word.partition(":")[0]) for word in words if ":" in word]
            needed |= {kind.extra for kind in kinds if kind is not None}
            if "--http" in words:
                needed.add("metrics")
    return needed - {""} - _MADE_BY_README


def installed_packages(page: Path) -> set[str]:
    """Return the extras and packages that the install lines of a page name; "all" is every extra."""
    installed: set[str] = set()
    for line in re.findall(r"pip install ([^\n`;&#]*)", page.read_text()):
        for word in re.sub(r"[\"',()]", " ", re.sub(r",(?=[\w,]*\])", "+", line)).split():
            extras = re.search(r"\[([\w+]+)\]", word)
            installed |= set(extras[1].split("+")) if extras else {word}
    return installed | EXTRAS if "all" in installed else installed
