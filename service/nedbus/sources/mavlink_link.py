"""The ways to a MAVLink vehicle: UDP, TCP, or a serial port; bytes in, bytes out, and who sent them."""

from __future__ import annotations

import os
import re
import select
import socket
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Final, Protocol

from nedbus.errors import ConfigError, SourceError

_AT_ONCE: Final = 100  # datagrams that are read before something else is done
_DATAGRAM: Final = 65535
_OPEN: Final = 3.0  # s that opening may take
_FORM = re.compile(r"(udpin|udp|udpout|tcp):(.+):(\d{1,5})|serial:(/.+)|(/dev/.+)")
FORMS: Final = "udpin:0.0.0.0:14550, udpout:HOST:PORT, tcp:HOST:PORT or serial:/dev/ttyACM0"

Peer = Any  # what a socket calls the address of the other side; nobody looks into it


class Link(Protocol):
    """An open way to one or several vehicles; whatever fails raises OSError, or SourceError with a reason."""

    stream: bool  # whether messages may be cut into pieces

    def read(self, seconds: float) -> Iterator[tuple[bytes, Peer]]:
        """Yield what has arrived and from whom, waiting so long for the first."""
        ...

    def send(self, data: bytes, peer: Peer) -> None:
        """Send, if that is possible at this moment."""
        ...

    @property
    def peer(self) -> Peer:
        """The other side where there is only one; None where it must first say something."""
        ...

    def close(self) -> None:
        """Close it."""
        ...


def check_link(text: str) -> None:
    """Raise ConfigError unless this names a link."""
    _split(text)


def open_link(text: str, *, baud: int) -> Link:
    """Open a link; raise SourceError when that is not possible, ConfigError for what names none."""
    kind, host, port = _split(text)
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


def _split(text: str) -> tuple[str, str, int]:
    """Return the kind of a link, its host or device, and its port."""
    found = _FORM.fullmatch(text)
    if found is None or (found[3] and not 0 < int(found[3]) < 2**16):
        raise ConfigError(f"source 'mavlink:{text}'", f"{text!r} is no link: write {FORMS}")
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

    def read(self, seconds: float) -> Iterator[tuple[bytes, Peer]]:
        if not _is_ready(self._socket, seconds):
            return
        with suppress(BlockingIOError, ConnectionError):  # nobody listens at the other side, yet
            for _ in range(_AT_ONCE):
                yield self._socket.recvfrom(_DATAGRAM)

    def send(self, data: bytes, peer: Peer) -> None:
        with suppress(OSError):  # a route that is away comes back, or the silence is noticed
            self._socket.sendto(data, peer)

    def close(self) -> None:
        self._socket.close()


class _Tcp:
    stream = True

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.create_connection((host, port), timeout=_OPEN)
        self.peer: Peer = (host, port)

    def read(self, seconds: float) -> Iterator[tuple[bytes, Peer]]:
        if _is_ready(self._socket, seconds):
            data = self._socket.recv(_DATAGRAM)
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

    def read(self, seconds: float) -> Iterator[tuple[bytes, Peer]]:
        if _is_ready(self._port, seconds):
            yield self._port.read(_DATAGRAM), self.peer

    def send(self, data: bytes, peer: Peer) -> None:
        self._port.write(data)

    def close(self) -> None:
        self._port.close()


def _is_ready(file: Any, seconds: float) -> bool:
    """Wait until something can be read, or the other side is gone; unlike select, for any number of open files."""
    poll = select.poll()
    poll.register(file, select.POLLIN)
    return bool(poll.poll(seconds * 1000))
