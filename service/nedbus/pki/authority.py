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
from nedbus.errors import PkiError, system_reason

from .certificate import DAYS, NAME_LENGTH, Certificate

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
    certificate = _sign(_CA_NAME, key.public_key(), key, days)
    return _write_files(folder / "ca", certificate, key)


def make_certificate(
    folder: Path, name: str, *, hosts: Sequence[str] = (), days: int | None = None
) -> list[Path]:
    """Create `NAME.key` and `NAME.crt`, signed by the CA in the folder, and return both paths.

    `hosts`: names and addresses of a router, verified by clients. A certificate without hosts is for clients only.

    Raises PkiError if the folder already has a certificate of that name, has no CA, or cannot be written.
    """
    has_length = 0 < len(name) <= NAME_LENGTH
    if not has_length or "/" in name or name.startswith("."):
        raise PkiError(
            f"{name!r} is not a valid name: use 1 to {NAME_LENGTH} characters, without / or a leading dot"
        )
    authority = Authority.read(folder)
    key = new_key()
    certificate = authority.sign(name, key.public_key(), hosts=hosts, days=days)
    return _write_files(folder / name, certificate, key)


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
    entries = [_read_entry(path, authority) for path in folder.glob("*.crt")]
    entries.sort(key=lambda entry: (entry.certificate.ends, entry.name))
    entries.sort(key=lambda entry: entry.use != "authority")  # stable
    return entries


def _read_entry(path: Path, authority: x509.Certificate) -> CertificateEntry:
    """Read a certificate in the folder of a CA, and check that it belongs to the CA and to the key next to it."""
    loaded = load_certificate(path)
    certificate = Certificate.read(path)
    name = certificate.subject
    use = "client"
    if path.name == "ca.crt":
        name = path.stem
        use = "authority"
    elif certificate.hosts:
        use = "router"
    problem = ""
    if not _has_own_key(path, loaded):
        problem = "does not match the key next to it"
    try:
        loaded.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        problem = _FOREIGN
    return CertificateEntry(path, name, use, certificate, problem)


def _has_own_key(path: Path, certificate: x509.Certificate) -> bool:
    """Return whether the key next to a certificate is its own; True if it is missing, or not readable by this user."""
    with suppress(OSError, ValueError, TypeError):
        data = path.with_suffix(".key").read_bytes()
        key = serialization.load_pem_private_key(data, password=None)
        return key.public_key() == certificate.public_key()
    return True


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
    key = None
    public_key = load_certificate(entry.path).public_key()
    if replace_key:
        key = new_key()
        public_key = key.public_key()
    signed = authority.sign(entry.name, public_key, hosts=entry.certificate.hosts, days=days)
    return _write_files(entry.path.with_suffix(""), signed, key, replace=True)


class Authority(NamedTuple):
    """A CA: its certificate and private key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    @classmethod
    def read(cls, folder: Path) -> Authority:
        """Read `ca.crt` and `ca.key`; raise PkiError if they are missing or damaged."""
        certificate = load_certificate(folder / "ca.crt")
        path = folder / "ca.key"
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
        mode = 0o644
        content = item.public_bytes(serialization.Encoding.PEM)
    else:
        mode = 0o600
        content = item.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with os.fdopen(descriptor, "wb") as file:
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
        raise PkiError(f"{stem} cannot be written: {system_reason(exc)}") from exc
    return list(written)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as exc:
        hint = "check that this user may read it"
        if path.name == "ca.crt":
            hint = "run 'nedbus pki ca' first"
        reason = system_reason(exc)
        raise PkiError(f"{path} cannot be read ({reason}): {hint}") from exc


def _sign(
    name: str, key: CertificatePublicKeyTypes, signer: ec.EllipticCurvePrivateKey, days: int | None, *,
    issuer: x509.Certificate | None = None, hosts: Sequence[str] = (),
) -> x509.Certificate:  # fmt: skip
    """Return a certificate for a key; without an issuer, a self-signed CA certificate."""
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = clock.now()
    if days is None:
        if issuer is None:
            days = _CA_DAYS
        else:
            days = DAYS
    until = now + dt.timedelta(days=days)
    if issuer is None:
        signed_by = subject
        ends = until
        constraints = x509.BasicConstraints(ca=True, path_length=0)
        allowed = {"key_cert_sign", "crl_sign"}
    else:
        signed_by = issuer.subject
        ends = min(until, issuer.not_valid_after_utc)
        constraints = x509.BasicConstraints(ca=False, path_length=None)
        allowed = {"digital_signature"}
    usages = {usage: usage in allowed for usage in _USAGES}
    authority_key = x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key())
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(signed_by)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        # The clock of a vehicle may be behind at boot.
        .not_valid_before(min(now, until) - dt.timedelta(days=1))
        .not_valid_after(ends)
        # Required by Python 3.13 and later, though not by Zenoh.
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
        .add_extension(authority_key, critical=False)
        .add_extension(constraints, critical=True)
        .add_extension(x509.KeyUsage(**usages), critical=True)
    )
    if issuer is not None:
        purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]  # a router is also a client of other routers
        if hosts:
            purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
        builder = builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
    if hosts:
        names = x509.SubjectAlternativeName([_general_name(host) for host in hosts])
        builder = builder.add_extension(names, critical=False)
    return builder.sign(signer, hashes.SHA256())


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)
