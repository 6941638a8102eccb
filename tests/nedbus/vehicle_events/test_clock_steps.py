"""Events while the host's clock is stepped: a service and a reader of two vehicles, with fake clocks."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from types import SimpleNamespace
from typing import Any, Final, cast

import hypothesis.strategies as st
import pytest
from hypothesis import example, given

from nedbus import Bus, Counts, Sample, Selection
from nedbus.client import PublisherRegistry, Publishers
from nedbus.daemon import Daemon
from nedbus.daemon.output import SourceOutput
from nedbus.monitoring import Observer
from nedbus.settings import load_settings
from nedbus.sources import Rejection, SourceMessage
from nedbus.vehicle_events import from_json
from nedbus_msgs import BY_TOPIC, Address
from tests.flights.messages import VALID, VLP, message

from .flight import GOOD_GPS

START: Final = 1.7e9  # s, Unix time
LENGTH: Final = 32.0  # s
RATE: Final = 4
ADDRESSES: Final = Address("1", VLP), Address("2", VLP)
GPS: Final = Address("1", "vehicle_gps_position")


class World:
    """A service, a reader, and their host's clock, which is stepped by `step` seconds at the time `at`."""

    def __init__(self, patch: pytest.MonkeyPatch, step: float, at: float) -> None:
        self.now, self._step, self._at = 0.0, step, at
        patch.setattr("nedbus.clock.steady", lambda: START + self.now)
        patch.setattr("nedbus.clock.utc_ns", lambda: self._utc_ns(self.offset))
        patch.setattr("time.monotonic_ns", lambda: round(self.now * 1e9))
        self.daemon = Daemon(load_settings(source=("sim:",)), version="0")
        publisher = SimpleNamespace(
            publish_encoded=lambda *_: None, close=lambda: None, source="px4-zenoh"
        )
        registry = SimpleNamespace(
            reject=lambda *_: None,
            publisher=lambda address, *_, **__: SimpleNamespace(
                definition=BY_TOPIC[address.topic], **vars(publisher)
            ),
        )
        self.output = SourceOutput(
            "px4",
            "px4-zenoh:",
            cast("PublisherRegistry", registry),
            lambda: self.now,
            self.daemon.event_log,
        )
        bus = SimpleNamespace(
            connected=True,
            routers=("tcp/127.0.0.1:7447",),
            subscribe=lambda *_, **__: SimpleNamespace(counts=Counts(), waiting=0),
            rejections=lambda: SimpleNamespace(take=list),
            publishers=lambda **_: Publishers((*ADDRESSES, GPS)),
        )
        self.reader = Observer(cast("Bus", bus), Selection("*"))

    @property
    def offset(self) -> float:
        return self._step if self.now >= self._at else 0.0

    @property
    def arrival(self) -> int:
        """Arrival time [ns] of a message that is read now; the clock is stepped between the two."""
        return self._utc_ns(self._step if self.now > self._at else 0.0)

    def _utc_ns(self, offset: float) -> int:
        """Return the time of a clock with this offset; exact, unlike the sum as a float."""
        return round(START) * 10**9 + round((self.now + offset) * 1e9)

    def receive(self, address: Address, fields: dict[str, Any], lost: int = 0) -> None:
        """Deliver a message with another host's timestamp to the service, live or from a replay, and to the reader."""
        received = SourceMessage(0.0, address, fields, lost=lost)
        if address.vehicle == "1":
            self.output.publish_live(received)
        else:
            self.output.publish_replay(received, lossless=False)
        content = SimpleNamespace(**fields)
        sent = round((START + self.now) * 1e9)
        self.reader.add(Sample(cast("Any", content), address, self.arrival, lost=lost, _sent=sent))

    def run(self) -> Iterator[object]:
        """Simulate GPS loss, silence, a rejection, a reset and losses; yield the events of service and reader."""
        for tick in range(round(LENGTH * RATE)):
            self.now = tick / RATE
            stamp = round((50 + self.now) * 1e6)
            if tick % RATE == 0:
                gps = GOOD_GPS | (
                    {"fix_type": 0, "satellites_used": 2} if 5 <= self.now < 9 else {}
                )
                self.receive(GPS, {"timestamp": stamp, **gps})
            for address in ADDRESSES:
                fields = VALID | {
                    "xy_valid": not 6 <= self.now < 9,
                    "xy_reset_counter": int(self.now > 25),
                }
                if address.vehicle == "2" and 12 <= self.now < 20:
                    continue
                self.receive(
                    address, message(stamp, **fields).__dict__, lost=3 * (tick == 30 * RATE)
                )
            if tick == 20 * RATE:  # retained message of a vehicle switched off ten minutes ago
                sent = round((START + self.now - 600) * 1e9)
                self.reader.add(
                    Sample(message(stamp, **VALID), Address("3", VLP), self.arrival, _sent=sent)
                )
            if tick == 22 * RATE:
                self.output.reject(Rejection("port", "not a message", address=ADDRESSES[0]))
            if tick % (RATE // 2) == 0:
                self.daemon.update_events()
                self.reader.poll()
        for event_log in (self.daemon.event_log, self.reader.event_log):
            event_log.settle(START + self.now + 60)
            yield [asdict(event) for event in event_log.events_since(0)[0]]


def fly(step: float, at: float) -> tuple[World, list[object]]:
    with pytest.MonkeyPatch.context() as patch:
        world = World(patch, step, at)
        reported = list(world.run())
        read = from_json(json.loads(json.dumps(asdict(world.daemon.report(within=1e5)))))
        assert read is not None
        labels = [event.time for event in read.events]
        steady = [event.time + world.offset for event in world.daemon.event_log.events_since(0)[0]]
        assert labels == pytest.approx(steady, abs=0.01)
        assert read.now == pytest.approx(START + world.now + world.offset, abs=0.01)
        assert world.daemon.status.started == pytest.approx(START + world.offset, abs=0.01)
        return world, reported


_, EXPECTED = fly(0.0, 0.0)


def test_service_and_reader_detect_the_expected_events() -> None:
    """Both logs contain the events of the reference flight: an invalid position with evidence, silence, reset, loss."""
    for events in cast("list[list[dict[str, Any]]]", EXPECTED):
        kinds = {(each["vehicle"], each["kind"], each["change"]) for each in events}
        assert {
            ("1", "xy_invalid", "begin"),
            ("2", "silent", "begin"),
            ("2", "silent", "end"),
        } <= kinds
        assert {("1", "reset", "once"), ("1", "lost", "once")} <= kinds
        assert not any(each["kind"] == "overload" for each in events)
        invalid = next(
            each for each in events if (each["vehicle"], each["kind"]) == ("1", "xy_invalid")
        )
        assert {each["kind"] for each in invalid["evidence"]} >= {"gps_fix_lost"}


@pytest.mark.long
# at the end of a silence, between the arrival of a sample and its reading
@example(step=10.0, at=20.0)
@given(step=st.sampled_from([-3600.0, -1.0, 10.0, 3600.0]), at=st.floats(0.0, LENGTH))
def test_clock_step_does_not_change_events(step: float, at: float) -> None:
    """A step of the host's clock at any time shifts only the times in reports; events and durations stay the same."""
    assert fly(step, at)[1] == EXPECTED
