"""Lossless publishers wait for their readers; the waits can be cancelled, and delay nothing else."""

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
from nedbus.client.publishing.flow_control import CACHE, WINDOW
from nedbus.transport import Session, open_router
from tests.flights.messages import VLP
from tests.nedbus.client.numbered import numbered, publish, receive_timestamps, wait_for_subscriber
from tests.peers.ports import free_endpoint
from tests.peers.processes import Start
from tests.peers.queryables import answer_queries
from tests.waits import DEADLINE, wait_for, wait_for_router

COUNT = 5000  # messages, more than a publisher sends to a stuck reader

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


async def wait_for_minimum_share(publisher: nedbus.AsyncPublisher) -> None:
    """Wait until a publisher has published at least its minimum share of the window."""
    async with asyncio.timeout(DEADLINE):
        while publisher.published < 100:
            await asyncio.sleep(0.01)


@pytest.fixture
def stuck(bus: nedbus.Bus) -> Iterator[nedbus.Subscription[Any]]:
    """Yield a subscription whose messages stay unread unless the test reads them."""
    with bus.subscribe(VLP, mode="every") as subscription:
        yield subscription


@asynccontextmanager
async def waiting_publishers(
    bus: nedbus.AsyncBus, number: int
) -> AsyncIterator[list[nedbus.AsyncPublisher]]:
    """Yield publishers that wait for a reader; finally cancel the waits."""
    publishers = [await bus.publisher(VLP, vehicle=each, lossless=True) for each in range(number)]
    waiting = [asyncio.create_task(each.publish_many(numbered(COUNT))) for each in publishers]
    for publisher in publishers:
        await wait_for_minimum_share(publisher)
    yield publishers
    for task in waiting:
        task.cancel()
    for task in waiting:
        with pytest.raises(asyncio.CancelledError):
            await task


@pytest.mark.slow
@pytest.mark.usefixtures("stuck")
def test_waiting_publishers_do_not_delay_queries(endpoint: str) -> None:
    """`latest` and a subscription work while 40 publishers wait for a reader, more than there are threads for queries.

    Cancelling the waits frees their threads, and an error in the block closes the bus without waiting.
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
    """After a cancelled call, `published` is the number of sent messages; sending the rest loses and repeats none."""

    async def scenario() -> None:
        async with nedbus.connect_async(endpoint) as bus:
            async with waiting_publishers(bus, 1) as [publisher]:
                pass
            sent = publisher.published
            assert 100 <= sent < COUNT
            reading = asyncio.create_task(asyncio.to_thread(receive_timestamps, stuck, COUNT))
            await publisher.publish_many(numbered(COUNT - sent, first=sent + 1))
            assert await reading == list(range(1, COUNT + 1))
            assert publisher.published == COUNT

    asyncio.run(scenario())
    assert stuck.counts == nedbus.Counts(received=COUNT)


def test_cancelled_close_closes_without_waiting(
    endpoint: str, zenoh_session: Session, bus: nedbus.Bus
) -> None:
    """A close that waits for acknowledgements can be cancelled; it then closes everything without waiting."""
    queries: list[zenoh.Query] = []

    async def scenario() -> None:
        async with nedbus.connect_async(endpoint) as other:
            first, second = [
                await other.publisher(VLP, vehicle=each, lossless=True) for each in (1, 2)
            ]
            await first.publish({"timestamp": 1})
            await second.publish({"timestamp": 1})
            for close, vehicles in ((first.close, ["2"]), (other.close, [])):
                before = len(queries)
                closing = asyncio.create_task(close())
                async with asyncio.timeout(DEADLINE):
                    while len(queries) == before:
                        await asyncio.sleep(0.01)
                assert not closing.done()
                closing.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await closing
                await asyncio.to_thread(wait_for_router, zenoh_session)
                assert list(bus.vehicles()) == vehicles
            with pytest.raises(nedbus.ClosedError):
                await second.publish({"timestamp": 2})

    with answer_queries(zenoh_session, f"nedbus/*/{VLP}/@ack", queries.append):
        asyncio.run(scenario())
    wait_for(
        lambda: not any(each.name.startswith("nedbus-close_") for each in threading.enumerate()),
        what="the closing thread to end",
    )


def test_exception_in_block_closes_publisher_without_waiting(
    client: nedbus.Bus, zenoh_session: Session
) -> None:
    """A `with` block that ends with an exception, such as Ctrl-C, does not wait for readers."""
    queries: list[zenoh.Query] = []
    silent = answer_queries(zenoh_session, f"nedbus/*/{VLP}/@ack", queries.append)
    with (
        silent,
        suppress(RuntimeError),
        client.publisher(VLP, vehicle="1", lossless=True) as publisher,
    ):
        publisher.publish({"timestamp": 1})
        raise RuntimeError("on purpose")
    assert not client.vehicles()


@pytest.mark.parametrize("whole_bus", [False, True])
def test_close_returns_after_its_timeout(
    client: nedbus.Bus, zenoh_session: Session, whole_bus: bool
) -> None:
    """Without acknowledgements, a close returns after its timeout; with timeout 0, it does not request any."""
    queries: list[zenoh.Query] = []
    with answer_queries(zenoh_session, f"nedbus/*/{VLP}/@ack", queries.append):
        for vehicle, timeout in (("1", 0.0), ("2", 0.05)):
            publisher = client.publisher(VLP, vehicle=vehicle, lossless=True)
            publisher.publish({"timestamp": 1})
            before = len(queries)
            (client if whole_bus and timeout else publisher).close(timeout=timeout)
            assert publisher.closed
            assert (len(queries) > before) == (timeout > 0)
    assert client.closed == whole_bus


@pytest.mark.parametrize("whole_bus", [False, True])
def test_ctrl_c_during_close_ends_the_wait(
    endpoint: str, monkeypatch: pytest.MonkeyPatch, whole_bus: bool
) -> None:
    """Ctrl-C during a close ends the wait for readers and closes everything."""

    def interrupt(*_: object) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr(nedbus.Publisher, "flush", interrupt)
    with nedbus.connect(endpoint) as bus:
        publisher = bus.publisher(VLP, vehicle="1", lossless=True)
        with pytest.raises(KeyboardInterrupt):
            (bus if whole_bus else publisher).close()
        assert (publisher.closed, bus.closed) == (True, whole_bus)


@pytest.mark.slow
@pytest.mark.usefixtures("stuck")
def test_ctrl_c_ends_waiting_publishers(start: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """One Ctrl-C ends a script in which six publishers wait for a reader."""
    process = start("-c", SCRIPT, NEDBUS_CONNECT=endpoint, coverage=False)
    wait_for(lambda: len(bus.latest()) == 6, what=f"the messages: {process.err}")
    process.signal(signal.SIGINT)
    assert process.wait() == -signal.SIGINT, process.err
    wait_for(lambda: not bus.vehicles(), what="the vehicles to disappear")


@pytest.fixture
def subscription(endpoint: str) -> Iterator[nedbus.Subscription[Any]]:
    """Subscribe to positions. Request this fixture before `bus`: otherwise it closes first, and `bus` waits 5 s."""
    with nedbus.connect(endpoint) as other, other.subscribe(VLP, mode="every") as subscription:
        yield subscription


@pytest.mark.parametrize("whole_bus", [False, True])
def test_lossless_close_waits_for_readers(
    subscription: nedbus.Subscription[Any], bus: nedbus.Bus, whole_bus: bool
) -> None:
    """A lossless publisher, or its bus, closes only once a paused reader has received all messages."""
    count = 3 * WINDOW
    publisher = bus.publisher(VLP, vehicle="1", lossless=True)
    wait_for_subscriber(publisher)

    def send() -> None:
        publisher.publish_many(numbered(count))
        (bus if whole_bus else publisher).close()

    sending = threading.Thread(target=send)
    sending.start()
    sending.join(0.2)
    assert sending.is_alive()
    assert receive_timestamps(subscription, count) == list(range(1, count + 1))
    sending.join(DEADLINE)
    assert not sending.is_alive()
    assert subscription.counts == nedbus.Counts(received=count)


@pytest.mark.parametrize("fails", [True, False])
def test_exception_skips_the_wait_for_readers(
    client: nedbus.Bus, monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    """A `with` block that ends with an exception closes without a flush; one that ends normally flushes."""
    flushed: list[nedbus.Publisher] = []

    def flush(publisher: nedbus.Publisher, *_: float) -> bool:
        flushed.append(publisher)
        return True

    monkeypatch.setattr(nedbus.Publisher, "flush", flush)
    client.publisher(VLP, vehicle="1", lossless=True)
    # the end of a `with` block
    client.__exit__(*((KeyError, KeyError(), None) if fails else (None, None, None)))
    assert bool(flushed) is not fails


@pytest.mark.slow
def test_lossless_publisher_loses_nothing_during_a_router_restart() -> None:
    """Without a router, a lossless publisher sends no more than its history cache holds; no message is lost."""
    endpoint, count = free_endpoint(), CACHE + 1000
    router = open_router(listen=(endpoint,))
    with nedbus.connect(endpoint) as other, nedbus.connect(endpoint) as bus:
        publisher = bus.publisher(VLP, vehicle="1", lossless=True)
        publish(publisher, 1)
        subscription = other.subscribe(VLP, mode="every")
        assert receive_timestamps(subscription, 1) == [1]
        router.close()
        wait_for(lambda: not bus.connected and not other.connected, what="the loss of the link")
        sending = threading.Thread(
            target=publisher.publish_many, args=[numbered(count - 1, first=2)], daemon=True
        )
        sending.start()
        wait_for(lambda: publisher.published > WINDOW, what="a window of messages")
        router = open_router(listen=(endpoint,))
        assert receive_timestamps(subscription, count - 1) == list(range(2, count + 1))
        sending.join(DEADLINE)
        assert publisher.flush()
        assert subscription.counts == nedbus.Counts(received=count)
    router.close()
