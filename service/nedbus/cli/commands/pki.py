"""Commands for the keys and certificates of a fleet: pki ca, cert, enroll, list, renew, rules."""

from __future__ import annotations

import datetime as dt
import json
import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from nedbus import pki as certificates
from nedbus.cli.options import JsonOption, command, require_one
from nedbus.cli.output.streams import counted, write, write_stderr
from nedbus.cli.output.table import to_table
from nedbus.errors import ConfigError, PkiError
from nedbus.pki import CERTIFICATE_PREFIX, RENEW_WITHIN, certificate_name

pki = typer.Typer(help="Make keys and certificates for tls/ endpoints.", no_args_is_help=True)

FolderArgument = Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the keys and certificates")]
WithinOption = Annotated[int, typer.Option(min=0, help="Certificates that expire within these days are due")]
DaysOption = Annotated[int | None, typer.Option(min=1, help=f"Days until it expires (default: {certificates.DAYS})")]


@command
def ca(folder: FolderArgument) -> None:
    """Make the authority that signs everything else: ca.key, to be kept in private, and ca.crt, which all need."""
    _write_pair(certificates.make_authority(folder))


@command
def cert(
    folder: FolderArgument,
    name: Annotated[str, typer.Argument(metavar="NAME", help="router, vehicle-1, reader, operator, ...")],
    *,
    host: Annotated[list[str] | None, typer.Option(help="Name or address of a router; repeatable")] = None,
    days: DaysOption = None,
) -> None:
    """Make NAME.key and NAME.crt; config/router-secure.json5 has the permissions of each name."""
    _write_pair(certificates.make_certificate(folder, name, hosts=host or (), days=days))


@command
def enroll(
    folder: FolderArgument,
    vehicle: Annotated[str, typer.Argument(metavar="VEHICLE", help="Its id, the second part of its keys")],
    *,
    router: Annotated[list[str], typer.Option("--router", "-r", metavar="tls/HOST:PORT", help="To join; repeatable")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder to make (default: vehicle-VEHICLE)")
    ] = None,
    source: Annotated[list[str] | None, typer.Option("--source", "-s", help="Default: to be filled in")] = None,
    target: Annotated[Path | None, typer.Option(help="Folder on the vehicle (default: /etc/nedbus)")] = None,
    days: DaysOption = None,
) -> None:
    """Make a bundle for a vehicle: certificate, key, nedbus.toml, compose.yml, and a README.txt."""
    output = output or Path(certificate_name(vehicle))
    _write_paths(
        certificates.make_bundle(
            folder, vehicle, output, routers=router, sources=source or (), target=target, days=days
        )
    )
    write_stderr(f"{output} has the vehicle's only key: copy it there, as its README.txt says, and remove it here")


@command
def list_(folder: FolderArgument, *, within: WithinOption = RENEW_WITHIN, as_json: JsonOption = False) -> None:
    """Show all certificates of a folder, and their expiry."""
    now = dt.datetime.now(dt.UTC)
    rows: list[dict[str, Any]] = [
        {
            "file": str(entry.path),
            "name": entry.name,
            "use": entry.use,
            "until": entry.certificate.ends.isoformat(),
            "days_left": math.floor(entry.certificate.days_left(now)),
            "state": _state(entry, now, within),
            "hosts": entry.certificate.hosts,
        }
        for entry in certificates.list_certificates(folder)
    ]
    if as_json:
        write(json.dumps(rows, indent=2))
        return
    cells = [
        [row["name"], row["use"], row["until"][:10], str(row["days_left"]), ", ".join([row["state"], *row["hosts"]])]
        for row in rows
    ]
    write(to_table(("NAME", "USE", "UNTIL", "DAYS", "STATE, HOSTS"), cells))


@command
def renew(
    folder: FolderArgument,
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME]...", help="Default: all that are due")] = None,
    *,
    within: WithinOption = RENEW_WITHIN,
    new_key: Annotated[bool, typer.Option("--new-key", help="With new keys, to be copied as well")] = False,
    days: DaysOption = None,
) -> None:
    """Renew certificates, with the same names, hosts and keys; the old ones stay valid until they expire."""
    now = dt.datetime.now(dt.UTC)
    entries = certificates.list_certificates(folder)
    if unknown := sorted({*(names or ())} - {entry.name for entry in entries}):
        raise PkiError(f"{folder} has no certificate of {unknown[0]!r}: 'nedbus pki list' shows what there is")
    due = [entry for entry in entries if entry.certificate.is_due(now, within) and not entry.problem]
    chosen = [entry for entry in entries if entry.name in names] if names else due
    for entry in chosen:
        _write_paths(certificates.renew_certificate(entry, replace_key=new_key, days=days))
    if chosen:
        write_stderr("copy these over the old ones; a router reads its certificate when it starts")
    else:
        write_stderr(f"nothing expires within {within} days: 'nedbus pki list' shows all")


@command
def rules(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A router's file, such as config/router-secure.json5")],
    vehicles: Annotated[list[str] | None, typer.Argument(metavar="[VEHICLE]...", help="Ids of vehicles")] = None,
    *,
    source: Annotated[Path | None, typer.Option("--from", help="A file of ids, - for stdin, or a folder")] = None,
    add: Annotated[bool, typer.Option("--add", help="Keep the vehicles that the file names already")] = False,
    remove: Annotated[bool, typer.Option("--remove", help="Remove these, and keep the others")] = False,
    prefix: Annotated[str, typer.Option("--prefix", help="First chunks of every key")] = "nedbus",
) -> None:
    """Write the access rules of exactly these vehicles into a router's file; without any, show whom it names."""
    require_one({"--add": add, "--remove": remove})
    before = certificates.read_access_rules(file)
    if not vehicles and source is None:
        for name in before:
            write(name)
        return
    given = {*(vehicles or ()), *(_read_names(source) if source else ())}
    if unknown := sorted(given - set(before)) if remove else []:
        raise ConfigError(str(file), f"it does not name vehicle {unknown[0]!r}")
    wanted = {*before, *given} if add else set(before) - given if remove else given
    certificates.write_access_rules(file, wanted, prefix=prefix)
    changes = [f"+ {name}" for name in sorted(wanted - {*before})] + [
        f"- {name}" for name in sorted({*before} - wanted)
    ]
    for line in changes:
        write(line)
    changed = "the router takes it when it starts again" if changes else "no change"
    write_stderr(f"{file} names {counted(len(wanted), 'vehicle')}: {changed}")


def _read_names(source: Path) -> list[str]:
    """Return the ids of a file, of standard input, or of the vehicles that have a certificate in a folder."""
    if source.is_dir():
        names = [entry.name for entry in certificates.list_certificates(source)]
        return [name.removeprefix(CERTIFICATE_PREFIX) for name in names if name.startswith(CERTIFICATE_PREFIX)]
    text = sys.stdin.read() if str(source) == "-" else source.read_text(encoding="utf-8")
    lines = (line.partition("#")[0].strip() for line in text.splitlines())
    return [line for line in lines if line]


def _state(entry: certificates.CertificateEntry, now: dt.datetime, within: int) -> str:
    if entry.certificate.is_due(now, 0):
        return "EXPIRED"
    return entry.problem or ("expires soon" if entry.certificate.is_due(now, within) else "valid")


def _write_paths(paths: list[Path]) -> None:
    for path in paths:
        write(str(path))


def _write_pair(paths: list[Path]) -> None:
    _write_paths(paths)
    write_stderr(f"{paths[0]} is secret: only its owner can read it; do not copy it elsewhere")


for _command in (ca, cert, enroll, list_, renew, rules):
    pki.command(_command.__name__.rstrip("_"))(_command)
