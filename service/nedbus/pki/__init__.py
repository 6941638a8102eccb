"""Certificates of a fleet: create, list, renew and bundle them, and write a router's access rules."""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

from .access_rules import read_access_rules, write_access_rules
from .certificate import CERTIFICATE_PREFIX, DAYS, RENEW_WITHIN, Certificate, certificate_name

if TYPE_CHECKING:
    from .authority import (
        CertificateEntry,
        list_certificates,
        make_authority,
        make_certificate,
        renew_certificate,
    )
    from .bundle import make_bundle
else:
    _AUTHORITY = (
        "CertificateEntry",
        "list_certificates",
        "make_authority",
        "make_certificate",
        "renew_certificate",
    )
    __getattr__ = lazy_exports(
        __name__,
        dict.fromkeys(_AUTHORITY, ("pki", "authority")) | {"make_bundle": ("pki", "bundle")},
    )

__all__ = [
    "CERTIFICATE_PREFIX", "DAYS", "RENEW_WITHIN", "Certificate", "CertificateEntry", "certificate_name",
    "list_certificates", "make_authority", "make_bundle", "make_certificate", "read_access_rules", "renew_certificate",
    "write_access_rules",
]  # fmt: skip
