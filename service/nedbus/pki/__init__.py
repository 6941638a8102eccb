"""Certificates of a fleet: making, listing and renewing them, bundles for vehicles, and a router's access rules."""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

from .access_rules import read_access_rules, write_access_rules
from .certificate import CERTIFICATE_PREFIX, DAYS, RENEW_WITHIN, Certificate, certificate_name

if TYPE_CHECKING:
    from .authority import make_authority, make_certificate
    from .bundle import make_bundle
    from .renewal import CertificateEntry, list_certificates, renew_certificate
else:
    __getattr__ = lazy_exports(
        __name__,
        dict.fromkeys(("make_authority", "make_certificate"), ("pki", "authority"))
        | dict.fromkeys(("CertificateEntry", "list_certificates", "renew_certificate"), ("pki", "renewal"))
        | {"make_bundle": ("pki", "bundle")},
    )

__all__ = [
    "CERTIFICATE_PREFIX", "DAYS", "RENEW_WITHIN", "Certificate", "CertificateEntry", "certificate_name",
    "list_certificates", "make_authority", "make_bundle", "make_certificate", "read_access_rules", "renew_certificate",
    "write_access_rules",
]  # fmt: skip
