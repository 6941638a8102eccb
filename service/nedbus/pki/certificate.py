"""The readable part of X.509 certificates: subject, issuer, hosts, validity; and the names of vehicles in them."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from nedbus.extras import needs
from nedbus_msgs import AddressError, check_vehicle

DAYS: Final = 825
"""Days for which a certificate is valid."""

RENEW_WITHIN: Final = 30
"""Days before its end from which a certificate is due for renewal."""

CERTIFICATE_PREFIX: Final = "vehicle-"
"""The common name of a vehicle's certificate is this and its id, so that no vehicle can be named like a reader."""

MAX_NAME: Final = 64
"""Characters of a common name, a limit of X.509."""


def certificate_name(vehicle: str) -> str:
    """Return the common name of a vehicle's certificate; raise AddressError if the id is invalid or too long."""
    check_vehicle(vehicle)
    longest = MAX_NAME - len(CERTIFICATE_PREFIX)
    if len(vehicle) > longest:
        raise AddressError("vehicle", vehicle, f"at most {longest} characters, for a certificate")
    return CERTIFICATE_PREFIX + vehicle


@dataclass(frozen=True, slots=True)
class Certificate:
    """One certificate: common names of its subject and its issuer, its hosts, and its validity, UTC."""

    subject: str
    issuer: str
    hosts: tuple[str, ...]
    begins: dt.datetime
    ends: dt.datetime

    @classmethod
    def decode(cls, data: bytes, *, pem: bool = False) -> Certificate:
        """Decode a certificate in DER, or the first one of a text with `pem`; it may come from any peer.

        Python's `ssl` decodes verified certificates only, the package `cryptography` any: a vehicle runs without it.

        Raises ValueError for anything else, ConfigError (a ValueError too) without the extra `pki`.
        """
        x509 = needs("pki", "cryptography.x509")
        try:
            found = x509.load_pem_x509_certificate(data) if pem else x509.load_der_x509_certificate(data)
            names = [each.value for each in found.extensions if each.oid == x509.OID_SUBJECT_ALTERNATIVE_NAME]
        except (x509.InvalidVersion, x509.DuplicateExtension, x509.UnsupportedGeneralNameType) as exc:
            raise ValueError(str(exc)) from exc
        hosts = tuple(str(name.value) for name in names[0]) if names else ()
        begins, ends = found.not_valid_before_utc, found.not_valid_after_utc
        return cls(_common_name(found.subject), _common_name(found.issuer), hosts, begins, ends)

    @classmethod
    def read(cls, path: str | Path) -> Certificate:
        """Read the first certificate of a PEM file; raise ValueError and ConfigError as `decode` does, OSError."""
        return cls.decode(Path(path).read_bytes(), pem=True)

    def days_left(self, now: dt.datetime) -> float:
        """Return the days until it expires, negative once it has."""
        return (self.ends - now) / dt.timedelta(days=1)

    def is_due(self, now: dt.datetime, within: float = RENEW_WITHIN) -> bool:
        """Return whether it is due for renewal: it ends within these days, or has ended."""
        return self.days_left(now) <= within

    def __str__(self) -> str:
        hosts = f" for {', '.join(self.hosts[:8])}" if self.hosts else ""
        return f"{self.subject}{hosts}, issued by {self.issuer}, valid until {self.ends:%Y-%m-%d}"


def _common_name(name: Any) -> str:
    """Return the common name of an `x509.Name`."""
    return next((str(each.value) for each in name if each.rfc4514_attribute_name == "CN"), "unnamed")
