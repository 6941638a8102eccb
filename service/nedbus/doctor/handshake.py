"""TLS handshakes with a router: which certificate it shows, whether it is to be trusted, and what it says of ours."""

from __future__ import annotations

import socket
import ssl
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from nedbus.transport import Tls

_TIMEOUT: Final = 1.5  # s of a handshake
_VERDICT: Final = 0.5  # s in which a router that rejects our certificate says so; one that accepts says nothing
_ALERTS: Final = {  # reasons of OpenSSL, by a part of their names
    "CERTIFICATE_REQUIRED": "it wants a certificate of this client, and none is given",
    "HANDSHAKE_FAILURE": "it wants a certificate of this client, perhaps, and rejects what is given",
    "UNKNOWN_CA": "it does not know the authority that issued the certificate of this client",
    "CERTIFICATE_EXPIRED": "it says that the certificate of this client has expired: by the clock of its host",
    "BAD_CERTIFICATE": "it rejects the certificate of this client",
    "UNSUPPORTED_CERTIFICATE": "the certificate of this client is not one for clients",
    "CERTIFICATE_UNKNOWN": "it rejects the certificate of this client",
    "DECRYPT_ERROR": "it rejects the certificate of this client",
    "ACCESS_DENIED": "it rejects the certificate of this client",
}
_REASONS: Final = {  # of OpenSSL's codes
    **dict.fromkeys((7, 18, 19, 20, 21), "other"),
    **dict.fromkeys((62, 64), "host"),
}


@dataclass(frozen=True, slots=True)
class Shown:
    """What a server showed: its certificate in DER, None if it spoke no TLS; what it says of ours, "" if nothing."""

    certificate: bytes | None
    rejection: str = ""


def look_at(host: str, port: int, tls: Tls | None) -> Shown:
    """Shake hands with a server, whoever it is, and return what it shows; raise OSError when it cannot be reached."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE  # nothing is sent: it is only looked at
    if tls is not None and tls.certificate is not None:
        with suppress(OSError, ssl.SSLError):  # its files are a finding of their own
            context.load_cert_chain(tls.certificate, tls.key)
    with socket.create_connection((host, port), timeout=_TIMEOUT) as plain:
        try:
            connection = context.wrap_socket(plain, server_hostname=host)
        except (ssl.SSLError, OSError) as exc:
            return Shown(None, _alert(exc))
        with connection:
            certificate = connection.getpeercert(binary_form=True)
            connection.settimeout(_VERDICT)
            try:
                connection.recv(1)  # with TLS 1.3 the verdict comes after the handshake
            except TimeoutError:
                return Shown(certificate)
            except (ssl.SSLError, OSError) as exc:
                return Shown(certificate, _alert(exc))
    return Shown(certificate)


def verify(host: str, port: int, tls: Tls) -> str:
    """Shake hands as a client does, and return why the server's certificate is not to be trusted, "" if it is.

    `other`: of another authority; `host`: for other hosts; else what OpenSSL says.

    Raises OSError when it cannot be reached.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(tls.ca)
        if tls.certificate is not None:
            context.load_cert_chain(tls.certificate, tls.key)
    except (OSError, ssl.SSLError):
        return ""  # its files are a finding of their own
    with socket.create_connection((host, port), timeout=_TIMEOUT) as plain:
        try:
            with context.wrap_socket(plain, server_hostname=host):
                return ""
        except ssl.SSLCertVerificationError as exc:
            return _REASONS.get(exc.verify_code, exc.verify_message)
        except (ssl.SSLError, OSError):
            return ""


def _alert(error: Exception) -> str:
    reason = (error.reason or "") if isinstance(error, ssl.SSLError) else ""
    return next((text for name, text in _ALERTS.items() if name in reason), "")
