"""The command for when nothing arrives: doctor."""

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

_MAX_WIDTH: Final = 80  # columns


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
    own_files = {"tls_ca": tls_ca, "tls_certificate": tls_certificate, "tls_key": tls_key}
    settings = load_settings(config, connect=connect and tuple(connect), prefix=prefix, **own_files)
    findings = examine(settings, version=__version__, vehicle=vehicle, mavlink=mavlink)
    state = worst_state(findings)
    if json_output:
        write(json.dumps({"state": state, "findings": [asdict(each) for each in findings]}))
    else:
        write(_to_report(findings))
    if state == "wrong":
        raise typer.Exit(1)


def _to_report(findings: Sequence[Finding]) -> str:
    """Return the findings as lines, and the number of each state."""
    width = min(terminal_width() or _MAX_WIDTH, _MAX_WIDTH)
    lines = []
    for each in findings:
        name = f"{each.check} {each.subject}".strip()
        texts = {f"{each.state:<8} ": f"{name}: {each.seen}", f"{'':<8} -> ": each.advice}
        for head, text in texts.items():
            indent, line = " " * len(head), to_text(text, MAX_TEXT)
            lines += textwrap.wrap(line, width, initial_indent=head, subsequent_indent=indent, break_on_hyphens=False)
    counts = Counter(each.state for each in findings)
    return "\n".join([*lines, "", ", ".join(f"{count} {state}" for state, count in counts.items())])
