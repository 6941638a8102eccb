"""The certificate authority (CA) of a fleet: create, sign, list and renew its keys and certificates.

The access rules in `config/router-secure.json5` match the common names of these certificates.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import os
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.types import CertificatePublicKeyTypes
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from nedbus import clock
from nedbus.atomic_write import atomic_write
from nedbus.errors import PkiError

from .certificate import DAYS, MAX_NAME, Certificate

_CA_NAME: Final = "nedbus CA"
_CA_DAYS: Final = 3650
_FOREIGN: Final = "signed by another authority"
_USAGES: Final = (
    "digital_signature", "content_commitment", "key_encipherment", "data_encipherment", "key_agreement",
    "key_cert_sign", "crl_sign", "encipher_only", "decipher_only",
)  # fmt: skip


def make_authority(folder: Path, *, days: int | None = None) -> list[Path]:
    """Create the CA of a fleet, `ca.key` and `ca.crt`, and return both paths.

    The key signs all other certificates; keep it off vehicles and routers.

    Raises PkiError if the folder already has a CA, or cannot be written.
    """
    key = new_key()
    return _write_files(folder / "ca", _sign(_CA_NAME, key.public_key(), key, days), key)


def make_certificate(
    folder: Path, name: str, *, hosts: Sequence[str] = (), days: int | None = None
) -> list[Path]:
    """Create `NAME.key` and `NAME.crt`, signed by the CA in the folder, and return both paths.

    `hosts`: names and addresses of a router, verified by clients. A certificate without hosts is for clients only.

    Raises PkiError if the folder already has a certificate of that name, has no CA, or cannot be written.
    """
    if not name or len(name) > MAX_NAME or "/" in name or name.startswith("."):
        raise PkiError(
            f"{name!r} is not a valid name: use 1 to {MAX_NAME} characters, without / or a leading dot"
        )
    authority = Authority.read(folder)
    key = new_key()
    return _write_files(
        folder / name, authority.sign(name, key.public_key(), hosts=hosts, days=days), key
    )


@dataclass(frozen=True, slots=True)
class CertificateEntry:
    """A certificate in the folder of a CA.

    `name`: common name; for the CA, the name of its file.
    `use`: "authority", "router" or "client".
    `problem`: why it cannot be used even before it expires; "" if valid.
    """

    path: Path
    name: str
    use: str
    certificate: Certificate
    problem: str


def list_certificates(folder: Path) -> list[CertificateEntry]:
    """Return the certificates in the folder of a CA: the CA first, then the others by expiry.

    Raises PkiError if the folder has no CA, or a certificate cannot be read.
    """
    authority = load_certificate(folder / "ca.crt")
    found = []
    for path in folder.glob("*.crt"):
        loaded = load_certificate(path)
        certificate = Certificate.read(path)
        problem = ""
        # the key is missing, or not readable by this user
        with suppress(OSError, ValueError, TypeError):
            key = serialization.load_pem_private_key(
                path.with_suffix(".key").read_bytes(), password=None
            )
            problem = (
                ""
                if key.public_key() == loaded.public_key()
                else "does not match the key next to it"
            )
        try:
            loaded.verify_directly_issued_by(authority)
        except (ValueError, TypeError, InvalidSignature):
            problem = _FOREIGN
        is_authority = path.name == "ca.crt"
        name = path.stem if is_authority else certificate.subject
        use = "authority" if is_authority else "router" if certificate.hosts else "client"
        found.append(CertificateEntry(path, name, use, certificate, problem))
    return sorted(
        found, key=lambda entry: (entry.use != "authority", entry.certificate.ends, entry.name)
    )


def renew_certificate(
    entry: CertificateEntry, *, replace_key: bool = False, days: int | None = None
) -> list[Path]:
    """Replace a certificate with one of the same name and hosts and a later expiry, and return the new files.

    The old certificate and its key stay valid until the certificate expires, even with `replace_key`.
    A CA keeps its key, so all certificates that it signed stay valid.

    Raises PkiError for a certificate of another CA, and if a file cannot be read or written.
    """
    folder = entry.path.parent
    authority = Authority.read(folder)
    if entry.use == "authority":
        signed = _sign(_CA_NAME, authority.key.public_key(), authority.key, days)
        return _write_files(folder / "ca", signed, replace=True)
    if entry.problem == _FOREIGN:
        raise PkiError(f"{entry.path} is signed by another CA: renew it in the folder of that CA")
    # The private key may exist only on the vehicle, but the old certificate has the public key.
    key = new_key() if replace_key else None
    public_key = key.public_key() if key else load_certificate(entry.path).public_key()
    signed = authority.sign(entry.name, public_key, hosts=entry.certificate.hosts, days=days)
    return _write_files(entry.path.with_suffix(""), signed, key, replace=True)


class Authority(NamedTuple):
    """A CA: its certificate and private key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    @classmethod
    def read(cls, folder: Path) -> Authority:
        """Read `ca.crt` and `ca.key`; raise PkiError if they are missing or damaged."""
        certificate, path = load_certificate(folder / "ca.crt"), folder / "ca.key"
        try:
            key = serialization.load_pem_private_key(_read(path), password=None)
        except (ValueError, TypeError):
            key = None
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise PkiError(
                f"{path} is not a key of 'nedbus pki ca': restore it, or create a new CA in another folder"
            )
        return cls(certificate, key)

    def sign(
        self,
        name: str,
        key: CertificatePublicKeyTypes,
        *,
        hosts: Sequence[str] = (),
        days: int | None = None,
    ) -> x509.Certificate:
        """Return a certificate for a key, for a router if hosts are given; it expires no later than the CA."""
        return _sign(name, key, self.key, days, issuer=self.certificate, hosts=hosts)


def new_key() -> ec.EllipticCurvePrivateKey:
    """Generate a private key on the curve P-256."""
    return ec.generate_private_key(ec.SECP256R1())


def write_new(path: Path, item: x509.Certificate | ec.EllipticCurvePrivateKey) -> None:
    """Write a certificate (mode 644) or a private key (mode 600) to a new file."""
    if isinstance(item, x509.Certificate):
        content, mode = item.public_bytes(serialization.Encoding.PEM), 0o644
    else:
        pkcs8, plain = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        content, mode = item.private_bytes(serialization.Encoding.PEM, pkcs8, plain), 0o600
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(content)


def load_certificate(path: Path) -> x509.Certificate:
    """Read the certificate in a PEM file; raise PkiError if it is missing or damaged."""
    try:
        return x509.load_pem_x509_certificate(_read(path))
    except ValueError as exc:
        raise PkiError(
            f"{path} is not a PEM certificate: move it away, or create a new one"
        ) from exc


def _write_files(
    stem: Path,
    certificate: x509.Certificate,
    key: ec.EllipticCurvePrivateKey | None = None,
    *,
    replace: bool = False,
) -> list[Path]:
    """Atomically write `STEM.key`, if a key is given, and `STEM.crt`, and return their paths."""
    items = {Path(f"{stem}.key"): key, Path(f"{stem}.crt"): certificate}
    written = {path: item for path, item in items.items() if item is not None}
    try:
        stem.parent.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            temporary = [
                stack.enter_context(atomic_write(path, replace=replace)) for path in written
            ]
            for path, item in zip(temporary, written.values(), strict=True):
                write_new(path, item)
    except FileExistsError as exc:
        reason = "move it away, or choose another folder or name"
        raise PkiError(f"{exc.filename} exists and is not overwritten: {reason}") from exc
    except OSError as exc:
        raise PkiError(f"{stem} cannot be written: {(exc.strerror or str(exc)).lower()}") from exc
    return list(written)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as exc:
        hint = (
            "run 'nedbus pki ca' first"
            if path.name == "ca.crt"
            else "check that this user may read it"
        )
        raise PkiError(
            f"{path} cannot be read ({(exc.strerror or str(exc)).lower()}): {hint}"
        ) from exc


def _sign(
    name: str, key: CertificatePublicKeyTypes, signer: ec.EllipticCurvePrivateKey, days: int | None, *,
    issuer: x509.Certificate | None = None, hosts: Sequence[str] = (),
) -> x509.Certificate:  # fmt: skip
    """Return a certificate for a key; without an issuer, a self-signed CA certificate."""
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now, is_authority = clock.now(), issuer is None
    if days is None:
        days = _CA_DAYS if is_authority else DAYS
    until = now + dt.timedelta(days=days)
    allowed = {"key_cert_sign", "crl_sign"} if is_authority else {"digital_signature"}
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject if issuer is None else issuer.subject)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        # The clock of a vehicle may be behind at boot.
        .not_valid_before(min(now, until) - dt.timedelta(days=1))
        .not_valid_after(until if issuer is None else min(until, issuer.not_valid_after_utc))
        # Required by Python 3.13 and later, though not by Zenoh.
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False
        )
        .add_extension(
            x509.BasicConstraints(is_authority, 0 if is_authority else None), critical=True
        )
        .add_extension(
            x509.KeyUsage(**{usage: usage in allowed for usage in _USAGES}), critical=True
        )
    )

    if issuer is not None:  # a router is also a client of other routers
        purposes = [ExtendedKeyUsageOID.CLIENT_AUTH] + (
            [ExtendedKeyUsageOID.SERVER_AUTH] if hosts else []
        )
        builder = builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
    if hosts:
        builder = builder.add_extension(
            x509.SubjectAlternativeName(list(map(_general_name, hosts))), critical=False
        )
    return builder.sign(signer, hashes.SHA256())


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)
