"""Announced topics that are silent or have no definition, with a fake clock."""

from __future__ import annotations

import pytest

from nedbus.sources import UnavailableTopics
from nedbus.sources.options import Px4ZenohOptions
from nedbus.sources.px4.streams import StreamRegistry
from nedbus.transport import PublisherToken, TopicKey
from nedbus_msgs import TOPICS


def token(topic: str, message: str = "Any", *, session: str = "a") -> PublisherToken:
    """Return the liveliness token of a PX4 publisher; for a known topic its message type is irrelevant."""
    domain = 0 if session == "a" else 2
    key = TopicKey(domain, f"fmu/out/{topic}", f"px4_msgs::msg::dds_::{message}_", "hash")
    return PublisherToken.parse(key.token("MP", session, "px4_aabbcc00000000000000000000000000", 1))


@pytest.fixture
def streams() -> StreamRegistry:
    """Return a registry with two topics, announced at 100 s by the same node."""
    streams = StreamRegistry(Px4ZenohOptions(), vehicle="1")
    for topic in ("vehicle_attitude", "vehicle_odometry"):
        streams.add_publisher(token(topic), 100.0)
    return streams


def report_after_message(
    streams: StreamRegistry, topic: str, now: float, *, session: str = "a"
) -> UnavailableTopics:
    """Return the unavailable topics after a message has arrived."""
    assert streams.on_message(str(token(topic, session=session).key), now).unsupported is None
    return streams.report(now)


def test_topic_is_silent_after_5_s_while_others_arrive(streams: StreamRegistry) -> None:
    """A topic is silent after 5 s without a message, until one arrives or its token is withdrawn."""
    assert report_after_message(streams, "vehicle_attitude", 104.9) == UnavailableTopics()
    assert report_after_message(streams, "vehicle_attitude", 105.0) == UnavailableTopics(
        (), ("1/vehicle_odometry",)
    )
    assert report_after_message(streams, "vehicle_odometry", 105.1) == UnavailableTopics()
    assert report_after_message(streams, "vehicle_attitude", 110.2) == UnavailableTopics(
        (), ("1/vehicle_odometry",)
    )
    streams.remove_publisher(token("vehicle_odometry"), 110.2)
    assert streams.report(110.2) == UnavailableTopics()


def test_vehicle_without_any_message_has_no_silent_topics(streams: StreamRegistry) -> None:
    """A vehicle whose link is down has no silent topics; messages of other vehicles are irrelevant."""
    streams.add_publisher(token("vehicle_status", session="b"), 100.0)
    assert streams.report(200.0) == UnavailableTopics()
    assert (
        report_after_message(streams, "vehicle_status", 200.0, session="b") == UnavailableTopics()
    )


def test_topic_without_nominal_rate_is_never_reported_as_silent(streams: StreamRegistry) -> None:
    """A topic without a nominal rate, such as home_position, is never reported as silent; others have 1 Hz or more."""
    assert {topic.rate for topic in TOPICS.values() if topic.rate < 1} == {0}
    streams.add_publisher(token("home_position"), 100.0)
    assert streams.report(200.0) == UnavailableTopics()
    assert report_after_message(streams, "vehicle_attitude", 200.0).silent == (
        "1/vehicle_odometry",
    )


def test_unsupported_messages_are_listed(streams: StreamRegistry) -> None:
    """Announced messages without a definition are listed once each, sorted, and at most 100 of them."""
    for number, name in enumerate(("Rpm", "Airspeed", "Rpm")):
        streams.add_publisher(token(f"topic_{number}", name), 100.0)
    assert streams.on_message(str(token("topic_0", "Rpm").key), 100.0).unsupported == "Rpm"
    assert streams.report(100.0) == UnavailableTopics(("Airspeed", "Rpm"))
    streams.remove_publisher(token("topic_1", "Airspeed"), 100.0)
    assert streams.report(100.0) == UnavailableTopics(("Rpm",))
    for number in range(2000):
        streams.add_publisher(token(f"any{number}x", f"Any{number}"), 100.0)
    assert len(streams.report(100.0).unsupported) == 100


def test_unselected_topics_are_not_listed() -> None:
    """With `topics=` all other topics are ignored silently."""
    streams = StreamRegistry(
        Px4ZenohOptions.model_validate({"topics": "vehicle_attitude"}), vehicle="1"
    )
    streams.add_publisher(token("rpm", "Rpm"), 100.0)
    assert streams.report(100.0) == UnavailableTopics()
