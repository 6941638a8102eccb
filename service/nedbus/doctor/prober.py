"""Probes of endpoints, routers and certificates; `nedbus check` uses all except those that open a session."""

import socket
import ssl
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from nedbus import Tls, clock, connect
from nedbus.endpoints import split_endpoint
from nedbus.errors import ConfigError, NedbusError, system_reason
from nedbus.pki import UNKNOWN_CA, Certificate, check_pem, read_certificate
from nedbus.settings import Settings
from nedbus.timings import TIMINGS
from nedbus_msgs import DEFAULT_PREFIX

from .finding import Finding, brief, worst_state

_CONNECT_TIMEOUT: Final = 2.0  # s
_PEM_FILES: Final = {"tls_ca": "the CA is", "tls_certificate": "this client is", "tls_key": ""}
_ALERTS: Final = {  # by substring of OpenSSL's reason for a TLS alert
    "CERTIFICATE_REQUIRED": "it requires a client certificate, and none is given",
    "UNKNOWN_CA": "it does not trust the CA that issued the client certificate",
    "CERTIFICATE_EXPIRED": "the client certificate has expired according to the router's clock",
    "CERTIFICATE": "it rejects the client certificate",
    "": "it aborts the handshake",
}
_SHOWN_HOSTS: Final = 8  # of a certificate for another host
_RENEW: Final = "renew it with 'nedbus pki renew' (docs/security.md)"
_OTHER_HOST: Final = (62, 64)  # X509_V_ERR_HOSTNAME_MISMATCH, X509_V_ERR_IP_ADDRESS_MISMATCH


def check_endpoint(endpoint: str, tls: Tls | None) -> Iterator[Finding]:
    """Yield findings on one router; stop at the first one that is "wrong"."""
    unreachable = reach_endpoint(endpoint)
    if unreachable is not None:
        yield unreachable
        return
    protocol, host, port = split_endpoint(endpoint) or ("", "", 0)
    if protocol == "tls":
        findings = list(_check_router_certificate(endpoint, host, port, tls))
        yield from findings
        if worst_state(findings) == "wrong":
            return
    try:
        bus = connect(endpoint, timeout=TIMINGS.doctor_open, prefix=DEFAULT_PREFIX, tls=tls)
        bus.close()
    except NedbusError:
        yield _explain_no_session(endpoint)
    else:
        yield Finding("endpoint", endpoint, "ok", "a Zenoh router answers")


def _explain_no_session(endpoint: str) -> Finding:
    """Return the finding that a port can be reached, but no session opens there."""
    protocol, host, port = split_endpoint(endpoint) or ("", "", 0)
    if protocol == "tcp" and read_certificate(host, port, TIMINGS.handshake):
        seen = "it speaks TLS"
        advice = "use tls/ instead of tcp/, with --tls-ca and a client certificate if needed"
    else:
        seen = "cannot open a Zenoh session"
        advice = "check that it is a Zenoh router (default port: 7447) below its max_sessions; see its log"
    return Finding("endpoint", endpoint, "wrong", seen, advice)


def reach_endpoint(endpoint: str) -> Finding | None:
    """Return a finding if an endpoint cannot be reached, else None; for UDP and QUIC only resolve the host name."""
    parts = split_endpoint(endpoint)
    if parts is None:  # a Unix domain socket
        return None
    protocol, host, port = parts
    try:
        if protocol in {"udp", "quic"}:
            socket.getaddrinfo(host, port)
        else:
            socket.create_connection((host, port), _CONNECT_TIMEOUT).close()
    except (socket.gaierror, UnicodeError):  # UnicodeError: an empty label, such as in a..b
        seen = f"cannot resolve host name {host}"
        advice = "correct the name, or use the IP address"
    except ConnectionRefusedError:
        seen = "connection refused, probably because nothing listens on this port"
        advice = (
            "start 'nedbus serve' or a Zenoh router there, or pass another endpoint with --connect"
        )
    except TimeoutError:
        seen = f"no answer within {_CONNECT_TIMEOUT:g} s"
        advice = "check that the host is on, the address is correct, and no firewall drops the port"
    except OSError as exc:
        seen = f"cannot connect: {system_reason(exc)}"
        advice = "check the cable, address and route"
    else:
        return None
    return Finding("endpoint", endpoint, "wrong", seen, advice)


def _check_router_certificate(
    endpoint: str, host: str, port: int, tls: Tls | None
) -> Iterator[Finding]:
    """Yield the validity of the router's certificate, and a finding if either side rejects the other's."""
    pem = read_certificate(host, port, TIMINGS.handshake)
    if not pem:
        seen = "it does not speak TLS"
        advice = "use tcp/ instead of tls/, or the endpoint of a Zenoh router with TLS"
        yield Finding("endpoint", endpoint, "wrong", seen, advice)
        return
    validity, certificate = _check_validity("tls", endpoint, "the router presents", pem.encode())
    yield validity
    if tls is None:
        advice = "pass the certificate of its CA with --tls-ca or NEDBUS_TLS_CA"
        yield Finding("tls", endpoint, "wrong", "cannot verify the router: no CA is given", advice)
        return
    try:
        _shake_hands(host, port, tls)
    except ssl.SSLCertVerificationError as exc:
        finding = _explain_distrust(endpoint, host, tls, certificate, exc)
        # Without advice, the finding on the validity reports the same.
        if finding.advice or validity.state != "wrong":
            yield finding
    except ssl.SSLError as exc:
        reason = exc.reason or ""
        seen = next(text for name, text in _ALERTS.items() if name in reason)
        advice = "use --tls-certificate and --tls-key with a certificate signed by the router's CA"
        yield Finding("tls", endpoint, "wrong", f"the router refuses this client: {seen}", advice)


def _shake_hands(host: str, port: int, tls: Tls) -> None:
    """Open a TLS connection, and wait for an alert; raise SSLError if one side rejects the other."""
    with (
        suppress(TimeoutError, ConnectionError),
        socket.create_connection((host, port), timeout=TIMINGS.handshake) as plain,
        tls.context().wrap_socket(plain, server_hostname=host) as connection,
    ):
        connection.settimeout(TIMINGS.tls_alert)
        connection.recv(1)  # with TLS 1.3 an alert arrives after the handshake


def _explain_distrust(
    endpoint: str,
    host: str,
    tls: Tls,
    certificate: Certificate | None,
    error: ssl.SSLCertVerificationError,
) -> Finding:
    """Return the finding that this client does not trust the router's certificate."""
    if error.verify_code in _OTHER_HOST:
        seen = f"the router's certificate is not for {host}"
        if certificate is not None:
            hosts = ", ".join(certificate.hosts[:_SHOWN_HOSTS]) or "no host at all"
            seen = f"{seen}, but for {hosts}"
        advice = f"connect to one of its hosts, or create a certificate: 'nedbus pki cert' with --host {host}"
    elif error.verify_code in UNKNOWN_CA:
        seen = f"the router's certificate is not signed by the CA in {tls.ca}"
        if certificate is not None:
            seen = f"{seen}, but by {brief(certificate.issuer)}"
        advice = "pass its CA as --tls-ca, or check that the router is yours"
    else:
        seen = f"the router's certificate is not trusted: {error.verify_message}"
        advice = ""
    return Finding("tls", endpoint, "wrong", seen, advice)


def check_tls_files(settings: Settings) -> tuple[list[tuple[str, Finding]], Tls | None]:
    """Check the TLS files of these settings; return findings by setting, and the files if usable."""
    findings = list[tuple[str, Finding]]()
    given = dict[str, Path]()
    for name, whose in _PEM_FILES.items():
        path = getattr(settings, name)
        if path is None:
            continue
        given[name] = path
        finding = check_pem_file(name, path, whose)
        if finding is not None:
            findings.append((name, finding))
    wrong = {finding.seen for _, finding in findings if finding.state == "wrong"}
    tls = None
    reason = None
    advice = ""
    try:
        if settings.tls is not None:
            settings.tls.zenoh_settings()  # raises ConfigError
            tls = settings.tls
            advice = "use a certificate signed by the CA of the router"
            if not wrong:
                reason = tls.explain()
    except ConfigError as exc:
        reason = exc.reason
    is_new = reason not in wrong and not settings.left_out & _PEM_FILES.keys()
    if reason and is_new:
        if "tls_certificate" in given:
            name = "tls_certificate"
        else:
            name = list(given)[-1]
        findings.append((name, Finding("certificate", str(given[name]), "wrong", reason, advice)))
    return findings, tls


def check_pem_file(name: str, path: Path, whose: str) -> Finding | None:
    """Return the validity of a certificate file; for a private key, None if it is valid."""
    kind = "CERTIFICATE"
    if name.endswith("_key"):
        kind = "PRIVATE KEY"
    try:
        check_pem(path, kind)
    except ConfigError as exc:
        return Finding("certificate", str(path), "wrong", exc.reason)
    if kind == "PRIVATE KEY":
        return None
    validity, _ = _check_validity("certificate", str(path), whose, path.read_bytes())
    return validity


def _check_validity(
    check: str, subject: str, whose: str, pem: bytes
) -> tuple[Finding, Certificate | None]:
    """Return the validity of a certificate, and the certificate if readable."""
    try:
        certificate = Certificate.decode(pem, pem=True)
    except ConfigError as exc:  # the extra `pki` is missing
        return Finding(check, subject, "unknown", "certificate expiry not checked", str(exc)), None
    except ValueError as exc:
        return Finding(check, subject, "wrong", f"not a valid certificate: {exc}"), None
    now = clock.now()
    seen = f"{whose} {brief(certificate)}"
    days = certificate.days_left(now)
    finding = Finding(check, subject, "ok", seen)
    if days < 0:
        finding = Finding(check, subject, "wrong", f"{seen}: it has expired", _RENEW)
    elif now < certificate.begins:
        advice = f"check the clock of this host: {now:%Y-%m-%d %H:%M} UTC"
        finding = Finding(check, subject, "wrong", f"{seen}: it is not valid yet", advice)
    elif certificate.is_due(now):
        finding = Finding(check, subject, "warning", f"{seen} ({days:.0f} days left)", _RENEW)
    return finding, certificate
