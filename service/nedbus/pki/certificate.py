"""Fields of X.509 certificates - subject, issuer, hosts, validity - and the common names of vehicles."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from nedbus.extras import import_optional
from nedbus_msgs import AddressError, check_vehicle

DAYS: Final = 825
"""Default validity of a certificate [days]."""

RENEW_WITHIN: Final = 30
"""Days before the expiry of a certificate at which it becomes due for renewal."""

CERTIFICATE_PREFIX: Final = "vehicle-"
"""Prefix of the vehicle id in common names, so no vehicle has the common name of a reader or router."""

NAME_LENGTH: Final = 64  # characters that X.509 allows in a common name
_SHOWN_HOSTS: Final = 8


def certificate_name(vehicle: str) -> str:
    """Return the common name of a vehicle's certificate; raise AddressError for an invalid or too long id."""
    check_vehicle(vehicle)
    longest = NAME_LENGTH - len(CERTIFICATE_PREFIX)
    if len(vehicle) > longest:
        raise AddressError("vehicle", vehicle, f"at most {longest} characters, for a certificate")
    return CERTIFICATE_PREFIX + vehicle


@dataclass(frozen=True, slots=True)
class Certificate:
    """A certificate: common names of subject and issuer, hosts, and validity (UTC)."""

    subject: str
    issuer: str
    hosts: tuple[str, ...]
    begins: dt.datetime
    ends: dt.datetime

    @classmethod
    def decode(cls, data: bytes, *, pem: bool = False) -> Certificate:
        """Decode an untrusted peer's certificate in DER or, with `pem`, the first one in a PEM text.

        Uses the optional package `cryptography`, because Python's `ssl` decodes only verified certificates.

        Raises ValueError for malformed data, ConfigError (also a ValueError) without the extra `pki`.
        """
        x509 = import_optional("pki", "cryptography.x509")
        try:
            if pem:
                load = x509.load_pem_x509_certificate
            else:
                load = x509.load_der_x509_certificate
            loaded = load(data)
            hosts = list[str]()
            for extension in loaded.extensions:
                if extension.oid == x509.OID_SUBJECT_ALTERNATIVE_NAME:
                    hosts += [str(name.value) for name in extension.value]
        except (
            x509.InvalidVersion,
            x509.DuplicateExtension,
            x509.UnsupportedGeneralNameType,
        ) as exc:
            raise ValueError(str(exc)) from exc
        return cls(
            subject=_common_name(loaded.subject),
            issuer=_common_name(loaded.issuer),
            hosts=tuple(hosts),
            begins=loaded.not_valid_before_utc,
            ends=loaded.not_valid_after_utc,
        )

    @classmethod
    def read(cls, path: str | Path) -> Certificate:
        """Read the first certificate in a PEM file; raise OSError, or the errors of `decode`."""
        return cls.decode(Path(path).read_bytes(), pem=True)

    def days_left(self, now: dt.datetime) -> float:
        """Return the days until expiry; negative for an expired certificate."""
        return (self.ends - now) / dt.timedelta(days=1)

    def is_due(self, now: dt.datetime, within: float = RENEW_WITHIN) -> bool:
        """Return whether the certificate is due for renewal: it expires within `within` days, or has expired."""
        return self.days_left(now) <= within

    def __str__(self) -> str:
        name = self.subject
        if self.hosts:
            name = f"{name} for {', '.join(self.hosts[:_SHOWN_HOSTS])}"
        return f"{name}, issued by {self.issuer}, valid until {self.ends:%Y-%m-%d}"


def _common_name(name: Any) -> str:
    for attribute in name:
        if attribute.rfc4514_attribute_name == "CN":
            return str(attribute.value)
    return "unnamed"
