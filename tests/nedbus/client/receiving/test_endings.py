"""The end of a subscription: what has been received is read, or counted as dropped."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import nedbus
from nedbus import Counts
from nedbus.cli.recorder import Recorder
from nedbus.errors import ClosedError, NoDataError, ReceiveError
from tests.flights.messages import VLP
from tests.nedbus.client.numbered import publish, wait_for_subscriber
from tests.waits import DEADLINE, wait_for

COUNT = 100


@pytest.fixture
def publisher(bus: nedbus.Bus) -> Iterator[nedbus.Publisher]:
    """Return a publisher that has not published yet."""
    with bus.publisher(VLP, vehicle="1") as publisher:
        yield publisher


@pytest.fixture
def unread(publisher: nedbus.Publisher, endpoint: str) -> Iterator[nedbus.Subscription[Any]]:
    """Yield a subscription with 100 unread messages."""
    with nedbus.connect(endpoint) as bus, bus.subscribe(VLP, mode="every") as subscription:
        wait_for_subscriber(publisher)
        publish(publisher, *range(2, COUNT + 2))
        wait_for(lambda: subscription.waiting == COUNT, what="all messages")
        yield subscription


def read_all(subscription: nedbus.Subscription[Any]) -> list[int]:
    return [sample.message.timestamp for sample in subscription]


def test_closed_subscription_counts_its_unread_messages(unread: nedbus.Subscription[Any]) -> None:
    """`close` discards unread messages and counts them as dropped."""
    unread.receive(DEADLINE)
    unread.close()
    assert (unread.waiting, unread.counts) == (0, Counts(received=1, dropped=COUNT - 1))
    with pytest.raises(ClosedError):
        unread.receive(1.0)


def test_closed_bus_counts_unread_messages(unread: nedbus.Subscription[Any]) -> None:
    """Closing the bus counts the unread messages of its subscriptions as dropped."""
    owner: Any = unread._owner
    owner.close()
    assert unread.counts == Counts(dropped=COUNT)


def test_drained_subscription_is_read_to_its_end(
    unread: nedbus.Subscription[Any], publisher: nedbus.Publisher
) -> None:
    """After `drain` no message is received; iteration returns those received before, then ends."""
    unread.drain()
    publish(publisher, 1000)
    assert unread.closed
    assert read_all(unread) == list(range(2, COUNT + 2))
    unread.close()
    assert unread.counts == Counts(received=COUNT)


def test_rest_of_a_drained_subscription_is_dropped_by_close(
    unread: nedbus.Subscription[Any],
) -> None:
    """`close` after `drain` counts what has not been read."""
    unread.drain()
    unread.drain()
    unread.receive(1.0)
    unread.close()
    assert unread.counts == Counts(received=1, dropped=COUNT - 1)


def test_waiting_reader_ends_when_another_thread_drains(endpoint: str) -> None:
    """`drain` ends the iteration of a thread that waits for a message."""
    with nedbus.connect(endpoint) as bus, bus.subscribe(VLP) as subscription:
        reader = threading.Thread(target=read_all, args=(subscription,))
        reader.start()
        wait_for(lambda: subscription._receiver._rings[0].idle, what="the reader to wait")
        subscription.drain()
        reader.join(DEADLINE)
        assert not reader.is_alive()


@pytest.mark.parametrize("form", [iter, nedbus.Subscription.rows])
def test_failure_raises_after_the_last_received_message(
    unread: nedbus.Subscription[Any], form: Callable[[nedbus.Subscription[Any]], Any]
) -> None:
    """If the session fails, iteration returns what has been received, then raises ReceiveError."""
    owner: Any = unread._owner
    owner._zenoh.close()
    read: list[int] = []
    with pytest.raises(ReceiveError):
        read.extend(sample.message.timestamp for sample in form(unread))
    assert unread.counts == Counts(received=COUNT)


def test_async_subscription_is_drained(publisher: nedbus.Publisher, endpoint: str) -> None:
    """`await drain()` lets `async for` read what has been received; `await close()` counts the rest as dropped."""

    async def scenario(count: int, *, drains: bool) -> Counts:
        async with (
            nedbus.connect_async(endpoint) as bus,
            bus.subscribe(VLP, mode="every") as subscription,
        ):
            await asyncio.to_thread(wait_for_subscriber, publisher)
            # a retained message that arrives after newer ones is discarded
            while subscription.waiting < count - COUNT:
                await asyncio.sleep(0.01)
            await asyncio.to_thread(publish, publisher, *range(2, COUNT + 2))
            while subscription.waiting < count:
                await asyncio.sleep(0.01)
            if drains:
                await subscription.drain()
                async for _ in subscription:
                    pass
            await subscription.close()
            return subscription.counts

    assert asyncio.run(scenario(COUNT, drains=True)) == Counts(received=COUNT)
    with_retained = COUNT + 1
    assert asyncio.run(scenario(with_retained, drains=False)) == Counts(dropped=with_retained)


def test_stopped_recorder_writes_all_received_messages(
    unread: nedbus.Subscription[Any], tmp_path: Path
) -> None:
    """A recorder that is stopped, even at once, writes what its subscription has received."""
    stop, path = threading.Event(), tmp_path / "a.mcap"
    stop.set()
    recorder = Recorder(unread, path)
    recorder.run(stop)
    assert recorder.status == f"{COUNT} messages"
    assert len(nedbus.read(path)) == COUNT


def test_recorder_without_messages_raises(endpoint: str, tmp_path: Path) -> None:
    """A stopped recorder that has received nothing raises NoDataError and leaves no file."""
    stop, path = threading.Event(), tmp_path / "a.mcap"
    stop.set()
    with nedbus.connect(endpoint) as bus, pytest.raises(NoDataError):
        Recorder(bus.subscribe("actuator_motors", mode="every"), path).run(stop)
    assert not path.exists()
