"""Lossless publishers of asyncio whose reader never reads: their waits end when cancelled, and delay nothing else."""

from __future__ import annotations

import asyncio
import signal
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, suppress
from typing import Any

import pytest
import zenoh

import nedbus
from nedbus.transport import Session
from tests.flights.messages import VLP
from tests.nedbus.client.numbered import numbered, take
from tests.peers.processes import Start
from tests.peers.queryables import answer_queries
from tests.waits import DEADLINE, wait_for, wait_for_router

COUNT = 5000  # messages, more than are sent without a reader that reads

SCRIPT = """
import asyncio
import nedbus
from tests.nedbus.client.numbered import numbered
async def publish(bus, number):
    async with await bus.publisher("vehicle_local_position", vehicle=number, lossless=True) as publisher:
        print("ready", flush=True)
        await publisher.publish_many(numbered(5000))
async def main():
    async with nedbus.connect_async() as bus:
        await asyncio.gather(*(publish(bus, number) for number in range(6)))
asyncio.run(main())
"""


async def until_waiting(publisher: nedbus.AsyncPublisher) -> None:
    """Return once a publisher has sent something and waits for its reader, if another has taken most of the window."""
    async with asyncio.timeout(DEADLINE):
        while publisher.published < 100:
            await asyncio.sleep(0.01)


@pytest.fixture
def stuck(bus: nedbus.Bus) -> Iterator[nedbus.Subscription[Any]]:
    """Subscribe without reading."""
    with bus.subscribe(VLP, mode="every") as subscription:
        yield subscription


@asynccontextmanager
async def waiting_publishers(bus: nedbus.AsyncBus, number: int) -> AsyncIterator[list[nedbus.AsyncPublisher]]:
    """Let publishers wait for a reader, and cancel their waits."""
    publishers = [await bus.publisher(VLP, vehicle=each, lossless=True) for each in range(number)]
    waiting = [asyncio.create_task(each.publish_many(numbered(COUNT))) for each in publishers]
    for publisher in publishers:
        await until_waiting(publisher)
    yield publishers
    for task in waiting:
        task.cancel()
    for task in waiting:
        with pytest.raises(asyncio.CancelledError):
            await task


@pytest.mark.usefixtures("stuck")
def test_waiting_publishers_delay_no_query(endpoint: str) -> None:
    """`latest` and a subscription work while 40 publishers wait for a reader, more than there are threads for queries.

    Once the waits are cancelled, no thread of theirs waits any more, and an error in the block closes without waiting.
    """

    async def scenario() -> None:
        async with nedbus.connect_async(endpoint) as bus:
            async with waiting_publishers(bus, 40):
                assert len(await bus.latest(VLP, vehicle="39", timeout=DEADLINE)) == 1
                async with bus.subscribe(VLP, vehicle="39") as subscription:
                    await subscription.receive(DEADLINE)
            raise RuntimeError("on purpose")

    with pytest.raises(RuntimeError, match="on purpose"):
        asyncio.run(scenario())


def test_cancelled_publish_many_can_be_continued(
    endpoint: str, stuck: nedbus.Subscription[nedbus.VehicleLocalPosition]
) -> None:
    """After a timeout, `published` has the number of messages sent; after the rest, nothing is lost or doubled."""

    async def scenario() -> None:
        async with nedbus.connect_async(endpoint) as bus:
            async with waiting_publishers(bus, 1) as [publisher]:
                pass
            sent = publisher.published
            assert 100 <= sent < COUNT
            reading = asyncio.create_task(asyncio.to_thread(take, stuck, COUNT))
            await publisher.publish_many(numbered(COUNT - sent, first=sent + 1))
            assert await reading == list(range(1, COUNT + 1))
            assert publisher.published == COUNT

    asyncio.run(scenario())
    assert stuck.counts == nedbus.Counts(received=COUNT)


def test_cancelled_close_closes_without_waiting(endpoint: str, zenoh_session: Session, bus: nedbus.Bus) -> None:
    """A reader that acknowledges nothing delays a close until it is cancelled; then everything is closed."""
    asked: list[zenoh.Query] = []

    async def scenario() -> None:
        async with nedbus.connect_async(endpoint) as other:
            first, second = [await other.publisher(VLP, vehicle=each, lossless=True) for each in (1, 2)]
            await first.publish({"timestamp": 1})
            await second.publish({"timestamp": 1})
            for close, vehicles in ((first.close, ["2"]), (other.close, [])):
                before = len(asked)
                closing = asyncio.create_task(close())
                async with asyncio.timeout(DEADLINE):
                    while len(asked) == before:
                        await asyncio.sleep(0.01)
                assert not closing.done()
                closing.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await closing
                await asyncio.to_thread(wait_for_router, zenoh_session)
                assert list(bus.vehicles()) == vehicles
            with pytest.raises(nedbus.ClosedError):
                await second.publish({"timestamp": 2})

    with answer_queries(zenoh_session, f"nedbus/*/{VLP}/@ack", asked.append):
        asyncio.run(scenario())
    wait_for(
        lambda: not any(each.name.startswith("nedbus-close_") for each in threading.enumerate()),
        what="the end of its thread",
    )


def test_error_in_the_block_of_a_publisher_closes_it_without_waiting(
    client: nedbus.Bus, zenoh_session: Session
) -> None:
    """A `with` block that ends with an exception, as Ctrl-C does, waits for no reader."""
    asked: list[zenoh.Query] = []
    silent = answer_queries(zenoh_session, f"nedbus/*/{VLP}/@ack", asked.append)
    with silent, suppress(RuntimeError), client.publisher(VLP, vehicle="1", lossless=True) as publisher:
        publisher.publish({"timestamp": 1})
        raise RuntimeError("on purpose")
    assert not client.vehicles()


@pytest.mark.parametrize("whole_bus", [False, True])
def test_close_with_a_timeout_gives_up(client: nedbus.Bus, zenoh_session: Session, whole_bus: bool) -> None:
    """A reader that acknowledges nothing delays a close by its timeout at most, and with 0 not at all."""
    asked: list[zenoh.Query] = []
    with answer_queries(zenoh_session, f"nedbus/*/{VLP}/@ack", asked.append):
        for vehicle, timeout in (("1", 0.0), ("2", 0.05)):
            publisher = client.publisher(VLP, vehicle=vehicle, lossless=True)
            publisher.publish({"timestamp": 1})
            before = len(asked)
            (client if whole_bus and timeout else publisher).close(timeout=timeout)
            assert publisher.closed
            assert (len(asked) > before) == (timeout > 0)
    assert client.closed == whole_bus


@pytest.mark.parametrize("whole_bus", [False, True])
def test_ctrl_c_during_close_closes(endpoint: str, monkeypatch: pytest.MonkeyPatch, whole_bus: bool) -> None:
    """Ctrl-C ends the wait of a close for readers, and everything is closed."""

    def interrupt(*_: object) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr(nedbus.Publisher, "flush", interrupt)
    with nedbus.connect(endpoint) as bus:
        publisher = bus.publisher(VLP, vehicle="1", lossless=True)
        with pytest.raises(KeyboardInterrupt):
            (bus if whole_bus else publisher).close()
        assert (publisher.closed, bus.closed) == (True, whole_bus)


@pytest.mark.usefixtures("stuck")
def test_ctrl_c_ends_waiting_publishers(start: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """One Ctrl-C ends a script of which six publishers wait for a reader."""
    process = start("-c", SCRIPT, NEDBUS_CONNECT=endpoint, coverage=False)
    wait_for(lambda: len(bus.latest()) == 6, what=f"the messages: {process.err}")
    process.signal(signal.SIGINT)
    assert process.wait() == -signal.SIGINT, process.err
    wait_for(lambda: not bus.vehicles(), what="the vehicles to go")
