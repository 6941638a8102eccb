"""Zenoh endpoints: the default, their form, and where a client on this host dials what a router listens on."""

from __future__ import annotations

import re
import socket
from collections.abc import Sequence
from typing import Final

from nedbus.errors import ConfigError

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
"""Where `nedbus serve` listens, and what clients join, unless something else is set."""

_MAX_PORT: Final = 65_535
_ENDPOINT = re.compile(
    r"(?P<protocol>tcp|tls|udp|ws|quic)/(?P<host>\S+):(?P<port>\d{1,9})(?:[?#]\S*)?|unixsock-stream/\S+"
)


def check_endpoints(endpoints: Sequence[str], *, where: str) -> None:
    """Raise ConfigError, with `where` as the name of the setting, unless each of these is a Zenoh endpoint."""
    for endpoint in endpoints:
        found = _ENDPOINT.fullmatch(endpoint)
        if found is None:
            raise ConfigError(
                where, f"{endpoint!r} is not an endpoint: write PROTOCOL/HOST:PORT, as in {DEFAULT_ENDPOINT}"
            )
        if int(found["port"] or 0) > _MAX_PORT:
            raise ConfigError(where, f"{endpoint!r} has port {found['port']}: ports are 0 to {_MAX_PORT}")


def split_endpoint(endpoint: str) -> tuple[str, str, int] | None:
    """Return protocol, host (without brackets) and port of an endpoint; None for a socket in the file system."""
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None or found["host"] is None:
        return None
    return found["protocol"], found["host"].strip("[]"), int(found["port"])


def explain_endpoints(endpoints: Sequence[str]) -> str | None:
    """Return why none of these can be reached, as far as this host knows: names without an address; else None."""
    unknown = []
    for endpoint in endpoints:
        parts = split_endpoint(endpoint)
        if parts is None:
            return None
        host = parts[1]
        try:
            socket.getaddrinfo(host, None)
        except OSError:
            unknown.append(host)
        else:
            return None
    hosts = " and ".join(unknown)
    return f"this host finds no address of {hosts}: correct the name, or write the IP address" if unknown else None


def dial_endpoint(endpoint: str) -> str:
    """Return where a client on this host connects to a router that listens here, on all interfaces perhaps."""
    return endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")
