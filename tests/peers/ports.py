"""Free ports of loopback."""

from __future__ import annotations

import os
import socket
from contextlib import suppress
from itertools import cycle, islice

# Linux takes ports of outgoing connections from 32768 up: a free port there may be taken before the test uses it.
# Each pytest process starts at another port.
_ports = islice(cycle(range(10_000, 32_000)), os.getpid() * 2503 % 22_000, None)


def free_port() -> int:
    """Return a port that is free for TCP and UDP."""
    for port in _ports:
        with (
            suppress(OSError),
            socket.socket() as tcp,
            socket.socket(type=socket.SOCK_DGRAM) as udp,
        ):
            tcp.bind(("127.0.0.1", port))
            udp.bind(("127.0.0.1", port))
            return port
    raise AssertionError("unreachable: the ports cycle")


def free_endpoint() -> str:
    """Return a Zenoh endpoint on a free port."""
    return f"tcp/127.0.0.1:{free_port()}"
