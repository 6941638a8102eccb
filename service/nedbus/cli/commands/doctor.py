"""Commands for troubleshooting: doctor examines a running system, check configuration files."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from nedbus import __version__
from nedbus.cli.options import JsonOption, command
from nedbus.cli.output.streams import MAX_TEXT, to_text, write, write_stderr
from nedbus.cli.output.table import fold
from nedbus.doctor import Finding, check_router_file, check_service, examine, worst_state
from nedbus.errors import ConfigError
from nedbus.settings import Settings
from nedbus_msgs import check_vehicle


@command
def doctor(
    read_settings: Callable[[], Settings],
    *,
    vehicle: Annotated[
        str | None, typer.Option("--vehicle", "-v", help="Examine only this vehicle; also test the write permission")
    ] = None,
    mavlink: Annotated[
        str | None, typer.Option(metavar="LINK", help="Also listen to a MAVLink link, such as udpin:0.0.0.0:14550")
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Diagnose why no messages arrive.

    Checks router, certificates, permissions, clocks, vehicles and MAVLink; lists the worst findings last.
    Takes a few seconds and changes nothing. Exits with 1 if a finding is wrong, else 0.
    """
    if vehicle is not None:
        check_vehicle(vehicle)
    findings = examine(read_settings(), version=__version__, vehicle=vehicle, mavlink=mavlink)
    state = worst_state(findings)
    if json_output:
        write(json.dumps({"state": state, "findings": [asdict(each) for each in findings]}))
    else:
        write(_to_report(findings))
    if state == "wrong":
        raise typer.Exit(1)


def _to_report(findings: Sequence[Finding]) -> str:
    """Format findings as lines, followed by the number of findings in each state."""
    lines = []
    for each in findings:
        name = f"{each.check} {each.subject}".rstrip(" :")
        lines.append(fold(f"{each.state:<8} ", to_text(f"{name}: {each.seen}", MAX_TEXT)))
        if each.advice:
            lines.append(fold(f"{'':<8} -> ", to_text(each.advice, MAX_TEXT)))
    counts = Counter(each.state for each in findings)
    return "\n".join([*lines, "", ", ".join(f"{count} {state}" for state, count in counts.items())])


@command
def check(
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="CONFIG...",
            help="Settings (.toml) or router files (.json5); default: the settings of serve",
            show_default=False,
        ),
    ] = None,
    *,
    offline: Annotated[bool, typer.Option("--offline", help="Check only the text of the files")] = False,
) -> None:
    """Check settings and router files.

    Reports every mistake with file, line and column. Exits with 2 if there is one.
    """
    mistakes = [] if files else check_service(offline=offline)
    for file in files or ():
        is_toml = file.suffix == ".toml"
        mistakes += check_service(file, offline=offline) if is_toml else check_router_file(file, offline=offline)
    report_mistakes(mistakes)


def report_mistakes(mistakes: Iterable[ConfigError]) -> None:
    """Write each mistake to stderr once; exit with 2 if there is one."""
    lines = dict.fromkeys(map(str, mistakes))
    for line in lines:
        write_stderr(f"nedbus: {line}")
    if lines:
        raise typer.Exit(2)
    write("no mistakes found")
