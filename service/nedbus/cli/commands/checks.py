"""Commands that find mistakes: doctor for a running system, check for configuration files."""

import json
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Final

import typer

from nedbus import __version__, limits
from nedbus.cli.options import JsonOption, command
from nedbus.cli.output.streams import to_text, write, write_stderr
from nedbus.cli.output.table import fold
from nedbus.doctor import check_router_file, check_service, examine, worst_state
from nedbus.errors import ConfigError
from nedbus.settings import Settings
from nedbus_msgs import check_vehicle

_EXAMINED: Final = "Examine only this vehicle; also test the write permission"
_LINK: Final = "Also listen on a MAVLink link, such as udpin:0.0.0.0:14540"
_RULES: Final = "Router's configuration: name the rules for this client's certificate"
_CONFIGS: Final = "Settings (.toml) or router files (.json5); default: the settings of serve"


@command
def doctor(
    read_settings: Callable[[], Settings],
    *,
    vehicle: Annotated[str | None, typer.Option("--vehicle", "-v", help=_EXAMINED)] = None,
    mavlink: Annotated[str | None, typer.Option(metavar="LINK", help=_LINK)] = None,
    rules: Annotated[
        Path | None, typer.Option(metavar="FILE", help=_RULES, show_default=False)
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Diagnose why no messages arrive.

    Checks router, certificates, permissions, clocks, vehicles and MAVLink; lists the worst findings last.
    Takes a few seconds and changes nothing. Exits with 1 if the state of a finding is "wrong".
    """
    if vehicle is not None:
        check_vehicle(vehicle)
    findings = examine(
        read_settings(), version=__version__, vehicle=vehicle, mavlink=mavlink, rules=rules
    )
    state = worst_state(findings)
    if json_output:
        write(json.dumps({"state": state, "findings": [asdict(finding) for finding in findings]}))
    else:
        for finding in findings:
            name = f"{finding.check} {finding.subject}".rstrip(" :")
            text = to_text(f"{name}: {finding.seen}", limits.LINE_TEXT)
            write(fold(f"{finding.state:<8} ", text))
            if finding.advice:
                write(fold(f"{'':<8} -> ", to_text(finding.advice, limits.LINE_TEXT)))
        counts = Counter(finding.state for finding in findings)
        totals = [f"{count} {name}" for name, count in counts.items()]
        write(f"\n{', '.join(totals)}")
    if state == "wrong":
        raise typer.Exit(1)


@command
def check(
    files: Annotated[
        list[Path] | None, typer.Argument(metavar="CONFIG", help=_CONFIGS, show_default=False)
    ] = None,
    *,
    offline: Annotated[
        bool, typer.Option("--offline", help="Check only the text of the files")
    ] = False,
) -> None:
    """Check settings and router files.

    Reports every mistake with file, line and column. Exits with 2 if there are any.
    """
    if not files:
        report_mistakes(check_service(offline=offline))
        return
    mistakes: list[ConfigError] = []
    for file in files:
        if file.suffix == ".toml":
            mistakes += check_service(file, offline=offline)
        else:
            mistakes += check_router_file(file, offline=offline)
    report_mistakes(mistakes)


def report_mistakes(mistakes: Iterable[ConfigError]) -> None:
    """Write each mistake to stderr once; exit with 2 if there are any."""
    lines = dict.fromkeys(map(str, mistakes))
    for line in lines:
        write_stderr(f"nedbus: {line}")
    if lines:
        raise typer.Exit(2)
    write("no mistakes found")
