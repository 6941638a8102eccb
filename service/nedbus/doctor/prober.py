"""Probe routers and certificates: `nedbus check` tries endpoints and reads files, the doctor also opens sessions."""

from __future__ import annotations

import datetime as dt
import socket
import ssl
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from nedbus.errors import ConfigError, NedbusError
from nedbus.pki import Certificate
from nedbus.settings import Settings
from nedbus.transport import Tls, check_pem, open_client, split_endpoint

from .finding import Finding, State, brief, worst_state

_CONNECT_TIMEOUT: Final = 2.0  # s
_HANDSHAKE_TIMEOUT: Final = 1.5  # s
_ALERT_TIMEOUT: Final = 0.5  # s for the alert of a router that rejects our certificate; one that accepts it is silent
_OPEN_TIMEOUT: Final = 1.5  # s
_PEM_FILES: Final = {"tls_ca": "the authority is", "tls_certificate": "this client is", "tls_key": ""}
_ALERTS: Final = {  # by a part of OpenSSL's names of TLS alerts
    "CERTIFICATE_REQUIRED": "it wants a certificate of this client, and none is given",
    "UNKNOWN_CA": "it does not know the authority that issued the certificate of this client",
    "CERTIFICATE_EXPIRED": "the certificate of this client has expired, by the clock of its host",
    "CERTIFICATE": "it rejects the certificate of this client",
    "": "it breaks off the handshake",
}
_RENEW: Final = "renew it: 'nedbus pki renew', docs/security.md"
_UNKNOWN_AUTHORITY: Final = (7, 18, 19, 20, 21)  # OpenSSL's codes
_OTHER_HOST: Final = (62, 64)


def check_endpoint(endpoint: str, tls: Tls | None) -> Iterator[Finding]:
    """Yield the findings on one router, up to the first that is wrong."""
    if unreachable := reach_endpoint(endpoint):
        yield unreachable
        return
    protocol, host, port = split_endpoint(endpoint) or ("", "", 0)
    if protocol == "tls":
        findings = list(_check_router_certificate(endpoint, host, port, tls))
        yield from findings
        if worst_state(findings) == "wrong":
            return
    try:
        open_client([endpoint], timeout=_OPEN_TIMEOUT, tls=tls).close()
    except NedbusError:
        if protocol == "tcp" and _read_certificate(host, port):
            seen, advice = "it speaks TLS", "write tls/ in place of tcp/, with --tls-ca, and what the router asks for"
        else:
            seen = "no Zenoh session opens there"
            advice = "is it a Zenoh router, has it room (max_sessions)? its port is 7447 by default; its log says more"
        yield Finding("endpoint", endpoint, "wrong", seen, advice)
    else:
        yield Finding("endpoint", endpoint, "ok", "a Zenoh router answers")


def reach_endpoint(endpoint: str) -> Finding | None:
    """Return a finding if an endpoint cannot be reached, else None; of UDP and QUIC only names are looked up."""
    parts = split_endpoint(endpoint)
    if parts is None:  # a socket in the file system
        return None
    protocol, host, port = parts
    try:
        if protocol in {"udp", "quic"}:
            socket.getaddrinfo(host, port)
        else:
            socket.create_connection((host, port), _CONNECT_TIMEOUT).close()
    except (socket.gaierror, UnicodeError):  # the latter for a name with an empty part, such as a..b
        seen, advice = f"this host finds no address of {host}", "correct the name, or write the IP address"
    except ConnectionRefusedError:
        seen = "nothing listens there: the host refuses the connection"
        advice = "start 'nedbus serve' or a Zenoh router there, or name another endpoint with --connect"
    except TimeoutError:
        seen = f"nothing answers within {_CONNECT_TIMEOUT:g} s"
        advice = "is the host on, is the address right, does a firewall drop the port?"
    except OSError as exc:
        seen, advice = f"cannot be reached: {(exc.strerror or str(exc)).lower()}", "check cable, address and route"
    else:
        return None
    return Finding("endpoint", endpoint, "wrong", seen, advice)


def _check_router_certificate(endpoint: str, host: str, port: int, tls: Tls | None) -> Iterator[Finding]:
    """Yield the validity of the router's certificate, and a finding if one side rejects the other."""
    pem = _read_certificate(host, port)
    if not pem:
        seen, advice = "it does not speak TLS", "write tcp/, or name the endpoint of a Zenoh router with TLS"
        yield Finding("endpoint", endpoint, "wrong", seen, advice)
        return
    validity, certificate = _judge_validity("tls", endpoint, "the router shows", pem.encode())
    yield validity
    if tls is None:
        advice = "give the certificate of the authority with --tls-ca or NEDBUS_TLS_CA"
        yield Finding("tls", endpoint, "wrong", "no authority is given that could vouch for the router", advice)
        return
    try:
        _shake_hands(host, port, tls)
    except ssl.SSLCertVerificationError as exc:
        if exc.verify_code in _OTHER_HOST:
            names = f", but for {', '.join(certificate.hosts[:8]) or 'no host at all'}" if certificate else ""
            seen = f"the router's certificate is not for {host}{names}"
            advice = f"connect by a host of it, or make a certificate with --host {host}: 'nedbus pki cert'"
        elif exc.verify_code in _UNKNOWN_AUTHORITY:
            issuer = f", but by {brief(certificate.issuer)}" if certificate else ""
            seen = f"the router's certificate is not signed by the authority in {tls.ca}{issuer}"
            advice = "give its authority as --tls-ca, or ask whose router it is"
        else:
            seen, advice = f"the router's certificate cannot be trusted: {exc.verify_message}", ""
        if advice or validity.state != "wrong":  # else it says the same
            yield Finding("tls", endpoint, "wrong", seen, advice)
    except ssl.SSLError as exc:
        seen = next(text for name, text in _ALERTS.items() if name in (exc.reason or ""))
        advice = "give --tls-certificate and --tls-key of a certificate that the router's authority has signed"
        yield Finding("tls", endpoint, "wrong", f"the router refuses: {seen}", advice)


def _read_certificate(host: str, port: int) -> str:
    """Return the certificate of a server in PEM, unverified; "" if it speaks no TLS."""
    with suppress(OSError):  # SSLError, too
        return ssl.get_server_certificate((host, port), timeout=_HANDSHAKE_TIMEOUT)
    return ""


def _shake_hands(host: str, port: int, tls: Tls) -> None:
    """Shake hands as a client does; raise SSLError if one side rejects the other."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(tls.ca)
    if tls.certificate is not None:
        context.load_cert_chain(tls.certificate, tls.key)
    with (
        suppress(TimeoutError, ConnectionError),
        socket.create_connection((host, port), timeout=_HANDSHAKE_TIMEOUT) as plain,
        context.wrap_socket(plain, server_hostname=host) as connection,
    ):
        connection.settimeout(_ALERT_TIMEOUT)
        connection.recv(1)  # with TLS 1.3 the alert comes after the handshake


def check_tls_files(settings: Settings) -> tuple[list[tuple[str, Finding]], Tls | None]:
    """Return the findings on the TLS files of these settings, each with its setting, and the files if they work."""
    given = {name: path for name in _PEM_FILES if (path := getattr(settings, name)) is not None}
    found = [(name, check_pem_file(name, path, _PEM_FILES[name])) for name, path in given.items()]
    findings = [(name, finding) for name, finding in found if finding is not None]
    wrong = {finding.seen for _, finding in findings if finding.state == "wrong"}
    tls, advice = None, ""
    try:
        if settings.tls is not None:
            settings.tls.zenoh_settings()
        tls = settings.tls
        reason = tls.explain() if tls is not None and not wrong else None
        advice = "give a certificate that the same authority has signed as the router's"
    except ConfigError as exc:
        reason = exc.reason
    if reason and reason not in wrong and not settings.left_out & _PEM_FILES.keys():
        name = "tls_certificate" if "tls_certificate" in given else list(given)[-1]
        findings.append((name, Finding("certificate", str(given[name]), "wrong", reason, advice)))
    return findings, tls


def check_pem_file(name: str, path: Path, whose: str) -> Finding | None:
    """Return the validity of a setting's certificate; None for a private key without a fault."""
    kind = "PRIVATE KEY" if name.endswith("_key") else "CERTIFICATE"
    try:
        check_pem(path, kind)
    except ConfigError as exc:
        return Finding("certificate", str(path), "wrong", exc.reason)
    return _judge_validity("certificate", str(path), whose, path.read_bytes())[0] if kind == "CERTIFICATE" else None


def _judge_validity(check: str, subject: str, whose: str, pem: bytes) -> tuple[Finding, Certificate | None]:
    """Return the validity of a certificate, and the certificate if it can be read."""
    try:
        certificate = Certificate.decode(pem, pem=True)
    except ConfigError as exc:  # the package that reads it is missing
        return Finding(check, subject, "unknown", "when the certificate expires is not checked", str(exc)), None
    except ValueError as exc:
        return Finding(check, subject, "wrong", f"cannot be read as a certificate: {exc}"), None
    now = dt.datetime.now(dt.UTC)
    days = certificate.days_left(now)
    state: State = "ok"
    note = advice = ""
    if days < 0:
        state, note, advice = "wrong", ": it has expired", _RENEW
    elif now < certificate.begins:
        state, note = "wrong", ": it is not valid yet"
        advice = f"is the clock of this host right? it says {now:%Y-%m-%d %H:%M} UTC"
    elif certificate.is_due(now):
        state, note, advice = "warning", f", {days:.0f} days from now", _RENEW
    return Finding(check, subject, state, f"{whose} {brief(certificate)}{note}", advice), certificate
