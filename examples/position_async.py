"""The same with asyncio: print where every vehicle is, and once a second how many samples were lost."""

import asyncio
from contextlib import suppress

import nedbus


async def show(subscription: nedbus.AsyncSubscription) -> None:
    async for sample in subscription:
        print(f"{sample.vehicle}: {sample.message.x:8.2f} {sample.message.y:8.2f} {sample.message.z:8.2f}")


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


with suppress(KeyboardInterrupt):
    asyncio.run(main())
