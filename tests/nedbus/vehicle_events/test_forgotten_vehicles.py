"""State kept about vehicles that come and go, in a service, a reader and a web page, with fake clocks."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Final, cast

import pytest

from nedbus import Bus, Counts, Sample, Selection, limits
from nedbus.client import PublisherRegistry, Publishers
from nedbus.daemon import Daemon
from nedbus.daemon.output import SourceOutput
from nedbus.monitoring import Observer
from nedbus.settings import load_settings
from nedbus.sources import SourceMessage
from nedbus.timings import TIMINGS
from nedbus.web.fleet import Fleet
from nedbus_msgs import BY_TOPIC, Address
from tests.flights.messages import VALID, VLP, message

AT_A_TIME: Final = 8


class World:
    """A service with a live source, a reader and its page, all of which receive every message."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.now, self.open, self.alive = 0.0, set[Address](), Publishers()
        patch.setattr("nedbus.clock.steady", lambda: self.now)
        patch.setattr("nedbus.clock.utc_ns", lambda: self.now_ns)
        patch.setattr("time.monotonic_ns", lambda: self.now_ns)
        self.daemon = Daemon(load_settings(source=("sim:",)), version="0")
        registry = SimpleNamespace(publisher=self._publisher, shared_vehicles=set, publishers=())
        self.daemon._registry = cast("PublisherRegistry", registry)
        self.output = SourceOutput(
            "px4", "px4-zenoh:", self.daemon._registry, lambda: self.now, self.daemon.event_log
        )
        bus = SimpleNamespace(
            connected=True,
            subscribe=lambda *_, **__: SimpleNamespace(counts=Counts(), waiting=0),
            rejections=lambda: SimpleNamespace(take=list),
            publishers=lambda **_: self.alive,
        )
        self.reader = Observer(cast("Bus", bus), Selection("*"))
        self.fleet = Fleet(self.reader.monitor)

    @property
    def now_ns(self) -> int:
        return round(self.now * 1e9)

    def _publisher(self, address: Address, *_: object, **__: object) -> SimpleNamespace:
        self.open.add(address)
        return SimpleNamespace(
            definition=BY_TOPIC[address.topic],
            publish_encoded=lambda *_: None,
            close=lambda: self.open.discard(address),
            source="px4-zenoh",
        )

    def receive(self, address: Address) -> None:
        sent = message(round(self.now * 1e6) + 1, **VALID)
        self.output.publish_live(SourceMessage(0.0, address, sent.__dict__))
        sample = Sample(sent, address, self.now_ns, _sent=self.now_ns)
        self.reader.add(sample)
        self.fleet.add(sample, self.now)

    def poll(self, *alive: Address) -> None:
        self.alive = Publishers(alive)
        self.daemon.update_events()
        self.output.expire_stale()
        snapshot, event_log = self.reader.poll(), self.reader.event_log
        states = {name: event_log.state(name, self.now) for name in event_log.vehicles}
        self.fleet.update(snapshot, states, {})

    def sizes(self) -> dict[str, int]:
        """Return the number of objects by kind of state."""
        event_logs = self.daemon.event_log, self.reader.event_log
        return {
            "vehicles": max(len(each.vehicles) for each in event_logs),
            "counts": max(len(each.counts) for each in event_logs),
            "addresses": len(self.output.addresses + self.output.stale),
            "streams": len(self.reader.monitor.snapshot()),
            "page": len(self.fleet.streams),
            "rows": len(self.fleet.snapshot.vehicles),
        }


@pytest.mark.long
def test_state_of_vehicles_that_come_and_go_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """After hundreds of vehicles, eight at a time, only those of the last minute and fifty more are kept."""
    world = World(monkeypatch)
    sizes = []
    for number in range(240):
        world.now += 2.0
        there = [
            Address(f"v{each}", VLP) for each in range(max(0, number - AT_A_TIME + 1), number + 1)
        ]
        for address in there:
            world.receive(address)
        world.poll(*there)
        sizes.append(world.sizes())
    assert sizes[140:240:10] == [sizes[-1]] * 10
    most = AT_A_TIME + limits.GONE_VEHICLES + 31
    assert all(number <= most for name, number in sizes[-1].items() if name != "counts")
    assert sizes[-1]["counts"] <= 3 * most
    world.now += TIMINGS.forgotten
    for _ in range(10):  # after the pause the reader counts as overloaded
        world.now += 1.0
        world.receive(there[-1])
        world.poll(there[-1])
    assert {name: number for name, number in world.sizes().items() if number != 1}.keys() == {
        "counts"
    }


def test_unpublished_stream_of_present_vehicle_is_forgotten_after_an_hour(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A topic that a vehicle no longer publishes is stale for an hour, then forgotten."""
    world, position, attitude = (
        World(monkeypatch),
        Address("1", VLP),
        Address("1", "estimator_local_position", 0),
    )
    for second in range(3):
        world.now = float(second)
        world.receive(position)
        world.receive(attitude)
        world.poll(position, attitude)
    for seconds, known in ((TIMINGS.forgotten - 9, {position, attitude}), (10, {position})):
        world.now += seconds
        world.receive(position)
        world.poll(position)
        world.receive(position)
        assert world.reader.monitor.keys() == known
        assert {*world.output.addresses, *world.output.stale} == known
        assert world.fleet.streams.keys() == known


def test_stream_that_returns_during_a_poll_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stream is not forgotten for its age in a snapshot if a sample arrives before the publishers are listed."""
    world, address = World(monkeypatch), Address("7", VLP)

    def publishers(**_: object) -> Publishers:
        world.receive(address)
        return Publishers()

    world.receive(address)
    world.poll(address)
    world.now += TIMINGS.forgotten + 1.0
    monkeypatch.setattr(world.reader._bus, "publishers", publishers)
    world.reader.poll()
    assert [health.messages for health in world.reader.monitor.snapshot().values()] == [2]
