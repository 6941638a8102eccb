"""TLS of a client: the files that it needs for `tls/` endpoints."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from nedbus.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Tls:
    """PEM files for `tls/` endpoints.

    `ca`: certificate of the authority that signed the router's certificate.
    `certificate`, `key`: this client's own, where a router asks for them (mutual TLS); both or none.

    Raises ConfigError for one of the pair without the other.
    """

    ca: str | Path
    certificate: str | Path | None = None
    key: str | Path | None = None

    def __post_init__(self) -> None:
        if (self.certificate is None) != (self.key is None):
            raise ConfigError("tls", "a certificate needs its key, and a key its certificate: give both or none")

    def zenoh_settings(self) -> dict[str, object]:
        """Return Zenoh's `transport/link/tls` section; raise ConfigError for a file that cannot be read."""
        for path in (self.ca, self.certificate, self.key):
            if path is not None and not os.access(path, os.R_OK):
                raise ConfigError("tls", f"{path} cannot be read: does it exist, and may this user read it?")
        own = {"connect_certificate": str(self.certificate), "connect_private_key": str(self.key), "enable_mtls": True}
        return {"root_ca_certificate": str(self.ca), **(own if self.certificate else {})}
