"""Downsampling publishers with a fake clock, and a link that counts its bytes."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress
from functools import partial
from typing import Any

import pytest

import nedbus
from nedbus.client.publishing import downsampler
from tests.flights.messages import message
from tests.waits import wait_for

from .numbered import receive_timestamps

MS = 1_000_000  # ns


class Link:
    """A TCP proxy to a router that forwards only while `flows` is set; `carried` counts the forwarded bytes."""

    def __init__(self, endpoint: str) -> None:
        self.carried = 0
        self.flows = threading.Event()
        self.flows.set()
        self.broken = False
        self._to = endpoint.removeprefix("tcp/").split(":")
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._sockets: list[socket.socket] = []
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """Break all connections, and refuse new ones until `broken` is False."""
        self.broken = True
        for each in self._sockets:
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self.flows.set()
        self._sockets.append(self._listener)
        self.cut()
        for each in self._sockets:
            each.close()

    def _accept(self) -> None:
        with suppress(OSError):  # the socket is closed
            while True:
                near, _ = self._listener.accept()
                if self.broken:
                    near.close()
                    continue
                far = socket.create_connection((self._to[0], int(self._to[1])))
                self._sockets += [near, far]
                for source, target in ((near, far), (far, near)):
                    threading.Thread(
                        target=self._forward, args=(source, target), daemon=True
                    ).start()

    def _forward(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):  # the socket is closed
            while data := source.recv(4096):
                self.flows.wait()
                self.carried += len(data)
                target.sendall(data)


class Clock:
    """A fake clock for publishers."""

    def __init__(self) -> None:
        self.now = 10**18

    def monotonic_ns(self) -> int:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Make the publishers of this process downsample according to a fake clock."""
    clock = Clock()
    monkeypatch.setattr(downsampler, "time", clock)
    return clock


def publish(publisher: nedbus.Publisher, clock: Clock, first: int, count: int) -> None:
    """Publish messages with the timestamps `first`, `first + 1`, ..., 10 ms apart."""
    for timestamp in range(first, first + count):
        clock.now += 10 * MS
        publisher.publish(message(timestamp))


def has_downsampling_reader(publisher: nedbus.Publisher) -> bool:
    """Return True if a reader has requested downsampled streams of the publisher's vehicle."""
    # a publisher checks it only in `publish`
    return publisher._downsampler.vehicle_listener.is_matched()


def wait_for_downsampling_reader(publisher: nedbus.Publisher) -> None:
    """Wait until a reader has requested downsampled streams of the publisher's vehicle."""
    wait_for(partial(has_downsampling_reader, publisher), what="a reader of downsampled streams")


def take_last(publisher: nedbus.Publisher, subscription: nedbus.Subscription[Any]) -> None:
    """Receive message 0, published earlier, and wait until the publisher is matched.

    Messages published before the reply with message 0 arrives may be overtaken by that reply.
    """
    assert receive_timestamps(subscription, 1) == [0]
    wait_for_downsampling_reader(publisher)
