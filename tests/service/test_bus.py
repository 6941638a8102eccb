"""Publish, subscribe, ask: the same rules for the sync and the async client, over a real router."""

from __future__ import annotations

import asyncio
import contextlib
import copy
import datetime as dt
import gc
import json
import logging
import math
import pickle
import signal
import threading
import time
import tracemalloc
import weakref
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import cast

import msgpack
import pytest
import zenoh

import nedbus
from nedbus import Mode
from nedbus.client.receive_queue import CAPACITY
from nedbus.transport import Session, ask_alive_keys, open_router
from nedbus_msgs import TOPICS, Address, encode
from tests.conftest import (
    DEADLINE,
    Client,
    Start,
    free_endpoint,
    message,
    repeating,
    wait_for,
    wait_for_reader,
)

VLP = "vehicle_local_position"
BOTH: list[Mode] = ["latest", "every"]


@pytest.mark.parametrize("mode", BOTH)
def test_message_arrives_as_it_was(client: Client, bus: nedbus.Bus, mode: Mode) -> None:
    """What is published arrives typed, equal to the bit, with its address and times."""
    publisher = bus.publisher("estimator_local_position", vehicle="7", instance=1)
    sent = message(5, x=0.1, ref_lat=47.397742123456789, vxy_max=math.inf, delta_xy=(1.0, math.nan))
    subscription = client.subscribe("*", mode=mode)
    publisher.publish(sent)
    sample = subscription.receive(DEADLINE)
    assert encode(sample.message) == encode(sent)
    assert sample.address == Address("7", "estimator_local_position", 1)
    assert (sample.vehicle, sample.topic, sample.instance, sample.lost) == ("7", "estimator_local_position", 1, 0)
    assert sample.sent is not None
    assert abs(sample.received - time.time_ns()) < 60e9
    assert sample.latency is not None


def test_every_sample_arrives_in_order(client: Client, bus: nedbus.Bus) -> None:
    """Mode "every" gives each sample once, in order, with counts to prove it."""
    publisher = bus.publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    subscription = client.subscribe(VLP, mode="every")
    first = subscription.receive(DEADLINE)
    for timestamp in range(2, 1002):
        publisher.publish(message(timestamp))
    taken = [first, *subscription.take(1000)]
    assert [sample.message.timestamp for sample in taken] == list(range(1, 1002))
    assert subscription.counts == nedbus.Counts(received=1001)


def test_latest_gives_the_newest_of_each_key(client: Client, bus: nedbus.Bus) -> None:
    """A reader that is slower than the data sees the newest of each vehicle; what it did not see is counted."""
    publishers = [bus.publisher(VLP, vehicle=vehicle) for vehicle in ("a", "b")]
    for publisher in publishers:
        publisher.publish(message(1))
    subscription = client.subscribe(VLP)
    assert {subscription.receive(DEADLINE).vehicle for _ in publishers} == {"a", "b"}
    for timestamp in range(2, 102):
        for publisher in publishers:
            publisher.publish(message(timestamp))
    seen: dict[str, int] = {}
    while set(seen.values()) != {101} or len(seen) < 2:
        sample = subscription.receive(DEADLINE)
        assert sample.message.timestamp > seen.get(sample.vehicle, 0)
        seen[sample.vehicle] = sample.message.timestamp
    counts = subscription.counts
    assert counts.received + counts.dropped == 202
    assert (counts.lost, counts.invalid) == (0, 0)


def test_ring_overflow_is_counted_as_dropped(bus: nedbus.Bus, endpoint: str) -> None:
    """What a "latest" reader's own queue dropped is counted from the publisher's sequence, exactly."""
    publisher = bus.publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    with nedbus.connect(endpoint) as other, other.subscribe(VLP) as subscription:
        assert subscription.receive().message.timestamp == 1
        for timestamp in range(2, 5001):
            publisher.publish(message(timestamp))
        while subscription.receive().message.timestamp != 5000:
            pass
        counts = subscription.counts
        assert counts.received + counts.dropped + counts.lost == 5000
        assert counts.dropped > 3000


@pytest.mark.parametrize("mode", BOTH)
def test_late_joiner_gets_the_last_value(client: Client, bus: nedbus.Bus, mode: Mode) -> None:
    """A subscription starts with the last value of each key, even if nothing is published any more."""
    for vehicle in ("a", "b"):
        publisher = bus.publisher(VLP, vehicle=vehicle)
        for timestamp in (1, 2, 3):
            publisher.publish(message(timestamp))
    subscription = client.subscribe("*", mode=mode)
    last: dict[str, int] = {}
    while last != {"a": 3, "b": 3}:  # what was still on its way may come before
        sample = subscription.receive(DEADLINE)
        last[sample.vehicle] = sample.message.timestamp


def test_subscription_is_a_choice(client: Client, bus: nedbus.Bus) -> None:
    """Topic, vehicle and instance choose what arrives."""
    for vehicle in ("1", "2"):
        for topic in TOPICS.values():
            for instance in (0, 1) if topic.instances else (None,):
                bus.publisher(topic.name, vehicle=vehicle, instance=instance).publish(message(1))
    wait_for(lambda: len(client.latest("*")) == 10, what="everything")
    assert {sample.vehicle for sample in client.latest(VLP)} == {"1", "2"}
    assert [str(sample.address) for sample in client.latest("estimator_local_position", vehicle="2")] == [
        "2/estimator_local_position/0",
        "2/estimator_local_position/1",
    ]
    subscription = client.subscribe("estimator_local_position", instance=1)
    assert {str(subscription.receive(DEADLINE).address) for _ in range(2)} == {
        "1/estimator_local_position/1",
        "2/estimator_local_position/1",
    }
    with pytest.raises(nedbus.NoDataError):
        subscription.receive(0.1)


def test_default_is_the_estimate(client: Client, bus: nedbus.Bus) -> None:
    """Without a topic neither subscriptions nor last values mix the estimate with the truth or with single EKFs."""
    for topic in reversed(tuple(TOPICS.values())):
        bus.publisher(topic.name, vehicle="1", instance=0 if topic.instances else None).publish(message(1))
    wait_for(lambda: len(client.latest("*")) == 4, what="all four topics")
    assert [sample.topic for sample in client.latest()] == [VLP]
    subscription = client.subscribe()
    assert subscription.receive(DEADLINE).topic == VLP
    with pytest.raises(nedbus.NoDataError):
        subscription.receive(0.1)


def test_latest_is_empty_where_nothing_is(client: Client) -> None:
    """No publisher, no answer, no error."""
    assert client.latest("*") == []
    assert client.vehicles() == {}
    assert client.services() == []


def test_vehicles_come_and_go(client: Client, endpoint: str) -> None:
    """Liveliness shows what is published now, and forgets what is closed."""
    with nedbus.connect(endpoint) as other:
        other.publisher(VLP, vehicle="7")
        other.publisher("estimator_local_position", vehicle="7", instance=2)
        wait_for(lambda: len(client.vehicles().get("7", [])) == 2, what="vehicle 7")
        assert client.vehicles() == {"7": [Address("7", "estimator_local_position", 2), Address("7", VLP)]}
    wait_for(lambda: not client.vehicles(), what="vehicle 7 to go")


def test_hundreds_of_publishers_answer_their_own_bus(endpoint: str) -> None:
    """More answers than a channel of Zenoh's holds (256) do not block, whoever asks: their own bus, or another."""
    with nedbus.connect(endpoint) as one, nedbus.connect(endpoint) as other:
        for number in range(600):
            one.publisher(VLP, vehicle=str(number)).publish(message(1))
        for asking in (one, other):
            wait_for(partial(has_all, asking), what="600 vehicles, each with an answer")


def has_vehicles(bus: nedbus.Bus, count: int) -> bool:
    return len(bus.vehicles()) == count


def has_all(bus: nedbus.Bus) -> bool:
    return len(bus.vehicles()) == len(bus.latest()) == 600


@pytest.mark.process
def test_question_that_nobody_answers_ends_with_ctrl_c(start: Start, endpoint: str, raw: Session) -> None:
    """A queryable that keeps its queries does not hold a script that asks: Ctrl-C ends the wait."""
    kept: list[zenoh.Query] = []
    queryable = raw.declare_queryable("nedbus/**", zenoh.handlers.Callback(kept.append, indirect=False))
    code = 'import nedbus; bus = nedbus.connect(); print("ready", flush=True); bus.latest(timeout=600)'
    process = start("-c", code, NEDBUS_CONNECT=endpoint, measured=False)
    wait_for(lambda: kept, what="the question")
    process.signal(signal.SIGINT)
    assert process.wait() == -signal.SIGINT, process.err
    queryable.undeclare()


def test_receive_times_out_with_words(client: Client) -> None:
    """NoDataError is a TimeoutError, and says what did not come and what to do."""
    subscription = client.subscribe(VLP, vehicle="9")
    with pytest.raises(
        nedbus.NoDataError, match=r"nedbus/9/vehicle_local_position within 0\.05 s.*nedbus list"
    ) as info:
        subscription.receive(0.05)
    assert isinstance(info.value, TimeoutError)


def test_closed_subscription_ends_iteration(client: Client) -> None:
    """Iteration ends without an error; receive says that it is closed; closing twice is fine."""
    subscription = client.subscribe(VLP)
    subscription.close()
    subscription.close()
    assert subscription.take(1) == []
    with pytest.raises(nedbus.ClosedError):
        subscription.receive(1.0)


def test_closed_bus_ends_everything(client: Client) -> None:
    """Everything that is asked of a closed bus raises ClosedError, and its subscriptions end."""
    subscription = client.subscribe(VLP)
    publisher = client.publisher(VLP, vehicle="1")
    client.close()
    client.close()
    assert subscription.take(1) == []
    with pytest.raises(nedbus.ClosedError):
        publisher.publish(message())
    for ask in (client.latest, client.vehicles, client.services, lambda: client.connected, client.subscribe):
        with pytest.raises(nedbus.ClosedError):
            ask()


def test_close_from_another_thread_ends_a_waiting_reader(bus: nedbus.Bus) -> None:
    """A thread that waits for a sample is let go when the subscription is closed."""
    for mode in BOTH:
        subscription = bus.subscribe(VLP, mode=mode)
        reader = threading.Thread(target=list, args=(subscription,), daemon=True)
        reader.start()
        subscription.close()
        reader.join(DEADLINE)
        assert not reader.is_alive()


@pytest.mark.parametrize("mode", BOTH)
def test_unread_subscription_can_be_closed(endpoint: str, bus: nedbus.Bus, mode: Mode) -> None:
    """A full queue holds neither close nor the process."""
    publisher = bus.publisher(VLP, vehicle="1")
    with nedbus.connect(endpoint) as other, other.subscribe(VLP, mode=mode):
        for timestamp in range(1, 20_000):
            publisher.publish(message(timestamp))
        start = time.monotonic()
    assert time.monotonic() - start < 9.0, "Zenoh's own limit for a stuck close is 10 s"


def test_stuck_every_reader_does_not_hold_its_bus(client: Client, bus: nedbus.Bus) -> None:
    """While an unread "every" subscription is full, the same bus still asks and reads elsewhere."""
    publisher = bus.publisher(VLP, vehicle="1")
    stuck = client.subscribe(VLP, mode="every")
    for timestamp in range(1, 20_001):
        publisher.publish(message(timestamp))
    wait_for(lambda: [s.message.timestamp for s in client.latest(VLP)] == [20_000], what="the last value")
    assert client.subscribe(VLP).receive(DEADLINE).message.timestamp > 0
    stuck.close()


def test_absent_is_counted_exactly(endpoint: str, bus: nedbus.Bus) -> None:
    """Of a flood that neither buffers nor the queue of a reader hold, each message is received, lost or dropped."""
    publisher = bus.publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    with nedbus.connect(endpoint) as other, other.subscribe(VLP, mode="every") as subscription:
        first = subscription.receive(DEADLINE)
        total = 2 * CAPACITY
        _, *rest = message(2).__dict__.values()
        for timestamp in range(2, total + 1):
            publisher.publish_row((timestamp, *rest))
        lost, received, absent, last = first.lost, 1, first.lost, first.message.timestamp
        while last != total:
            sample = subscription.receive(DEADLINE)
            assert sample.message.timestamp > last + sample.lost
            lost, received = lost + sample.lost, received + 1
            absent += sample.message.timestamp - last - 1
            last = sample.message.timestamp
        counts = subscription.counts
        assert (counts.received, counts.lost, counts.invalid) == (received, lost, 0)
        assert lost + counts.dropped == absent == total - received > 0


def test_invalid_payload_never_ends_an_iteration(
    client: Client, raw: Session, bus: nedbus.Bus, caplog: pytest.LogCaptureFixture
) -> None:
    """Garbage, foreign keys, deletes and wildcard puts are counted and named once; good samples come through."""
    publisher = bus.publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    subscription = client.subscribe("*", mode="every")
    assert subscription.receive(DEADLINE).message.timestamp == 1
    good = encode(message(2, x=1.0))
    for key, payload in (
        ("nedbus/1/vehicle_local_position", b"garbage"),
        ("nedbus/1/vehicle_local_position", msgpack.packb([1, 2, 3])),
        ("nedbus/*/vehicle_local_position", good),
        ("nedbus/1/vehicle_attitude", good),
        ("nedbus/1/estimator_local_position", good),
        ("nedbus/1", good),
    ):
        raw.put(key, payload)
    raw.delete("nedbus/1/vehicle_local_position")
    raw.put("nedbus/2/vehicle_local_position", good)
    sample = subscription.receive(DEADLINE)
    assert (sample.vehicle, sample.message.x, sample.sent) == ("2", 1.0, None)
    assert subscription.counts == nedbus.Counts(received=2, invalid=7)
    warned = [record.message for record in caplog.records if record.levelno == logging.WARNING]
    assert len(warned) == len({text.split(":")[0] for text in warned}), "each key is named once"
    assert any("garbage" in text or "one msgpack value" in text for text in warned)


def test_long_keys_cost_a_reader_nothing(
    client: Client, raw: Session, bus: nedbus.Bus, caplog: pytest.LogCaptureFixture
) -> None:
    """300 invalid keys of 60 kB are counted; the reader keeps none of them, and logs 100 short lines at most."""
    publisher = bus.publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    subscription = client.subscribe("*", mode="every")
    assert subscription.receive(DEADLINE).message.timestamp == 1
    tracemalloc.start()
    try:
        for number in range(300):
            raw.put(f"nedbus/{number}/{'x' * 60_000}", b"", congestion_control=zenoh.CongestionControl.BLOCK)
        wait_for(lambda: subscription.counts.invalid == 300, what="all to be counted")
        kept, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept < 100 * 60_000
    warned = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert len(warned) == 100
    assert max(map(len, warned)) < 1000
    assert [text.endswith("; further keys are only counted") for text in warned] == 99 * [False] + [True]


def test_newer_layout_is_read_with_its_publishers_schema(
    client: Client, raw: Session, caplog: pytest.LogCaptureFixture
) -> None:
    """An unknown layout is looked up once, while its messages are invalid; unknown fields are said once."""
    fields = [{"name": name, "type": "any"} for name in ("timestamp", "brand_new", "x")]
    answer = json.dumps({"layouts": [{"name": "9.9", "wire": 9, "fields": fields}]})
    asked = []

    def reply(query: zenoh.Query) -> None:
        asked.append(query)
        with query:
            query.reply("nedbus/@schema/VehicleLocalPosition", answer)

    queryable = raw.declare_queryable(
        "nedbus/@schema/VehicleLocalPosition", zenoh.handlers.Callback(reply, indirect=False)
    )
    subscription = client.subscribe(VLP, mode="every")
    wait_for_reader(raw, "nedbus/1/vehicle_local_position")
    with repeating(lambda: raw.put("nedbus/1/vehicle_local_position", msgpack.packb([9, 4, True, 2.5]))):
        taken = subscription.take(2)
    assert [(sample.message.timestamp, sample.message.x) for sample in taken] == [(4, 2.5), (4, 2.5)]
    assert subscription.counts.invalid > 0
    assert len(asked) == 1
    assert [text for text in caplog.messages if "not read" in text] == [
        "layout 9 is newer than this reader; not read: brand_new"
    ]
    queryable.undeclare()


@pytest.mark.parametrize(
    "answer", [b"no json", b"[]", b'{"layouts": 3}', b'{"layouts": [{"wire": 9, "fields": [1, 2]}]}']
)
def test_layout_that_nobody_explains_is_invalid(client: Client, raw: Session, answer: bytes) -> None:
    """A hostile or broken answer about a layout is as good as none: the payload is counted as invalid."""
    key = "nedbus/@schema/VehicleLocalPosition"

    def reply(query: zenoh.Query) -> None:
        with query:
            query.reply(key, answer)

    queryable = raw.declare_queryable(key, zenoh.handlers.Callback(reply, indirect=False))
    subscription = client.subscribe(VLP, mode="every")
    wait_for_reader(raw, "nedbus/1/vehicle_local_position")
    raw.put("nedbus/1/vehicle_local_position", msgpack.packb([9, 1, 2]))
    raw.put("nedbus/1/vehicle_local_position", encode(message(2)))
    assert subscription.receive(DEADLINE).message.timestamp == 2
    assert subscription.counts.invalid == 1
    queryable.undeclare()


def test_publish_takes_messages_and_fields(client: Client, bus: nedbus.Bus) -> None:
    """Fields by name are validated; what is no message is refused before it is sent."""
    publisher = client.publisher(VLP, vehicle="1")
    publisher.publish({"timestamp": 4, "x": 1.0})
    wait_for(lambda: [sample.message.x for sample in bus.latest(VLP)] == [1.0], what="the message")
    with pytest.raises(ValueError, match="xy_valid"):
        publisher.publish({"timestamp": 5, "xy_valid": True})
    assert bus.latest(VLP)[0].message.timestamp == 4
    assert publisher.published == 1


def test_two_publishers_of_one_address_are_refused(client: Client) -> None:
    """Two sources of one key would mix two flights into one."""
    publisher = client.publisher(VLP, vehicle="1")
    with pytest.raises(nedbus.AddressInUseError, match="1/vehicle_local_position is published by this process already"):
        client.publisher(VLP, vehicle="1")
    publisher.publish(message(1))


def test_wrong_names_are_refused_before_anything_is_sent(client: Client) -> None:
    """A typo in a topic or vehicle is an AddressError at once, not a silent subscription."""
    with pytest.raises(nedbus.AddressError, match="vehicle_local_positon"):
        client.subscribe("vehicle_local_positon")
    with pytest.raises(nedbus.AddressError, match="vehicle"):
        client.latest(vehicle="a/b")
    with pytest.raises(
        nedbus.AddressError, match=r"vehicle \['1', '2'\] .* one name, .* several vehicles need a call each"
    ):
        client.subscribe(vehicle=["1", "2"])  # type: ignore[arg-type] # that is the mistake
    with pytest.raises(nedbus.AddressError, match="instance"):
        client.publisher("estimator_local_position", vehicle="1")


def test_nothing_listening_is_a_clear_error() -> None:
    """The error is a ConnectionError, and says where, for how long, and what to do."""
    where = free_endpoint()
    with pytest.raises(
        nedbus.ConnectError, match=rf"nothing answers at {where} .*nedbus serve.*NEDBUS_CONNECT"
    ) as info:
        nedbus.connect(where, timeout=0.1)
    assert isinstance(info.value, ConnectionError)


@pytest.mark.parametrize("is_async", [False, True])
def test_connecting_without_a_timeout_waits_for_a_router(*, is_async: bool) -> None:
    """`timeout=None` waits for a router, for as long as it takes."""
    where = free_endpoint()

    async def connect_async() -> bool:
        async with nedbus.connect_async(where, timeout=None) as bus:
            return bus.connected

    def connect() -> bool:
        with nedbus.connect(where, timeout=None) as bus:
            return bus.connected

    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit((lambda: asyncio.run(connect_async())) if is_async else connect)
        with pytest.raises(TimeoutError):
            waiting.result(0.5)
        router = open_router(listen=(where,))
        assert waiting.result(DEADLINE)
    router.close()


def test_second_endpoint_is_taken_when_the_first_is_dead(endpoint: str) -> None:
    """Several endpoints are several chances."""
    with nedbus.connect([free_endpoint(), endpoint]) as bus:
        assert bus.connected


def test_bus_finds_its_router_in_the_environment(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """NEDBUS_CONNECT is for scripts that should not name a router."""
    monkeypatch.setenv("NEDBUS_CONNECT", endpoint)
    with nedbus.connect() as bus:
        assert bus.connected


def test_prefix_separates(endpoint: str) -> None:
    """Two fleets on one router do not see each other."""
    with nedbus.connect(endpoint, prefix="fleet/a") as one, nedbus.connect(endpoint, prefix="fleet/b") as two:
        one.publisher(VLP, vehicle="1").publish(message(1))
        assert [sample.vehicle for sample in one.latest("*")] == ["1"]
        assert list(one.vehicles()) == ["1"]
        assert two.latest("*") == []
        assert two.vehicles() == {}


def test_async_reader_lets_others_run(endpoint: str, bus: nedbus.Bus) -> None:
    """A reader that always finds a sample still gives way to the loop."""
    publisher = bus.publisher(VLP, vehicle="1")

    async def scenario() -> int:
        turns = 0

        async def count_turns() -> None:
            nonlocal turns
            while True:
                turns += 1
                await asyncio.sleep(0)

        async with nedbus.connect_async(endpoint) as other, other.subscribe(VLP, mode="every") as subscription:
            await asyncio.to_thread(wait_for_reader, bus._session, publisher.key)
            for timestamp in range(1, 1001):
                publisher.publish(message(timestamp))
            counter = asyncio.create_task(count_turns())
            taken = 0
            async for _ in subscription:
                taken += 1
                if taken == 900:
                    break
            counter.cancel()
        return turns

    assert asyncio.run(scenario()) > 5


def test_latest_keeps_the_newest_of_a_quiet_key(client: Client, bus: nedbus.Bus) -> None:
    """A busy vehicle does not push a quiet one out while the reader pauses, and everything is counted."""
    busy, quiet = (bus.publisher(VLP, vehicle=vehicle) for vehicle in ("busy", "quiet"))
    busy.publish(message(1))
    subscription = client.subscribe(VLP)
    assert subscription.receive(DEADLINE).vehicle == "busy"
    quiet.publish(message(1))
    for timestamp in range(2, 3001):
        busy.publish(message(timestamp))
    wait_for(lambda: sum(vars_of(subscription.counts)) >= 2999, what="all but the two newest to be counted")
    newest = {sample.vehicle: sample.message.timestamp for sample in subscription.take(2)}
    assert newest == {"busy": 3000, "quiet": 1}
    counts = subscription.counts
    assert counts.received + counts.dropped + counts.lost == 3001


def vars_of(counts: nedbus.Counts) -> tuple[int, ...]:
    return counts.received, counts.lost, counts.dropped, counts.invalid


def test_counts_survive_a_restart_of_the_publisher(client: Client, endpoint: str) -> None:
    """Another publisher of the same key starts its own sequence: nothing is lost, nothing is dropped."""
    subscription = client.subscribe(VLP, mode="every")
    for start in (1, 1001):
        with nedbus.connect(endpoint) as other:
            publisher = other.publisher(VLP, vehicle="1")
            wait_for_reader(other._session, publisher.key)
            for timestamp in range(start, start + 1000):
                publisher.publish(message(timestamp))
            taken = subscription.take(1000)
        assert [sample.message.timestamp for sample in taken] == list(range(start, start + 1000))
        assert not any(sample.lost for sample in taken)
    assert subscription.counts == nedbus.Counts(received=2000)


def test_two_publishers_of_one_key_lose_nothing(client: Client, bus: nedbus.Bus, endpoint: str) -> None:
    """Their sequences are followed apart."""
    subscription = client.subscribe(VLP, mode="every")
    with nedbus.connect(endpoint) as other:
        publishers = [each.publisher(VLP, vehicle="1") for each in (bus, other)]
        wait_for_reader(other._session, publishers[1].key)
        wait_for_reader(bus._session, publishers[0].key)
        for timestamp in range(1, 501):
            for publisher in publishers:
                publisher.publish(message(timestamp))
        taken = subscription.take(1000)
    assert sum(sample.lost for sample in taken) == 0
    assert subscription.counts == nedbus.Counts(received=1000)


def answers(raw: Session, key: str) -> int:
    """Count the answers to a plain get."""
    return sum(reply.ok is not None for reply in raw.get(key))


def test_two_processes_of_one_vehicle_both_answer(bus: nedbus.Bus, endpoint: str, raw: Session) -> None:
    """A plain get is answered by whoever publishes the key, also when another publishes the same vehicle."""
    with nedbus.connect(endpoint) as other:
        bus.publisher(VLP, vehicle="1").publish(message(1))
        other.publisher("external_ins_local_position", vehicle="1").publish(message(2))
        for key in ("nedbus/1/vehicle_local_position", "nedbus/1/external_ins_local_position"):
            wait_for(partial(answers, raw, key), what=key)


def test_closed_publisher_is_gone(client: Client, bus: nedbus.Bus) -> None:
    """A publisher that was closed is not listed, answers no more, refuses to publish, and makes room for another."""
    publisher = client.publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    wait_for(bus.latest, what="the message")
    publisher.close()
    publisher.close()
    assert client.latest("*") == []
    wait_for(lambda: not bus.vehicles(), what="the vehicle to go")
    with pytest.raises(nedbus.ClosedError):
        publisher.publish(message(2))
    with client.publisher(VLP, vehicle="1") as again:
        again.publish(message(3))


def test_publisher_keeps_its_bus_open(endpoint: str, bus: nedbus.Bus) -> None:
    """A script may hold the publisher alone."""
    publisher = nedbus.connect(endpoint).publisher(VLP, vehicle="1")
    gc.collect()
    publisher.publish(message(1))
    wait_for(bus.latest, what="the message")
    assert isinstance(publisher._owner, nedbus.Bus)
    publisher._owner.close()


def test_async_timeouts_lose_nothing(endpoint: str, bus: nedbus.Bus) -> None:
    """A receive that times out has taken nothing."""
    publisher = bus.publisher(VLP, vehicle="1")
    publisher.publish(message(1))

    async def scenario() -> list[int]:
        taken: list[int] = []
        async with nedbus.connect_async(endpoint) as other, other.subscribe(VLP, mode="every") as subscription:
            taken.append((await subscription.receive(DEADLINE)).message.timestamp)
            for timestamp in range(2, 641):
                publisher.publish(message(timestamp))
            while taken[-1] != 640:
                try:
                    taken.append((await subscription.receive(0.0001)).message.timestamp)
                except nedbus.NoDataError:
                    continue
        return taken

    assert asyncio.run(scenario()) == list(range(1, 641))


def test_unknown_layout_does_not_hold_the_reader(client: Client, raw: Session, bus: nedbus.Bus) -> None:
    """Twenty layouts that nobody explains cost the reader nothing but counts."""
    publisher = bus.publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    subscription = client.subscribe(VLP, mode="every")
    assert subscription.receive(DEADLINE).message.timestamp == 1
    for layout in range(100, 120):
        raw.put("nedbus/2/vehicle_local_position", msgpack.packb([layout, 1, 2]))
    wait_for(lambda: subscription.counts.invalid == 20, what="twenty invalid payloads")


@pytest.mark.parametrize("mode", BOTH)
def test_peer_that_never_answers_silences_no_reader(bus: nedbus.Bus, raw: Session, mode: Mode) -> None:
    """It sends unknown layouts, and holds the question for them: others are read meanwhile, and it is asked once."""
    held = raw.declare_queryable("nedbus/@schema/VehicleLocalPosition", zenoh.handlers.RingChannel(100))
    publisher = bus.publisher(VLP, vehicle="1")
    subscription = bus.subscribe(VLP, mode=mode)
    wait_for_reader(raw, "nedbus/2/vehicle_local_position")
    for layout in range(100, 150):
        raw.put("nedbus/2/vehicle_local_position", msgpack.packb([layout, 1, 2]))
    wait_for(lambda: subscription.waiting or subscription.counts.invalid, what="the first of them")
    publisher.publish(message(1))
    assert subscription.receive(DEADLINE).message.timestamp == 1
    wait_for(lambda: subscription.counts.invalid == 50, what="all of them")
    questions = []
    while (question := held.handler.try_recv()) is not None:
        questions.append(question)
    assert len(questions) <= 1


def test_hostile_answers_do_not_reach_a_script(client: Client, raw: Session, caplog: pytest.LogCaptureFixture) -> None:
    """A status that is no JSON, or nested without end, is left out, with one line for all of them."""

    def reply(query: zenoh.Query) -> None:
        with query:
            query.reply("nedbus/@service/evil/status", b"[" * 100_000)
            for number in range(20):
                query.reply(f"nedbus/@service/{'x' * 30_000}{number}/status", b"junk")

    queryable = raw.declare_queryable("nedbus/@service/*/status", zenoh.handlers.Callback(reply, indirect=False))
    assert client.services() == []
    queryable.undeclare()
    warned = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert [text.endswith(": an answer that is not JSON") and len(text) < 1000 for text in warned] == [True]


@contextlib.contextmanager
def answering(raw: Session, answers: Mapping[str, bytes]) -> Iterator[None]:
    """Answer each question for services with all of these, by the name of a service."""

    def reply(query: zenoh.Query) -> None:
        with query:
            for name, payload in answers.items():
                query.reply(f"nedbus/@service/{name}/status", payload)

    queryable = raw.declare_queryable("nedbus/@service/*/status", zenoh.handlers.Callback(reply, indirect=False))
    yield
    queryable.undeclare()


def test_status_that_grows_when_it_is_read_fills_no_memory(
    bus: nedbus.Bus, raw: Session, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """JSON may take up 30 times its length: of 480 kB, what is beyond 4 MiB is left out, and that is logged."""
    monkeypatch.setattr("nedbus.client.discovery._MAX_CONTENT", 2**22, raising=False)
    large = b'{"a": [' + 8_000 * b"{}," + b"0]}"
    with answering(raw, {**{f"evil{number}": large for number in range(20)}, "honest": b'{"host": "honest"}'}):
        services = bus.services(timeout=DEADLINE)
    assert len(services) == 3
    assert {"host": "honest"} in services
    assert "18 services are left out: their answers are too large" in caplog.messages


def test_answers_that_are_too_many_are_left_out(
    bus: nedbus.Bus, raw: Session, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The bytes that are kept of one question are bounded, and the log says how many answers were left out."""
    monkeypatch.setattr("nedbus.transport.queries._MAX_BYTES", 10_500)
    status = b'{"a": "' + 950 * b"x" + b'"}'
    with answering(raw, {f"evil{number:02}": status for number in range(50)}):
        assert len(bus.services(timeout=DEADLINE)) == 10
    assert "nedbus/@service/*/status: 40 answers too many are left out" in caplog.messages


def test_junk_does_not_displace_a_waiting_sample(client: Client, raw: Session, bus: nedbus.Bus) -> None:
    """Mode "latest" gives the newest valid sample, though junk came after it on the same key."""
    publisher = bus.publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    subscription = client.subscribe(VLP)
    assert subscription.receive(DEADLINE).message.timestamp == 1
    publisher.publish(message(2))
    raw.put(publisher.key, b"junk")
    wait_for(lambda: subscription.counts.invalid == 1, what="the junk to be counted")
    assert subscription.receive(DEADLINE).message.timestamp == 2


def test_wrong_mode_is_refused(client: Client) -> None:
    """A typo in the mode must not become another mode."""
    with pytest.raises(nedbus.AddressError, match="mode 'newest' is not valid: expected one of latest, every"):
        client.subscribe("*", mode=cast("Mode", "newest"))


@pytest.mark.parametrize("timeout", [0.0, -1.0, float("inf")])
def test_any_timeout_is_taken(bus: nedbus.Bus, timeout: float) -> None:
    """None of these is an error of another library."""
    bus.publisher(VLP, vehicle="1").publish(message(1))
    bus.latest("*", timeout=timeout)
    bus.vehicles(timeout=timeout)
    subscription = bus.subscribe()
    taken: list[nedbus.Sample] = []

    def receive() -> list[nedbus.Sample]:
        with contextlib.suppress(nedbus.NoDataError):
            taken.append(subscription.receive(timeout))
        return taken

    wait_for(receive, what="the message, which a receive without patience gets once it is there")
    assert taken[0].message.timestamp == 1


def test_cancelled_opening_opens_once(endpoint: str, bus: nedbus.Bus) -> None:
    """Receives that are cancelled while the subscription opens leave one subscriber, and no message comes twice."""
    publisher = bus.publisher(VLP, vehicle="1")

    async def scenario() -> list[int]:
        async with nedbus.connect_async(endpoint) as other:
            subscription = other.subscribe(mode="every")
            for _ in range(3):
                task = asyncio.create_task(subscription.receive())
                await asyncio.sleep(0)
                await asyncio.sleep(0)
                task.cancel()
            publisher.publish(message(1))
            taken = [(await subscription.receive(DEADLINE)).message.timestamp]
            publisher.publish(message(2))
            taken.append((await subscription.receive(DEADLINE)).message.timestamp)
            assert len(other._opened()._subscribers) == 1
            return taken

    assert asyncio.run(scenario()) == [1, 2]


def test_timeout_includes_the_opening() -> None:
    """A receive with a timeout does not wait longer for the router, which is away, than for a message."""
    where = free_endpoint()
    router = open_router(listen=(where,))

    async def scenario() -> None:
        async with nedbus.connect_async(where) as bus:
            subscription = bus.subscribe(mode="every")
            await asyncio.to_thread(router.close)
            with pytest.raises(nedbus.NoDataError):  # and not ConnectError, after 3 s
                await subscription.receive(0.01)

    asyncio.run(scenario())


def test_forgotten_bus_is_closed(endpoint: str, raw: Session) -> None:
    """A bus that nobody refers to any more is closed, with its publishers, and not only when the process ends."""
    forgotten = nedbus.connect(endpoint)
    publisher = forgotten.publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    subscription = forgotten.subscribe(mode="every")
    gone = weakref.ref(forgotten)
    wait_for(lambda: len(list(raw.liveliness().get("nedbus/*/@alive/**"))) == 1, what="the vehicle")
    del forgotten, publisher, subscription
    gc.collect()
    assert gone() is None
    wait_for(lambda: not list(raw.liveliness().get("nedbus/*/@alive/**")), what="the vehicle to go")


def test_collecting_garbage_never_closes(endpoint: str) -> None:
    """Garbage is collected in any thread, with any lock held: the closing, which waits, is done by another."""
    subscription = nedbus.connect(endpoint).subscribe()
    receive_queue = subscription._queue
    with receive_queue._lock:  # as a thread holds it that is in the midst of something
        del subscription
        gc.collect()  # a closing in this thread would wait for the lock for ever
    wait_for(lambda: receive_queue.ended, what="the end of the subscription")


@pytest.mark.parametrize(
    "ask", ["bus.latest()", "bus.subscribe()", "publisher.publish({'timestamp': 2})", "next(subscription)"]
)
def test_forked_process_is_told_at_once(start: Start, endpoint: str, ask: str) -> None:
    """Zenoh does not survive a fork: in the child everything raises ForkError, and the child still ends."""
    code = f"""
import os, sys
import nedbus
bus = nedbus.connect()
subscription = bus.subscribe()
publisher = bus.publisher("vehicle_local_position", vehicle="1")
publisher.publish({{"timestamp": 1}})
if child := os.fork():
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
for ask in (lambda: {ask}, nedbus.connect):
    try:
        ask()
    except nedbus.ForkError as exc:
        print(exc)
sys.exit(7)
"""
    process = start("-c", code, NEDBUS_CONNECT=endpoint, measured=False)
    assert process.wait() == 7, process.err
    assert process.out.count("start processes with multiprocessing.get_context('spawn')") == 2
    assert "Traceback" not in process.err


def test_live_answer_wins_over_a_stored_one(client: Client, bus: nedbus.Bus, raw: Session) -> None:
    """A storage that kept a message with a later time, of the vehicle's last run, does not hide the live one."""
    later = zenoh.Timestamp(dt.datetime.now(dt.UTC) + dt.timedelta(hours=1), b"\x07")

    def reply(query: zenoh.Query) -> None:
        with query:
            for vehicle in "12":
                query.reply(f"nedbus/{vehicle}/{VLP}", encode(message(99)), timestamp=later)

    storage = raw.declare_queryable("nedbus/*/vehicle_local_position", zenoh.handlers.Callback(reply, indirect=False))
    bus.publisher(VLP, vehicle="1").publish(message(1))

    def answers() -> list[tuple[str, int, bool]]:
        return [(sample.vehicle, sample.message.timestamp, sample.stored) for sample in client.latest()]

    wait_for(lambda: answers() == [("1", 1, False), ("2", 99, True)], what="the live one and the stored one")
    storage.undeclare()


def test_last_value_in_a_newer_layout_is_read(client: Client, raw: Session) -> None:
    """What `subscribe` can read, `latest` reads as well: a layout that its publisher explains."""
    layout = {"wire": 9, "fields": [{"name": name} for name in ("timestamp", "brand_new", "x")]}

    def reply(query: zenoh.Query) -> None:
        with query:
            if "@schema" in str(query.key_expr):
                query.reply("nedbus/@schema/VehicleLocalPosition", json.dumps({"layouts": [layout]}))
            else:
                query.reply(f"nedbus/1/{VLP}", msgpack.packb([9, 5, True, 2.5]))

    keys = ("nedbus/@schema/VehicleLocalPosition", f"nedbus/1/{VLP}")
    queryables = [raw.declare_queryable(key, zenoh.handlers.Callback(reply, indirect=False)) for key in keys]
    wait_for(lambda: [sample.message.x for sample in client.latest()] == [2.5], what="the message")
    for queryable in queryables:
        queryable.undeclare()


def test_vehicle_may_be_a_number(client: Client, bus: nedbus.Bus) -> None:
    """A MAVLink system id names a vehicle as it does in the settings."""
    bus.publisher(VLP, vehicle=7).publish(message(1))
    assert client.subscribe(vehicle=7).receive(DEADLINE).vehicle == "7"
    assert [sample.vehicle for sample in client.latest(vehicle=7)] == ["7"]
    assert client.latest(vehicle=8) == []


def test_single_message_reaches_whoever_subscribes_next(client: Client, bus: nedbus.Bus) -> None:
    """The router knows a publisher before it can publish: else one of 300 was never seen, beside three busy loops."""
    for vehicle in range(100):
        bus.publisher(VLP, vehicle=vehicle).publish(message(1))
        assert client.subscribe(vehicle=vehicle).receive(DEADLINE).message.timestamp == 1


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda sample: pickle.loads(pickle.dumps(sample))])
def test_sample_can_be_copied_pickled_and_hashed(bus: nedbus.Bus, copied: Callable[[object], nedbus.Sample]) -> None:
    """A script may queue samples for another process, or keep them in a set; the time when it was sent stays exact."""
    bus.publisher(VLP, vehicle="1", source="test").publish(message(1, x=math.nan))
    sample = bus.subscribe().receive(DEADLINE)
    again = copied(sample)
    assert again == sample
    assert (again.sent, again.source, again.missing) == (sample.sent, "test", sample.missing)
    assert len({sample, again}) == 1
    assert again != nedbus.Sample(sample.message, sample.address, sample.received)


@pytest.mark.parametrize("mode", BOTH)
def test_two_threads_may_read_one_subscription(bus: nedbus.Bus, mode: Mode) -> None:
    """Each message goes to one of them, and neither fails, in either mode."""
    publisher = bus.publisher(VLP, vehicle="1")
    subscription = bus.subscribe(mode=mode)
    wait_for_reader(bus._session, publisher.key)
    taken: list[int] = []

    def read() -> None:
        taken.extend(sample.message.timestamp for sample in subscription)

    threads = [threading.Thread(target=read) for _ in range(4)]
    for thread in threads:
        thread.start()
    for timestamp in range(1, 2001):
        publisher.publish(message(timestamp))
    wait_for(lambda: 2000 in taken, what="the last message")
    if mode == "every":
        wait_for(lambda: len(taken) == 2000, what="all others")
    subscription.close()
    for thread in threads:
        thread.join(DEADLINE)
        assert not thread.is_alive()
    assert len(taken) == len(set(taken)) == subscription.counts.received


def test_unexpected_error_in_the_pump_is_counted(
    bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A bug that one sample triggers is logged and counted; the sample is asked for again, and the reader goes on."""
    publisher = bus.publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    subscription = bus.subscribe(mode="every")
    assert subscription.receive(DEADLINE).message.timestamp == 1
    with monkeypatch.context() as patched:
        patched.setattr(subscription._queue._decoder, "admit", lambda _: 1 / 0)
        publisher.publish(message(2))
        wait_for(lambda: subscription.counts.invalid == 1, what="the sample to be counted")
    publisher.publish(message(3))
    assert [subscription.receive(DEADLINE).message.timestamp for _ in range(2)] == [2, 3]
    assert any("left out after an unexpected error" in text for text in caplog.messages)


def test_unexpected_error_in_an_answer_leaves_others_answered(
    bus: nedbus.Bus, raw: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The thread that answers queries survives a bug in one answer."""
    publisher = bus.publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    wait_for(partial(answers, raw, publisher.key), what="an answer")
    with monkeypatch.context() as patched:
        patched.setattr(nedbus.Publisher, "last", property(lambda _: 1 / 0), raising=False)
        assert answers(raw, publisher.key) == 0
    assert answers(raw, publisher.key) == 1


def test_vehicles_are_asked_for_once(bus: nedbus.Bus, endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Asking for all tokens costs everybody on the router: whoever asks again and again only follows them."""
    asked: list[str] = []

    def ask(session: Session, key_expr: str, *, timeout: float) -> tuple[list[str], bool]:
        asked.append(key_expr)
        return ask_alive_keys(session, key_expr, timeout=timeout)

    monkeypatch.setattr("nedbus.client.vehicle_directory.ask_alive_keys", ask)
    with nedbus.connect(endpoint) as other:
        for count, vehicle in enumerate("abc", 1):
            other.publisher(VLP, vehicle=vehicle)
            wait_for(partial(has_vehicles, bus, count), what=f"vehicle {vehicle}")
    wait_for(lambda: not bus.vehicles(), what="the vehicles to go")
    assert asked == ["nedbus/*/@alive/**"]


def test_incomplete_list_of_vehicles_is_said(
    bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """With more tokens than are kept, or a router that is too slow to list them, what is known is no whole list."""
    monkeypatch.setattr(
        "nedbus.client.vehicle_directory.ask_alive_keys", lambda *_, timeout: ([f"nedbus/1/@alive/{VLP}"], False)
    )
    assert list(bus.vehicles()) == list(bus.vehicles()) == ["1"]
    assert len([text for text in caplog.messages if "not all liveliness tokens are known" in text]) == 1
