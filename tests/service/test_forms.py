"""Rows and batches over a real router: what arrives, from where, and what is counted."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator

import msgpack
import numpy as np
import pytest

import nedbus
from nedbus import Batch
from nedbus.client.acknowledgement import KEPT, WINDOW
from nedbus.transport import Session, open_router
from nedbus_msgs import LAYOUTS, Address, Row, VehicleLocalPosition, downgrade, encode
from nedbus_msgs.arrays import DTYPE, MessageArray, to_array, to_message
from tests.conftest import DEADLINE, free_endpoint, message, wait_for, wait_for_reader

VLP = "vehicle_local_position"
COUNT = 900  # fewer than half a window: here one thread publishes and reads


def take_rows(subscription: nedbus.Subscription, count: int) -> list[nedbus.Sample[Row]]:
    rows = subscription.rows()
    return [next(rows) for _ in range(count)]


def as_message(sample: nedbus.Sample[Row]) -> VehicleLocalPosition:
    return VehicleLocalPosition(**sample.message._asdict())


def take_batches(batches: Iterator[Batch], count: int) -> list[Batch]:
    taken: list[Batch] = []
    while sum(map(len, taken)) < count:
        taken.append(next(batches))
    return taken


def test_rows_are_the_messages(bus: nedbus.Bus, endpoint: str) -> None:
    """Sent as rows, read as rows: named tuples with the same values, in order, none lost."""
    with nedbus.connect(endpoint) as other, other.subscribe(VLP, mode="every") as subscription:
        publisher = bus.publisher(VLP, vehicle="1", lossless=True)
        wait_for_reader(bus._session, publisher.key)
        sent = [message(number, x=number / 3, xy_valid=True, y=0.0) for number in range(1, COUNT)]
        for each in sent:
            publisher.publish_row(tuple(each.__dict__.values()))
        samples = take_rows(subscription, len(sent))
        assert all(isinstance(sample.message, Row) for sample in samples)
        assert [as_message(sample) for sample in samples] == sent
        assert {sample.address for sample in samples} == {Address("1", VLP)}
        assert subscription.counts == nedbus.Counts(received=len(sent))


def test_batches_hold_everything(bus: nedbus.Bus, endpoint: str) -> None:
    """Sent as an array, read as arrays: the same values, with address, sequence and time of each."""
    messages = to_array([message(number, x=number / 3) for number in range(1, COUNT)])
    with nedbus.connect(endpoint) as other, other.subscribe("*", mode="every") as subscription:
        for vehicle in ("1", "2"):
            publisher = bus.publisher(VLP, vehicle=vehicle, lossless=True)
            wait_for_reader(bus._session, publisher.key)
            publisher.publish_many(messages)
        batches = take_batches(subscription.batches(), 2 * len(messages))
        for vehicle in ("1", "2"):
            own = np.concatenate([batch.of(Address(vehicle, VLP)) for batch in batches])
            assert own.tobytes() == messages.tobytes()
        for batch in batches:
            assert len(batch) == len(batch.address_index) == len(batch.sent) == len(batch.sequence)
            assert (batch.sent <= batch.received).all()
            assert (batch.sent > batch.received - 60e9).all()
            for place in range(len(batch.addresses)):
                assert (np.diff(batch.sequence[batch.address_index == place]) == 1).all()
        assert subscription.counts == nedbus.Counts(received=2 * len(messages))
        assert sum(batch.lost for batch in batches) == 0


def test_closing_waits_until_readers_have_it(bus: nedbus.Bus, endpoint: str) -> None:
    """A lossless publisher is closed, alone or with its bus, once a reader that pauses has everything."""
    count = 10_000  # several windows
    messages = to_array([message(number) for number in range(1, count + 1)])
    publishers = [bus.publisher(VLP, vehicle=vehicle, lossless=True) for vehicle in "ab"]
    assert all(publisher.flush() for publisher in publishers), "nobody reads"

    def send(publisher: nedbus.Publisher, close: Callable[[], None]) -> None:
        publisher.publish_many(messages)
        close()

    with nedbus.connect(endpoint) as other, other.subscribe(VLP, mode="every") as subscription:
        for publisher, close in zip(publishers, (publishers[0].close, bus.close), strict=True):
            wait_for_reader(bus._session, publisher.key)
            sending = threading.Thread(target=send, args=(publisher, close))
            sending.start()
            sending.join(0.5)
            assert sending.is_alive()
            assert [subscription.receive(DEADLINE).message.timestamp for _ in messages] == list(range(1, count + 1))
            sending.join(DEADLINE)
            assert not sending.is_alive()
        assert subscription.counts == nedbus.Counts(received=2 * count)


def fail_in_order(endpoint: str, messages: MessageArray) -> None:
    with nedbus.connect(endpoint) as bus:
        publisher = bus.publisher(VLP, vehicle="1", lossless=True)
        wait_for_reader(bus._session, publisher.key)
        publisher.publish_many(messages)
        raise KeyError


def fail_in_asyncio(endpoint: str, messages: MessageArray) -> None:
    async def fail() -> None:
        async with nedbus.connect_async(endpoint) as bus:
            publisher = await bus.publisher(VLP, vehicle="1", lossless=True)
            await asyncio.to_thread(wait_for_reader, bus._opened()._session, publisher.key)
            await publisher.publish_many(messages)
            raise KeyError

    asyncio.run(fail())


@pytest.mark.parametrize("fail", [fail_in_order, fail_in_asyncio])
def test_exception_does_not_wait_for_readers(endpoint: str, fail: Callable[[str, MessageArray], None]) -> None:
    """A script that fails ends at once, from either client, whoever has not read yet."""
    messages = to_array([message(number) for number in range(1, COUNT)])
    with nedbus.connect(endpoint) as other, other.subscribe(VLP, mode="every"), pytest.raises(KeyError):
        fail(endpoint, messages)


def test_nothing_is_lost_while_the_router_is_away() -> None:
    """A lossless publisher sends no more than it keeps, and goes on when its reader is back at the router."""
    endpoint, count = free_endpoint(), KEPT + 1000
    router = open_router(listen=(endpoint,))
    with nedbus.connect(endpoint) as bus, nedbus.connect(endpoint) as other:
        publisher = bus.publisher(VLP, vehicle="1", lossless=True)
        publisher.publish(message(1))
        with other.subscribe(VLP, mode="every") as subscription:
            assert subscription.receive(DEADLINE).message.timestamp == 1
            router.close()
            wait_for(lambda: not bus.connected and not other.connected, what="the loss of the link")
            messages = to_array([message(number) for number in range(2, count + 1)])
            sending = threading.Thread(target=publisher.publish_many, args=[messages], daemon=True)
            sending.start()
            wait_for(lambda: publisher.published > WINDOW, what="a window that went nowhere")
            router = open_router(listen=(endpoint,))
            rest = [subscription.receive(DEADLINE).message.timestamp for _ in range(count - 1)]
            assert rest == list(range(2, count + 1))
            sending.join(DEADLINE)
            assert publisher.flush()
            assert subscription.counts == nedbus.Counts(received=count)
    router.close()


@pytest.mark.parametrize("filler", [0, 50], ids=["few", "many"])
def test_unusual_payloads_are_decoded_one_by_one(bus: nedbus.Bus, raw: Session, endpoint: str, filler: int) -> None:
    """Among others: another encoder's, an older layout's, invalid ones and wrong keys, with the same end as singly."""
    good = message(7, x=1.5, hagl_max_z=3.0, hagl_max_xy=3.0)
    values = [list(value) if isinstance(value, tuple) else value for value in good.__dict__.values()]
    old = [list(value) if isinstance(value, tuple) else value for value in downgrade(good, "V0").values()]
    assert len(old) == len(LAYOUTS["V0"].fields)
    key = f"nedbus/1/{VLP}"
    payloads = [encode(good)] * filler + [msgpack.packb([1, *values]), msgpack.packb([0, *old])]
    bad = bytearray(encode(good))
    bad[4 + 9] = 0xC0  # a tag
    with nedbus.connect(endpoint) as other, other.subscribe("*", mode="every") as subscription:
        wait_for_reader(raw, key)
        for payload in (*payloads, bytes(bad), b"", encode(good) + b"\0", *payloads):
            raw.put(key, payload)
        raw.put(f"nedbus/*/{VLP}", encode(good))
        raw.delete(key)
        raw.put("nedbus/1/nothing", encode(good))
        batches = subscription.batches()
        taken = take_batches(batches, 2 * len(payloads))
        raw.put(key, encode(message(8)))
        taken += take_batches(batches, 1)
        messages = [to_message(element) for batch in taken for element in batch.messages]
        assert messages == [good] * 2 * len(payloads) + [message(8)]
        assert {address for batch in taken for address in batch.addresses} == {Address("1", VLP)}
        assert subscription.counts == nedbus.Counts(received=len(messages), invalid=6)


def test_batches_then_singles(bus: nedbus.Bus, endpoint: str) -> None:
    """A reader may change from batches to single samples: nothing counts as lost for that."""
    publisher = bus.publisher(VLP, vehicle="1", lossless=True)
    with nedbus.connect(endpoint) as other, other.subscribe(VLP, mode="every") as subscription:
        wait_for_reader(bus._session, publisher.key)
        for start in (1, 101, 201):
            for number in range(start, start + 100):
                publisher.publish(message(number))
            if start == 101:
                taken = sum(map(len, take_batches(subscription.batches(), 100)))
                assert taken == 100
            else:
                samples = [subscription.receive(30.0) for _ in range(100)]
                assert [sample.message.timestamp for sample in samples] == list(range(start, start + 100))
                assert not any(sample.lost for sample in samples)
        assert subscription.counts == nedbus.Counts(received=300)


def test_latest_in_batches(bus: nedbus.Bus, endpoint: str) -> None:
    """In mode "latest" a batch has the newest of each key."""
    with nedbus.connect(endpoint) as other, other.subscribe(VLP) as subscription:
        publishers = [bus.publisher(VLP, vehicle=vehicle) for vehicle in "ab"]
        for number in range(1, 200):
            for publisher in publishers:
                publisher.publish(message(number))
        seen: dict[str, int] = {}
        for batch in subscription.batches():
            assert len(batch.addresses) == len(batch)
            for address, index in zip(batch.addresses, batch.address_index, strict=True):
                seen[address.vehicle] = int(batch.messages["timestamp"][index])
            if seen == {"a": 199, "b": 199}:
                break


def test_invalid_message_is_an_error_of_ours(bus: nedbus.Bus, endpoint: str) -> None:
    """Every way to publish, blocking or awaited, raises NedbusError for an invalid message, and sends nothing."""
    publisher = bus.publisher(VLP, vehicle="1")
    fields = {**message(1).model_dump(), "eph": -1.0}
    array = to_array([VehicleLocalPosition.model_construct(**fields)])
    calls: list[tuple[str, object]] = [
        ("publish", fields), ("publish_row", tuple(fields.values())), ("publish_many", array)
    ]  # fmt: skip
    for name, given in calls:
        with pytest.raises(nedbus.NedbusError, match=r"eph: must not be negative \(is -1.0\)"):
            getattr(publisher, name)(given)

    async def publish() -> int:
        async with nedbus.connect_async(endpoint) as other:
            twin = await other.publisher(VLP, vehicle="2")
            for name, given in calls:
                with pytest.raises(nedbus.NedbusError, match=r"eph: must not be negative \(is -1.0\)"):
                    await getattr(twin, name)(given)
            return twin.published

    assert publisher.published == asyncio.run(publish()) == 0


def test_array_that_is_refused_sends_nothing(bus: nedbus.Bus) -> None:
    """One bad message, or another dtype: an error, and none of the array is sent."""
    publisher = bus.publisher(VLP, vehicle="1")
    messages = to_array([message(1), message(2)])
    messages["eph"][1] = -1.0
    with pytest.raises(nedbus.InvalidMessageError, match=r"at index 1: eph: must not be negative \(is -1.0\)"):
        publisher.publish_many(messages)
    with pytest.raises(TypeError, match="astype"):
        publisher.publish_many(np.zeros(3, [("x", "f4")]))
    assert publisher.published == 0
    publisher.publish_many(np.empty(0, DTYPE))
    publisher.close()
    with pytest.raises(nedbus.ClosedError):
        publisher.publish_many(messages[:1])


def test_async_rows_and_batches(bus: nedbus.Bus, endpoint: str) -> None:
    """The twin has the same two ways, for `async for`."""
    publisher = bus.publisher(VLP, vehicle="1", lossless=True)

    async def read() -> tuple[list[int], int]:
        async with nedbus.connect_async(endpoint) as other, other.subscribe(VLP, mode="every") as subscription:
            await asyncio.to_thread(wait_for_reader, bus._session, publisher.key)
            publisher.publish_many(to_array([message(number) for number in range(1, 301)]))
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


def test_batch_is_waited_for_so_long(bus: nedbus.Bus, endpoint: str) -> None:
    """A batch can be waited for with a timeout, from either client; where each comes from is known of all."""
    publisher = bus.publisher(VLP, vehicle="1", source="test")

    async def receive() -> tuple[int, bool]:
        async with nedbus.connect_async(endpoint) as other, other.subscribe(VLP, mode="every") as subscription:
            batch = await subscription.receive_batch(DEADLINE)
            try:
                await subscription.receive_batch(0.01)
            except nedbus.NoDataError:
                return len(batch), True
            return len(batch), False

    publisher.publish({"timestamp": 7, "x": 1.0})
    with nedbus.connect(endpoint) as other, other.subscribe(VLP, mode="every") as subscription:
        batch = subscription.receive_batch(DEADLINE)
        with pytest.raises(nedbus.NoDataError):
            subscription.receive_batch(0.01)
        assert batch.messages["timestamp"].tolist() == [7]
        [provenance] = batch.provenances
        assert (provenance.source, "x" in provenance.missing, "y" in provenance.missing) == ("test", False, True)
    assert asyncio.run(receive()) == (1, True)


def test_sample_tells_where_it_comes_from(bus: nedbus.Bus, endpoint: str) -> None:
    """Source and missing fields follow each message, also into the last value, and cost a publisher nothing to say."""
    publisher = bus.publisher(VLP, vehicle="1", source="mine")
    whole = dict(VehicleLocalPosition(timestamp=1).model_dump())
    publisher.publish(whole)
    with nedbus.connect(endpoint) as other, other.subscribe(VLP, mode="every") as subscription:
        missing = [subscription.receive(DEADLINE).missing]  # the last value: from here on it is known to listen
        for fields in ({"timestamp": 2, "x": 1.0}, {"timestamp": 3}, whole):
            publisher.publish(fields)
        publisher.publish(VehicleLocalPosition(timestamp=4, y=2.0))
        missing += [subscription.receive(DEADLINE).missing for _ in range(4)]
        [last] = other.latest(VLP)
    assert [len(each) for each in missing] == [0, 51, 52, 0, 51]
    assert "y" not in missing[4]
    assert (last.source, last.missing) == ("mine", missing[4])
