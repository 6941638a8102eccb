"""The links to a MAVLink vehicle: UDP, TCP, or a serial port; bytes in with their sender, bytes out."""

from __future__ import annotations

import os
import re
import select
import socket
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Final, Protocol

from nedbus.errors import ConfigError, SourceError

_MAX_DATAGRAMS: Final = 100  # that one read returns
_MAX_READ: Final = 65535  # bytes
_CONNECT_TIMEOUT: Final = 3.0  # s
_LINK = re.compile(r"(udpin|udp|udpout|tcp):(.+):(\d{1,5})|serial:(/.+)|(/dev/.+)")
_FORMS: Final = "udpin:0.0.0.0:14550, udpout:HOST:PORT, tcp:HOST:PORT or serial:/dev/ttyACM0"

Peer = Any  # the address of the other side, in the form that its socket uses


class Link(Protocol):
    """An open connection to one or several vehicles; what fails raises OSError."""

    stream: bool  # messages may arrive in pieces

    def read(self, timeout: float) -> Iterator[tuple[bytes, Peer]]:
        """Yield what has arrived and its sender; wait up to `timeout` seconds for the first."""
        ...

    def send(self, data: bytes, peer: Peer) -> None:
        """Send now, or drop it if that is not possible."""
        ...

    @property
    def peer(self) -> Peer:
        """The other side where it is known from the start; None where it must send first."""
        ...

    def close(self) -> None:
        """Close it."""
        ...


def check_link(text: str) -> None:
    """Raise ConfigError for an invalid link."""
    _parse(text)


def open_link(text: str, *, baud: int) -> Link:
    """Open a link; raise SourceError when that fails, ConfigError for an invalid one."""
    kind, host, port = _parse(text)
    try:
        if kind == "serial":
            return _Serial(host, baud)
        if kind == "tcp":
            return _Tcp(host, port)
        return _Udp(host, port, listens=kind != "udpout")
    except (OSError, UnicodeError) as exc:
        number = exc.errno if isinstance(exc, OSError) else None
        reason = os.strerror(number).lower() if number and number > 0 else str(exc)
        raise SourceError(f"mavlink:{text}", f"cannot be opened ({reason})") from exc


def _parse(text: str) -> tuple[str, str, int]:
    """Return the kind of a link, its host or device, and its port."""
    found = _LINK.fullmatch(text)
    if found is None or (found[3] and not 0 < int(found[3]) < 2**16):
        raise ConfigError(f"source 'mavlink:{text}'", f"{text!r} is not a link: write {_FORMS}")
    if found[1]:
        return found[1], found[2].strip("[]"), int(found[3])
    return "serial", found[4] or found[5], 0


class _Udp:
    stream = False

    def __init__(self, host: str, port: int, *, listens: bool) -> None:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self.peer: Peer = None if listens else address
        if listens:
            try:
                self._socket.bind(address)
            except OSError:
                self.close()
                raise

    def read(self, timeout: float) -> Iterator[tuple[bytes, Peer]]:
        if not _is_ready(self._socket, timeout):
            return
        with suppress(BlockingIOError, ConnectionError):  # the other side does not listen, yet
            for _ in range(_MAX_DATAGRAMS):
                yield self._socket.recvfrom(_MAX_READ)

    def send(self, data: bytes, peer: Peer) -> None:
        with suppress(OSError):  # a missing route comes back, or the vehicle times out
            self._socket.sendto(data, peer)

    def close(self) -> None:
        self._socket.close()


class _Tcp:
    stream = True

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.create_connection((host, port), timeout=_CONNECT_TIMEOUT)
        self.peer: Peer = (host, port)

    def read(self, timeout: float) -> Iterator[tuple[bytes, Peer]]:
        if _is_ready(self._socket, timeout):
            data = self._socket.recv(_MAX_READ)
            if not data:
                raise ConnectionResetError(None, "the other side closed the connection")
            yield data, self.peer

    def send(self, data: bytes, peer: Peer) -> None:
        self._socket.sendall(data)

    def close(self) -> None:
        self._socket.close()


class _Serial:
    stream = True

    def __init__(self, device: str, baud: int) -> None:
        from serial import Serial

        self._port = Serial(device, baud, timeout=0, write_timeout=1.0)
        self.peer: Peer = device

    def read(self, timeout: float) -> Iterator[tuple[bytes, Peer]]:
        if _is_ready(self._port, timeout):
            yield self._port.read(_MAX_READ), self.peer

    def send(self, data: bytes, peer: Peer) -> None:
        self._port.write(data)

    def close(self) -> None:
        self._port.close()


def _is_ready(file: Any, timeout: float) -> bool:
    """Wait until there is data or the other side has closed; unlike select, with any number of open files."""
    poll = select.poll()
    poll.register(file, select.POLLIN)
    return bool(poll.poll(timeout * 1000))
