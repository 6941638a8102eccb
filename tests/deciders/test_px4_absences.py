"""Topics that are announced and do not arrive, or are not carried, at times that the test gives."""

from __future__ import annotations

import pytest

from nedbus.sources import Absence
from nedbus.sources.options import Px4ZenohOptions
from nedbus.sources.px4.streams import StreamRegistry
from nedbus.transport import PublisherToken, TopicKey, publisher_token


def token(topic: str, message: str = "Any", *, session: str = "a") -> PublisherToken:
    """Return the token of a PX4's publisher; its message does not matter for a topic that is carried."""
    domain = 0 if session == "a" else 2
    key = TopicKey(domain, f"fmu/out/{topic}", f"px4_msgs::msg::dds_::{message}_", "hash")
    return PublisherToken.parse(publisher_token(key, session, "px4_aabbcc00000000000000000000000000", 1))


@pytest.fixture
def streams() -> StreamRegistry:
    """Return a registry that knows of two topics, announced at 100 s by one node."""
    streams = StreamRegistry(Px4ZenohOptions(), vehicle="1")
    for topic in ("vehicle_attitude", "vehicle_odometry"):
        streams.add_publisher(token(topic), 100.0)
    return streams


def hear(streams: StreamRegistry, topic: str, now: float, *, session: str = "a") -> Absence:
    """Return what is absent just after a message."""
    assert streams.hear(str(token(topic, session=session).key), now).not_carried is None
    return streams.report(now)


def test_topic_is_silent_after_5_s_while_others_arrive(streams: StreamRegistry) -> None:
    """It is silent from 5 s on, whether something came before or not, until something comes, or it is withdrawn."""
    assert hear(streams, "vehicle_attitude", 104.9) == Absence()
    assert hear(streams, "vehicle_attitude", 105.0) == Absence((), ("1/vehicle_odometry",))
    assert hear(streams, "vehicle_odometry", 105.1) == Absence()
    assert hear(streams, "vehicle_attitude", 110.2) == Absence((), ("1/vehicle_odometry",))
    streams.remove_publisher(token("vehicle_odometry"), 110.2)
    assert streams.report(110.2) == Absence()


def test_nothing_is_silent_while_nothing_arrives(streams: StreamRegistry) -> None:
    """A vehicle whose link is down loses all its topics, and another one does not make up for it."""
    streams.add_publisher(token("vehicle_status", session="b"), 100.0)
    assert streams.report(200.0) == Absence()
    assert hear(streams, "vehicle_status", 200.0, session="b") == Absence()


def test_topic_on_events_is_never_silent(streams: StreamRegistry) -> None:
    """home_position may not come for as long as it likes."""
    streams.add_publisher(token("home_position"), 100.0)
    assert streams.report(200.0) == Absence()
    assert hear(streams, "vehicle_attitude", 200.0).silent == ("1/vehicle_odometry",)


def test_messages_that_are_not_carried_are_listed(streams: StreamRegistry) -> None:
    """They are sorted, each once, for as long as they are announced; and bounded."""
    for number, name in enumerate(("Rpm", "Airspeed", "Rpm")):
        streams.add_publisher(token(f"topic_{number}", name), 100.0)
    assert streams.hear(str(token("topic_0", "Rpm").key), 100.0).not_carried == "Rpm"
    assert streams.report(100.0) == Absence(("Airspeed", "Rpm"))
    streams.remove_publisher(token("topic_1", "Airspeed"), 100.0)
    assert streams.report(100.0) == Absence(("Rpm",))
    for number in range(2000):
        streams.add_publisher(token(f"any{number}x", f"Any{number}"), 100.0)
    assert len(streams.report(100.0).not_carried) == 100


def test_topics_that_no_option_asks_for_are_not_listed() -> None:
    """With `topics=` all others are left out without a word."""
    streams = StreamRegistry(Px4ZenohOptions.model_validate({"topics": "vehicle_attitude"}), vehicle="1")
    streams.add_publisher(token("rpm", "Rpm"), 100.0)
    assert streams.report(100.0) == Absence()
