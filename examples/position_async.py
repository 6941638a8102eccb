"""Print the position of every vehicle with asyncio, and the message counts once a second."""

import asyncio
import os
import sys
from contextlib import suppress

import nedbus


async def show(subscription: nedbus.AsyncSubscription) -> None:
    async for sample in subscription:
        position = sample.message.position
        where = (
            "no valid position"
            if position is None
            else " ".join(f"{metres:8.2f}" for metres in position)
        )
        print(f"{sample.vehicle}: {where}")


async def report(subscription: nedbus.AsyncSubscription) -> None:
    while True:
        await asyncio.sleep(1.0)
        print(subscription.counts)


async def main() -> None:
    async with nedbus.connect_async() as bus:
        subscription = bus.subscribe(mode="every")
        async with asyncio.TaskGroup() as group:
            group.create_task(show(subscription))
            group.create_task(report(subscription))


try:
    with suppress(KeyboardInterrupt):
        asyncio.run(main())
except* BrokenPipeError:
    os._exit(0)  # the reader, such as `head`, has ended: a normal exit would print the rest
except* nedbus.ConnectError as group:
    sys.exit(str(group.exceptions[0]))
