"""Links to MAVLink vehicles over UDP, TCP or a serial port, and checks of sender ids."""

import errno
import math
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
    r"(?P<kind>udpin|udpout|tcp):(?P<host>.+):(?P<port>\d{1,5})(?:@(?P<local_port>\d{1,5}))?"
)
_SERIAL: Final = re.compile(r"serial:(?P<device>/.+)")
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

    stream = False
    baud = None

    def __init__(self, link: LinkAddress) -> None:
        addresses = socket.getaddrinfo(link.host, link.port, type=socket.SOCK_DGRAM)
        family, _, _, _, address = addresses[0]
        self.peer: Peer = address
        local: Any = ("", link.local_port)
        if link.kind == "udpin":
            self.peer = None
            local = address
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        if sys.platform == "linux":
            self._socket.setsockopt(socket.SOL_SOCKET, _TIMESTAMPS, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, _DROPS, 1)
        self.dropped = 0
        self._drained = time.monotonic()  # when no datagram waited
        self.close = self._socket.close
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

    stream = True
    dropped = 0

    def __init__(self, file: Any, peer: Peer, baud: int | None = None) -> None:
        os.set_blocking(file.fileno(), False)
        self.peer = peer
        self.baud = baud
        self.close = file.close
        self._file = file
        self._unsent = bytearray()  # whole frames; the first may be sent in part
        self._sending = threading.Lock()

    def read(self, timeout: float) -> Iterator[Packet]:
        """Yield received bytes, and send queued frames; wait up to `timeout` seconds."""
        awaited = select.POLLIN
        if self._unsent:
            awaited |= select.POLLOUT
        ready = _wait(self._file, timeout, awaited)
        if ready:
            self._flush()
        if not ready & ~select.POLLOUT:
            return
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
                written = os.write(self._file.fileno(), self._unsent)
                del self._unsent[:written]


Link = _UdpLink | _StreamLink
"""An open connection to one or more vehicles; its methods raise OSError."""


def parse_link(text: str) -> LinkAddress:
    """Parse a link; raise ConfigError if it is invalid."""
    serial = _SERIAL.fullmatch(text)
    if serial is not None:
        return LinkAddress("serial", serial["device"])
    link = _LINK.fullmatch(text)
    if link is not None and _is_valid(link):
        kind = link["kind"]
        local_port = 0
        if kind == "udpout":
            target = f"{link['host']}:{link['port']}"
            local_port = int(link["local_port"] or _local_port(target))
        return LinkAddress(kind, link["host"].strip("[]"), int(link["port"]), local_port)
    raise ConfigError(f"source 'mavlink:{text}'", f"{text!r} is not a link; write {_FORMS}")


def _is_valid(link: re.Match[str]) -> bool:
    """Return whether the ports of a link exist; only udpout has a local one."""
    if not 0 < int(link["port"]) < 2**16:
        return False
    local_port = link["local_port"]
    if local_port is None:
        return True
    return link["kind"] == "udpout" and int(local_port) < 2**16


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
        raise SourceError(f"mavlink:{text}", _why_not_opened(text, link, exc)) from exc


def _why_not_opened(text: str, link: LinkAddress, error: OSError | UnicodeError) -> str:
    """Return why a link cannot be opened, and the remedy for a port in use."""
    number = error.errno if isinstance(error, OSError) else None
    if number is None or number <= 0:  # such as an unknown host
        return f"cannot be opened ({error})"
    reason = f"cannot be opened ({os.strerror(number).lower()})"
    if number != errno.EADDRINUSE:
        return reason
    if link.kind != "udpout":
        return f"{reason}: close the other program or use another port"
    target, _, _ = text.partition("@")
    remedy = f"close the other program or use another one, as in {target}@14555"
    return f"{reason} at local port {link.local_port}: {remedy}"


def _wait(file: Any, timeout: float, events: int = select.POLLIN) -> int:
    """Wait for events, such as data, or the end of the stream; return them, 0 after a timeout."""
    poll = select.poll()  # unlike select(), without a limit on file descriptors
    poll.register(file, events)
    for _, happened in poll.poll(timeout * 1000):
        return happened
    return 0


def name_of(peer: Peer) -> str:
    """Return an address as text."""
    if not isinstance(peer, tuple):
        return str(peer)
    host, port, *_ = peer
    return f"{host}:{port}"


class PeerChoice:
    """The address to which the messages for one vehicle are sent: the one that has delivered its data.

    Another address that sends with the id of the vehicle, a second link or a stranger, does not replace it at once. It
    replaces an address that is silent for 3 s, or once it has delivered 20 messages in a row.

    `peer`: the chosen address. `second`: another address that sent while the chosen one did, None if there is none.
    """

    def __init__(self, peer: Peer, now: float) -> None:
        self.peer = peer
        self.second: Peer = None
        self._last = now  # time of the last message from the chosen address
        # since that message: another address, the time of its last message, and their number
        self._other: Peer = None
        self._other_last = -math.inf
        self._run = 0

    def add(self, peer: Peer, now: float) -> None:
        """Add a message from an address, at monotonic time `now` [s]."""
        if peer == self.peer:
            if now - self._other_last < _PEER_TIMEOUT:
                self.second = self._other
            self._choose(peer, now)
            return
        if peer != self._other:
            self._other = peer
            self._run = 0
        self._run += 1
        self._other_last = now
        if now - self._last > _PEER_TIMEOUT or self._run >= _PEER_RUN:
            self._choose(peer, now)

    def _choose(self, peer: Peer, now: float) -> None:
        self.peer = peer
        self._last = now
        self._other = None
        self._other_last = -math.inf
        self._run = 0


class DuplicateIds:
    """Detect system ids with two senders, whose messages arrive alternately from two addresses."""

    def __init__(self) -> None:
        # the last changes of the address from which each system sends, with their times
        self._changes = defaultdict[int, deque[tuple[Peer, float]]](lambda: deque(maxlen=_CHANGES))
        self._reported: set[int] = set()

    def add(self, system: int, peer: Peer, now: float) -> str:
        """Add a message at monotonic time `now` [s]; return a warning about two senders, once per system, or ""."""
        changes = self._changes[system]
        if changes and changes[-1][0] == peer:
            return ""
        changes.append((peer, now))
        _, first_time = changes[0]
        if len(changes) < _CHANGES or now - first_time > _WINDOW or system in self._reported:
            return ""
        self._reported.add(system)
        before, _ = changes[-2]
        both = f"{name_of(before)} and {name_of(peer)}"
        return f"{both} both send as system {system}, and their messages are mixed; give each its own MAV_SYS_ID"
