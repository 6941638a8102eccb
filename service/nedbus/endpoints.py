"""Endpoints of Zenoh and addresses of HTTP servers: default, syntax, name resolution, and the address to dial."""

import re
import socket
from collections.abc import Sequence
from contextlib import suppress
from ipaddress import ip_address
from typing import Final

from nedbus.errors import ConfigError

# `nedbus serve` listens on it, and clients connect to it
DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
_ENDPOINT: Final = re.compile(
    r"(?P<protocol>tcp|tls|udp|ws|quic)/(?P<host>\S+):(?P<port>\d{1,9})(?:[?#]\S*)?|unixsock-stream/\S+"
)


def check_endpoints(endpoints: Sequence[str], *, where: str) -> None:
    """Raise ConfigError unless all are valid Zenoh endpoints; `where` is the name of the setting."""
    for endpoint in endpoints:
        found = _ENDPOINT.fullmatch(endpoint)
        if found is None:
            reason = f"{endpoint!r} is not an endpoint: write PROTOCOL/HOST:PORT, as in {DEFAULT_ENDPOINT}"
            raise ConfigError(where, reason)
        if int(found["port"] or 0) > 65_535:
            raise ConfigError(where, f"{endpoint!r} has port {found['port']}: ports are 0 to 65535")


def split_endpoint(endpoint: str) -> tuple[str, str, int] | None:
    """Return protocol, host (without brackets) and port of an endpoint; None for a Unix socket."""
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None or found["host"] is None:
        return None
    return found["protocol"], found["host"].strip("[]"), int(found["port"])


def resolution_error(endpoints: Sequence[str]) -> str | None:
    """Return an error text if name resolution fails for all endpoints, else None."""
    hosts = []
    for parts in map(split_endpoint, endpoints):
        if parts is None:
            return None
        with suppress(OSError):
            socket.getaddrinfo(parts[1], None)
            return None
        hosts.append(parts[1])
    names = " and ".join(hosts)
    return f"cannot resolve {names}; check the spelling, or use an IP address" if hosts else None


def dial_endpoint(endpoint: str) -> str:
    """Return the endpoint to dial for a local router, with loopback in place of a wildcard address."""
    return endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


def split_http(where: str) -> tuple[str, int]:
    """Parse HOST:PORT or [HOST]:PORT; raise ValueError for anything else."""
    host, _, port = where.rpartition(":")
    if host.startswith("[") and host.endswith("]"):
        bare = host[1:-1]
    else:
        bare = host
    if not bare or (":" in bare) != (host != bare) or not port.isdecimal() or int(port) > 65_535:
        raise ValueError(f"{where!r} is not an address: write HOST:PORT, such as 127.0.0.1:9464")
    return bare, int(port)


def is_loopback(host: str) -> bool:
    """Return whether a server on this address is reachable from this host only."""
    with suppress(ValueError):
        return ip_address(host).is_loopback
    return host == "localhost"
