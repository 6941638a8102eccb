"""Whether a router is full: Zenoh tells a client only that there is no connection, so it is asked by hand.

The first steps of Zenoh's protocol, version 9: InitSyn, InitAck with a cookie, OpenSyn with that cookie, and then
OpenAck, or Close with a reason. A router that has `max_sessions` closes with the reason INVALID.
Source: what zenohd 1.10.2 sends, and zenoh-protocol's `transport` module.
"""

from __future__ import annotations

import os
import socket
import ssl
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

from .endpoints import split_endpoint
from .tls import Tls

_PATIENCE: Final = 1.0  # s for each step
_CLIENT: Final = 2  # what InitSyn says of who asks
_VERSION: Final = 9
_INIT, _OPEN, _CLOSE = 0x01, 0x02, 0x03  # kinds of messages, the lower five bits of the first byte
_SIZES, _SECONDS = 0x40, 0x40  # flags: InitAck says its sizes; the lease of OpenSyn is in seconds
_FULL: Final = frozenset({2, 3})  # reasons of Close: INVALID, as zenohd says; MAX_SESSIONS, as it could
_LARGEST: Final = 4096  # bytes of an answer that are read


def full_router(endpoints: Sequence[str], tls: Tls | None) -> str | None:
    """Return the first of these endpoints whose router speaks Zenoh and has no room for a session, else None."""
    for endpoint in endpoints:
        parts = split_endpoint(endpoint)
        if parts is not None and parts[0] in {"tcp", "tls"}:
            with suppress(OSError, ValueError, IndexError):
                if _is_full(*parts, tls):
                    return endpoint
    return None


def _is_full(protocol: str, host: str, port: int, tls: Tls | None) -> bool:
    with socket.create_connection((host, port), _PATIENCE) as plain:
        if protocol == "tcp":
            return _ask(plain)
        if tls is None:
            return False
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)  # not stricter than Zenoh is
        context.load_verify_locations(tls.ca)
        if tls.certificate is not None and tls.key is not None:
            context.load_cert_chain(tls.certificate, tls.key)
        with context.wrap_socket(plain, server_hostname=host) as secure:
            return _ask(secure)


def _ask(connection: socket.socket) -> bool:
    """Take the steps of a session, as far as it goes, and return whether the router closes it for want of room."""
    identity = os.urandom(8)
    _send(connection, bytes([_INIT, _VERSION, (len(identity) - 1) << 4 | _CLIENT]) + identity)
    answer = _receive(connection)
    if answer[0] & 0x1F != _INIT:
        return False
    begin = 3 + (answer[2] >> 4) + 1 + (3 if answer[0] & _SIZES else 0)
    size, digits = _read_number(answer[begin:])
    cookie = answer[begin : begin + digits + size]  # with its length before it, as OpenSyn has it
    lease, first_number = bytes([1]), bytes([0])
    _send(connection, bytes([_OPEN | _SECONDS]) + lease + first_number + cookie)
    answer = _receive(connection)
    return answer[0] & 0x1F == _CLOSE and answer[1] in _FULL


def _send(connection: socket.socket, message: bytes) -> None:
    connection.sendall(len(message).to_bytes(2, "little") + message)


def _receive(connection: socket.socket) -> bytes:
    """Return the next message, without its length; raise OSError when none comes."""
    connection.settimeout(_PATIENCE)
    data = b""
    while len(data) < 2 or len(data) < 2 + int.from_bytes(data[:2], "little"):
        part = connection.recv(_LARGEST)
        if not part or len(data) > _LARGEST:
            raise ConnectionError
        data += part
    return data[2 : 2 + int.from_bytes(data[:2], "little")]


def _read_number(data: bytes) -> tuple[int, int]:
    """Return a number of variable length, seven bits in each byte, and how many bytes it has."""
    value = 0
    for index, byte in enumerate(data[:9]):
        value |= (byte & 0x7F) << 7 * index
        if byte < 0x80:
            return value, index + 1
    raise ValueError("too long")
