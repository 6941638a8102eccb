"""TLS files of a client for `tls/` endpoints, and the diagnosis of invalid files."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from nedbus import clock
from nedbus.errors import ConfigError

if TYPE_CHECKING:
    import ssl

_LABEL: Final = re.compile(r"-----BEGIN ([A-Z0-9 ]+)-----")
UNKNOWN_CA: Final = (7, 18, 19, 20, 21)
"""OpenSSL's verification codes for a certificate that was signed by another CA."""
_VERIFY_REASONS: Final = {  # reasons by OpenSSL's verification code
    9: "or its CA is not valid yet: check the clock of this host",
    10: "or its CA has expired",
    **dict.fromkeys(UNKNOWN_CA, "is not signed by the CA in tls_ca"),
}


@dataclass(frozen=True, slots=True)
class Tls:
    """PEM files for `tls/` endpoints.

    `ca`: certificate of the CA that signed the router's certificate.
    `certificate`, `key`: client certificate and its key, for routers with mutual TLS; both or neither.

    Raises ConfigError for a certificate without its key, or a key without its certificate.
    """

    ca: str | Path
    certificate: str | Path | None = None
    key: str | Path | None = None

    def __post_init__(self) -> None:
        if (self.certificate is None) != (self.key is None):
            raise ConfigError(
                "tls", "a certificate needs its key, and a key its certificate: set both or neither"
            )

    def zenoh_settings(self) -> dict[str, object]:
        """Return Zenoh's `transport/link/tls` section.

        Raises ConfigError for a file that is unreadable or of the wrong kind, and for a key that does not match.
        """
        import ssl

        check_pem(self.ca, "CERTIFICATE")
        settings: dict[str, object] = {"root_ca_certificate": str(self.ca)}
        if self.certificate is not None and self.key is not None:
            check_pem(self.certificate, "CERTIFICATE")
            check_pem(self.key, "PRIVATE KEY")
            _load_pair(ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT), self.certificate, self.key)
            own = {
                "connect_certificate": str(self.certificate),
                "connect_private_key": str(self.key),
            }
            settings |= {**own, "enable_mtls": True}
        return settings

    def context(self, *, server: bool = False) -> ssl.SSLContext:
        """Return the SSL context for one side of a connection, which trusts the CA and presents the certificate.

        Raises OSError (or SSLError) unless `ca` is a certificate, ConfigError for a key that does not match.
        """
        import ssl

        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if server else ssl.PROTOCOL_TLS_CLIENT)
        context.load_verify_locations(self.ca)
        if self.certificate is not None and self.key is not None:
            _load_pair(context, self.certificate, self.key)
        return context

    def explain(self) -> str | None:
        """Return the reason why a router would reject these files, such as an expired certificate; else None.

        Performs a TLS handshake in memory, with a server that trusts the CA.
        """
        import ssl

        try:
            ours = self.context()
            peer = self.context(server=True)
        except OSError:
            return f"{self.ca} is not a CA certificate"
        if self.certificate is None:
            if not peer.get_ca_certs():
                return f"{self.ca} is not a CA certificate: it cannot sign others"
            until = max(
                ssl.cert_time_to_seconds(str(certificate["notAfter"]))
                for certificate in peer.get_ca_certs()
            )
            if until < clock.utc():
                return f"{self.ca} has expired"
            return None
        ours.check_hostname = False
        ours.verify_mode = ssl.CERT_NONE  # the server is this process
        peer.verify_mode = ssl.CERT_REQUIRED
        to_server = ssl.MemoryBIO()
        to_client = ssl.MemoryBIO()
        client = ours.wrap_bio(to_client, to_server)
        server = peer.wrap_bio(to_server, to_client, server_side=True)
        for side in (client, server, client, server):  # the steps of a handshake
            try:
                side.do_handshake()
            except ssl.SSLWantReadError:
                continue
            except ssl.SSLCertVerificationError as exc:
                return (
                    f"{self.certificate} {_VERIFY_REASONS.get(exc.verify_code, exc.verify_message)}"
                )
            except ssl.SSLError:
                break
        return None


def read_certificate(host: str, port: int, timeout: float) -> str:
    """Return a server's certificate in PEM, without verifying it; "" if none is presented within `timeout` seconds."""
    import ssl

    with suppress(OSError):  # also catches SSLError
        return ssl.get_server_certificate((host, port), timeout=timeout)
    return ""


def check_pem(path: str | Path, kind: str) -> None:
    """Raise ConfigError unless a file has a PEM block of this kind, such as CERTIFICATE or PRIVATE KEY."""
    if not os.access(path, os.R_OK) or not Path(path).is_file():
        raise ConfigError(
            "tls", f"{path} cannot be read: check that it exists and that this user may read it"
        )
    text = Path(path).read_text(errors="replace")
    labels = _LABEL.findall(text)
    if not any(label.endswith(kind) for label in labels):
        if labels:
            problem = f"contains a {labels[0].lower()}"
        elif text:
            problem = "is not PEM"
        else:
            problem = "is empty"
        hint = "check whether two files are swapped" if labels else "create one with 'nedbus pki'"
        raise ConfigError("tls", f"{path} {problem}, but a {kind.lower()} is required: {hint}")


def _load_pair(context: ssl.SSLContext, certificate: str | Path, key: str | Path) -> None:
    import ssl

    try:
        context.load_cert_chain(certificate, key, password=lambda: "")
    except ssl.SSLError as exc:
        reason = f"{certificate} or {key} is damaged, or the key has a password: create new ones"
        if exc.reason == "KEY_VALUES_MISMATCH":
            reason = f"{key} is not the key of {certificate}: use the two files that were created together"
        raise ConfigError("tls", reason) from exc
