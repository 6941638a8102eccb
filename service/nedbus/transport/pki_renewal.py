"""Certificates of an authority's folder: who has one, until when, and a new one before it ends."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.x509.oid import NameOID

from nedbus.errors import PkiError
from nedbus.whole_file import whole_file

from .certificate import RENEW_WITHIN, Certificate
from .pki import CA_DAYS, DAYS, Authority, new_key, sign_authority, write_certificate, write_pair

__all__ = ["RENEW_WITHIN", "CertificateEntry", "decode_certificate", "list_certificates", "renew_certificate"]


@dataclass(frozen=True, slots=True)
class CertificateEntry:
    """A certificate of a folder.

    `name`: its common name, for an authority that of its file.
    `use`: "authority", "router" or "client".
    `until`: when it ends, UTC.
    `hosts`: names and addresses of a router.
    `problem`: why it is of no use although it has not ended, "" when it is.
    """

    path: Path
    name: str
    use: str
    until: dt.datetime
    hosts: tuple[str, ...]
    problem: str

    @property
    def days_left(self) -> int:
        """Whole days until it ends, negative when it has."""
        return (self.until - dt.datetime.now(dt.UTC)).days

    def is_due(self, within: int = RENEW_WITHIN) -> bool:
        """Return whether it ends within so many days, or has ended."""
        return self.until <= dt.datetime.now(dt.UTC) + dt.timedelta(days=within)


def list_certificates(folder: Path) -> list[CertificateEntry]:
    """Return the certificates of an authority's folder, the authority first, then those that end first.

    Raises PkiError when the folder has no authority, or a certificate cannot be read.
    """
    authority = _load(folder / "ca.crt")
    found = [_describe(path, _load(path), authority) for path in folder.glob("*.crt")]
    return sorted(found, key=lambda entry: (entry.use != "authority", entry.until, entry.name))


def renew_certificate(entry: CertificateEntry, *, replace_key: bool = False, days: int | None = None) -> list[Path]:
    """Replace a certificate by one of the same name and hosts that ends later, and return the files that are new.

    The old one stays valid until it ends, wherever it is in use; so it does with `replace_key`, with its old key.
    An authority keeps its key, or what it signed would be void.

    Raises PkiError for one that this folder's authority did not sign, and when a file cannot be read or written.
    """
    folder = entry.path.parent
    authority = Authority.read(folder)
    if entry.use == "authority":
        return _replace(entry.path, sign_authority(authority.key, days=days or CA_DAYS))
    if entry.problem == _FOREIGN:
        raise PkiError(f"{entry.path} is {_FOREIGN}: renew it where that authority is")
    if replace_key:
        key = new_key()
        signed = authority.sign(entry.name, key.public_key(), hosts=entry.hosts, days=days or DAYS)
        return write_pair(folder, entry.path.stem, key, signed, replace=True)
    # The key itself may be on its vehicle only: the old certificate has all that is needed of it.
    public_key = _load(entry.path).public_key()
    return _replace(entry.path, authority.sign(entry.name, public_key, hosts=entry.hosts, days=days or DAYS))


def decode_certificate(data: bytes, *, pem: bool) -> Certificate:
    """Decode a certificate that comes from anybody, in DER or PEM; raise ValueError for anything else."""
    try:
        found = x509.load_pem_x509_certificate(data) if pem else x509.load_der_x509_certificate(data)
        return Certificate(
            _common_name(found.subject) or "nobody",
            _common_name(found.issuer) or "nobody",
            _hosts(found),
            found.not_valid_before_utc,
            found.not_valid_after_utc,
        )
    except (x509.InvalidVersion, x509.DuplicateExtension, x509.UnsupportedGeneralNameType) as exc:
        raise ValueError(str(exc)) from exc


_FOREIGN: Final = "signed by another authority"
_UNFIT: Final = "not of the key beside it"


def _describe(path: Path, certificate: x509.Certificate, authority: x509.Certificate) -> CertificateEntry:
    hosts = _hosts(certificate)
    is_authority = path.name == "ca.crt"
    return CertificateEntry(
        path,
        path.stem if is_authority else _common_name(certificate.subject) or path.stem,
        "authority" if is_authority else "router" if hosts else "client",
        certificate.not_valid_after_utc,
        hosts,
        _problem(path, certificate, authority),
    )


def _problem(path: Path, certificate: x509.Certificate, authority: x509.Certificate) -> str:
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        return _FOREIGN
    try:
        key = serialization.load_pem_private_key(path.with_suffix(".key").read_bytes(), password=None)
    except (OSError, ValueError, TypeError):
        return ""  # the key is where it is used, or is not ours to read
    return "" if key.public_key() == certificate.public_key() else _UNFIT


def _common_name(name: x509.Name) -> str:
    names = name.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def _hosts(certificate: x509.Certificate) -> tuple[str, ...]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in names)


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
