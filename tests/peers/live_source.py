"""Live sources in a test: their output without a service, and the status of a service's only source."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from typing import Self, cast

import nedbus
from nedbus.sources import LiveSource, Rejection, SourceMessage, UnavailableTopics, parse_source
from nedbus.transport import Session
from tests.waits import DEADLINE


class Listener:
    """A listening live source: pending messages, all rejections, and the topics that are currently unavailable."""

    def __init__(
        self, text: str, *, routers: tuple[str, ...] = (), router: Session | None = None
    ) -> None:
        source = parse_source(text).open_source(vehicle="1", routers=routers)
        assert isinstance(source, LiveSource)
        self._events = cast(
            "Generator[SourceMessage | Rejection | UnavailableTopics | None]", source.listen(router)
        )
        self.messages: list[SourceMessage] = []
        self.rejections: list[Rejection] = []
        self.unavailable = UnavailableTopics()
        self.step()

    @property
    def rejected(self) -> int:
        """Number of rejected messages."""
        return sum(each.count for each in self.rejections)

    def step(self) -> None:
        """Process the next event of the source; it yields None at least every 0.25 s."""
        event = next(self._events)
        if isinstance(event, SourceMessage):
            self.messages.append(event)
        elif isinstance(event, UnavailableTopics):
            self.unavailable = event
        elif isinstance(event, Rejection):
            self.rejections.append(event)

    def step_until(self, condition: Callable[[], object], *, what: str) -> None:
        """Process events until a condition holds."""
        end = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < end, f"timed out after {DEADLINE} s waiting for {what}"
            self.step()

    def receive(self, count: int = 1) -> list[SourceMessage]:
        """Wait for `count` messages and return them."""
        self.step_until(lambda: len(self.messages) >= count, what=f"{count} messages")
        received, self.messages = self.messages[:count], self.messages[count:]
        return received

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._events.close()


def source_status(bus: nedbus.Bus) -> nedbus.health.SourceStatus:
    """Return the status of the service's only source, or an empty status before the service has started."""
    services = bus.services()
    return services[0].sources[0] if services else nedbus.health.SourceStatus()
