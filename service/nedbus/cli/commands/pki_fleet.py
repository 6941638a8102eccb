"""Commands for the certificates of many vehicles: pki enroll, pki list, pki renew, pki rules."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from nedbus import transport
from nedbus.cli.options import JsonOption, command, require_one
from nedbus.cli.output.streams import write, write_stderr
from nedbus.errors import ConfigError, PkiError

FolderArgument = Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the keys and certificates")]
WithinOption = Annotated[int | None, typer.Option(min=0, help="What expires within so many days is due (default: 30)")]
DaysOption = Annotated[int | None, typer.Option(min=1, help="Days until it expires (default: 825)")]


@command
def enroll(
    folder: FolderArgument,
    vehicle: Annotated[str, typer.Argument(metavar="VEHICLE", help="Its id, the second part of its keys")],
    *,
    router: Annotated[
        list[str], typer.Option("--router", "-r", metavar="tls/HOST:PORT", help="Router to join; repeatable")
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder to make (default: vehicle-VEHICLE)")
    ] = None,
    source: Annotated[
        list[str] | None, typer.Option("--source", "-s", help="What it publishes (default: to be filled in)")
    ] = None,
    target: Annotated[
        Path | None, typer.Option("--target", help="Folder of these files on the vehicle (default: /etc/nedbus)")
    ] = None,
    days: DaysOption = None,
) -> None:
    """Make a bundle for a vehicle: certificate, key, nedbus.toml, compose.yml, and what to copy where."""
    output = output or Path(transport.certificate_name(vehicle))
    paths = transport.make_bundle(
        folder,
        vehicle,
        output,
        routers=router,
        sources=source or (),
        target=target or transport.TARGET,
        days=days or transport.DAYS,
    )
    for path in paths:
        write(str(path))
    write_stderr(f"{output} has the vehicle's only key: copy it there, as its README.txt says, and remove it here")


@command
def list_(
    folder: FolderArgument,
    *,
    within: WithinOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show who has a certificate, and until when."""
    within = transport.RENEW_WITHIN if within is None else within
    entries = transport.list_certificates(folder)
    if as_json:
        rows = [
            {
                "file": str(entry.path),
                "name": entry.name,
                "use": entry.use,
                "until": entry.until.isoformat(),
                "days_left": entry.days_left,
                "state": _state(entry, within),
                "hosts": list(entry.hosts),
            }
            for entry in entries
        ]
        write(json.dumps(rows, indent=2))
        return
    width = max(len("NAME"), *(len(entry.name) for entry in entries))
    write(f"{'NAME':{width}}  {'USE':9}  {'UNTIL':10}  {'DAYS':>5}  STATE")
    for entry in entries:
        hosts = f" ({', '.join(entry.hosts)})" if entry.hosts else ""
        until = f"{entry.until:%Y-%m-%d}"
        state = _state(entry, within)
        write(f"{entry.name:{width}}  {entry.use:9}  {until}  {entry.days_left:5}  {state}{hosts}")


@command
def renew(
    folder: FolderArgument,
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="These, due or not (default: all that are due)")
    ] = None,
    *,
    within: WithinOption = None,
    new_key: Annotated[bool, typer.Option("--new-key", help="With new keys, to be copied as well")] = False,
    days: DaysOption = None,
) -> None:
    """Renew certificates, with the same names, hosts and keys; the old ones stay valid until they expire."""
    within = transport.RENEW_WITHIN if within is None else within
    entries = transport.list_certificates(folder)
    known = {entry.name for entry in entries}
    for name in names or ():
        if name not in known:
            raise PkiError(f"{folder} has no certificate of {name!r}: 'nedbus pki list' shows what there is")
    chosen = [
        entry for entry in entries if (entry.name in names if names else entry.is_due(within) and not entry.problem)
    ]
    for entry in chosen:
        for path in transport.renew_certificate(entry, replace_key=new_key, days=days):
            write(str(path))
    if not chosen:
        soonest = min(entries, key=lambda entry: entry.until)
        write_stderr(f"nothing expires within {within} days; the first is {soonest.name}, on {soonest.until:%Y-%m-%d}")
    else:
        write_stderr("copy these over the old ones; a router reads its certificate when it starts")


@command
def rules(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A router's file, such as config/router-secure.json5")],
    vehicles: Annotated[list[str] | None, typer.Argument(metavar="[VEHICLE]...", help="Ids of vehicles")] = None,
    *,
    source: Annotated[
        Path | None,
        typer.Option("--from", help="A file with an id a line, - for standard input, or the folder of certificates"),
    ] = None,
    add: Annotated[bool, typer.Option("--add", help="Keep the vehicles that the file names already")] = False,
    remove: Annotated[bool, typer.Option("--remove", help="Remove these, and keep the others")] = False,
    prefix: Annotated[str, typer.Option("--prefix", help="First chunks of every key")] = "nedbus",
) -> None:
    """Write the access rules of exactly these vehicles into a router's file; without any, show whom it names."""
    require_one({"--add": add, "--remove": remove})
    before = transport.read_access_rules(file)
    if not vehicles and source is None:
        for name in before:
            write(name)
        return
    given = {*(vehicles or ()), *(_read_names(source) if source else ())}
    if unknown := sorted(given - set(before)) if remove else []:
        raise ConfigError(str(file), f"it does not name vehicle {unknown[0]!r}")
    wanted = {*before, *given} if add else set(before) - given if remove else given
    change = transport.write_access_rules(file, wanted, prefix=prefix)
    for name in change.added:
        write(f"+ {name}")
    for name in change.removed:
        write(f"- {name}")
    changed = "the router takes it when it starts again" if change.added or change.removed else "no change"
    write_stderr(f"{file} names {len(change.vehicles)} vehicles: {changed}")


def _read_names(source: Path) -> list[str]:
    """Return the ids of a file, of standard input, or of the vehicles that have a certificate in a folder."""
    if source.is_dir():
        names = [entry.name for entry in transport.list_certificates(source)]
        prefix = transport.CERTIFICATE_PREFIX
        return [name.removeprefix(prefix) for name in names if name.startswith(prefix)]
    text = sys.stdin.read() if str(source) == "-" else source.read_text(encoding="utf-8")
    lines = (line.partition("#")[0].strip() for line in text.splitlines())
    return [line for line in lines if line]


def _state(entry: transport.CertificateEntry, within: int) -> str:
    if entry.is_due(0):
        return "EXPIRED"
    return entry.problem or ("expires soon" if entry.is_due(within) else "valid")
