"""Links over TCP and serial ports: frames are sent whole, or not at all, and never block."""

from __future__ import annotations

import os
import socket
import tty
from collections.abc import Callable, Iterator
from contextlib import closing, suppress

import pytest
from pymavlink.dialects.v20 import common as dialect

from nedbus.sources.mavlink import link as links
from nedbus.sources.mavlink.link import Link, open_link
from tests.peers.live_source import Listener
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


def test_dropped_frames_are_logged(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """The number of messages that the link did not accept is logged; the source continues to receive."""
    monkeypatch.setattr(links, "_MAX_UNSENT", 10)
    position = dialect.MAVLink_local_position_ned_message(1000, 0, 0, 0, 0, 0, 0).pack(dialect.MAVLink(None, 9, 1))
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
    assert "messages to the vehicle were not sent, because the link did not accept them" in caplog.text
