"""Topics that are announced and do not arrive, or are not carried, at times that the test gives."""

from __future__ import annotations

import pytest

from nedbus.sources import Absence
from nedbus.sources.px4.publishers import PublisherTable
from nedbus.transport import PublisherToken, TopicKey, publisher_token
from nedbus_msgs import Address


def token(topic: str, *, session: str = "a") -> PublisherToken:
    """Return the token of a PX4's publisher; which type it has does not matter here."""
    key = TopicKey(0, f"fmu/out/{topic}", "px4_msgs::msg::dds_::Any_", "hash")
    return PublisherToken.parse(publisher_token(key, session, "px4_aabbcc00000000000000000000000000", 1))


@pytest.fixture
def absences() -> PublisherTable:
    """Return what knows of two topics, announced at 100 s by one node."""
    absences = PublisherTable()
    for topic in ("vehicle_attitude", "vehicle_odometry"):
        absences.add(token(topic), Address("1", topic), 100.0)
    return absences


def hear(absences: PublisherTable, topic: str, now: float) -> Absence:
    """Return what is absent just after a message."""
    assert not absences.hear(token(topic).key, now)
    return absences.report(now)


def test_topic_is_silent_after_5_s_while_others_arrive(absences: PublisherTable) -> None:
    """It is silent from 5 s on, whether something came before or not, until something comes, or it is withdrawn."""
    assert hear(absences, "vehicle_attitude", 104.9) == Absence()
    assert hear(absences, "vehicle_attitude", 105.0) == Absence((), ("1/vehicle_odometry",))
    assert hear(absences, "vehicle_odometry", 105.1) == Absence()
    assert hear(absences, "vehicle_attitude", 110.2) == Absence((), ("1/vehicle_odometry",))
    absences.remove(token("vehicle_odometry"), 110.2)
    assert absences.report(110.2) == Absence()


def test_nothing_is_silent_while_nothing_arrives(absences: PublisherTable) -> None:
    """A vehicle whose link is down loses all its topics, and another one does not make up for it."""
    absences.add(token("vehicle_status", session="b"), Address("2", "vehicle_status"), 100.0)
    assert absences.report(200.0) == Absence()
    assert hear(absences, "vehicle_status", 200.0) == Absence()


def test_topic_on_events_is_never_silent(absences: PublisherTable) -> None:
    """home_position, and topics of which nobody knows the rate, may not come for as long as they like."""
    for topic in ("home_position", "wheel_encoders"):
        absences.add(token(topic), Address("1", topic), 100.0)
    assert absences.report(200.0) == Absence()
    assert hear(absences, "vehicle_attitude", 200.0).silent == ("1/vehicle_odometry",)


def test_messages_that_are_not_carried_are_listed(absences: PublisherTable) -> None:
    """They are sorted, each once, without those that nobody wants, for as long as they are announced; and bounded."""
    for number, name in enumerate(("Rpm", "Airspeed", "Rpm", "")):
        absences.add(token(f"topic_{number}"), name, 100.0)
    assert absences.hear(token("topic_0").key, 100.0)
    assert absences.report(100.0) == Absence(("Airspeed", "Rpm"))
    absences.remove(token("topic_1"), 100.0)
    assert absences.report(100.0) == Absence(("Rpm",))
    for number in range(2000):
        absences.add(token(f"any_{number}"), f"Any{number}", 100.0)
    assert len(absences.report(100.0).not_carried) == 100
