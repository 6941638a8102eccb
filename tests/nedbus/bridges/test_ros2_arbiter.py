"""The choice of streams that the bridge publishes to ROS 2, without a network and with a fake clock."""

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
    arbiter: Ros2Arbiter, addresses: Collection[Address], nodes: Mapping[Address, str] | None = None, *, now: float
) -> list[tuple[str, str]]:
    """Return action and topic of each decision."""
    return [(each.action, each.topic) for each in arbiter.update(addresses, nodes or {}, now=now)]


def test_topic_has_a_namespace_by_vehicle() -> None:
    """Vehicle 1 has no namespace; otherwise a configured one wins over the vehicle's name in ROS 2 form."""
    arbiter = make({"named": "/fleet/a/", "bare": ""})
    estimator = Address("wing-2", "estimator_local_position", 1)
    assert arbiter.topic_of(estimator) == "wing_2/fmu/out/estimator_local_position_1"
    namespaces = {"1": "", "7": "px4_7/", "wing": "wing/", "named": "fleet/a/", "bare": ""}
    assert {name: arbiter.topic_of(Address(name, VLP)).removesuffix(TOPIC) for name in namespaces} == namespaces


@pytest.mark.parametrize("namespace", ["7up", "a b", "a//b", "a-b", "/1/"])
def test_namespace_invalid_in_ros_2_is_rejected(namespace: str) -> None:
    """ROS 2 names begin with a letter and consist of letters, digits and underscores."""
    with pytest.raises(AddressError, match="namespace"):
        make({"1": namespace})


def test_address_is_published_once_and_withdrawn_when_gone() -> None:
    """Only changes produce decisions; a sample may arrive before or after the token."""
    arbiter = make()
    assert not arbiter.publishes(ONE)
    assert arbiter.update([ONE], {}, now=0.0) == [Decision("publish", ONE, TOPIC)]
    assert arbiter.publishes(ONE)
    assert arbiter.update([ONE], {}, now=1.0) == []
    assert arbiter.update([], {}, now=2.0) == [Decision("withdraw", ONE, TOPIC)]
    assert not arbiter.publishes(ONE)
    assert arbiter.update([], {}, now=3.0) == []


@pytest.mark.parametrize("published", [False, True])
def test_topic_of_another_node_is_left_to_it(published: bool) -> None:
    """The bridge does not publish a topic of another node, such as PX4 itself, or stops; the node is reported once."""
    arbiter = make()
    arbiter.update([ONE] if published else [], {}, now=0.0)
    assert arbiter.publishes(ONE) is published
    assert arbiter.update([ONE], {ONE: "px4"}, now=1.0) == [Decision("defer", ONE, TOPIC, "px4")]
    assert arbiter.update([ONE], {ONE: "px4"}, now=2.0) == []
    assert not arbiter.publishes(ONE)


def test_topic_is_taken_over_some_time_after_the_node_is_gone() -> None:
    """The delay starts when the node was last seen, so a node that restarts keeps its topic."""
    arbiter = make()
    for now in (0.0, 4.0):
        arbiter.update([ONE], {ONE: "px4"}, now=now)
    assert actions(arbiter, [ONE], now=4.0 + TIMINGS.take_over) == []
    assert actions(arbiter, [ONE], now=4.1 + TIMINGS.take_over) == [("publish", TOPIC)]
    assert actions(arbiter, [ONE], {ONE: "px4"}, now=20.0) == [("defer", TOPIC)]


def test_vehicle_that_was_gone_is_published_at_once() -> None:
    """An address that left the bus is forgotten, so its return is not delayed."""
    arbiter = make()
    arbiter.update([ONE], {ONE: "px4"}, now=0.0)
    arbiter.update([], {}, now=1.0)
    assert actions(arbiter, [ONE], now=2.0) == [("publish", TOPIC)]


def test_two_addresses_of_one_topic_conflict() -> None:
    """The first address in order gets the topic; the other one is reported once, and follows when that is gone."""
    arbiter = make()
    first, second = Address("a-b", VLP), Address("a_b", VLP)
    topic = f"a_b/fmu/out/{VLP}"
    assert arbiter.update([second, first], {}, now=0.0) == [
        Decision("publish", first, topic),
        Decision("conflict", second, topic, str(first)),
    ]
    assert arbiter.update([first, second], {}, now=1.0) == []
    assert (arbiter.publishes(first), arbiter.publishes(second)) == (True, False)
    assert actions(arbiter, [second], now=2.0) == [("withdraw", topic), ("publish", topic)]
    # An address that comes later does not displace one that is published, whatever their order.
    assert arbiter.update([first, second], {}, now=3.0) == [Decision("conflict", first, topic, str(second))]
    assert actions(arbiter, [first, second], {second: "px4"}, now=4.0) == [("defer", topic)]
    assert actions(arbiter, [first, second], now=5.0) == [("publish", topic)]
    assert actions(arbiter, [first, second], now=5.0 + TIMINGS.take_over) == [("conflict", topic)]  # reported again
