"""Commands for keys and certificates of a fleet: pki ca, cert, enroll, list, renew, rules."""

import json
import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from nedbus import clock, pki as certificates
from nedbus.cli.options import JsonOption, allow_one, command
from nedbus.cli.output.streams import write, write_stderr
from nedbus.cli.output.table import to_table
from nedbus.errors import ConfigError, PkiError
from nedbus.pki import CERTIFICATE_PREFIX, RENEW_WITHIN, certificate_name
from nedbus_msgs.text import counted

pki = typer.Typer(
    help="Manage keys, certificates and access rules for tls/ endpoints.", no_args_is_help=True
)

FolderArgument = Annotated[
    Path, typer.Argument(metavar="FOLDER", help="Folder of the keys and certificates")
]
WithinOption = Annotated[
    int, typer.Option(min=0, help="Days before expiry when a certificate is due for renewal")
]
DaysOption = Annotated[
    int | None, typer.Option(min=1, help=f"Validity in days (default: {certificates.DAYS})")
]


@command
def ca(folder: FolderArgument) -> None:
    """Create the certificate authority of a fleet: ca.key and ca.crt.

    Keep ca.key private; every host needs ca.crt.
    """
    _write_pair(certificates.make_authority(folder))


@command
def cert(
    folder: FolderArgument,
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="router, vehicle-1, reader, operator, ...")
    ],
    *,
    host: Annotated[
        list[str] | None, typer.Option(help="Host name or address of a router; repeatable")
    ] = None,
    days: DaysOption = None,
) -> None:
    """Create a certificate and its key: NAME.crt and NAME.key.

    The access rules of config/router-secure.json5 give each NAME its permissions.
    """
    _write_pair(certificates.make_certificate(folder, name, hosts=host or (), days=days))


@command
def enroll(
    folder: FolderArgument,
    vehicle: Annotated[
        str, typer.Argument(metavar="VEHICLE", help="Vehicle id, the second part of its Zenoh keys")
    ],
    *,
    router: Annotated[
        list[str],
        typer.Option("--router", "-r", metavar="tls/HOST:PORT", help="Router; repeatable"),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder to create (default: vehicle-VEHICLE)"),
    ] = None,
    source: Annotated[
        list[str] | None, typer.Option("--source", "-s", help="Source; repeatable")
    ] = None,
    target: Annotated[
        Path | None, typer.Option(help="Folder on the vehicle (default: /etc/nedbus)")
    ] = None,
    days: DaysOption = None,
) -> None:
    """Create the bundle of a vehicle.

    It contains certificate, key, nedbus.toml, compose.yml and README.txt.
    """
    output = output or Path(certificate_name(vehicle))
    made = certificates.make_bundle(
        folder, vehicle, output, routers=router, sources=source or (), target=target, days=days
    )
    _write_paths(made)
    write_stderr(
        f"move {output} to the vehicle and follow its README.txt: it has the only copy of the private key"
    )


@command
def list_(
    folder: FolderArgument, *, within: WithinOption = RENEW_WITHIN, as_json: JsonOption = False
) -> None:
    """List the certificates of a folder and their expiry."""
    now = clock.now()
    rows: list[dict[str, Any]] = [
        {
            "file": str(entry.path), "name": entry.name, "use": entry.use,
            "until": entry.certificate.ends.isoformat(), "days_left": math.floor(entry.certificate.days_left(now)),
            "state": "EXPIRED" if entry.certificate.is_due(now, 0)
            else entry.problem or ("expires soon" if entry.certificate.is_due(now, within) else "valid"),
            "hosts": entry.certificate.hosts,
        }
        for entry in certificates.list_certificates(folder)
    ]  # fmt: skip
    if as_json:
        write(json.dumps(rows, indent=2))
        return
    for row in rows:
        row |= {name: row[name].replace("authority", "CA") for name in ("use", "state")}
    cells = [
        [
            row["name"],
            row["use"],
            row["until"][:10],
            str(row["days_left"]),
            ", ".join([row["state"], *row["hosts"]]),
        ]
        for row in rows
    ]
    write(to_table(("NAME", "USE", "UNTIL", "DAYS", "STATE, HOSTS"), cells))


@command
def renew(
    folder: FolderArgument,
    names: Annotated[
        list[str] | None, typer.Argument(metavar="NAME", help="Default: all that expire soon")
    ] = None,
    *,
    within: WithinOption = RENEW_WITHIN,
    new_key: Annotated[bool, typer.Option("--new-key", help="Also create new keys")] = False,
    days: DaysOption = None,
) -> None:
    """Renew certificates; names, hosts and, without --new-key, keys stay the same.

    The old certificates remain valid until they expire.
    """
    now = clock.now()
    entries = certificates.list_certificates(folder)
    unknown = sorted({*(names or ())} - {entry.name for entry in entries})
    if unknown:
        raise PkiError(
            f"{folder} has no certificate named {unknown[0]!r}: 'nedbus pki list' shows all names"
        )
    due = [
        entry for entry in entries if entry.certificate.is_due(now, within) and not entry.problem
    ]
    if names:
        chosen = [entry for entry in entries if entry.name in names]
    else:
        chosen = due
    for entry in chosen:
        _write_paths(certificates.renew_certificate(entry, replace_key=new_key, days=days))
    if chosen:
        write_stderr(
            "replace the old files with these, and restart routers: they read certificates only at startup"
        )
    else:
        write_stderr(f"no certificate expires within {within} days: 'nedbus pki list' shows all")


@command
def rules(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Router file, such as config/router-secure.json5")
    ],
    vehicles: Annotated[
        list[str] | None, typer.Argument(metavar="VEHICLE", help="Vehicle ids")
    ] = None,
    *,
    source: Annotated[
        Path | None, typer.Option("--from", help="Read ids from a file, stdin (-) or PKI folder")
    ] = None,
    add: Annotated[
        bool, typer.Option("--add", help="Add these vehicles to those in the file")
    ] = False,
    remove: Annotated[
        bool, typer.Option("--remove", help="Remove these vehicles from the file")
    ] = False,
    prefix: Annotated[str, typer.Option("--prefix", help="Key prefix")] = "nedbus",
) -> None:
    """Set or show the vehicles in the access rules of a router file.

    Without --add or --remove, the rules then allow only the given vehicles. Without vehicles, lists those in the file.
    """
    allow_one({"--add": add, "--remove": remove})
    before = certificates.read_access_rules(file)
    if not vehicles and source is None:
        for name in before:
            write(name)
        return
    given = {*(vehicles or ())}
    if source is not None and source.is_dir():
        known = [entry.name for entry in certificates.list_certificates(source)]
        given.update(
            name.removeprefix(CERTIFICATE_PREFIX)
            for name in known
            if name.startswith(CERTIFICATE_PREFIX)
        )
    elif source is not None:
        if str(source) == "-":
            text = sys.stdin.read()
        else:
            text = source.read_text(encoding="utf-8")
        given.update(filter(None, (line.partition("#")[0].strip() for line in text.splitlines())))
    wanted = given
    if add:
        wanted = {*before, *given}
    elif remove:
        unknown = sorted(given - set(before))
        if unknown:
            raise ConfigError(str(file), f"its access rules do not name vehicle {unknown[0]!r}")
        wanted = set(before) - given
    certificates.write_access_rules(file, wanted, prefix=prefix)
    for sign, names in (("+", wanted - {*before}), ("-", {*before} - wanted)):
        for name in sorted(names):
            write(f"{sign} {name}")
    changed = "restart the router to apply them"
    if wanted == {*before}:
        changed = "no change"
    write_stderr(f"{file} names {counted(len(wanted), 'vehicle')}: {changed}")


def _write_paths(paths: list[Path]) -> None:
    write("\n".join(map(str, paths)))


def _write_pair(paths: list[Path]) -> None:
    _write_paths(paths)
    write_stderr(f"{paths[0]} is a private key, readable only by its owner: do not share it")


for _command in (ca, cert, enroll, list_, renew, rules):
    pki.command(_command.__name__.rstrip("_"))(_command)
