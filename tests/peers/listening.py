"""Live sources in a test: what they yield without a service, and what a service tells of its only one."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from typing import Self, cast

import nedbus
from nedbus.sources import LiveSource, Rejection, SourceMessage, UnavailableTopics, parse_source
from nedbus.transport import Session
from tests.waits import DEADLINE


class Listener:
    """A live source that listens: the messages that were not received yet, all rejections, and what is absent now."""

    def __init__(self, text: str, *, routers: tuple[str, ...] = (), router: Session | None = None) -> None:
        source = parse_source(text).open_source(vehicle="1", routers=routers)
        assert isinstance(source, LiveSource)
        self._events = cast("Generator[SourceMessage | Rejection | UnavailableTopics | None]", source.listen(router))
        self.messages: list[SourceMessage] = []
        self.rejections: list[Rejection] = []
        self.unavailable = UnavailableTopics()
        self.turn()

    @property
    def rejected(self) -> int:
        """For how many messages the rejections stand."""
        return sum(each.count for each in self.rejections)

    def turn(self) -> None:
        """Take what it yields next, which is nothing after a quarter of a second at the latest."""
        event = next(self._events)
        if isinstance(event, SourceMessage):
            self.messages.append(event)
        elif isinstance(event, UnavailableTopics):
            self.unavailable = event
        elif event is not None:
            self.rejections.append(event)

    def turn_until(self, condition: Callable[[], object], *, what: str) -> None:
        """Take what it yields until a condition holds."""
        end = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < end, f"waited {DEADLINE} s in vain for {what}"
            self.turn()

    def receive(self, count: int = 1) -> list[SourceMessage]:
        """Wait for `count` messages, and return them."""
        self.turn_until(lambda: len(self.messages) >= count, what=f"{count} messages")
        received, self.messages = self.messages[:count], self.messages[count:]
        return received

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._events.close()


def status_of_source(bus: nedbus.Bus) -> nedbus.health.SourceStatus:
    """Return the status of the service's only source, or an empty one before there is one."""
    services = bus.services()
    return services[0].sources[0] if services else nedbus.health.SourceStatus()
