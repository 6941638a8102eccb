"""Arbitration of ROS 2 topics, without a network and with a fake clock."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import pytest

from nedbus.bridges.ros2_arbiter import Decision, Ros2Arbiter
from nedbus.errors import AddressError
from nedbus.timings import TIMINGS
from nedbus_msgs import Address
from tests.flights.messages import VLP

ONE = Address("1", VLP)
TOPIC = f"fmu/out/{VLP}"


def make(namespaces: Mapping[str, str] | None = None) -> Ros2Arbiter:
    return Ros2Arbiter(namespaces or {})


def actions(
    arbiter: Ros2Arbiter,
    addresses: Collection[Address],
    nodes: Mapping[Address, str] | None = None,
    *,
    now: float,
) -> list[tuple[str, str]]:
    """Return action and topic of each decision."""
    return [(each.action, each.topic) for each in arbiter.update(addresses, nodes or {}, now=now)]


def test_topic_namespace_is_derived_from_vehicle() -> None:
    """Vehicle 1 has no namespace; other vehicles have the configured one, or else one derived from their name."""
    arbiter = make({"named": "/fleet/a/", "bare": ""})
    estimator = Address("wing-2", "estimator_local_position", 1)
    assert arbiter.topic_of(estimator) == "wing_2/fmu/out/estimator_local_position_1"
    namespaces = {"1": "", "7": "px4_7/", "wing": "wing/", "named": "fleet/a/", "bare": ""}
    assert {
        name: arbiter.topic_of(Address(name, VLP)).removesuffix(TOPIC) for name in namespaces
    } == namespaces


@pytest.mark.parametrize("namespace", ["7up", "a b", "a//b", "a-b", "/1/"])
def test_namespace_invalid_in_ros_2_is_rejected(namespace: str) -> None:
    """A namespace raises AddressError unless its names begin with a letter and have only letters, digits and "_"."""
    with pytest.raises(AddressError, match="namespace"):
        make({"1": namespace})


def test_address_is_published_once_and_withdrawn_when_gone() -> None:
    """`update` returns only changes: an address is published once, and withdrawn when it is gone."""
    arbiter = make()
    assert ONE not in arbiter.published
    assert arbiter.update([ONE], {}, now=0.0) == [Decision("publish", ONE, TOPIC)]
    assert ONE in arbiter.published
    assert arbiter.update([ONE], {}, now=1.0) == []
    assert arbiter.update([], {}, now=2.0) == [Decision("withdraw", ONE, TOPIC)]
    assert ONE not in arbiter.published
    assert arbiter.update([], {}, now=3.0) == []


@pytest.mark.parametrize("published", [False, True])
def test_topic_of_another_node_is_not_published(published: bool) -> None:
    """A topic that another node, such as PX4, already publishes is not published, and this is reported once."""
    arbiter = make()
    arbiter.update([ONE] if published else [], {}, now=0.0)
    assert (ONE in arbiter.published) is published
    assert arbiter.update([ONE], {ONE: "px4"}, now=1.0) == [Decision("defer", ONE, TOPIC, "px4")]
    assert arbiter.update([ONE], {ONE: "px4"}, now=2.0) == []
    assert ONE not in arbiter.published


def test_topic_is_taken_over_after_a_delay() -> None:
    """A topic is taken over some time after the other node was last seen, so a node that restarts keeps its topic."""
    arbiter = make()
    for now in (0.0, 4.0):
        arbiter.update([ONE], {ONE: "px4"}, now=now)
    assert actions(arbiter, [ONE], now=4.0 + TIMINGS.take_over) == []
    assert actions(arbiter, [ONE], now=4.1 + TIMINGS.take_over) == [("publish", TOPIC)]
    assert actions(arbiter, [ONE], {ONE: "px4"}, now=20.0) == [("defer", TOPIC)]


def test_returning_vehicle_is_published_without_delay() -> None:
    """An address that leaves the bus is forgotten, so it is published at once when it returns."""
    arbiter = make()
    arbiter.update([ONE], {ONE: "px4"}, now=0.0)
    arbiter.update([], {}, now=1.0)
    assert actions(arbiter, [ONE], now=2.0) == [("publish", TOPIC)]


def test_addresses_with_the_same_topic_conflict() -> None:
    """The first address gets the topic; the second one is reported once, and published when the first is gone."""
    arbiter = make()
    first, second = Address("a-b", VLP), Address("a_b", VLP)
    topic = f"a_b/fmu/out/{VLP}"
    assert arbiter.update([second, first], {}, now=0.0) == [
        Decision("publish", first, topic),
        Decision("conflict", second, topic, str(first)),
    ]
    assert arbiter.update([first, second], {}, now=1.0) == []
    assert [*arbiter.published] == [first]
    assert actions(arbiter, [second], now=2.0) == [("withdraw", topic), ("publish", topic)]
    # A later address does not displace a published one, whatever their order.
    assert arbiter.update([first, second], {}, now=3.0) == [
        Decision("conflict", first, topic, str(second))
    ]
    assert actions(arbiter, [first, second], {second: "px4"}, now=4.0) == [("defer", topic)]
    assert actions(arbiter, [first, second], now=5.0) == [("publish", topic)]
    # reported again
    assert actions(arbiter, [first, second], now=5.0 + TIMINGS.take_over) == [("conflict", topic)]
