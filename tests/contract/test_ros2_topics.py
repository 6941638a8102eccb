"""Names of ROS 2 topics."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nedbus_msgs import TOPICS, Address, AddressError, ros2_topic_of, split_ros2_topic

NAMESPACES = st.lists(st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,9}", fullmatch=True), max_size=3).map("/".join)
ADDRESSES = st.sampled_from(sorted(TOPICS)).flatmap(
    lambda topic: st.builds(
        Address, st.just("7"), st.just(topic), st.integers(0, 255) if TOPICS[topic].instances else st.none()
    )
)


@given(ADDRESSES, NAMESPACES, st.sampled_from(["", "/"]))
def test_topic_round_trip(address: Address, namespace: str, slash: str) -> None:
    """The name of an address's topic splits into its namespace, topic and instance, with a leading slash or not."""
    name = ros2_topic_of(address, namespace)
    assert split_ros2_topic(slash + name) == (namespace, address.topic, address.instance)


@pytest.mark.parametrize(
    ("address", "namespace", "name"),
    [
        (Address("1", "vehicle_local_position"), "", "fmu/out/vehicle_local_position"),
        (Address("1", "estimator_local_position", 0), "px4_1", "px4_1/fmu/out/estimator_local_position_0"),
        (Address("1", "vehicle_local_position"), "/fleet/a/", "fleet/a/fmu/out/vehicle_local_position"),
    ],
)
def test_topic_is_px4s(address: Address, namespace: str, name: str) -> None:
    """The name is PX4's, below the namespace; an instance is a suffix."""
    assert ros2_topic_of(address, namespace) == name


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("/fmu/out/vehicle_local_position_v1", ("", "vehicle_local_position", None)),
        ("fmu/out/estimator_local_position", ("", "estimator_local_position", 0)),
        ("px4_1/fmu/out/estimator_local_position1", ("px4_1", "estimator_local_position", 1)),
        ("a/fmu/out/estimator_local_position_v1_2", ("a", "estimator_local_position", 2)),
        ("vehicle_local_position_groundtruth", ("", "vehicle_local_position_groundtruth", None)),
        ("a/b/external_ins_local_position", ("a/b", "external_ins_local_position", None)),
    ],
)
def test_other_spellings_are_accepted(name: str, parts: tuple[str, str, int | None]) -> None:
    """A version suffix is ignored, an instance may lack its underscore, and instance 0 may lack its number."""
    assert split_ros2_topic(name) == parts


@pytest.mark.parametrize("name", ["", "/", "fmu/out/vehicle_attitude", "fmu/out/vehicle_local_position_x", "a//"])
def test_other_topics_are_rejected(name: str) -> None:
    """A topic that is not one of the four is an AddressError."""
    with pytest.raises(AddressError, match="topic"):
        split_ros2_topic(name)
