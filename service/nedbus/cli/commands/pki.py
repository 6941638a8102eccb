"""Commands that make keys and certificates: pki ca, pki cert; and the table of all that `nedbus pki` has."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nedbus import transport
from nedbus.cli.options import command
from nedbus.cli.output.streams import write, write_stderr

from .pki_fleet import FolderArgument, enroll, list_, renew, rules

pki = typer.Typer(help="Make keys and certificates for tls/ endpoints.", no_args_is_help=True)


@pki.command()
@command
def ca(folder: FolderArgument) -> None:
    """Make the authority that signs everything else: ca.key, to be kept in private, and ca.crt, which all need."""
    _write_paths(transport.make_authority(folder))


@pki.command()
@command
def cert(
    folder: FolderArgument,
    name: Annotated[str, typer.Argument(metavar="NAME", help="router, vehicle-1, reader, operator, ...")],
    *,
    host: Annotated[
        list[str] | None,
        typer.Option("--host", help="For a router: a name or address that clients connect to; repeatable"),
    ] = None,
    days: Annotated[int | None, typer.Option(min=1, help="Days until it expires (default: 825)")] = None,
) -> None:
    """Make NAME.key and NAME.crt; config/router-secure.json5 defines what each name may do."""
    _write_paths(transport.make_certificate(folder, name, hosts=host or (), days=days or transport.DAYS))


pki.command("enroll")(enroll)
pki.command("list")(list_)
pki.command("renew")(renew)
pki.command("rules")(rules)


def _write_paths(paths: list[Path]) -> None:
    for path in paths:
        write(str(path))
    write_stderr(f"{paths[0]} is secret: only its owner can read it; do not copy it elsewhere")
