"""Publishers with invalid messages and arguments, and failures while one is opened."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import closing
from types import SimpleNamespace
from typing import Any, Final, cast

import numpy as np
import pytest
import zenoh

import nedbus
from nedbus import Counts, Mode
from nedbus.client import PublisherRegistry, QueryServer, io_thread
from nedbus.client.publishing.group import Outgoing
from nedbus.client.receiving import Receiver
from nedbus.transport import Session, open_client, token_keys
from nedbus_msgs import BY_TOPIC, DEFAULT, Address, VehicleLocalPosition, get_topic
from nedbus_msgs.arrays import DTYPE, to_array
from tests.flights.messages import VLP, message
from tests.nedbus.client.lossy import LossyQueue
from tests.nedbus.client.numbered import numbered, receive_timestamps, wait_for_subscriber
from tests.waits import DEADLINE, wait_for


@pytest.mark.parametrize("method", ["publish", "publish_row", "publish_many"])
def test_every_publish_method_raises_for_invalid_messages(client: nedbus.Bus, method: str) -> None:
    """Every publish method of either client raises InvalidMessageError for an invalid message, and sends nothing."""
    publisher = client.publisher(VLP, vehicle="1")
    fields = {**message(1).model_dump(), "eph": -1.0}
    given: dict[str, object] = {
        "publish": fields,
        "publish_row": tuple(fields.values()),
        "publish_many": to_array([message(1), VehicleLocalPosition.model_construct(**fields)]),
    }
    with pytest.raises(
        nedbus.InvalidMessageError, match=r"eph: must not be negative \(is -1.0\)"
    ) as info:
        getattr(publisher, method)(given[method])
    assert isinstance(info.value, nedbus.NedbusError)
    assert ("at index 1:" in str(info.value)) is (method == "publish_many")
    assert publisher.published == 0


def test_publish_many_with_invalid_arguments_sends_nothing(bus: nedbus.Bus) -> None:
    """`publish_many` raises TypeError for another dtype and ClosedError after closing; an empty array sends nothing."""
    publisher = bus.publisher(VLP, vehicle="1")
    with pytest.raises(TypeError, match="astype"):
        publisher.publish_many(np.zeros(3, [("x", "f4")]))
    publisher.publish_many(np.empty(0, DTYPE))
    publisher.close()
    with pytest.raises(nedbus.ClosedError):
        publisher.publish_many(numbered(1))
    assert publisher.published == 0


def test_publish_many_waits_for_credit_at_exactly_the_due_messages(
    bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lossless `publish_many` waits for its readers at the message that is due, whatever is put in one group.

    All messages arrive in order.
    """
    publisher, waited = bus.publisher(VLP, vehicle="1", lossless=True), list[int]()
    control = publisher._flow_control

    def wait_for_credit(published: int) -> None:
        waited.append(published)
        control.check_at = published + 37 if len(waited) < 3 else 1000

    monkeypatch.setattr(control, "wait_for_credit", wait_for_credit)
    control.check_at = 70
    with bus.subscribe(VLP, vehicle="1", mode="every") as subscription:
        wait_for_subscriber(publisher)
        publisher.publish_many(numbered(300))
        assert receive_timestamps(subscription, 300) == list(range(1, 301))
    assert waited == [70, 107, 144]
    assert publisher.published == 300


def test_invalid_source_leaves_nothing_behind(bus: nedbus.Bus, zenoh_session: Session) -> None:
    """A publisher with an invalid source raises, and leaves no listener, directory, job or liveliness token behind."""
    jobs = len(io_thread._jobs)
    for number in range(3):
        with pytest.raises(nedbus.errors.ArgumentError, match="not valid"):
            bus.publisher(VLP, vehicle=str(number), source="not valid")
        assert_nothing_is_open(bus._publishers, zenoh_session)
    # one vehicle answers schema queries, for messages in transit
    assert len(io_thread._jobs) <= jobs + 1


class FailingSession:
    """A session in which one declaration fails."""

    def __init__(self, session: Session, fails_at: int) -> None:
        self.session, self.left = session, fails_at
        self.declared = self.probes = 0

    def __getattr__(self, name: str) -> Any:
        found = getattr(self.session, name)
        return self.counted(found) if name.startswith("declare_") else found

    def liveliness(self) -> SimpleNamespace:
        return SimpleNamespace(declare_token=self.counted(self.session.liveliness().declare_token))

    def counted(self, declare: Callable[..., object]) -> Callable[..., object]:
        def call(*arguments: Any, **options: Any) -> object:
            self.left -= 1
            self.declared += 1
            if self.left == 0:
                raise zenoh.ZError("out of resources")
            result = declare(
                *(self.session if each is self else each for each in arguments), **options
            )
            if isinstance(result, zenoh.Publisher):  # a probe, which declares a matching listener
                self.probes += 1
                return SimpleNamespace(
                    declare_matching_listener=self.counted(result.declare_matching_listener),
                    undeclare=lambda: self.undeclare(result),
                )
            return result

        return call

    def undeclare(self, probe: zenoh.Publisher) -> None:
        self.probes -= 1
        probe.undeclare()


@pytest.mark.parametrize("step", [*range(1, 11)])
@pytest.mark.parametrize("declarations", [7, 9], ids=["client", "lossless-in-router"])
def test_failed_declaration_leaves_nothing_behind(
    bus: nedbus.Bus,
    zenoh_session: Session,
    monkeypatch: pytest.MonkeyPatch,
    step: int,
    declarations: int,
) -> None:
    """If any declaration of a publisher fails, nothing stays open, and the address is free for the next one."""
    is_router = declarations == 9
    session = cast("Any", FailingSession(bus._session, step))
    monkeypatch.setattr(
        "zenoh.ext.declare_advanced_publisher",
        session.counted(zenoh.ext.declare_advanced_publisher),
    )
    queries = QueryServer(session)
    registry, address = (
        PublisherRegistry(session, queries, prefix="nedbus", is_client=not is_router),
        Address("1", VLP),
    )
    if step <= declarations:
        with pytest.raises(nedbus.NedbusError, match="out of resources"):
            registry.publisher(address, lossless=is_router)
        assert (session.declared, session.probes) == (step, 0)
        assert_nothing_is_open(registry, zenoh_session)
    publisher = registry.publisher(address, lossless=is_router)
    publisher.publish(message(5))
    wait_for(lambda: len(open_tokens(zenoh_session)) == 2, what="the tokens")
    assert step <= declarations or session.declared == declarations, "each declaration is tested"
    publisher.close()
    queries.close()
    registry.heartbeats.close()


def test_interrupted_open_closes_the_publisher(
    bus: nedbus.Bus, zenoh_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C while `bus.publisher` waits for the router closes the publisher, which the script has no reference to."""

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("nedbus.client.bus.token_keys", interrupt)
        with pytest.raises(KeyboardInterrupt):
            bus.publisher(VLP, vehicle="1")
    assert_nothing_is_open(bus._publishers, zenoh_session)
    bus.publisher(VLP, vehicle="1").publish(message(5))


def open_tokens(session: Session) -> list[str]:
    """Return the liveliness tokens of publishers and of their keys."""
    return [
        key
        for each in ("**", "*/@alive/**")
        for key in token_keys(session, f"nedbus/{each}", timeout=DEADLINE)
    ]


def assert_nothing_is_open(registry: PublisherRegistry, session: Session) -> None:
    """Check that a registry has no open publisher, and no state or liveliness token of one."""
    assert not registry.publishers
    assert not registry._rate_listeners
    assert not registry._directories
    assert not registry.heartbeats.writers
    wait_for(lambda: open_tokens(session) == [], what="the end of the liveliness tokens")


UNKNOWN_RATE: Final = nedbus.define_msg("SensorCombined", "uint64 timestamp\nfloat32[3] gyro_rad")


def recover(
    endpoint: str, publisher: nedbus.Publisher, sent: Iterable[nedbus.Message]
) -> tuple[list[int], Counts]:
    """Publish messages of which a reader in mode `every` misses all but the first and the last; return what it gets."""
    first, *missed, last = sent
    queue = LossyQueue(publisher.key)
    queue.missing = range(1, len(missed) + 1)
    with closing(open_client([endpoint], timeout=DEADLINE)) as session:
        receiver = Receiver(session, queue)
        with nedbus.Subscription[Any](receiver, queue, owner=None) as subscription:
            wait_for_subscriber(publisher)
            for each in (first, *missed, last):
                publisher.publish(each)
            received = [subscription.receive(DEADLINE).message.timestamp]
            while received[-1] != last.timestamp:
                received.append(subscription.receive(DEADLINE).message.timestamp)
            return received, subscription.counts


@pytest.mark.parametrize("excess", [0, 3])
@pytest.mark.parametrize("topic", list(DEFAULT.topics))
def test_20_s_of_a_position_topic_are_recovered(
    endpoint: str, bus: nedbus.Bus, topic: str, excess: int
) -> None:
    """A reader recovers 20 s of each position topic at its nominal rate, at least 400 messages, and counts older ones.

    The last message reveals the gap, so the history holds one message less.
    """
    instance = 0 if get_topic(topic).instances else None
    publisher = bus._publishers.publisher(Address("1", topic, instance), short_history=True)
    depth = max(400, round(20 * get_topic(topic).rate))
    sent = [message(timestamp) for timestamp in range(depth + 1 + excess)]
    received, counts = recover(endpoint, publisher, sent)
    assert received == [0, *range(1 + excess, len(sent))]
    assert counts == Counts(received=len(received), lost=excess)


@pytest.mark.parametrize("excess", [0, 3])
@pytest.mark.parametrize(("is_source", "depth"), [(True, 50), (False, 400)])
def test_messages_of_a_topic_without_a_rate_are_recovered(
    endpoint: str, bus: nedbus.Bus, is_source: bool, depth: int, excess: int
) -> None:
    """A reader recovers 50 messages of a source's topic without a nominal rate, and 400 of a script's.

    It counts older ones as lost.
    """
    address, model = Address("1", "home_position"), BY_TOPIC["home_position"].model
    publisher = bus._publishers.publisher(address, short_history=is_source)
    sent = [
        model.model_validate({"timestamp": timestamp}) for timestamp in range(depth + 1 + excess)
    ]
    received, counts = recover(endpoint, publisher, sent)
    assert received == [0, *range(1 + excess, len(sent))]
    assert counts == Counts(received=len(received), lost=excess)


@pytest.mark.parametrize("mode", ["latest", "every"])
def test_late_reader_gets_the_last_message_of_a_topic_sent_on_change(
    client: nedbus.Bus, bus: nedbus.Bus, mode: Mode
) -> None:
    """A reader that joins later gets the last message of a topic sent on change, or whose rate is unknown.

    It does not depend on the other messages that the vehicle publishes meanwhile.
    """
    home = bus.publisher("home_position", vehicle="1")
    other = bus.publisher("sensor_combined", vehicle="1", definition=UNKNOWN_RATE)
    home.publish(
        {
            "timestamp": 1,
            "lat": 47.0,
            "lon": 8.0,
            "alt": 400.0,
            "valid_hpos": True,
            "valid_alt": True,
        }
    )
    for timestamp in range(300):
        other.publish({"timestamp": timestamp, "gyro_rad": (0.0, 0.0, 0.0)})
    for topic, timestamp in (("home_position", 1), ("sensor_combined", 299)):
        with client.subscribe(topic, mode=mode) as subscription:
            sample = subscription.receive(DEADLINE)
            assert (sample.message.timestamp, sample.retained) == (timestamp, True)


def test_messages_share_one_encoding(bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    """All messages with the same source and missing fields have one encoding object: the history holds it once."""
    publisher, put = bus.publisher(VLP, vehicle="1", source="a"), list[Outgoing]()
    monkeypatch.setattr(publisher._writer, "put", put.extend)
    for source in ("a", "b"):
        publisher.relabel(source)
        for timestamp in range(3):
            publisher.publish(message(timestamp))
        for timestamp in range(3):
            publisher.publish({"timestamp": timestamp, "x": 1.0})
    encodings = [encoding for _, _, encoding in put]
    assert len(encodings) == 12
    for start in range(0, 12, 3):
        assert all(encoding is encodings[start] for encoding in encodings[start : start + 3])
    assert len({str(encoding) for encoding in encodings}) == 4
