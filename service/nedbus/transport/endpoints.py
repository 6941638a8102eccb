"""Zenoh endpoints: the default, their form, and where a client on this host dials what a router listens on."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

from nedbus.errors import ConfigError

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
"""Where `nedbus serve` listens, and what clients join, unless something else is set."""

_ENDPOINT = re.compile(r"(?:tcp|tls|udp|ws|quic)/\S+:\d{1,5}(?:[?#]\S*)?|unixsock-stream/\S+")


def check_endpoints(endpoints: Sequence[str], *, where: str) -> None:
    """Raise ConfigError, with `where` as the name of the setting, unless each of these is a Zenoh endpoint."""
    for endpoint in endpoints:
        if not _ENDPOINT.fullmatch(endpoint):
            raise ConfigError(
                where, f"{endpoint!r} is not an endpoint: write PROTOCOL/HOST:PORT, as in {DEFAULT_ENDPOINT}"
            )


def dial_endpoint(endpoint: str) -> str:
    """Return where a client on this host connects to a router that listens here, on all interfaces perhaps."""
    return endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")
