"""X.509 certificates, as far as a person asks: whose, for which names, by whom, from when until when.

Python's `ssl` decodes a certificate only after it has verified it, and what is wrong with one must be read before that:
the package `cryptography` does. It is optional (extra `pki`): a vehicle that only uses its certificate runs without.
"""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from nedbus.extras import needs

RENEW_WITHIN: Final = 30
"""Days before the end of a certificate in which it is to be renewed."""

_DAY: Final = dt.timedelta(days=1)


@dataclass(frozen=True, slots=True)
class Certificate:
    """One certificate: common names of its subject and its issuer, the hosts it is for, and its validity."""

    subject: str
    issuer: str
    hosts: tuple[str, ...]
    begins: dt.datetime
    ends: dt.datetime

    @classmethod
    def decode(cls, data: bytes, *, pem: bool = False) -> Certificate:
        """Decode a certificate in DER, or the first one of a text with `pem`.

        Raises ValueError for anything else, ConfigError (which is one, too) without the extra `pki`.
        """
        certificate: Certificate = needs("pki", "nedbus.transport.pki_renewal").decode_certificate(data, pem=pem)
        return certificate

    @classmethod
    def read(cls, path: str | Path) -> Certificate:
        """Read the first certificate of a PEM file; raise ValueError and ConfigError as `decode` does, OSError."""
        return cls.decode(Path(path).read_bytes(), pem=True)

    def days_left(self, now: dt.datetime) -> float:
        """Return for how many days it is still valid; negative once it has expired."""
        return (self.ends - now) / _DAY

    def is_due(self, now: dt.datetime) -> bool:
        """Return whether it is to be renewed: it ends soon, or has ended."""
        return self.days_left(now) <= RENEW_WITHIN

    def __str__(self) -> str:
        hosts = f" for {', '.join(self.hosts[:8])}" if self.hosts else ""
        return f"{self.subject}{hosts}, issued by {self.issuer}, valid until {self.ends:%Y-%m-%d}"
