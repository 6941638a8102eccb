"""AsyncNewest: the view of the newest messages, for asyncio."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterable
from contextlib import suppress
from typing import TYPE_CHECKING, Self

from nedbus.errors import NoDataError
from nedbus_msgs import Message

from .async_subscription import AsyncSubscription
from .newest import NewestBase, NewestMessage
from .receiving import Inbox, Receiver

if TYPE_CHECKING:
    from .bus import Bus


class AsyncNewest(NewestBase):
    """The asyncio version of Newest; `bus.newest(...)` returns one, which opens on first use."""

    def __init__(
        self,
        open_receiver: Callable[[], Awaitable[Receiver]],
        inbox: Inbox,
        topics: Iterable[str],
        *,
        owner: Bus,
    ) -> None:
        super().__init__(inbox, topics, owner._network)
        self._subscription = AsyncSubscription[Message](open_receiver, inbox)

    async def update(self, timeout: float | None = 0.0) -> list[NewestMessage[Message]]:
        """Read what has arrived, or wait for a message; see `Newest.update`."""
        await self._subscription._open()
        await asyncio.sleep(0)  # otherwise a loop that never waits would starve other tasks
        news = self._read()
        if not news and timeout != 0:
            with suppress(NoDataError):
                news = self._read(await self._subscription.receive(timeout))
        return news

    async def close(self) -> None:
        """Close the view; its messages remain. A second call does nothing."""
        await self._subscription.close()

    async def __aenter__(self) -> Self:
        await self._subscription._open()
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()
