"""The page of the command line, from Typer's command tree."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import typer

from nedbus.cli.app import make_app

from .markdown import cell, code, page, plain, section, table


def commands() -> Iterator[tuple[str, Any]]:
    """Yield each command with its name, such as `nedbus pki ca`; the first one is `nedbus` itself."""
    root = typer.main.get_command(make_app())
    yield "nedbus", root
    yield from _below("nedbus", root)


def _below(name: str, group: Any) -> Iterator[tuple[str, Any]]:
    for each, command in group.commands.items():
        yield f"{name} {each}", command
        if hasattr(command, "commands"):
            yield from _below(f"{name} {each}", command)


def commands_page() -> str:
    """Return the page of all commands, with their arguments, options and defaults."""
    return page(
        "Command line",
        "Exit codes: 0 for success, 1 for failure, 2 for a usage error, 130 for Ctrl-C.",
        "Without `--connect` and `--config`, [the settings](settings.md) apply.",
        *(_command(name, command) for name, command in commands()),
    )


def _command(name: str, command: Any) -> str:
    context = typer.Context(command, info_name=name)
    usage = command.get_usage(context).removeprefix("Usage: ")
    rows = [record for each in command.params if (record := each.get_help_record(context))]
    return section(
        f"`{name}`",
        plain("\n".join(line.strip() for line in (command.help or "").splitlines())).strip(),
        f"```text\n{' '.join(usage.split())}\n```",
        table(["option", "meaning"], [[code(option), cell(meaning)] for option, meaning in rows]),
    )
