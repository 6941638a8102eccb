"""A publisher for asyncio: the twin of Publisher."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Self

from nedbus_msgs import Address, Row, VehicleLocalPosition

from .publishing.publisher import FLUSH_TIMEOUT, Publisher

if TYPE_CHECKING:
    from nedbus_msgs.arrays import MessageArray


class AsyncPublisher:
    """Publish the messages of one address from asyncio; get one from `await bus.publisher(...)`.

    The twin of Publisher, with its methods awaited; errors are the same.
    What may wait for readers (a lossless `publish`, `publish_many`, `flush`, `close`) waits in a thread, and other
    tasks of the event loop go on; await one call before the next.
    """

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher

    @property
    def address(self) -> Address:
        """The address that it publishes."""
        return self._publisher.address

    @property
    def key(self) -> str:
        """The Zenoh key expression of that address."""
        return self._publisher.key

    @property
    def source(self) -> str | None:
        """Where its messages come from, as readers see it."""
        return self._publisher.source

    @property
    def lossless(self) -> bool:
        """Whether `publish` waits for slow readers."""
        return self._publisher.lossless

    @property
    def published(self) -> int:
        """How many messages it has published."""
        return self._publisher.published

    async def publish(self, message: VehicleLocalPosition | Mapping[str, object]) -> None:
        """Validate a message, or the fields of one by name, and publish it, as `Publisher.publish` does."""
        if self._publisher.lossless:
            await asyncio.to_thread(self._publisher.publish, message)
        else:
            self._publisher.publish(message)

    async def publish_row(self, values: Sequence[object] | Row) -> None:
        """Validate the values of all fields in PX4's order, and publish them, as `Publisher.publish_row` does."""
        if self._publisher.lossless:
            await asyncio.to_thread(self._publisher.publish_row, values)
        else:
            self._publisher.publish_row(values)

    async def publish_many(self, messages: MessageArray) -> None:
        """Validate the messages in a structured array, and publish them, as `Publisher.publish_many` does."""
        await asyncio.to_thread(self._publisher.publish_many, messages)

    async def flush(self, timeout: float = FLUSH_TIMEOUT) -> bool:
        """Wait until all readers of mode "every" have what was published, as `Publisher.flush` does."""
        return await asyncio.to_thread(self._publisher.flush, timeout)

    async def close(self) -> None:
        """Stop publishing this address, as `Publisher.close` does."""
        await asyncio.to_thread(self._publisher.close)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()
