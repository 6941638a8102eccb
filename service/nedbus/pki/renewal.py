"""Certificates of an authority's folder: a list of them with their ends, and a new one before one ends."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization

from nedbus.errors import PkiError
from nedbus.whole_file import whole_file

from .authority import Authority, new_key, sign_authority, write_certificate, write_pair
from .certificate import Certificate

_FOREIGN: Final = "signed by another authority"
_UNFIT: Final = "not of the key beside it"


@dataclass(frozen=True, slots=True)
class CertificateEntry:
    """A certificate of a folder.

    `name`: its common name, for an authority that of its file.
    `use`: "authority", "router" or "client".
    `problem`: why it is of no use although it has not ended, "" if it is of use.
    """

    path: Path
    name: str
    use: str
    certificate: Certificate
    problem: str


def list_certificates(folder: Path) -> list[CertificateEntry]:
    """Return the certificates of an authority's folder, the authority first, then those that end first.

    Raises PkiError when the folder has no authority, or a certificate cannot be read.
    """
    authority = _load(folder / "ca.crt")
    found = [_describe(path, authority) for path in folder.glob("*.crt")]
    return sorted(found, key=lambda entry: (entry.use != "authority", entry.certificate.ends, entry.name))


def renew_certificate(entry: CertificateEntry, *, replace_key: bool = False, days: int | None = None) -> list[Path]:
    """Replace a certificate by one of the same name and hosts that ends later, and return the files that are new.

    The old one stays valid until it ends, wherever it is in use; so it does with `replace_key`, with its old key.
    An authority keeps its key, or what it signed would be void.

    Raises PkiError for one that this folder's authority did not sign, and when a file cannot be read or written.
    """
    folder = entry.path.parent
    authority = Authority.read(folder)
    if entry.use == "authority":
        return _replace(entry.path, sign_authority(authority.key, days=days))
    if entry.problem == _FOREIGN:
        raise PkiError(f"{entry.path} is {_FOREIGN}: renew it where that authority is")
    # The private key may be on its vehicle only: the old certificate has all that is needed of it.
    key = new_key() if replace_key else None
    public_key = _load(entry.path).public_key() if key is None else key.public_key()
    signed = authority.sign(entry.name, public_key, hosts=entry.certificate.hosts, days=days)
    return write_pair(folder, entry.path.stem, key, signed, replace=True) if key else _replace(entry.path, signed)


def _describe(path: Path, authority: x509.Certificate) -> CertificateEntry:
    signed = _load(path)
    certificate = Certificate.read(path)
    problem = _find_problem(path, signed, authority)
    if path.name == "ca.crt":
        return CertificateEntry(path, path.stem, "authority", certificate, problem)
    use = "router" if certificate.hosts else "client"
    return CertificateEntry(path, certificate.subject, use, certificate, problem)


def _find_problem(path: Path, certificate: x509.Certificate, authority: x509.Certificate) -> str:
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        return _FOREIGN
    try:
        key = serialization.load_pem_private_key(path.with_suffix(".key").read_bytes(), password=None)
    except (OSError, ValueError, TypeError):
        return ""  # the key is where it is used, or is not ours to read
    return "" if key.public_key() == certificate.public_key() else _UNFIT


def _load(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except OSError as exc:
        hint = "'nedbus pki ca' makes an authority" if path.name == "ca.crt" else "may this user read it?"
        raise PkiError(f"{path}: {(exc.strerror or str(exc)).lower()}: {hint}") from exc
    except ValueError as exc:
        raise PkiError(f"{path} is not a certificate in PEM: move it away, or make it anew") from exc


def _replace(path: Path, certificate: x509.Certificate) -> list[Path]:
    try:
        with whole_file(path, replace=True) as part:
            write_certificate(part, certificate)
    except OSError as exc:
        raise PkiError(f"{path} cannot be written: {(exc.strerror or str(exc)).lower()}") from exc
    return [path]
