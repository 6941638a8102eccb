"""Check configuration before it is used: check, and serve --check."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from nedbus.cli.options import command
from nedbus.cli.output.streams import write, write_stderr
from nedbus.doctor import check_router_file, check_service
from nedbus.errors import ConfigError


@command
def check(
    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="CONFIG...", help="Settings (.toml) and router files (.json5)", show_default=False),
    ] = None,
    *,
    offline: Annotated[bool, typer.Option("--offline", help="Judge the text only, and not what this host has")] = False,
) -> None:
    """Say all that is wrong with settings and router files, with file, line and column; exit with 2 if anything is."""
    mistakes = [] if files else check_service(offline=offline)
    for file in files or ():
        is_toml = file.suffix == ".toml"
        mistakes += check_service(file, offline=offline) if is_toml else check_router_file(file, offline=offline)
    report_mistakes(mistakes)


def report_mistakes(mistakes: Iterable[ConfigError]) -> None:
    """Write each mistake to stderr, once, and exit with 2 if there is one."""
    lines = dict.fromkeys(map(str, mistakes))
    for line in lines:
        write_stderr(f"nedbus: {line}")
    if lines:
        raise typer.Exit(2)
    write("nothing is wrong")
