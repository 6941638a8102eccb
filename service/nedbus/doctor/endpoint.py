"""The way to a router: does its name resolve, does TCP connect, does it speak Zenoh, and over TLS as whom."""

from __future__ import annotations

import datetime as dt
import socket
from collections.abc import Iterator
from contextlib import suppress
from typing import Final

from nedbus.errors import NedbusError
from nedbus.pki import Certificate
from nedbus.transport import Tls, open_client, split_endpoint

from .finding import Finding, brief
from .handshake import look_at, verify
from .parallel import within
from .speaker import identify
from .validity import explain_unread, judge_validity

_RESOLVE: Final = 2.0  # s
_CONNECT: Final = 2.0  # s
_OPEN: Final = 1.5  # s
_NAME: Final = "endpoint"
_OTHER: Final = "name the endpoint of a Zenoh router with --connect; its port is 7447 by default"
_KINDS: Final = {  # what listens there, and what to do
    "http": ("an HTTP server answers there, not a Zenoh router", _OTHER),
    "other": ("something answers there that is not a Zenoh router", _OTHER),
    "tls": ("it speaks TLS", "write tls/ in place of tcp/, with --tls-ca, and what the router asks for"),
    "zenoh": ("a Zenoh router answers there, without TLS", "write tcp/ in place of tls/"),
    "silent": (
        "it accepts the connection and says nothing",
        f"has the router no room for more sessions (max_sessions, docs/hosts.md), or is it stuck? else {_OTHER}",
    ),
    "closes": (
        "it closes the connection without an answer",
        f"is it none of Zenoh's? {_OTHER}",
    ),
    "no session": (
        "no session opens",
        "has it no room for more sessions (max_sessions, docs/hosts.md), or another version of Zenoh?",
    ),
}


def check_endpoint(endpoint: str, tls: Tls | None) -> list[Finding]:
    """Return what is found on the way to one router, up to the first thing that is wrong."""
    parts = split_endpoint(endpoint)
    if parts is None:  # a socket in the file system
        return [_open(endpoint, tls, None)]
    protocol, host, port = parts
    wrong = _reach(endpoint, protocol, host, port)
    if wrong is not None:
        return [wrong]
    findings = list(_check_tls(endpoint, host, port, tls)) if protocol == "tls" else []
    if any(finding.state == "wrong" for finding in findings):
        return findings
    return [*findings, _open(endpoint, tls, parts)]


def answers(endpoint: str, findings: list[Finding]) -> bool:
    """Return whether a router answered there, by what `check_endpoint` found."""
    return any(each.check == _NAME and each.subject == endpoint and each.state == "ok" for each in findings)


def _reach(endpoint: str, protocol: str, host: str, port: int) -> Finding | None:
    """Return why nothing can be reached at an endpoint; None if something can, or cannot be told."""
    seen, advice = _resolve(host, port)
    if not seen and protocol not in {"udp", "quic"}:
        seen, advice = _connect(host, port)
    return Finding(_NAME, endpoint, "wrong", seen, advice) if seen else None


def _resolve(host: str, port: int) -> tuple[str, str]:
    """Return why a host has no address and what to do, nothing if it has one."""
    try:
        within(_RESOLVE, lambda: socket.getaddrinfo(host, port))
    except TimeoutError:
        return f"no name server answers for {host}", "write the IP address"
    except (OSError, UnicodeError):
        return f"{host} has no address", "correct the name, or write the IP address"
    return "", ""


def _connect(host: str, port: int) -> tuple[str, str]:
    """Return why TCP does not connect and what to do, nothing if it does."""
    try:
        socket.create_connection((host, port), timeout=_CONNECT).close()
    except ConnectionRefusedError:
        advice = "start 'nedbus serve' or a Zenoh router there, or name another endpoint with --connect"
        return "nothing listens there: the host refuses the connection", advice
    except TimeoutError:
        advice = "is the host on, is the address right, does a firewall drop the port?"
        return f"nothing answers within {_CONNECT:g} s", advice
    except OSError as exc:
        return f"cannot be reached: {(exc.strerror or str(exc)).lower()}", "check cable, address and route"
    return "", ""


def _open(endpoint: str, tls: Tls | None, where: tuple[str, str, int] | None) -> Finding:
    try:
        with open_client([endpoint], timeout=_OPEN, tls=tls):
            return Finding(_NAME, endpoint, "ok", "a Zenoh router answers")
    except NedbusError as exc:
        if where is None or where[0] not in {"tcp", "tls"}:
            return Finding(_NAME, endpoint, "wrong", str(exc), "start a Zenoh router there")
    return _explain(endpoint, *where)


def _explain(endpoint: str, protocol: str, host: str, port: int) -> Finding:
    """Return what speaks there in place of a router that accepts this client."""
    kind = "silent"
    with suppress(OSError):
        kind = identify(host, port)
    if kind != "http" and protocol == "tls":
        kind = "zenoh" if _speaks_zenoh(endpoint.replace("tls/", "tcp/", 1)) else "no session"
    elif kind in {"silent", "closes"} and _speaks_tls(host, port):
        kind = "tls"
    return Finding(_NAME, endpoint, "wrong", *_KINDS[kind])


def _speaks_zenoh(endpoint: str) -> bool:
    try:
        open_client([endpoint], timeout=_OPEN).close()
    except NedbusError:
        return False
    return True


def _speaks_tls(host: str, port: int) -> bool:
    try:
        return look_at(host, port, None).certificate is not None
    except OSError:
        return False


def _check_tls(endpoint: str, host: str, port: int, tls: Tls | None) -> Iterator[Finding]:
    """Yield which certificate a router shows, whether it is trusted, and what the router says of ours."""
    shown = look_at(host, port, tls)
    if shown.certificate is None:
        if shown.rejection:
            yield Finding("tls", endpoint, "wrong", shown.rejection, "give --tls-certificate and --tls-key")
            return
        yield _explain_no_tls(endpoint, host, port)
        return
    certificate = None
    try:
        certificate = Certificate.decode(shown.certificate)
    except ValueError as exc:
        judged = explain_unread("tls", endpoint, exc)
    else:
        judged = judge_validity("tls", endpoint, "the router shows", certificate, dt.datetime.now(dt.UTC))
    yield judged
    if tls is None:
        advice = "give the certificate of the authority with --tls-ca or NEDBUS_TLS_CA"
        yield Finding("tls", endpoint, "wrong", "no authority is given that could vouch for the router", advice)
        return
    reason = verify(host, port, tls)
    if reason == "host":
        names = f", but for {', '.join(certificate.hosts[:8]) or 'no host at all'}" if certificate else ""
        advice = f"connect by a host of it, or make a certificate with --host {host}: 'nedbus pki cert'"
        yield Finding("tls", endpoint, "wrong", f"the router's certificate is not for {host}{names}", advice)
    elif reason == "other":
        issuer = f", but by {brief(certificate.issuer)}" if certificate else ""
        seen = f"the router's certificate is not signed by the authority in {tls.ca}{issuer}"
        yield Finding("tls", endpoint, "wrong", seen, "give its authority as --tls-ca, or ask whose router it is")
    elif reason and judged.state != "wrong":  # not what is said of it already
        yield Finding("tls", endpoint, "wrong", f"the router's certificate cannot be trusted: {reason}")
    if shown.rejection:
        advice = "give --tls-certificate and --tls-key of a certificate that the router's authority has signed"
        yield Finding("tls", endpoint, "wrong", f"the router refuses: {shown.rejection}", advice)


def _explain_no_tls(endpoint: str, host: str, port: int) -> Finding:
    finding = _explain(endpoint, "tls", host, port)
    if finding.seen != _KINDS["no session"][0]:
        return finding
    advice = "name the endpoint of a Zenoh router with TLS, or write tcp/"
    return Finding(_NAME, endpoint, "wrong", "what listens there does not speak TLS", advice)
