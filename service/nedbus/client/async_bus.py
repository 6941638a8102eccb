"""The bus for asyncio: the twin of Bus."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import Self

from nedbus.errors import ClosedError
from nedbus_msgs import ANY, DEFAULT_TOPIC, Address, Selection, vehicle_name

from .async_publisher import AsyncPublisher
from .async_subscription import AsyncSubscription
from .bus import Bus
from .rejections import Rejections
from .sample import Mode, Sample


class AsyncBus:
    """The twin of Bus for asyncio, from `connect_async`: the same methods, awaited where they wait.

    Of `open_session` there is no twin, as Zenoh's sessions block.
    """

    def __init__(self, open_bus: Callable[[threading.Event], Bus]) -> None:
        self._open_bus = open_bus
        self._bus: Bus | None = None

    @property
    def connected(self) -> bool:
        """Whether there is a link to a router at this moment."""
        return self._opened().connected

    @property
    def prefix(self) -> str:
        """The first chunks of every key."""
        return self._opened().prefix

    @property
    def routers(self) -> tuple[str, ...]:
        """The endpoints that it joins."""
        return self._opened().routers

    def subscribe(
        self,
        topic: str = DEFAULT_TOPIC,
        *,
        vehicle: str | int = ANY,
        instance: int | None = None,
        mode: Mode = "latest",
        max_rate: float | None = None,
    ) -> AsyncSubscription:
        """Subscribe as `Bus.subscribe` does, for `async for`; it opens when it is first waited on."""
        self._opened()
        return self.subscribe_to(Selection(topic, vehicle_name(vehicle), instance), mode=mode, max_rate=max_rate)

    def subscribe_to(
        self, selection: Selection, *, mode: Mode = "latest", max_rate: float | None = None
    ) -> AsyncSubscription:
        """Subscribe to a selection of addresses, as `subscribe` does."""
        bus = self._opened()
        receive_queue = bus._make_queue(selection, mode, max_rate)
        name = selection.key_expr(prefix=bus.prefix)
        return AsyncSubscription(lambda: bus._open_subscriber(selection, receive_queue), receive_queue, name=name)

    async def latest(
        self, topic: str = DEFAULT_TOPIC, *, vehicle: str | int = ANY, instance: int | None = None, timeout: float = 2.0
    ) -> list[Sample]:
        """Return the last sample of each key as `Bus.latest` does."""
        bus = self._opened()
        return await asyncio.to_thread(bus.latest, topic, vehicle=vehicle, instance=instance, timeout=timeout)

    async def vehicles(self, *, timeout: float = 2.0) -> dict[str, list[Address]]:
        """Return the vehicles that are published now as `Bus.vehicles` does."""
        return await asyncio.to_thread(self._opened().vehicles, timeout=timeout)

    async def services(self, *, timeout: float = 2.0) -> list[dict[str, object]]:
        """Return the status of every nedbus service as `Bus.services` does."""
        return await asyncio.to_thread(self._opened().services, timeout=timeout)

    async def rejections(self) -> Rejections:
        """Follow the reports of messages that services on this network reject from now on; `take` does not wait."""
        return await asyncio.to_thread(self._opened().rejections)

    async def publisher(
        self,
        topic: str,
        *,
        vehicle: str | int,
        instance: int | None = None,
        lossless: bool = False,
        source: str | None = None,
    ) -> AsyncPublisher:
        """Return a publisher as `Bus.publisher` does, whose methods are awaited."""
        publisher = await asyncio.to_thread(
            self._opened().publisher, topic, vehicle=vehicle, instance=instance, lossless=lossless, source=source
        )
        return AsyncPublisher(publisher)

    async def close(self) -> None:
        """Close the bus as `Bus.close` does."""
        if self._bus is not None:
            await asyncio.to_thread(self._bus.close)

    async def __aenter__(self) -> Self:
        cancelled = threading.Event()
        try:
            self._bus = await asyncio.to_thread(self._open_bus, cancelled)
        except asyncio.CancelledError:
            cancelled.set()  # the thread would try on, and Python waits for it
            raise
        return self

    async def __aexit__(self, *exc: object) -> None:
        if self._bus is not None:
            await asyncio.to_thread(self._bus.__exit__, *exc)

    def _opened(self) -> Bus:
        if self._bus is None:
            raise ClosedError
        return self._bus
