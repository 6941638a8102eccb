"""The newest message of each stream: of any samples, and of a bus."""

from __future__ import annotations

import asyncio
import dataclasses
import gc
import math
import threading
import time
import weakref
from types import SimpleNamespace

import pytest

import nedbus
from nedbus import Sample, SensorGps, VehicleAttitude, limits
from nedbus.errors import AddressError, ArgumentError, ClosedError, ReceiveError
from nedbus.health import Monitor
from nedbus.timings import Timings
from nedbus.transport import open_router
from nedbus_msgs import Address
from tests.flights.messages import VLP, message
from tests.nedbus.client.numbered import publish, wait_for_subscriber
from tests.peers.ports import free_endpoint
from tests.peers.processes import Start
from tests.waits import DEADLINE, wait_for

SECOND = 1_000_000_000
ATTITUDE = VehicleAttitude(timestamp=7, q=(1.0, 0.0, 0.0, 0.0))
PUBLISHING = """
import sys, nedbus
with nedbus.connect(sys.argv[1]) as bus, bus.publisher("vehicle_local_position", vehicle="1") as publisher:
    publisher.publish({"timestamp": 5})
    print("published", flush=True)
    sys.stdin.read()
"""


def sample(vehicle: str, timestamp: int = 0) -> Sample:
    return Sample(message(timestamp), Address(vehicle, VLP), received=time.time_ns())


@pytest.mark.parametrize("step", [3600, -3600])
def test_health_ignores_wall_clock_steps(monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    """Rate and age use the monotonic clock: setting the wall clock between arrival and reading changes nothing."""
    now, utc, address = 10_000 * SECOND, 10_000 * SECOND, Address("1", VLP)
    monkeypatch.setattr("time.monotonic_ns", lambda: now)
    monkeypatch.setattr("nedbus.clock.utc_ns", lambda: utc)
    monitor = Monitor()
    for index in range(300):
        now, utc = now + SECOND // 100, utc + SECOND // 100
        arrived = dataclasses.replace(sample("1", index * 10_000), received=utc)
        utc += step * SECOND * (index == 150)
        monitor.add(arrived)
    assert monitor.snapshot()[address].rate == pytest.approx(100.0)
    now += 7 * SECOND
    health = monitor.snapshot()[address]
    assert health.rate is None
    assert health.age == pytest.approx(7.0)


@pytest.mark.parametrize("step", [3600, -3600])
def test_age_ignores_a_wall_clock_step_before_reading(
    monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    """A message that waits while the wall clock is set has its real age, not that of the message before it."""
    now = utc = 10_000 * SECOND
    monkeypatch.setattr("time.monotonic_ns", lambda: now)
    monkeypatch.setattr("nedbus.clock.utc_ns", lambda: utc)
    monitor = Monitor()
    monitor.add(dataclasses.replace(sample("1"), received=utc))
    now, utc = now + 5 * SECOND, utc + 5 * SECOND
    waiting = dataclasses.replace(sample("1"), received=utc)
    now, utc = now + 2 * SECOND, utc + (2 + step) * SECOND
    monitor.add(waiting)
    age = monitor[Address("1", VLP)].age
    assert age == pytest.approx(2.0 if step > 0 else 0.0)  # a step back hides how long it waited


def test_rate_is_measured_at_arrival(monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples that queue up while a reader starts, and that it then reads together, do not raise the rate."""
    now, start, address = 0, time.time_ns(), Address("1", VLP)
    monkeypatch.setattr("time.monotonic_ns", lambda: now)
    monkeypatch.setattr("nedbus.clock.utc_ns", lambda: start + now)
    monitor, now = Monitor(), SECOND
    for index in range(151):
        arrival = SECOND // 2 + index * SECOND // 100
        now = max(now, arrival)
        monitor.add(dataclasses.replace(sample("1", index * 10_000), received=start + arrival))
    assert monitor.snapshot()[address].rate == pytest.approx(100.0)


@pytest.mark.slow
def test_number_of_monitored_streams_is_bounded() -> None:
    """In a flood of keys, the monitor keeps the 10,000 most recently updated streams, including an active one."""
    monitor, real = Monitor(), sample("real")
    flood = [
        dataclasses.replace(real, address=Address(f"flood-{number}", VLP))
        for number in range(10_900)
    ]
    for number, each in enumerate(flood):
        monitor.add(each)
        if number % 10 == 0:
            monitor.add(real)
    streams = monitor.snapshot()
    assert (len(streams), streams[real.address].messages, monitor.evicted) == (
        limits.KEYS,
        1090,
        10_901 - limits.KEYS,
    )
    assert flood[1 - limits.KEYS].address in streams
    assert flood[-limits.KEYS].address not in streams
    monitor.forget(real.address)
    assert real.address not in monitor.snapshot()


def test_retained_sample_is_not_measured() -> None:
    """Measurement of a stream starts with its first live sample, because a retained one may have any age."""
    monitor, first = Monitor(), sample("1")
    assert not monitor.add(dataclasses.replace(first, retained=True))
    assert monitor.snapshot() == {}
    assert monitor.add(first)
    assert monitor.snapshot()[first.address].messages == 1


def test_retained_sample_is_shown_until_a_live_one() -> None:
    """Its age is the time since it was sent, infinite without a time; it replaces older retained messages only."""
    monitor, now = Monitor(), time.time_ns()
    retained = [
        dataclasses.replace(
            sample("1", number), retained=True, _sent=None if age is None else now - age * SECOND
        )
        for number, age in enumerate((None, 60, 90, 50, 2))
    ]
    shown = []
    for each in retained[:4]:
        monitor.add(each)
        shown.append(monitor[VLP].message.timestamp)
    assert shown == [0, 1, 1, 3]
    assert monitor[VLP].age == pytest.approx(50.0, abs=5.0)
    assert not monitor[VLP].alive
    monitor.add(sample("1", 9))
    monitor.add(retained[4])
    assert monitor[VLP].message.timestamp == 9
    assert monitor[VLP].age < 5.0
    assert monitor[VLP].alive
    monitor.forget(Address("1", VLP))
    monitor.add(retained[0])
    assert monitor[VLP].age == math.inf


def test_stream_is_selected_by_address_class_or_topic() -> None:
    """A class or topic selects the only stream of this topic; an error names the streams if there are several."""
    monitor, first = Monitor(), sample("1", 1)
    assert monitor.get(VLP) is None
    with pytest.raises(KeyError):
        monitor[nedbus.VehicleLocalPosition]
    monitor.add(first)
    assert monitor[VLP] is monitor[nedbus.VehicleLocalPosition] is monitor[first.address]
    assert monitor.get(VehicleAttitude) is None
    monitor.add(sample("2", 2))
    for several in (VLP, nedbus.VehicleLocalPosition):
        with pytest.raises(
            ArgumentError,
            match=f"has several streams: expected an address, such as 1/{VLP}, 2/{VLP}",
        ):
            monitor.get(several)
    assert [(str(address), each.message.timestamp) for address, each in monitor.items()] == [
        (f"1/{VLP}", 1),
        (f"2/{VLP}", 2),
    ]
    monitor.forget(first.address)
    assert monitor[VLP].message.timestamp == 2
    with pytest.raises(AddressError):
        monitor.get(3)  # type: ignore[call-overload] # not an address


@pytest.mark.parametrize(
    ("topic", "silence", "network", "alive"),
    [
        (VLP, 0.9, (False, 0), True),  # too early to tell
        (VLP, 1.1, (True, 1), True),
        (VLP, 1.1, (True, 0), False),
        (VLP, 1.1, (False, 1), False),
        (VLP, 3.1, (True, 1), False),
        (VLP, 3.1, (True, None), False),
        ("home_position", 3600.0, (True, 1), True),
        ("home_position", 3600.0, (True, None), True),
        ("home_position", 1.1, (True, 0), False),
    ],
)
def test_stream_is_alive_unless_disconnected_gone_or_stale(
    monkeypatch: pytest.MonkeyPatch,
    topic: str,
    silence: float,
    network: tuple[bool, int | None],
    alive: bool,
) -> None:
    """The rule is that of `stream_state`, after the first second; None publishers: their list is incomplete."""
    (connected, publishers), now, start = network, 0, time.time_ns()
    monkeypatch.setattr("time.monotonic_ns", lambda: now)
    monkeypatch.setattr("nedbus.clock.utc_ns", lambda: start + now)
    monitor, address = Monitor(), Address("1", topic)
    listed = nedbus.health.Publishers({address: publishers or 0})
    listed.complete = publishers is not None
    monitor._view.ask = lambda: (connected, listed)
    fields = message(1) if topic == VLP else nedbus.HomePosition(timestamp=1)
    for _ in range(10):
        now += SECOND // 100
        monitor.add(Sample(fields, address, start + now))
    now += round(silence * SECOND)
    stream = monitor[address]
    assert stream.age == pytest.approx(silence)
    assert stream.alive is alive
    state = nedbus.client.stream_state(stream.health, publishers=publishers, connected=connected)
    assert silence < 1.0 or alive is (state.name not in ("disconnected", "gone", "stale"))


def test_network_is_asked_once_per_second_at_most() -> None:
    """However many streams are silent, a loop asks for the link and the publishers once per second, if at all."""
    monitor, asked = Monitor(), list[int]()

    def ask() -> tuple[bool, nedbus.health.Publishers]:
        asked.append(1)
        return True, nedbus.health.Publishers()

    monitor._view.ask = ask
    for vehicle in range(100):
        monitor.add(sample(str(vehicle)))
    assert all(each.alive for each in monitor.values())
    assert not asked
    for vehicle in range(100):
        monitor.add(
            dataclasses.replace(sample(f"old-{vehicle}"), received=0, retained=True, _sent=0)
        )
    begin = time.monotonic()
    assert sum(each.alive for each in monitor.values()) == 100
    assert len(asked) <= 1 + time.monotonic() - begin


def test_network_is_asked_again_after_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """The answer about link and publishers holds for a second: a view notices a publisher that has left by then."""
    now, publishers = 1000.0, nedbus.health.Publishers({Address("1", VLP): 1})
    monkeypatch.setattr("time.monotonic", lambda: now)
    monkeypatch.setattr("time.monotonic_ns", lambda: round(now * SECOND))
    monitor = Monitor()
    monitor._view.ask = lambda: (True, publishers)
    monitor.add(sample("1"))
    stream = monitor[Address("1", VLP)]
    now += 1.5
    assert stream.alive
    publishers = nedbus.health.Publishers()
    now += 0.4
    assert stream.alive
    now += 0.7
    assert not stream.alive


def test_messages_are_read_while_others_are_added(monkeypatch: pytest.MonkeyPatch) -> None:
    """One thread adds and evicts streams; others iterate, look up and measure meanwhile."""
    monkeypatch.setattr("nedbus.limits.KEYS", 20)
    monitor, first = Monitor(), sample("1")

    def add() -> None:
        for number in range(3000):
            monitor.add(dataclasses.replace(first, address=Address(f"v{number % 50}", VLP)))

    adding = threading.Thread(target=add)
    adding.start()
    while adding.is_alive():
        assert all(each.age >= 0 for _, each in monitor.items())
        assert len(monitor.snapshot()) <= 20
        assert len(list(monitor)) <= 20
    adding.join()
    assert {address.vehicle for address in monitor} == {f"v{number}" for number in range(30, 50)}


def test_only_the_last_added_stream_of_a_monitor_is_updated() -> None:
    """`updated` of a Monitor is true for the stream of the last `add`, until another one is added."""
    monitor = Monitor()
    monitor.add(sample("7"))
    assert [monitor[Address("7", VLP)].updated] == [True]
    monitor.add(sample("8"))
    assert [each.updated for each in monitor.values()] == [False, True]


def test_update_lists_a_stream_once(bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stream of which `update` reads two messages, one it waited for and one behind it, is listed once."""
    with bus.newest(nedbus.VehicleLocalPosition) as view:
        waited = sample("1", 5)
        arrived = [sample("1", 6), sample("2", 7)]
        inbox = SimpleNamespace(ended=False, waiting=2, pop=lambda: arrived.pop(0))
        monkeypatch.setattr(view, "_inbox", inbox)
        news = view._read(waited)
        assert [(each.sample.vehicle, each.message.timestamp) for each in news] == [
            ("1", 6),
            ("2", 7),
        ]


def test_loop_reads_the_newest_message_of_each_stream(client: nedbus.Bus, bus: nedbus.Bus) -> None:
    """`update` returns the streams with news; each has its newest message, `updated` until the next update."""
    with (
        bus.publisher(VehicleAttitude, vehicle=1) as attitude,
        bus.publisher("sensor_gps", vehicle=1, instance=0) as gps,
        bus.publisher(VLP, vehicle=1) as other,
    ):
        attitude.publish(ATTITUDE)
        other.publish(message(1))
        with client.newest(VehicleAttitude, "sensor_gps", vehicle=1) as view:
            assert [each.sample.topic for each in view.update(DEADLINE)] == ["vehicle_attitude"]
            retained = view[VehicleAttitude]
            assert (retained.message, retained.sample.retained, retained.updated) == (
                ATTITUDE,
                True,
                True,
            )
            assert retained.alive
            assert view.update() == []
            assert not retained.updated
            assert view.get(SensorGps) is None
            for publisher in (attitude, gps):
                wait_for_subscriber(publisher)
            for number in range(100):
                gps.publish(SensorGps(timestamp=1000 + number))
            wait_for(
                lambda: view.update() and view["sensor_gps"].message.timestamp == 1099,
                what="the last message",
            )
            assert view["sensor_gps"].updated
            assert view["sensor_gps"].age < DEADLINE
            assert view["sensor_gps"].health.messages == view.counts.received - 1
            assert not retained.updated
            assert {str(each) for each, _ in view.items()} == {
                "1/vehicle_attitude",
                "1/sensor_gps/0",
            }
            with pytest.raises(
                ArgumentError,
                match=f"'{VLP}' is not valid: expected one of this view: sensor_gps, veh",
            ):
                view.get(VLP)
            assert view.update(0.001) == []
            assert view.counts.dropped + view.counts.received == 101
        assert view.closed
        assert view["sensor_gps"].message.timestamp == 1099
        with pytest.raises(ClosedError):
            view.update()


def test_invalid_arguments_raise_at_once(client: nedbus.Bus, bus: nedbus.Bus) -> None:
    """An invalid name or class opens no view; a topic without a publisher has no message and delays no other."""
    for wrong in ("two words", 3):
        with pytest.raises(AddressError):
            client.newest(wrong)  # type: ignore[arg-type] # neither a class nor a topic
    with pytest.raises(ArgumentError, match="max_rate 0"):
        client.newest(max_rate=0)
    with (
        bus.publisher(VLP, vehicle=1) as publisher,
        client.newest(*(f"none_{each}" for each in range(7)), VLP) as view,
    ):
        publish(publisher, 1)
        wait_for(lambda: view.update(0.1), what="the message")
        assert view.get("none_3") is None
        assert view[VLP].message.timestamp == 1


def test_more_streams_than_the_limit_in_one_update(
    bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`update` returns every message that it has read, although the least recently updated streams are evicted."""
    publishers = [bus.publisher(VLP, vehicle=number) for number in range(5)]
    with bus.newest() as view:
        for publisher in publishers:
            wait_for_subscriber(publisher)
            publish(publisher, 1)
        wait_for(lambda: view._receiver.receive() and view._inbox.waiting == 5, what="the messages")
        monkeypatch.setattr("nedbus.limits.KEYS", 3)
        assert len(view.update()) == 5
        assert (len(view), view.evicted, view.counts.received) == (3, 2, 5)
        with pytest.raises(ArgumentError, match="has several streams"):
            view.get(VLP)


def test_invalid_message_does_not_replace_a_valid_one(bus: nedbus.Bus, client: nedbus.Bus) -> None:
    """A payload that cannot be decoded counts as invalid; the newest valid message remains."""
    with bus.publisher(VLP, vehicle=1) as publisher, client.newest(vehicle=1) as view:
        view.update()
        wait_for_subscriber(publisher)
        publisher.publish(message(1))
        wait_for(view.update, what="the message")
        bus._session.put(publisher.key, b"\xc1")
        wait_for(lambda: view.update() or view.counts.invalid, what="the invalid message")
        assert list(view.invalid) == [publisher.address]
        assert "not a VehicleLocalPosition" in view.invalid[publisher.address]
        assert (view[VLP].message.timestamp, view.counts.invalid) == (1, 1)


@pytest.mark.slow
def test_stream_of_another_process_is_gone_with_it(
    client: nedbus.Bus, endpoint: str, start: Start
) -> None:
    """A position is alive while its publisher's process sends, and no longer when the process has been killed."""
    process = start("-c", PUBLISHING, endpoint, coverage=False)
    with client.newest(vehicle=1) as view:
        wait_for(lambda: view.update(0.1), what="the position")
        assert view[VLP].alive
        process.kill()
        wait_for(lambda: not view[VLP].alive, what="the end of the stream")
        assert view[VLP].message.timestamp == 5


def test_failed_session_raises_after_the_last_message(endpoint: str) -> None:
    """What was received is read first; then `update` raises ReceiveError, and the messages remain."""
    with nedbus.connect(endpoint) as bus, bus.publisher(VLP, vehicle=1) as publisher:
        reader = nedbus.connect(endpoint)
        view = reader.newest(vehicle=1)
        wait_for_subscriber(publisher)
        publish(publisher, 1)
        wait_for(lambda: view._receiver.receive() and view._inbox.waiting, what="the message")
        view._inbox.end("its Zenoh session was closed")
        assert [each.message.timestamp for each in view.update()] == [1]
        with pytest.raises(ReceiveError, match="session was closed"):
            view.update(1.0)
        assert view[VLP].message.timestamp == 1
        reader.close()
        assert not view[VLP].alive or view[VLP].age <= 1.0


@pytest.mark.slow
def test_link_that_is_lost_ends_aliveness(timings: Timings) -> None:
    """Without a link to the router no stream is alive, whatever its topic."""
    endpoint = free_endpoint()
    with open_router(listen=[endpoint]) as router:
        bus = nedbus.connect(endpoint)
        publisher = bus.publisher("home_position", vehicle=1)
        publisher.publish({"timestamp": 1})
        view = bus.newest("home_position")
        wait_for(lambda: view.update(0.1), what="the message")
        assert view["home_position"].alive
        router.close()
        wait_for(lambda: not view["home_position"].alive, what="the loss of the link")
    bus.close()


@pytest.mark.slow
def test_view_that_is_not_referenced_closes(bus: nedbus.Bus) -> None:
    """A view without references ends its subscription, like a Subscription."""
    view = bus.newest("*")
    inbox, reference = view._inbox, weakref.ref(view)
    del view
    gc.collect()
    assert reference() is None
    wait_for(lambda: inbox.ended, what="the end of the subscription")


def test_update_without_timeout_starts_no_thread(bus: nedbus.Bus) -> None:
    """Only a wait with a timeout starts a receiving thread."""
    with bus.newest() as view:
        view.update()
        assert view._receiver._rings[0].pump is None
        view.update(0.001)
        assert view._receiver._rings[0].pump is not None


def test_asyncio_loop_without_waiting_does_not_starve_other_tasks(endpoint: str) -> None:
    """Each `update` lets other tasks run, even if it does not wait."""

    async def scenario() -> None:
        async with nedbus.connect_async(endpoint) as reader, reader.newest() as view:
            ran = asyncio.Event()
            asyncio.get_running_loop().call_soon(ran.set)
            await view.update()
            assert ran.is_set()

    asyncio.run(scenario())


def test_asyncio_waits_for_news(bus: nedbus.Bus, endpoint: str) -> None:
    """`await update` waits for a message, and a closed view raises ClosedError."""

    async def scenario() -> None:
        async with nedbus.connect_async(endpoint) as reader, reader.newest(vehicle=1) as view:
            assert await view.update(0.001) == []
            await asyncio.to_thread(wait_for_subscriber, publisher)
            waiting = asyncio.create_task(view.update(DEADLINE))
            await asyncio.sleep(0)
            publish(publisher, 3)
            assert [each.message.timestamp for each in await waiting] == [3]
            assert view[nedbus.VehicleLocalPosition].alive
            await view.close()
            with pytest.raises(ClosedError):
                await view.update()

    with bus.publisher(VLP, vehicle=1) as publisher:
        asyncio.run(scenario())
