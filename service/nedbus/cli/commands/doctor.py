"""The command for a person to whom nothing arrives: doctor."""

from __future__ import annotations

import json
import textwrap
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated, Final

import typer

from nedbus import __version__
from nedbus.cli.options import (
    ConfigOption,
    ConnectOption,
    JsonOption,
    PrefixOption,
    TlsCaOption,
    TlsCertificateOption,
    TlsKeyOption,
    command,
)
from nedbus.cli.output.streams import MAX_TEXT, to_text, write
from nedbus.cli.output.table import terminal_width
from nedbus.doctor import Finding, examine, worst_state
from nedbus.settings import load_settings
from nedbus_msgs import check_vehicle

_WIDTH: Final = 80  # columns, at most
_INDENT: Final = " " * 9


@command
def doctor(
    *,
    vehicle: Annotated[
        str | None, typer.Option("--vehicle", "-v", help="Look at this vehicle, and whether this client may write it")
    ] = None,
    mavlink: Annotated[
        str | None, typer.Option("--mavlink", metavar="LINK", help="Listen here too, such as udpin:0.0.0.0:14550")
    ] = None,
    connect: ConnectOption = None,
    prefix: PrefixOption = None,
    tls_ca: TlsCaOption = None,
    tls_certificate: TlsCertificateOption = None,
    tls_key: TlsKeyOption = None,
    config: ConfigOption = None,
    json_output: JsonOption = False,
) -> None:
    """Say why nothing arrives: router, certificates, permissions, clocks, vehicles, MAVLink; what is worst comes last.

    Exit 0 when nothing is wrong, 1 otherwise. It takes a few seconds, and changes nothing.
    """
    if vehicle is not None:
        check_vehicle(vehicle)
    settings = load_settings(
        config,
        connect=connect and tuple(connect),
        prefix=prefix,
        tls_ca=tls_ca,
        tls_certificate=tls_certificate,
        tls_key=tls_key,
    )
    findings = examine(settings, version=__version__, vehicle=vehicle, mavlink=mavlink)
    state = worst_state(findings)
    if json_output:
        write(json.dumps({"state": state, "findings": [asdict(each) for each in findings]}))
    else:
        write(_to_report(findings, min(terminal_width() or _WIDTH, _WIDTH)))
    if state == "wrong":
        raise typer.Exit(1)


def _to_report(findings: Sequence[Finding], width: int) -> str:
    """Return all findings as lines, and how many there are of each state."""
    lines = []
    for each in findings:
        name = f"{each.check} {each.subject}".strip()
        lines += _fold(f"{each.state:<8} ", to_text(f"{name}: {each.seen}", MAX_TEXT), width)
        if each.advice:
            lines += _fold(f"{_INDENT}-> ", to_text(each.advice, MAX_TEXT), width)
    counts = Counter(each.state for each in findings)
    summary = ", ".join(f"{counts[state]} {state}" for state in dict.fromkeys(each.state for each in findings))
    return "\n".join([*lines, "", summary])


def _fold(head: str, text: str, width: int) -> list[str]:
    indent = " " * max(len(head), len(_INDENT))
    return textwrap.wrap(text, width, initial_indent=head, subsequent_indent=indent, break_on_hyphens=False)
