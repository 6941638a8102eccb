"""Commands that make keys and certificates: pki ca, pki cert."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from nedbus.errors import PkiError

from .options import command, tell, write

FolderArgument = Annotated[Path, typer.Argument(metavar="FOLDER", help="Where keys and certificates are kept")]

pki = typer.Typer(help="Make keys and certificates for tls/ endpoints.", no_args_is_help=True)


@pki.command()
@command
def ca(folder: FolderArgument) -> None:
    """Make the authority that signs everything else: ca.key, which stays at home, and ca.crt, which all need."""
    with _needing_cryptography():
        from nedbus.pki import make_authority
    _tell_paths(make_authority(folder))


@pki.command()
@command
def cert(
    folder: FolderArgument,
    name: Annotated[str, typer.Argument(metavar="NAME", help="router, vehicle-1, reader, operator, ...")],
    *,
    host: Annotated[
        list[str] | None, typer.Option("--host", help="For a router: a name or address that clients dial; repeatable")
    ] = None,
    days: Annotated[int | None, typer.Option(min=1, help="Days until it expires (default: 825)")] = None,
) -> None:
    """Make NAME.key and NAME.crt; config/router-secure.json5 says what each name may do."""
    with _needing_cryptography():
        from nedbus.pki import DAYS, make_certificate
    _tell_paths(make_certificate(folder, name, hosts=host or (), days=days or DAYS))


@contextmanager
def _needing_cryptography() -> Iterator[None]:
    try:
        yield
    except ModuleNotFoundError:
        raise PkiError("certificates need the package cryptography: pip install 'nedbus[pki]'") from None


def _tell_paths(paths: list[Path]) -> None:
    for path in paths:
        write(str(path))
    tell(f"{paths[0]} is secret: only its owner can read it, and it should be nowhere else")
