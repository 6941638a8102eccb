"""Rows and batches through a real router: their contents, addresses and counts."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from typing import Any, cast

import msgpack
import numpy as np
import pytest

import nedbus
from nedbus import Batch
from nedbus.client.publishing.flow_control import CACHE, WINDOW
from nedbus.transport import Session, open_router
from nedbus_msgs import Address, Row, VehicleLocalPosition
from nedbus_msgs.arrays import DTYPE, to_array, to_message
from tests.flights.local_position import LAYOUTS, downgrade, encode
from tests.flights.messages import VLP, message
from tests.nedbus.client.numbered import numbered, publish, take, wait_for_subscriber
from tests.peers.ports import free_endpoint
from tests.waits import DEADLINE, wait_for, wait_for_matching

COUNT = 900  # fewer than half a window: here one thread publishes and reads


@pytest.fixture
def subscription(endpoint: str) -> Iterator[nedbus.Subscription[Any]]:
    """Subscribe to everything; requested before `bus`, it closes after it, which else waits 5 s for the reader."""
    with nedbus.connect(endpoint) as other, other.subscribe("*", mode="every") as subscription:
        yield subscription


def take_batches(batches: Iterator[Batch], count: int) -> list[Batch]:
    taken: list[Batch] = []
    while sum(map(len, taken)) < count:
        taken.append(next(batches))
    return taken


def test_rows_are_the_messages(subscription: nedbus.Subscription[Any], bus: nedbus.Bus) -> None:
    """Rows are named tuples with the published values, in order and complete."""
    publisher = bus.publisher(VLP, vehicle="1", lossless=True)
    wait_for_subscriber(publisher)
    sent = [message(number, x=number / 3, xy_valid=True, y=0.0) for number in range(1, COUNT)]
    for each in sent:
        publisher.publish_row(tuple(each.__dict__.values()))
    rows = subscription.rows()
    samples = [next(rows) for _ in sent]
    assert all(isinstance(sample.message, Row) for sample in samples)
    assert [VehicleLocalPosition(**cast("Row", sample.message)._asdict()) for sample in samples] == sent
    assert {sample.address for sample in samples} == {Address("1", VLP)}
    assert subscription.counts == nedbus.Counts(received=len(sent))


def test_batches_hold_everything(subscription: nedbus.Subscription[Any], bus: nedbus.Bus) -> None:
    """Arrays have the published values, with address, sequence number and time of each message."""
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
        assert len(batch) == len(batch.address_index) == len(batch.sent) == len(batch.received) == len(batch.sequence)
        assert (batch.sent <= batch.received).all()
        assert (batch.sent > batch.received - 60e9).all()
        for place in range(len(batch.addresses)):
            assert (np.diff(batch.sequence[batch.address_index == place]) == 1).all()
    assert subscription.counts == nedbus.Counts(received=2 * len(messages))
    assert sum(batch.lost for batch in batches) == 0


@pytest.mark.parametrize("whole_bus", [False, True])
def test_closing_waits_for_readers(subscription: nedbus.Subscription[Any], bus: nedbus.Bus, whole_bus: bool) -> None:
    """A lossless publisher closes, alone or with its bus, once a reader that pauses has received everything."""
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
    assert take(subscription, count) == list(range(1, count + 1))
    sending.join(DEADLINE)
    assert not sending.is_alive()
    assert subscription.counts == nedbus.Counts(received=count)


@pytest.mark.parametrize("fails", [True, False])
def test_exception_does_not_wait_for_readers(client: nedbus.Bus, monkeypatch: pytest.MonkeyPatch, fails: bool) -> None:
    """After an exception a script ends at once, with either client; otherwise it waits for readers."""
    flushed: list[nedbus.Publisher] = []

    def flush(publisher: nedbus.Publisher, *_: float) -> bool:
        flushed.append(publisher)
        return True

    monkeypatch.setattr(nedbus.Publisher, "flush", flush)
    client.publisher(VLP, vehicle="1", lossless=True)
    client.__exit__(*((KeyError, KeyError(), None) if fails else (None, None, None)))  # the end of a `with` block
    assert bool(flushed) is not fails


def test_nothing_is_lost_while_the_router_is_away() -> None:
    """A lossless publisher sends no more than its history cache, and continues when its reader is back."""
    endpoint, count = free_endpoint(), CACHE + 1000
    router = open_router(listen=(endpoint,))
    with nedbus.connect(endpoint) as other, nedbus.connect(endpoint) as bus:
        publisher = bus.publisher(VLP, vehicle="1", lossless=True)
        publish(publisher, 1)
        subscription = other.subscribe(VLP, mode="every")
        assert take(subscription, 1) == [1]
        router.close()
        wait_for(lambda: not bus.connected and not other.connected, what="the loss of the link")
        sending = threading.Thread(target=publisher.publish_many, args=[numbered(count - 1, first=2)], daemon=True)
        sending.start()
        wait_for(lambda: publisher.published > WINDOW, what="a window that went nowhere")
        router = open_router(listen=(endpoint,))
        assert take(subscription, count - 1) == list(range(2, count + 1))
        sending.join(DEADLINE)
        assert publisher.flush()
        assert subscription.counts == nedbus.Counts(received=count)
    router.close()


@pytest.mark.parametrize("filler", [0, 50], ids=["few", "many"])
def test_unusual_payloads_are_decoded_one_by_one(bus: nedbus.Bus, zenoh_session: Session, filler: int) -> None:
    """Payloads of other encoders, older layouts, invalid ones and wrong keys give the same result as one by one."""
    good = message(7, x=1.5, hagl_max_z=3.0, hagl_max_xy=3.0)
    values = [list(value) if isinstance(value, tuple) else value for value in good.__dict__.values()]
    old = [list(value) if isinstance(value, tuple) else value for value in downgrade(good, "V0").values()]
    assert len(old) == len(LAYOUTS["V0"].fields)
    key = f"nedbus/1/{VLP}"
    payloads = [encode(good)] * filler + [msgpack.packb([1, *values]), msgpack.packb([0, *old])]
    bad = bytearray(encode(good))
    bad[4 + 9] = 0xC0  # a tag
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


def test_latest_in_batches(bus: nedbus.Bus) -> None:
    """In mode "latest" a batch has the newest message of each key."""
    subscription = bus.subscribe(VLP)
    publishers = [bus.publisher(VLP, vehicle=vehicle) for vehicle in "ab"]
    for number in range(1, 200):
        for publisher in publishers:
            publish(publisher, number)
    seen: dict[str, int] = {}
    for batch in subscription.batches():
        assert len(batch.addresses) == len(batch)
        for address, index in zip(batch.addresses, batch.address_index, strict=True):
            seen[address.vehicle] = int(batch.messages["timestamp"][index])
        if seen == {"a": 199, "b": 199}:
            break


@pytest.mark.parametrize("way", ["publish", "publish_row", "publish_many"])
def test_invalid_message_is_an_error_of_ours(client: nedbus.Bus, way: str) -> None:
    """Every publish method, blocking or asyncio, raises NedbusError for an invalid message, and sends nothing."""
    publisher = client.publisher(VLP, vehicle="1")
    fields = {**message(1).model_dump(), "eph": -1.0}
    given: dict[str, object] = {
        "publish": fields,
        "publish_row": tuple(fields.values()),
        "publish_many": to_array([message(1), VehicleLocalPosition.model_construct(**fields)]),
    }
    with pytest.raises(nedbus.InvalidMessageError, match=r"eph: must not be negative \(is -1.0\)") as info:
        getattr(publisher, way)(given[way])
    assert isinstance(info.value, nedbus.NedbusError)
    assert ("at index 1:" in str(info.value)) is (way == "publish_many")
    assert publisher.published == 0


def test_array_that_is_refused_sends_nothing(bus: nedbus.Bus) -> None:
    """Another dtype is an error, an empty array is not, and a closed publisher publishes nothing."""
    publisher = bus.publisher(VLP, vehicle="1")
    with pytest.raises(TypeError, match="astype"):
        publisher.publish_many(np.zeros(3, [("x", "f4")]))
    publisher.publish_many(np.empty(0, DTYPE))
    publisher.close()
    with pytest.raises(nedbus.ClosedError):
        publisher.publish_many(numbered(1))
    assert publisher.published == 0


def test_async_rows_and_batches(endpoint: str, bus: nedbus.Bus) -> None:
    """AsyncSubscription has the same two forms, for `async for`."""
    publisher = bus.publisher(VLP, vehicle="1")

    async def read() -> tuple[list[int], int]:
        async with nedbus.connect_async(endpoint) as other, other.subscribe(VLP, mode="every") as subscription:
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


def test_batch_is_awaited_with_a_timeout(client: nedbus.Bus, bus: nedbus.Bus) -> None:
    """A batch can be awaited with a timeout, with either client, and has the provenance of each message."""
    bus.publisher(VLP, vehicle="1", source="test").publish({"timestamp": 7, "x": 1.0})
    subscription = client.subscribe(VLP, mode="every")
    batch = subscription.receive_batch(DEADLINE)
    with pytest.raises(nedbus.NoDataError):
        subscription.receive_batch(0.01)
    assert batch.messages["timestamp"].tolist() == [7]
    [provenance] = batch.provenances
    assert (provenance.source, "x" in provenance.missing, "y" in provenance.missing) == ("test", False, True)


def test_sample_tells_where_it_comes_from(bus: nedbus.Bus) -> None:
    """Source and missing fields follow each message, also in the last value, at no cost to the publisher."""
    publisher = bus.publisher(VLP, vehicle="1", source="mine")
    whole = message(1).model_dump()
    publisher.publish(whole)
    subscription = bus.subscribe(VLP, mode="every")
    missing = [subscription.receive(DEADLINE).missing]  # the last value: from here on it is known to listen
    for fields in ({"timestamp": 2, "x": 1.0}, {"timestamp": 3}, whole):
        publisher.publish(fields)
    publisher.publish(VehicleLocalPosition(timestamp=4, y=2.0))
    missing += [subscription.receive(DEADLINE).missing for _ in range(4)]
    [last] = bus.latest(VLP)
    assert [len(each) for each in missing] == [0, 51, 52, 0, 51]
    assert "y" not in missing[4]
    assert (last.source, last.missing) == ("mine", missing[4])
