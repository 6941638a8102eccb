"""Ports of loopback that nobody uses."""

from __future__ import annotations

import os
import socket
from contextlib import suppress
from itertools import cycle, islice

# From 32768 on Linux gives ports to connections that go out: one that is free now may be taken before it is used.
# Each process of pytest begins elsewhere.
_ports = islice(cycle(range(10_000, 32_000)), os.getpid() * 2503 % 22_000, None)


def free_port() -> int:
    """Return a port that nobody uses now, neither with TCP nor with UDP."""
    for port in _ports:
        with suppress(OSError), socket.socket() as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
            tcp.bind(("127.0.0.1", port))
            udp.bind(("127.0.0.1", port))
            return port
    raise AssertionError("never: ports begin again")


def free_endpoint() -> str:
    """Return a Zenoh endpoint on a free port."""
    return f"tcp/127.0.0.1:{free_port()}"
