"""Rows and batches through a real router: their contents, addresses and counts."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from typing import Any, cast

import msgpack
import numpy as np
import pytest

import nedbus
from nedbus import Batch
from nedbus.transport import Session
from nedbus_msgs import Address, Row, VehicleLocalPosition
from nedbus_msgs.arrays import to_array, to_message
from tests.flights.local_position import LAYOUTS, downgrade, encode
from tests.flights.messages import VLP, message
from tests.nedbus.client.numbered import numbered, publish, wait_for_subscriber
from tests.waits import DEADLINE, wait_for_matching

COUNT = 900  # fewer than half a window, because one thread publishes and reads


@pytest.fixture
def subscription(endpoint: str) -> Iterator[nedbus.Subscription[Any]]:
    """Subscribe to all topics. Request this fixture before `bus`: otherwise it closes first, and `bus` waits 5 s."""
    with nedbus.connect(endpoint) as other, other.subscribe("*", mode="every") as subscription:
        yield subscription


def take_batches(batches: Iterator[Batch], count: int) -> list[Batch]:
    taken: list[Batch] = []
    while sum(map(len, taken)) < count:
        taken.append(next(batches))
    return taken


def test_rows_equal_published_messages(
    subscription: nedbus.Subscription[Any], bus: nedbus.Bus
) -> None:
    """Rows are named tuples with the published values, in order and complete."""
    publisher = bus.publisher(VLP, vehicle="1", lossless=True)
    wait_for_subscriber(publisher)
    sent = [message(number, x=number / 3, xy_valid=True, y=0.0) for number in range(1, COUNT)]
    for each in sent:
        publisher.publish_row(tuple(each.__dict__.values()))
    rows = subscription.rows()
    samples = [next(rows) for _ in sent]
    assert all(isinstance(sample.message, Row) for sample in samples)
    assert [
        VehicleLocalPosition(**cast("Row", sample.message)._asdict()) for sample in samples
    ] == sent
    assert {sample.address for sample in samples} == {Address("1", VLP)}
    assert subscription.counts == nedbus.Counts(received=len(sent))


def test_batches_equal_published_messages(
    subscription: nedbus.Subscription[Any], bus: nedbus.Bus
) -> None:
    """Batches have the published values, with address, sequence number and times of each message."""
    messages = to_array([message(number, x=number / 3) for number in range(1, COUNT)])
    for vehicle in ("1", "2"):
        publisher = bus.publisher(VLP, vehicle=vehicle, lossless=True)
        wait_for_subscriber(publisher)
        publisher.publish_many(messages)
    batches = take_batches(subscription.batches(), 2 * len(messages))
    for vehicle in ("1", "2"):
        own = np.concatenate([batch.of(Address(vehicle, VLP)) for batch in batches])
        assert own.tobytes() == messages.tobytes()
    for batch in batches:
        assert (
            len(batch)
            == len(batch.address_index)
            == len(batch.sent)
            == len(batch.received)
            == len(batch.sequence)
        )
        assert (batch.sent <= batch.received).all()
        assert (batch.sent > batch.received - 60e9).all()
        for index in range(len(batch.addresses)):
            assert (np.diff(batch.sequence[batch.address_index == index]) == 1).all()
    assert subscription.counts == nedbus.Counts(received=2 * len(messages))
    assert sum(batch.lost for batch in batches) == 0


@pytest.mark.parametrize("filler", [0, 50], ids=["few", "many"])
def test_batch_decodes_unusual_payloads(
    bus: nedbus.Bus, zenoh_session: Session, filler: int
) -> None:
    """A batch includes payloads of other encoders and older layouts; invalid payloads and keys count as invalid."""
    good = message(7, x=1.5, hagl_max_z=3.0, hagl_max_xy=3.0)
    values = [
        list(value) if isinstance(value, tuple) else value for value in good.__dict__.values()
    ]
    old = [
        list(value) if isinstance(value, tuple) else value
        for value in downgrade(good, "V0").values()
    ]
    assert len(old) == len(LAYOUTS["V0"].fields)
    key = f"nedbus/1/{VLP}"
    payloads = [encode(good)] * filler + [msgpack.packb([1, *values]), msgpack.packb([0, *old])]
    bad = bytearray(encode(good))
    bad[4 + 9] = 0xC0  # a msgpack type byte
    subscription = bus.subscribe("*", mode="every")
    wait_for_matching(zenoh_session, key)
    for payload in (*payloads, bytes(bad), b"", encode(good) + b"\0", *payloads):
        zenoh_session.put(key, payload)
    zenoh_session.put(f"nedbus/*/{VLP}", encode(good))
    zenoh_session.delete(key)
    zenoh_session.put("nedbus/1/nothing", encode(good))
    batches = subscription.batches()
    taken = take_batches(batches, 2 * len(payloads))
    zenoh_session.put(key, encode(message(8)))
    taken += take_batches(batches, 1)
    messages = [to_message(element) for batch in taken for element in batch.messages]
    assert messages == [good] * 2 * len(payloads) + [message(8)]
    assert {address for batch in taken for address in batch.addresses} == {Address("1", VLP)}
    assert subscription.counts == nedbus.Counts(received=len(messages), invalid=6)


def test_batch_in_mode_latest_has_the_newest_messages(bus: nedbus.Bus) -> None:
    """In mode "latest" a batch has the newest message of each key."""
    subscription = bus.subscribe(VLP)
    publishers = [bus.publisher(VLP, vehicle=vehicle) for vehicle in "ab"]
    for number in range(1, 200):
        for publisher in publishers:
            publish(publisher, number)
    newest: dict[str, int] = {}
    for batch in subscription.batches():
        assert len(batch.addresses) == len(batch)
        for address, index in zip(batch.addresses, batch.address_index, strict=True):
            newest[address.vehicle] = int(batch.messages["timestamp"][index])
        if newest == {"a": 199, "b": 199}:
            break


def test_async_subscription_yields_rows_and_batches(endpoint: str, bus: nedbus.Bus) -> None:
    """`async for` iterates over the rows and batches of an AsyncSubscription."""
    publisher = bus.publisher(VLP, vehicle="1")

    async def read() -> tuple[list[int], int]:
        async with (
            nedbus.connect_async(endpoint) as other,
            other.subscribe(VLP, mode="every") as subscription,
        ):
            await asyncio.to_thread(wait_for_subscriber, publisher)
            publisher.publish_many(numbered(300))
            stamps = []
            async for sample in subscription.rows():
                stamps.append(sample.message.timestamp)
                if len(stamps) == 100:
                    break
            count = 0
            async for batch in subscription.batches():
                count += len(batch)
                if count == 200:
                    break
            await subscription.close()
            assert [sample async for sample in subscription.rows()] == []
            return stamps, count

    assert asyncio.run(read()) == (list(range(1, 101)), 200)


def test_receive_batch_returns_a_batch_or_raises_on_timeout(
    client: nedbus.Bus, bus: nedbus.Bus
) -> None:
    """`receive_batch` returns a batch with the provenance of each message, or raises NoDataError on timeout."""
    bus.publisher(VLP, vehicle="1", source="test").publish({"timestamp": 7, "x": 1.0})
    subscription = client.subscribe(VLP, mode="every")
    batch = subscription.receive_batch(DEADLINE)
    with pytest.raises(nedbus.NoDataError):
        subscription.receive_batch(0.01)
    assert batch.messages["timestamp"].tolist() == [7]
    [provenance] = batch.provenances
    assert (provenance.source, "x" in provenance.missing, "y" in provenance.missing) == (
        "test",
        False,
        True,
    )


def test_sample_has_source_and_missing_fields(bus: nedbus.Bus) -> None:
    """Each sample, including the last one from `latest`, has the source and missing fields of its message."""
    publisher = bus.publisher(VLP, vehicle="1", source="mine")
    whole = message(1).model_dump()
    publisher.publish(whole)
    subscription = bus.subscribe(VLP, mode="every")
    # once the last message is here, the reader is subscribed
    missing = [subscription.receive(DEADLINE).missing]
    for fields in ({"timestamp": 2, "x": 1.0}, {"timestamp": 3}, whole):
        publisher.publish(fields)
    publisher.publish(VehicleLocalPosition(timestamp=4, y=2.0))
    missing += [subscription.receive(DEADLINE).missing for _ in range(4)]
    [last] = bus.latest(VLP)
    assert [len(each) for each in missing] == [0, 51, 52, 0, 51]
    assert "y" not in missing[4]
    assert (last.source, last.missing) == ("mine", missing[4])
