"""ROS 2 topic names, types and type hashes, compared with those of PX4."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from nedbus_msgs import (
    MESSAGES,
    TOPICS,
    Address,
    AddressError,
    VehicleLocalPosition,
    dds_type,
    hash_of,
    ros2_topic_of,
    ros2_type,
    ros2_types,
    split_ros2_topic,
)
from tests.flights.local_position import (
    ROS2_TYPE,
    decode_cdr,
    downgrade,
    encode_cdr,
    layout_of_type_hash,
    type_hash,
    upgrade,
)

NAMESPACES = st.lists(st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,9}", fullmatch=True), max_size=3).map(
    "/".join
)
ADDRESSES = st.sampled_from(sorted(TOPICS)).flatmap(
    lambda topic: st.builds(
        Address,
        st.just("7"),
        st.just(topic),
        st.integers(0, 255) if TOPICS[topic].instances else st.none(),
    )
)


@given(ADDRESSES, NAMESPACES, st.sampled_from(["", "/"]))
def test_topic_round_trip(address: Address, namespace: str, slash: str) -> None:
    """A ROS 2 topic name splits into namespace, topic and instance again, with or without a leading slash."""
    name = ros2_topic_of(address, namespace)
    assert split_ros2_topic(slash + name) == (namespace, address.topic, address.instance)


@pytest.mark.parametrize(
    ("address", "namespace", "name"),
    [
        (Address("1", "vehicle_local_position"), "", "fmu/out/vehicle_local_position"),
        (
            Address("1", "estimator_local_position", 0),
            "px4_1",
            "px4_1/fmu/out/estimator_local_position_0",
        ),
        (
            Address("1", "vehicle_local_position"),
            "/fleet/a/",
            "fleet/a/fmu/out/vehicle_local_position",
        ),
    ],
)
def test_topic_name_matches_px4(address: Address, namespace: str, name: str) -> None:
    """The name is PX4's, below the namespace, with the instance as suffix."""
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
        ("fmu/out/vehicle_attitude_v1", ("", "vehicle_attitude", None)),
        ("fmu/out/battery_status", ("", "battery_status", 0)),
        ("fmu/out/wheel_encoders", ("", "wheel_encoders", None)),
        ("fmu/out/wheel_encoders_1", ("", "wheel_encoders", 1)),
    ],
)
def test_variants_of_topic_names_are_accepted(
    name: str, parts: tuple[str, str, int | None]
) -> None:
    """A version suffix is ignored, an instance may lack its underscore, and instance 0 may lack its number."""
    assert split_ros2_topic(name) == parts


@pytest.mark.parametrize(
    "name", ["", "/", "fmu/out/Attitude", "fmu/out/vehicle_local_position_x", "a_/", "fmu/out/_0"]
)
def test_invalid_topic_name_raises(name: str) -> None:
    """A name that no PX4 topic can have, or a misspelled one, raises AddressError."""
    with pytest.raises(AddressError, match="topic"):
        split_ros2_topic(name)


OLD = "px4_msgs_old/msg/VehicleLocalPosition"
HASHES = {
    ("1.13", ROS2_TYPE): "17c50cbaa974220380eed223bc94d4dd523c2284b3f4e74063d51aac5e76b7b0",
    ("1.14", ROS2_TYPE): "f1bdfb1a3cda989a49bb023a881c64ad75c6ef294e0bbb952f30a1f1b8282a54",
    ("1.15", ROS2_TYPE): "d7958e559f8434b5af0f4ee73139f08ba52174f4dfae724a18caa608597f820b",
    ("V0", ROS2_TYPE): "120f130998c012e3da2a4c1a955a002698144f8874b8148a2de7989439ea9ef3",
    ("V0", f"{OLD}V0"): "b53c11b6ebdbc7363a77a650888783ec5a7839ef5c1f879c8ae76b4f66eb700e",
    ("V0", f"{ROS2_TYPE}V0"): "e82a6899a4c2b67455596670679fc68121e83c44e67f12fc4286707e8c701fd0",
    ("1.16", ROS2_TYPE): "690ad535169297241c696494adbd98bbdc45566645026fe7963513a29a1bf144",
}


@pytest.mark.parametrize(("layout", "ros2_type"), HASHES)
def test_type_hash_matches_ros_2(layout: str, ros2_type: str) -> None:
    """Each type has the hash that ROS 2 computes, and the layout is found by that hash."""
    assert ros2_type in ros2_types()
    assert type_hash(layout, name=ros2_type) == f"RIHS01_{HASHES[layout, ros2_type]}"
    assert layout_of_type_hash(type_hash(layout, name=ros2_type)) == layout
    assert layout_of_type_hash(HASHES[layout, ros2_type]) == layout


def test_hash_in_the_documentation_is_that_of_log_message() -> None:
    """docs/live.md has the hash of LogMessage for libraries that compute another one."""
    definition = MESSAGES["LogMessage"]
    text = (Path(__file__).parents[3] / "docs/live.md").read_text()
    assert f'type_hash="{hash_of(definition.current, ros2_type(definition))}"' in text


def test_layout_is_found_by_hash() -> None:
    """A payload is decoded by type hash exactly as by layout name."""
    fields = downgrade(VehicleLocalPosition(timestamp=1), "1.14")
    payload = encode_cdr(fields, layout=type_hash("1.14"))
    assert payload == encode_cdr(fields, layout="1.14")
    assert upgrade(decode_cdr(payload, layout=type_hash("1.14"))).timestamp == 1
    assert layout_of_type_hash("RIHS01_" + 64 * "0") is None


def test_dds_type_matches_rmw_zenoh() -> None:
    """A ROS 2 type appears in keys as rmw_zenoh writes it."""
    assert dds_type(ROS2_TYPE) == "px4_msgs::msg::dds_::VehicleLocalPosition_"
