"""Certificates of an authority's folder: a list of them with their ends, and a new one before one ends."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization

from nedbus.errors import PkiError

from .authority import Authority, load_certificate, new_key, sign_authority, write_files
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
    authority = load_certificate(folder / "ca.crt")
    found = [_describe(path, authority) for path in folder.glob("*.crt")]
    return sorted(found, key=lambda entry: (entry.use != "authority", entry.certificate.ends, entry.name))


def renew_certificate(entry: CertificateEntry, *, replace_key: bool = False, days: int | None = None) -> list[Path]:
    """Replace a certificate by one of the same name and hosts that ends later, and return the files that are new.

    The old one stays valid until it ends, wherever it is in use; so it does with `replace_key`, with its old key.
    An authority keeps its key, or all that it signed would be void.

    Raises PkiError for one that this folder's authority did not sign, and when a file cannot be read or written.
    """
    folder = entry.path.parent
    authority = Authority.read(folder)
    if entry.use == "authority":
        return write_files(folder / "ca", sign_authority(authority.key, days=days), replace=True)
    if entry.problem == _FOREIGN:
        raise PkiError(f"{entry.path} is {_FOREIGN}: renew it where that authority is")
    # The private key may be on its vehicle only: the old certificate has all that is needed of it.
    key = new_key() if replace_key else None
    public_key = load_certificate(entry.path).public_key() if key is None else key.public_key()
    signed = authority.sign(entry.name, public_key, hosts=entry.certificate.hosts, days=days)
    return write_files(entry.path.with_suffix(""), signed, key, replace=True)


def _describe(path: Path, authority: x509.Certificate) -> CertificateEntry:
    signed = load_certificate(path)
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
