"""Access rule of all HTTP servers: refuse requests that other websites make through a browser on this network."""

import ipaddress
import re
import socket
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from functools import cache
from typing import Final

# scrapers and probes may use any host name
_ANY_NAME: Final = {"/metrics", "/healthz", "/readyz", "/vehicles"}
_HOST: Final = re.compile(r"(\[[^\]]*\]|[^:]*)(?::\d*)?")


def why_refused(
    path: str,
    values_of: Callable[[str], Sequence[str]],
    *,
    is_local: bool,
    origins: Collection[str] = (),
) -> str:
    """Return why a request is refused, "" if it is accepted.

    `values_of`: returns the values of a header; `is_local`: the server is bound to loopback; `origins`: further
    accepted hosts with port.

    In DNS rebinding, a website points its own host name to this server to read the responses. Therefore the Host header
    must be a name that such a website cannot control: an IP address, localhost, a name of this host or, unless bound to
    loopback, a name without a dot, as in Docker. Unless bound to loopback, metrics, health, readiness and vehicle
    states are served under any name. A request without a Host header is accepted, because no browser sends one.

    An Origin header must name the host and port of the Host header. Of cross-site requests only links are accepted.
    """
    hosts = values_of("Host")
    if len(hosts) > 1:
        return "more than one Host header"
    accepts_any_name = path in _ANY_NAME and not is_local
    for host in hosts:
        is_accepted = accepts_any_name or host in origins or _is_own_name(host, is_local=is_local)
        if not is_accepted:
            return f"{path[:100]} is only served under an IP address or a name of this host"
    for origin in values_of("Origin"):
        _, _, origin_host = origin.partition("//")
        if origin_host not in hosts and origin_host not in origins:
            return "request of a page from another host"
    is_cross_site = "cross-site" in values_of("Sec-Fetch-Site")
    is_link = "document" in values_of("Sec-Fetch-Dest")
    if is_cross_site and not is_link:
        return "cross-site request"
    return ""


def _is_own_name(host: str, *, is_local: bool) -> bool:
    """Return whether a Host header names this host by a name that a website cannot control."""
    parts = _HOST.fullmatch(host)
    if parts is None:
        return False
    name = parts[1].strip("[]").lower().removesuffix(".")
    with suppress(ValueError):
        ipaddress.ip_address(name)
        return True
    if name == "localhost" or name in _names():
        return True
    is_plain_name = name != "" and "." not in name
    return is_plain_name and not is_local


@cache
def _names() -> set[str]:
    return {socket.gethostname().lower(), socket.getfqdn().lower()}
