"""What listens on a TCP port, if it is no Zenoh router that accepts us: told by what it answers."""

from __future__ import annotations

import socket
from contextlib import suppress
from typing import Final

_TIMEOUT: Final = 0.5  # s for what speaks first, and then for an answer
_REQUEST: Final = b"GET / HTTP/1.0\r\n\r\n"
_TLS_ALERT: Final = b"\x15\x03"


def identify(host: str, port: int) -> str:
    """Return `http`, `tls`, `other` (something answers), `closes` or `silent`; raise OSError when nothing accepts."""
    with socket.create_connection((host, port), timeout=_TIMEOUT) as connection:
        connection.settimeout(_TIMEOUT)
        answer, closed = b"", False
        with suppress(TimeoutError):
            answer = _receive(connection)
            closed = not answer
        if not answer and not closed:
            with suppress(TimeoutError):
                try:
                    connection.sendall(_REQUEST)
                except OSError:
                    return "closes"
                answer = _receive(connection)
                closed = not answer
    if answer.startswith(b"HTTP/"):
        return "http"
    if answer.startswith(_TLS_ALERT):
        return "tls"
    return "other" if answer else "closes" if closed else "silent"


def _receive(connection: socket.socket) -> bytes:
    """Return what comes next, nothing when the other side closes."""
    try:
        return connection.recv(64)
    except ConnectionError:
        return b""
