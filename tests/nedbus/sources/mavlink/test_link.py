"""Links: over TCP and serial ports frames are sent whole, or not at all, and never block; udpout keeps its port."""

from __future__ import annotations

import os
import socket
import tty
from collections.abc import Callable, Iterator
from contextlib import closing, suppress

import pytest
from pymavlink.dialects.v20 import common as dialect

from nedbus import limits
from nedbus.errors import ConfigError, SourceError
from nedbus.sources.mavlink.link import Link, LinkAddress, open_link, parse_link
from tests.peers.live_source import Listener
from tests.peers.ports import free_port
from tests.waits import wait_for

MAX_FRAMES = 1_000_000
"""More than the buffers of the system hold."""

Pair = tuple[Link, Callable[[], bytes]]


def frame(number: int) -> bytes:
    """Return bytes of the size of a long frame, which differ from all others."""
    return number.to_bytes(4) * 63


@pytest.fixture(params=["tcp", "serial"])
def pair(request: pytest.FixtureRequest) -> Iterator[Pair]:
    """Yield a link, and a function that returns what its peer has received since the last call."""
    if request.param == "tcp":
        with (
            socket.create_server(("127.0.0.1", 0)) as server,
            closing(open_link(f"tcp:127.0.0.1:{server.getsockname()[1]}", baud=57600)) as link,
            server.accept()[0] as connection,
        ):
            connection.setblocking(False)
            yield link, lambda: connection.recv(2**20)
        return
    radio, port = os.openpty()
    tty.setraw(port)
    os.set_blocking(radio, False)
    with closing(open_link(f"serial:{os.ttyname(port)}", baud=57600)) as link:
        yield link, lambda: os.read(radio, 2**20)
    os.close(radio)
    os.close(port)


def test_blocked_link_drops_whole_frames(pair: Pair) -> None:
    """If the peer does not read, frames are queued and then refused at once; it receives each accepted one intact."""
    link, receive = pair
    accepted = []
    for number in range(MAX_FRAMES):
        if not link.send(frame(number), link.peer):
            break
        accepted.append(frame(number))
    assert 0 < len(accepted) < MAX_FRAMES
    assert not link.send(frame(0), link.peer)
    received = bytearray()

    def transfer() -> bool:
        assert not list(link.read(0.0))  # sends what is queued
        with suppress(BlockingIOError):
            received.extend(receive())
        return len(received) >= sum(map(len, accepted))

    wait_for(transfer, what="all accepted frames")
    assert received == b"".join(accepted)
    assert link.send(frame(1), link.peer), "there is room again"


def test_dropped_frames_are_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The number of messages that the link did not accept is logged; the source continues to receive."""
    monkeypatch.setattr(limits, "MAVLINK_UNSENT", 10)
    position = dialect.MAVLink_local_position_ned_message(1000, 0, 0, 0, 0, 0, 0).pack(
        dialect.MAVLink(None, 9, 1)
    )
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        Listener(f"mavlink:tcp:127.0.0.1:{server.getsockname()[1]}") as listener,
        server.accept()[0] as connection,
    ):
        connection.sendall(position)
        listener.receive()
        listener.step_until(lambda: caplog.records, what="a warning")
        connection.setblocking(False)
        with pytest.raises(BlockingIOError):
            connection.recv(1)
    assert (
        "messages to the vehicle were not sent, because the link did not accept them" in caplog.text
    )


class FirstPartner:
    """A UDP port of PX4: it sends only to the first address from which it received after its boot."""

    def __init__(self) -> None:
        self._socket = socket.socket(type=socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.port = self._socket.getsockname()[1]
        self.partner: tuple[str, int] | None = None

    def send(self) -> None:
        with suppress(BlockingIOError):
            while True:
                _, sender = self._socket.recvfrom(65535)
                self.partner = self.partner or sender
        if self.partner:
            message = dialect.MAVLink_local_position_ned_message(1000, *range(6))
            self._socket.sendto(message.pack(dialect.MAVLink(None, 9, 1)), self.partner)

    def close(self) -> None:
        self._socket.close()


def test_restarted_service_receives_again_over_udpout() -> None:
    """PX4 keeps its first UDP partner until it reboots: a restarted service sends from the same port."""
    with closing(FirstPartner()) as vehicle:
        for _ in range(2):
            with Listener(f"mavlink:udpout:127.0.0.1:{vehicle.port}") as listener:

                def is_received(listener: Listener = listener) -> bool:
                    vehicle.send()
                    return bool(listener.messages)

                listener.step_until(is_received, what="a position")


def test_local_port_of_udpout_can_be_chosen() -> None:
    """The local port follows from the target, or from @PORT; one in use is an error that names it."""
    one, other = parse_link("udpout:10.0.0.1:14580"), parse_link("udpout:10.0.0.2:14580")
    assert one == parse_link("udpout:10.0.0.1:14580"), "the same one after each start"
    assert one.local_port != other.local_port
    assert {20_000 <= each.local_port < 30_000 for each in (one, other)} == {True}
    port = free_port()
    text = f"udpout:127.0.0.1:14580@{port}"
    assert parse_link(text) == LinkAddress("udpout", "127.0.0.1", 14580, port)
    assert parse_link("udpout:[::1]:14580@7") == LinkAddress("udpout", "::1", 14580, 7)
    with (
        closing(open_link(text, baud=57600)),
        pytest.raises(SourceError) as info,
    ):
        open_link(text, baud=57600)
    remedy = "close the other program or use another one, as in udpout:127.0.0.1:14580@14555"
    assert str(info.value).endswith(f"address already in use) at local port {port}: {remedy}")
    for wrong in (
        "udpout:10.0.0.1:14580@",
        "udpout:10.0.0.1:14580@99999",
        "udpin:0.0.0.0:14540@14550",
    ):
        with pytest.raises(ConfigError, match="is not a link"):
            parse_link(wrong)
