"""X.509 certificates, as far as a person asks: whose, for which names, by whom, from when until when.

Python's `ssl` decodes a certificate only after it has verified it; what is wrong with one must be read before that.
The bytes come from anybody: what is malformed raises ValueError.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import re
import ssl
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

_COMMON_NAME: Final = bytes([0x55, 0x04, 0x03])  # 2.5.4.3
_ALTERNATIVE_NAMES: Final = bytes([0x55, 0x1D, 0x11])  # 2.5.29.17
_VERSION, _EXTENSIONS = 0xA0, 0xA3  # tags of the optional parts of a certificate
_DNS, _IP = 0x82, 0x87  # tags of names
_UTC_TIME: Final = 0x17
_PEM: Final = re.compile(r"-----BEGIN CERTIFICATE-----.+?-----END CERTIFICATE-----", re.DOTALL)
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
    def parse(cls, der: bytes) -> Self:
        """Parse a certificate in DER; raise ValueError for anything else."""
        try:
            signed = _parts(_only(_parts(der)))[0][1]
            parts = [part for part in _parts(signed) if part[0] != _VERSION]
            _, _, issuer, validity, subject, *rest = parts  # after the serial number and the algorithm
            begins, ends = (_time(*part) for part in _parts(validity[1]))
            extensions = [part for tag, part in rest if tag == _EXTENSIONS]
            hosts = tuple(_hosts(extensions[0])) if extensions else ()
            return cls(_common_name(subject[1]), _common_name(issuer[1]), hosts, begins, ends)
        except (IndexError, TypeError) as exc:
            raise ValueError("not a certificate") from exc

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read the first certificate of a PEM file; raise ValueError if there is none, OSError."""
        found = _PEM.search(Path(path).read_text(errors="replace"))
        if found is None:
            raise ValueError("no certificate in PEM")
        return cls.parse(ssl.PEM_cert_to_DER_cert(found[0]))

    def days_left(self, now: dt.datetime) -> float:
        """Return for how many days it is still valid; negative once it has expired."""
        return (self.ends - now) / _DAY

    def __str__(self) -> str:
        hosts = f" for {', '.join(self.hosts[:8])}" if self.hosts else ""
        return f"{self.subject}{hosts}, issued by {self.issuer}, valid until {self.ends:%Y-%m-%d}"


def _parts(data: bytes) -> list[tuple[int, bytes]]:
    """Return tag and content of each value in a row of DER values."""
    parts, index = [], 0
    while index < len(data):
        tag, size, start = data[index], data[index + 1], index + 2
        if size > 0x80:
            count = size & 0x7F
            size, start = int.from_bytes(data[start : start + count], "big"), start + count
        if start + size > len(data):
            raise ValueError("not a certificate: it is cut off")
        parts.append((tag, data[start : start + size]))
        index = start + size
    return parts


def _only(parts: list[tuple[int, bytes]]) -> bytes:
    ((_, content),) = parts
    return content


def _time(tag: int, content: bytes) -> dt.datetime:
    text = content.decode("ascii")
    if tag == _UTC_TIME:  # two digits of the year: 1950 to 2049
        text = ("20" if text < "50" else "19") + text
    return dt.datetime.strptime(text, "%Y%m%d%H%M%SZ").replace(tzinfo=dt.UTC)


def _common_name(name: bytes) -> str:
    for _, attributes in _parts(name):
        for _, attribute in _parts(attributes):
            (_, kind), (_, value) = _parts(attribute)
            if kind == _COMMON_NAME:
                return value.decode("utf-8", "replace")
    return "nobody"


def _hosts(extensions: bytes) -> Iterator[str]:
    for _, extension in _parts(_only(_parts(extensions))):
        (_, kind), *_, (_, value) = _parts(extension)
        if kind != _ALTERNATIVE_NAMES:
            continue
        for tag, name in _parts(_only(_parts(value))):
            if tag == _DNS:
                yield name.decode("ascii", "replace")
            elif tag == _IP:
                yield str(ipaddress.ip_address(name))
