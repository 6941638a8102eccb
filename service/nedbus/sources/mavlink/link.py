"""Links to MAVLink vehicles over UDP, TCP or a serial port, and checks of sender ids."""

import errno
import os
import re
import select
import socket
import struct
import sys
import threading
import time
import zlib
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import Any, Final, NamedTuple

from nedbus import clock, limits
from nedbus.errors import ConfigError, SourceError

Peer = Any  # remote address, as returned by the socket

# address changes per window that mean two senders; a reconnect causes 1, a reordered packet 2 more
_CHANGES: Final = 5
_WINDOW: Final = 5.0  # s
_PEER_TIMEOUT: Final = 3.0  # s without a message from an address until another one replaces it
_PEER_RUN: Final = 20  # messages in a row from another address that replace it earlier
_READ_DATAGRAMS: Final = 100  # per read
_READ_BYTES: Final = 65535  # bytes
# bytes, if net.core.rmem_max allows it: the default holds 277 small datagrams
_RECEIVE_BUFFER: Final = 2**22
_CONNECT_TIMEOUT: Final = 3.0  # s
_TIMESTAMPS: Final = 35  # Linux's SO_TIMESTAMPNS: the arrival of a datagram
_DROPS: Final = 40  # Linux's SO_RXQ_OVFL: the number of datagrams dropped before it
_TIME: Final = struct.Struct("qq")  # s and ns since the epoch
_CONTROL_BYTES: Final = socket.CMSG_SPACE(_TIME.size) + socket.CMSG_SPACE(4)  # bytes
_LINK: Final = re.compile(
    r"(udpin|tcp):(.+):(\d{1,5})|(udpout):(.+):(\d{1,5})(?:@(\d{1,5}))?|(serial):(/.+)"
)
_FORMS: Final = "udpin:0.0.0.0:14540, udpout:HOST:PORT, tcp:HOST:PORT or serial:/dev/ttyACM0"
# below those that Linux gives to sockets without a port
_LOCAL_PORTS: Final = range(20_000, 30_000)


class Packet(NamedTuple):
    """Bytes from a peer. `time`: arrival at this host, monotonic [s], even if they were read later."""

    data: bytes
    peer: Peer
    time: float


class LinkAddress(NamedTuple):
    """The parts of a link. `host`: of a serial port, its device; `local_port`: from which udpout sends, else 0."""

    kind: str
    host: str
    port: int = 0
    local_port: int = 0


class _UdpLink:
    """A UDP socket; `peer` is None if it listens. `dropped`: datagrams dropped because they were read too late.

    udpout sends from a fixed local port: PX4 sends to the first address from which it received after its boot, so a
    restarted service would receive nothing at another port.
    """

    stream, baud = False, None

    def __init__(self, link: LinkAddress) -> None:
        family, _, _, _, address = socket.getaddrinfo(link.host, link.port, type=socket.SOCK_DGRAM)[
            0
        ]
        listens = link.kind == "udpin"
        local = address if listens else ("", link.local_port)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        for option in (_TIMESTAMPS, _DROPS) if sys.platform == "linux" else ():
            self._socket.setsockopt(socket.SOL_SOCKET, option, 1)
        self.dropped, self._drained = 0, time.monotonic()
        self.close = self._socket.close
        self.peer: Peer = None if listens else address
        try:
            self._socket.bind(local)
        except OSError:
            self.close()
            raise

    def read(self, timeout: float) -> Iterator[Packet]:
        """Yield received datagrams; wait up to `timeout` seconds for the first."""
        if not _wait(self._socket, timeout):
            self._drained = time.monotonic()
            return
        with suppress(BlockingIOError, ConnectionError):  # ICMP: the peer is not listening yet
            for _ in range(_READ_DATAGRAMS):
                data, control, _, peer = self._socket.recvmsg(_READ_BYTES, _CONTROL_BYTES)
                now = time.monotonic()
                yield Packet(data, peer, max(self._drained, now - self._read_control(control)))
            return
        self._drained = time.monotonic()

    def _read_control(self, control: Iterable[tuple[int, int, bytes]]) -> float:
        """Note the number of dropped datagrams; return how long this one waited by the system's clock [s]."""
        waited = 0.0
        for _, kind, value in control:
            if kind == _DROPS:
                self.dropped = int.from_bytes(value, sys.byteorder)
            elif kind == _TIMESTAMPS:
                seconds, nanoseconds = _TIME.unpack(value)
                waited = max(0.0, (clock.utc_ns() - nanoseconds) / 1e9 - seconds)
        return waited

    def send(self, frame: bytes, peer: Peer) -> bool:
        """Send a frame without blocking; return False if that fails, such as in a full buffer."""
        try:
            self._socket.sendto(frame, peer)
        except ConnectionError:  # ICMP: the peer is not listening yet
            pass
        except OSError:
            return False
        return True


class _StreamLink:
    """A TCP connection, or a serial port if `baud` is set; a read may return a partial message."""

    stream, dropped = True, 0

    def __init__(self, file: Any, peer: Peer, baud: int | None = None) -> None:
        os.set_blocking(file.fileno(), False)
        self.peer, self.baud = peer, baud
        self.close = file.close
        self._file = file
        self._unsent = bytearray()  # whole frames; the first may be sent in part
        self._sending = threading.Lock()

    def read(self, timeout: float) -> Iterator[Packet]:
        """Yield received bytes, and send queued frames; wait up to `timeout` seconds."""
        if ready := _wait(self._file, timeout, select.POLLOUT * bool(self._unsent)):
            self._flush()
        if ready & ~select.POLLOUT:
            with suppress(BlockingIOError):
                data = os.read(self._file.fileno(), _READ_BYTES)
                if not data:
                    raise ConnectionResetError(None, "the peer closed the connection")
                yield Packet(data, self.peer, time.monotonic())

    def send(self, frame: bytes, _: Peer) -> bool:
        """Send or queue a whole frame without blocking; return False if the queue is full. Raises OSError."""
        with self._sending:
            if len(self._unsent) + len(frame) > limits.MAVLINK_UNSENT:
                return False
            self._unsent += frame
        self._flush()
        return True

    def _flush(self) -> None:
        with self._sending, suppress(BlockingIOError):
            while self._unsent:
                del self._unsent[: os.write(self._file.fileno(), self._unsent)]


Link = _UdpLink | _StreamLink
"""An open connection to one or more vehicles; its methods raise OSError."""


def parse_link(text: str) -> LinkAddress:
    """Parse a link; raise ConfigError if it is invalid."""
    error = ConfigError(f"source 'mavlink:{text}'", f"{text!r} is not a link; write {_FORMS}")
    found = _LINK.fullmatch(text)
    if found is None:
        raise error
    if found[8]:
        return LinkAddress("serial", found[9])
    if found[1]:
        link = LinkAddress(found[1], found[2].strip("[]"), int(found[3]))
    else:
        local_port = int(found[7]) if found[7] else _local_port(f"{found[5]}:{found[6]}")
        link = LinkAddress("udpout", found[5].strip("[]"), int(found[6]), local_port)
    if not 0 < link.port < 2**16 or link.local_port >= 2**16:
        raise error
    return link


def _local_port(target: str) -> int:
    """Return the port from which to send to a target: the same one after each start, and for most targets its own."""
    return _LOCAL_PORTS[zlib.crc32(target.encode()) % len(_LOCAL_PORTS)]


def open_link(text: str, *, baud: int) -> Link:
    """Open a link; raise SourceError if that fails, ConfigError if the link is invalid."""
    link = parse_link(text)
    host, port = link.host, link.port
    try:
        if link.kind == "serial":
            from serial import Serial

            return _StreamLink(Serial(host, baud, timeout=0), host, baud)
        if link.kind == "tcp":
            with socket.create_connection((host, port), timeout=_CONNECT_TIMEOUT) as connection:
                # keeps the socket open
                return _StreamLink(connection.makefile("rwb", buffering=0), (host, port))
        return _UdpLink(link)
    except (OSError, UnicodeError) as exc:
        number = exc.errno if isinstance(exc, OSError) else None
        reason = os.strerror(number).lower() if number and number > 0 else str(exc)
        remedy = ""
        if number == errno.EADDRINUSE and link.kind == "udpout":
            remedy = f" at local port {link.local_port}: close the other program or use another one, as in {text}@14555"
        elif number == errno.EADDRINUSE:
            remedy = ": close the other program or use another port"
        raise SourceError(f"mavlink:{text}", f"cannot be opened ({reason}){remedy}") from exc


def _wait(file: Any, timeout: float, events: int = 0) -> int:
    """Wait for data, the end of the stream, or other events; return them, 0 after a timeout."""
    poll = select.poll()  # unlike select(), without a limit on file descriptors
    poll.register(file, select.POLLIN | events)
    return next((found for _, found in poll.poll(timeout * 1000)), 0)


def name_of(peer: Peer) -> str:
    """Return an address as text."""
    return ":".join(map(str, peer[:2])) if isinstance(peer, tuple) else str(peer)


class PeerChoice:
    """The address to which the messages for one vehicle are sent: the one that has delivered its data.

    Another address that sends with the id of the vehicle, a second link or a stranger, does not replace it at once. It
    replaces an address that is silent for 3 s, or once it has delivered 20 messages in a row.

    `peer`: the chosen address. `second`: another address that sent while the chosen one did, None if there is none.
    """

    def __init__(self, peer: Peer, now: float) -> None:
        self.peer, self.second = peer, None
        self._last = now  # time of the last message from the chosen address
        # last message from another address since then, and its time
        self._other: tuple[Peer, float] | None = None
        self._run = 0  # messages from that address since then

    def add(self, peer: Peer, now: float) -> None:
        """Add a message from an address, at monotonic time `now` [s]."""
        if peer == self.peer:
            if self._other is not None and now - self._other[1] < _PEER_TIMEOUT:
                self.second = self._other[0]
            self._other = None
            self._run = 0
            self._last = now
            return
        self._run = self._run + 1 if self._other is not None and self._other[0] == peer else 1
        self._other = peer, now
        if now - self._last > _PEER_TIMEOUT or self._run >= _PEER_RUN:
            self.peer = peer
            self._other = None
            self._run = 0
            self._last = now


class DuplicateIds:
    """Detect system ids with two senders, whose messages arrive alternately from two addresses."""

    def __init__(self) -> None:
        self._changes: defaultdict[int, deque[tuple[Peer, float]]] = defaultdict(
            lambda: deque(maxlen=_CHANGES)
        )
        self._found: set[int] = set()

    def add(self, system: int, peer: Peer, now: float) -> str:
        """Add a message at monotonic time `now` [s]; return a warning about two senders, once per system, or ""."""
        changes = self._changes[system]
        if changes and changes[-1][0] == peer:
            return ""
        changes.append((peer, now))
        if len(changes) < _CHANGES or now - changes[0][1] > _WINDOW or system in self._found:
            return ""
        self._found.add(system)
        both = f"{name_of(changes[-2][0])} and {name_of(peer)}"
        return f"{both} both send as system {system}, and their messages are mixed; give each its own MAV_SYS_ID"
