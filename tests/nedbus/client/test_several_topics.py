"""Subscriptions to several topics, and the limits of unread messages and of batches."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import nedbus
from nedbus import Counts, Mode, SensorGps, VehicleAttitude, limits
from nedbus.errors import AddressError, ArgumentError, NoDataError
from nedbus.transport import open_router
from tests.flights.messages import VLP, message
from tests.nedbus.client.numbered import wait_for_subscriber
from tests.peers.ports import free_endpoint
from tests.waits import DEADLINE, wait_for

from .receiving.raw_samples import OTHER_KEY, VALID, drain, make_queue, put, raw

ATTITUDE = VehicleAttitude(timestamp=7, q=(1.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("mode", ["latest", "every"])
@pytest.mark.parametrize("max_rate", [None, 5])
def test_several_topics_are_received_in_one_loop(
    bus: nedbus.Bus, endpoint: str, mode: Mode, max_rate: float | None
) -> None:
    """A subscription to a class and to a topic name receives the messages of both, and of no other topic."""
    with (
        bus.publisher(VehicleAttitude, vehicle=1) as attitude,
        bus.publisher(nedbus.VehicleLocalPosition, vehicle=1) as position,
        bus.publisher("estimator_local_position", vehicle=1, instance=0) as other,
        nedbus.connect(endpoint) as reader,
    ):
        attitude.publish(ATTITUDE)
        position.publish(message(1))
        other.publish(message(1))
        with reader.subscribe(VehicleAttitude, VLP, mode=mode, max_rate=max_rate) as subscription:
            received = [subscription.receive(DEADLINE).topic for _ in range(2)]
            assert sorted(received) == ["vehicle_attitude", VLP]
            assert subscription.waiting == 0


@pytest.mark.parametrize("max_rate", [None, 5])
def test_several_vehicles_are_received_in_one_loop(
    bus: nedbus.Bus, endpoint: str, max_rate: float | None
) -> None:
    """`vehicle=["a", "b"]` selects both vehicles and no other, in subscriptions, views and queries."""
    for vehicle in ("a", "b", "c"):
        bus.publisher(VLP, vehicle=vehicle).publish(message(1))
    with nedbus.connect(endpoint) as reader:
        with reader.subscribe(VLP, vehicle=["a", "b"], max_rate=max_rate) as subscription:
            assert sorted(subscription.receive(DEADLINE).vehicle for _ in range(2)) == ["a", "b"]
            assert subscription.waiting == 0
        assert [sample.vehicle for sample in reader.latest(VLP, vehicle=["a", "b"])] == ["a", "b"]
        with reader.newest(VLP, vehicle=["b", "c"]) as view:
            wait_for(lambda: bool(view.update()) or len(view) == 2, what="two vehicles")
            assert {address.vehicle for address in view} <= {"b", "c"}
        with pytest.raises(AddressError, match="at least one vehicle"):
            reader.subscribe(vehicle=[])


def test_gaps_of_several_topics_are_counted_exactly(bus: nedbus.Bus, endpoint: str) -> None:
    """A reader of several topics receives every message of each, in order."""
    with (
        bus.publisher(VehicleAttitude, vehicle=1, lossless=True) as attitude,
        bus.publisher(VLP, vehicle=1) as position,
        nedbus.connect(endpoint) as reader,
        reader.subscribe(VehicleAttitude, VLP, mode="every") as subscription,
    ):
        for publisher in (attitude, position):
            wait_for_subscriber(publisher)
        for number in range(2, 102):
            attitude.publish(ATTITUDE.model_copy(update={"timestamp": number}))
            position.publish(message(number))
        wait_for(lambda: subscription.waiting == 200, what="all messages")
        subscription.drain()
        stamps: dict[str, list[int]] = {"vehicle_attitude": [], VLP: []}
        for sample in subscription:
            stamps[sample.topic].append(sample.message.timestamp)
        assert list(stamps.values()) == [list(range(2, 102))] * 2
        assert subscription.counts == Counts(received=200)


def test_asyncio_reads_several_topics(bus: nedbus.Bus, endpoint: str) -> None:
    """`async for` yields the messages of several topics."""
    bus.publisher(VehicleAttitude, vehicle=1).publish(ATTITUDE)
    bus.publisher(VLP, vehicle=1).publish(message(1))

    async def scenario() -> set[str]:
        async with (
            nedbus.connect_async(endpoint) as reader,
            reader.subscribe(VehicleAttitude, VLP) as subscription,
        ):
            return {(await subscription.receive(DEADLINE)).topic for _ in range(2)}

    assert asyncio.run(scenario()) == {"vehicle_attitude", VLP}


def test_all_topics_include_the_others(client: nedbus.Bus) -> None:
    """With "*", further topics and repeated ones add no second subscription, which would receive each message twice."""
    with client.subscribe("*", VehicleAttitude) as everything, client.subscribe(VLP, VLP) as once:
        assert everything.name == "nedbus/*/**"
        assert "," not in once.name


def test_one_unknown_topic_of_eight_raises(client: nedbus.Bus) -> None:
    """A subscription to eight topics, one of which does not exist, raises and names it."""
    topics = [
        "vehicle_attitude",
        VLP,
        "sensor_gps",
        "actuator_motors",
        "home_position",
        "vehicle_status",
        "cpuload",
    ]
    with pytest.raises(AddressError, match="No Topic"):
        client.subscribe(*topics, "No Topic")


def test_topic_with_several_messages_raises(client: nedbus.Bus) -> None:
    """`topic` belongs to one class, so it cannot be combined with several."""
    with pytest.raises(ArgumentError, match="topic"):
        client.subscribe(VehicleAttitude, SensorGps, topic="vehicle_gps_position")  # type: ignore[call-overload] # wrong


@pytest.mark.parametrize("count", [0, -1, True, 1.5])
def test_limit_below_one_message_raises(client: nedbus.Bus, count: Any) -> None:
    """`limit` and `max_messages` must be integers above 0."""
    for mode in ("latest", "every"):
        with pytest.raises(ArgumentError, match="limit"):
            client.subscribe(mode=mode, limit=count)
    with client.subscribe() as subscription:
        for call in (subscription.batches, subscription.receive_batch):
            with pytest.raises(ArgumentError, match="max_messages"):
                call(max_messages=count)


@pytest.mark.parametrize("timeout", ["1", float("nan"), True])
def test_timeout_that_is_no_number_raises(client: nedbus.Bus, timeout: Any) -> None:
    """A timeout is a number of seconds; a negative one is over at once."""
    with client.subscribe() as subscription, client.newest() as view:
        for call in (subscription.receive, subscription.receive_batch, view.update):
            with pytest.raises(ArgumentError, match="timeout"):
                call(timeout)
        with pytest.raises(NoDataError):
            subscription.receive(-1)


def test_timeout_beyond_the_clock_waits(client: nedbus.Bus) -> None:
    """A timeout that the system's clock cannot reach does not end the wait."""
    sent = nedbus.VehicleLocalPosition(timestamp=1)
    with client.subscribe() as subscription, client.publisher(VLP, vehicle="1") as publisher:
        publisher.publish(sent)
        assert subscription.receive(1e10).message == sent


@pytest.mark.parametrize("mode", ["latest", "every"])
def test_unread_messages_beyond_the_limit_are_dropped(
    mode: Mode, caplog: pytest.LogCaptureFixture
) -> None:
    """Beyond `limit` unread messages, the oldest are dropped and counted; a warning gives the reason once."""
    inbox = make_queue(mode, limit=1)
    put(inbox, [raw(0), raw(0, key=OTHER_KEY, publisher="b")])
    reason = {
        "latest": "more keys than the limit of 1 have an unread message",
        "every": "slower than the data",
    }[mode]
    assert [reason in text for text in caplog.messages] == [True]
    assert [sample.vehicle for sample in drain(inbox)] == ["2"]
    assert inbox.counts == Counts(received=1, dropped=1)


@pytest.mark.parametrize("mode", ["latest", "every"])
def test_bytes_of_unread_messages_are_bounded(mode: Mode, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond a number of bytes, the oldest unread messages are dropped and counted; reading makes room again."""
    monkeypatch.setattr(limits, "UNREAD_BYTES", 3 * len(VALID))
    inbox = make_queue(mode)
    for _ in range(2):
        put(inbox, [raw(None, key=f"nedbus/{vehicle}/{VLP}") for vehicle in "12345"])
        assert [sample.vehicle for sample in drain(inbox)] == list("345")
    put(inbox, [raw(None, key=f"nedbus/{vehicle}/{VLP}") for vehicle in "123"])
    assert inbox.counts == Counts(received=6, dropped=4)


@pytest.mark.parametrize("mode", ["latest", "every"])
def test_batches_have_at_most_max_messages(mode: Mode) -> None:
    """`max_messages` limits a batch in both modes; the rest follows in order."""
    inbox = make_queue(mode)
    put(inbox, [raw(None, key=f"nedbus/{vehicle}/{VLP}") for vehicle in "12345"])
    read = [
        [each.vehicle for each in batch.addresses]
        for batch in iter(lambda: inbox.pop_batch(max_messages=2), None)
    ]
    assert read == [["1", "2"], ["3", "4"], ["5"]]


def test_publisher_of_a_class_publishes_its_topic(bus: nedbus.Bus, client: nedbus.Bus) -> None:
    """`publisher` takes what `subscribe` takes: a class, with another of its topics if needed, or a name."""
    with bus.publisher(
        nedbus.VehicleLocalPosition, topic="estimator_local_position", vehicle=1, instance=0
    ) as publisher:
        assert publisher.address.topic == "estimator_local_position"
    with pytest.raises(AddressError, match="one of VehicleAttitude"):
        bus.publisher(VehicleAttitude, topic=VLP, vehicle=1)


def test_callback_that_cannot_be_called_raises(client: nedbus.Bus) -> None:
    """`on_link` rejects anything but a function at once, not on the thread that would call it."""
    with pytest.raises(ArgumentError, match="call 3 is not valid: expected a function"):
        client.on_link(3)  # type: ignore[arg-type] # not a function


def test_closed_callback_is_not_called() -> None:
    """`on_link` returns an object whose `close`, or `with` block, ends the calls; all share one watch of the link."""
    endpoint = free_endpoint()
    calls: list[str] = []
    router = open_router(listen=[endpoint])
    with nedbus.connect(endpoint) as bus:
        with bus.on_link(lambda is_up: calls.append(f"first {is_up}")) as first:
            second = bus.on_link(lambda is_up: calls.append(f"second {is_up}"))
            bus.on_link(lambda is_up: calls.append(f"third {is_up}"))
        router.close()
        wait_for(lambda: len(calls) == 2, what="the loss of the link")
        second.close()
        second.close()
        with open_router(listen=[endpoint]):
            wait_for(lambda: "third True" in calls, what="the link")
            first.close()
    assert sorted(calls) == ["second False", "third False", "third True"]


def test_changes_of_the_link_are_reported() -> None:
    """`on_link` calls a function when the router is gone and when it is back, with asyncio in the event loop."""
    endpoint = free_endpoint()
    changes: list[bool] = []
    in_loop: list[bool] = []

    async def scenario() -> None:
        async with nedbus.connect_async(endpoint) as bus:
            bus.on_link(in_loop.append)
            await asyncio.to_thread(first.close)
            await asyncio.to_thread(
                wait_for, lambda: in_loop == [False], what="the loss of the link"
            )
            with open_router(listen=[endpoint]):
                await asyncio.to_thread(
                    wait_for, lambda: in_loop == changes == [False, True], what="the link"
                )

    first = open_router(listen=[endpoint])
    with nedbus.connect(endpoint) as bus:
        bus.on_link(changes.append)
        asyncio.run(scenario())
        wait_for(lambda: changes == [False, True, False], what="the changes")
