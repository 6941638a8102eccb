"""Output of a live source: topics without a rate, rejections, and the limit of addresses; with a fake clock."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any, cast

import pytest

import nedbus
from nedbus import limits
from nedbus.client import PublisherRegistry
from nedbus.daemon.output import SourceOutput
from nedbus.sources import Rejection, ReplayRun, SourceMessage, UnavailableTopics
from nedbus.vehicle_events import EventLog
from nedbus_msgs import BY_TOPIC, Address, Definition, codec_of
from tests.flights.messages import VLP

HOME, POSITION, OTHER = Address("1", "home_position"), Address("1", VLP), Address("2", VLP)
ATTITUDE = Address("1", "vehicle_attitude")


class FakeOutput:
    """The output of a live source without a session; records the published messages and the rejection reports."""

    def __init__(self) -> None:
        self.now, self.published = 0.0, list[tuple[Address, int]]()  # address and timestamp
        self.failure: nedbus.InvalidMessageError | None = None
        self.reports = list[dict[str, object]]()
        self.event_log = EventLog()
        registry = SimpleNamespace(
            publisher=self._open,
            publishers={},
            reject=lambda _, report: self.reports.append(report),
        )
        self.output = SourceOutput(
            "px4",
            "px4-zenoh:",
            cast("PublisherRegistry", registry),
            lambda: self.now,
            self.event_log,
        )

    def receive(self, seconds: float, *addresses: Address, timestamp: int | None = None) -> None:
        """Advance the clock, receive a message on each address, and expire stale addresses."""
        self.now += seconds
        for address in addresses:
            fields = {"timestamp": round(self.now * 1e6) if timestamp is None else timestamp}
            self.output.publish_live(SourceMessage(0.0, address, fields))
        self.output.expire_stale()

    def _open(self, address: Address, definition: Any, **_: object) -> SimpleNamespace:
        definition = definition or BY_TOPIC[address.topic]

        def publish(payload: bytes, _: object) -> None:
            if self.failure is not None:
                raise self.failure
            self.published.append((address, codec_of(definition).decode(payload).timestamp))

        return SimpleNamespace(
            definition=definition,
            publish_encoded=publish,
            close=lambda: None,
            relabel=lambda _: None,
            source="",
        )


def test_home_position_stays_published_while_its_vehicle_sends() -> None:
    """A topic without a rate stays published while other messages of its vehicle arrive."""
    fake = FakeOutput()
    fake.receive(1, HOME, POSITION, OTHER)
    for _ in range(10):
        fake.receive(1, POSITION, OTHER)
    assert set(fake.output.addresses) == {HOME, POSITION, OTHER}
    for _ in range(4):
        fake.receive(1, OTHER)
    assert (fake.output.addresses, set(fake.output.stale)) == ([OTHER], {HOME, POSITION})


def test_home_position_is_republished_after_an_outage() -> None:
    """The last home position is republished after a link outage (PX4 does not repeat it), but not after a reboot."""
    fake = FakeOutput()
    fake.receive(1, HOME, POSITION)
    fake.receive(4)
    assert fake.output.addresses == []
    fake.receive(1, OTHER)
    assert fake.output.addresses == [OTHER]
    fake.receive(1, POSITION)
    assert set(fake.output.addresses) == {HOME, POSITION, OTHER}
    assert fake.published[-2:] == [(HOME, 1_000_000), (POSITION, 7_000_000)]
    fake.receive(4)
    fake.receive(1, POSITION, timestamp=5)
    assert fake.output.addresses == [POSITION]
    assert fake.published[-1] == (POSITION, 5)


def test_home_position_is_not_republished_after_a_reboot() -> None:
    """A home position from before a reboot is not republished, even if its timestamp is lower than the new uptime."""
    fake = FakeOutput()
    fake.receive(2, HOME, POSITION)
    for _ in range(30):
        fake.receive(1, POSITION)
    fake.receive(4)
    fake.receive(1, POSITION, timestamp=12_000_000)
    fake.receive(0, ATTITUDE, timestamp=12_100_000)
    assert set(fake.output.addresses) == {POSITION, ATTITUDE}
    assert [address for address, _ in fake.published].count(HOME) == 1


@pytest.mark.slow
def test_stalest_address_is_replaced_at_the_limit() -> None:
    """At the limit of addresses, a new address replaces the one that has been stale longest."""
    fake = FakeOutput()
    for number in range(1500):
        fake.receive(1, Address(f"v{number}", VLP))
    assert Address("v1499", VLP) in fake.output.addresses
    assert 990 <= len(fake.output.addresses + fake.output.stale) <= 1000
    assert not fake.output.rejected


def test_oldest_stale_address_goes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of several stale addresses, the one that has been stale longest is replaced, and the others stay."""
    monkeypatch.setattr(limits, "LIVE_ADDRESSES", 3)
    fake = FakeOutput()
    first, second, third, fourth = (Address(f"v{number}", VLP) for number in range(4))
    fake.receive(1, first)
    fake.receive(1, second)
    fake.receive(10, third)
    assert fake.output.stale == [first, second]
    fake.receive(1, fourth)
    assert fake.output.stale == [second]


@pytest.mark.slow
def test_address_beyond_the_limit_is_rejected_until_another_is_stale() -> None:
    """While 1,000 addresses are published, messages on any other address are rejected, counted, and logged once."""
    fake = FakeOutput()
    present = [Address(f"v{number}", VLP) for number in range(1000)]
    fake.receive(1, *present, OTHER)
    fake.receive(1, *present, OTHER)
    assert OTHER not in fake.output.addresses
    assert fake.output.rejections == {"too many addresses": 2}
    assert fake.output.warnings == (
        f"further addresses: the limit is 1000, and {OTHER} is the first one ignored",
    )
    fake.receive(4, *present[1:])
    fake.receive(1, OTHER)
    assert OTHER in fake.output.addresses
    assert present[0] not in fake.output.stale


@pytest.mark.slow
def test_addresses_of_a_replay_are_limited() -> None:
    """Messages of a replay beyond 10,000 addresses are rejected, counted, and logged once."""
    fake = FakeOutput()
    addresses: dict[Address, Definition[Any] | None] = dict.fromkeys(
        Address(f"v{number}", VLP) for number in range(10_001)
    )
    run = ReplayRun(iter(()), addresses, None, "")
    fake.output.claim_all(run, lossless=True, stop=threading.Event())
    assert len(fake.output.addresses) == 10_000
    last = [*addresses][-1]
    for address in (last, last, POSITION):
        fake.output.publish_replay(SourceMessage(0.0, address, {"timestamp": 1}), lossless=True)
    assert fake.output.rejections == {"too many addresses": 3}
    assert fake.output.warnings == (
        f"further addresses: the limit is 10000, and {last} is the first one ignored",
    )


def test_text_of_a_rejection_is_limited(caplog: pytest.LogCaptureFixture) -> None:
    """Sender and reason of a rejection, which a peer may choose, are cut to 300 characters wherever they appear."""
    fake = FakeOutput()
    fake.output.reject(Rejection("w" * 1000, "r" * 1000, POSITION))
    where, reason = "w" * 300, "r" * 300
    assert fake.output.warnings == (f"{where}: {reason}",)
    assert caplog.messages == [f"px4: {where} rejected: {reason}"]
    assert fake.reports == [{"source": "px4-zenoh:", "where": where, "reason": reason}]
    assert [event.text for event in fake.event_log.events] == [f"{VLP} rejected: {reason}"]


def test_number_of_rules_and_of_logged_invalid_messages_is_limited(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Invalid messages are counted by rule, from the 51st rule on as "other", and the first five are logged."""
    fake = FakeOutput()
    for number in range(60):
        rule = f"field{number}", "must be finite"
        fake.failure = nedbus.InvalidMessageError(
            ": ".join(rule), [rule], message="VehicleLocalPosition"
        )
        fake.receive(0, POSITION)
    assert (fake.output.rejected, len(fake.output.rejections), fake.output.rejections["other"]) == (
        60,
        51,
        10,
    )
    assert [number for number in range(60) if f"field{number}:" in caplog.text] == [0, 1, 2, 3, 4]


def test_silent_addresses_are_logged_once_up_to_the_limit(caplog: pytest.LogCaptureFixture) -> None:
    """A silent address is logged once, and only the first 1,000, because a peer may announce any number."""
    fake = FakeOutput()
    for start in (0, 600, 1200, 0):
        names = tuple(f"v{number}/{VLP}" for number in range(start, start + 600))
        fake.output.note(UnavailableTopics(silent=names))
        assert fake.output.unavailable.silent == names
    text = "".join(record.getMessage() for record in caplog.records)
    assert [text.count(f"v{number}/") for number in (0, 599, 999, 1000, 1799)] == [1, 1, 1, 0, 0]


def test_slow_stream_stays_published_for_three_of_its_intervals() -> None:
    """A stream of a message every 4 s is stale after 12 s without one, not after 3 s."""
    fake = FakeOutput()
    for _ in range(6):
        fake.receive(4, HOME if fake.now else POSITION, POSITION)
    for silence, published in ((8, True), (3, True), (2, False)):
        fake.receive(silence)
        assert (POSITION in fake.output.addresses) == published


def test_flapping_stream_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    """A stream that comes and goes is logged until the second time that it is stale, and again once it was stable."""
    caplog.set_level("INFO")
    fake = FakeOutput()

    def flap() -> list[str]:
        caplog.clear()
        for _ in range(5):
            fake.receive(0.5, POSITION)
        fake.receive(4)
        fake.receive(1, POSITION)
        return [text.partition(" is ")[2] for text in caplog.messages]

    assert flap() == ["published", "stale: no message for 4 s", "published again"]
    assert flap()[0].startswith("stale: no message for 4 s; it flaps")
    assert [flap(), flap()] == [[], []]
    for _ in range(120):
        fake.receive(0.5, POSITION)
    assert flap() == ["stale: no message for 4 s", "published again"]


def test_stream_with_another_layout_gets_another_publisher() -> None:
    """A stream whose definition has other fields than before, as of new firmware, is published with the new one."""
    fake = FakeOutput()
    known = BY_TOPIC[VLP]
    other = BY_TOPIC["vehicle_attitude"]
    stream = fake.output.claim(POSITION)
    first = stream.publisher
    assert fake.output.claim(POSITION, known).publisher is first
    second = fake.output.claim(POSITION, other).publisher
    assert second is not None
    assert second is not first
    assert second.definition is other
    assert fake.output.claim(POSITION).publisher is second, "no definition is that of the topic"


def test_message_that_waited_in_the_service_has_a_latency() -> None:
    """A message that is published more than 1 s after its arrival, as on a busy host, has this latency."""
    fake = FakeOutput()
    fake.now = 100.0
    for arrived in (99.5, 97.0):
        message = SourceMessage(0.0, POSITION, {"timestamp": round(arrived * 1e6)}, arrived=arrived)
        fake.output.publish_live(message)
    fake.now = 101.5
    latencies = fake.output._streams[POSITION].health.latencies
    assert sum(latencies.counts) == 1
    assert latencies.sum == 3.0
