"""Certificates of a fleet: create, list, renew, check and bundle them; write and read a router's access rules."""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

from .access_rules import read_access_rules, write_access_rules
from .certificate import CERTIFICATE_PREFIX, DAYS, RENEW_WITHIN, Certificate, certificate_name

if TYPE_CHECKING:
    from nedbus.transport import (
        UNKNOWN_CA,
        AccessControl,
        AccessRule,
        Decision,
        RouterConfig,
        check_pem,
        read_certificate,
        read_router_config,
    )

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
    # Zenoh, which reads a router's configuration, takes 50 ms to load.
    _OF_TRANSPORT = (
        "UNKNOWN_CA",
        "AccessControl",
        "AccessRule",
        "Decision",
        "RouterConfig",
        "check_pem",
        "read_certificate",
        "read_router_config",
    )
    _from_pki = lazy_exports(
        __name__,
        dict.fromkeys(_AUTHORITY, ("pki", "authority")) | {"make_bundle": ("pki", "bundle")},
    )
    _from_transport = lazy_exports("nedbus", dict.fromkeys(_OF_TRANSPORT, ("", "transport")))

    def __getattr__(name: str) -> object:
        """Import an exported name on first use."""
        if name in _OF_TRANSPORT:
            return _from_transport(name)
        return _from_pki(name)


__all__ = [
    "CERTIFICATE_PREFIX", "DAYS", "RENEW_WITHIN", "UNKNOWN_CA", "AccessControl", "AccessRule", "Certificate",
    "CertificateEntry", "Decision", "RouterConfig", "certificate_name", "check_pem", "list_certificates",
    "make_authority", "make_bundle", "make_certificate", "read_access_rules", "read_certificate", "read_router_config",
    "renew_certificate", "write_access_rules",
]  # fmt: skip
