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
    is_any_name = path in _ANY_NAME and not is_local
    if not all(
        is_any_name or host in origins or _is_own_name(host, is_local=is_local) for host in hosts
    ):
        return f"{path[:100]} is only served under an IP address or a name of this host"
    if any(origin.partition("//")[2] not in (*hosts, *origins) for origin in values_of("Origin")):
        return "request of a page from another host"
    if "cross-site" in values_of("Sec-Fetch-Site") and "document" not in values_of(
        "Sec-Fetch-Dest"
    ):
        return "cross-site request"
    return ""


def _is_own_name(host: str, *, is_local: bool) -> bool:
    found = _HOST.fullmatch(host)
    name = found[1].strip("[]").lower().removesuffix(".") if found else ""
    with suppress(ValueError):
        return bool(ipaddress.ip_address(name))
    return (
        name == "localhost" or name in _names() or (name != "" and "." not in name and not is_local)
    )


@cache
def _names() -> set[str]:
    return {socket.gethostname().lower(), socket.getfqdn().lower()}
