"""ROS 2's types of the message, compared with PX4's known type hashes."""

from __future__ import annotations

import pytest

from nedbus_msgs import (
    ROS2_TYPE,
    ROS2_TYPES,
    LayoutError,
    VehicleLocalPosition,
    dds_type,
    decode_cdr,
    downgrade,
    encode_cdr,
    layout_of_type_hash,
    type_hash,
    upgrade,
)

HASHES = {
    ("1.13", ROS2_TYPE): "17c50cbaa974220380eed223bc94d4dd523c2284b3f4e74063d51aac5e76b7b0",
    ("1.14", ROS2_TYPE): "f1bdfb1a3cda989a49bb023a881c64ad75c6ef294e0bbb952f30a1f1b8282a54",
    ("1.15", ROS2_TYPE): "d7958e559f8434b5af0f4ee73139f08ba52174f4dfae724a18caa608597f820b",
    ("V0", ROS2_TYPE): "120f130998c012e3da2a4c1a955a002698144f8874b8148a2de7989439ea9ef3",
    ("V0", "px4_msgs_old/msg/VehicleLocalPositionV0"): (
        "b53c11b6ebdbc7363a77a650888783ec5a7839ef5c1f879c8ae76b4f66eb700e"
    ),
    ("V0", "px4_msgs/msg/VehicleLocalPositionV0"): "e82a6899a4c2b67455596670679fc68121e83c44e67f12fc4286707e8c701fd0",
    ("1.16", ROS2_TYPE): "690ad535169297241c696494adbd98bbdc45566645026fe7963513a29a1bf144",
}


@pytest.mark.parametrize(("layout", "ros2_type"), HASHES)
def test_hash_is_ros_2s(layout: str, ros2_type: str) -> None:
    """The hash is the one that ROS 2 computes of each type, and the layout is found by it."""
    assert ros2_type in ROS2_TYPES
    assert type_hash(layout, ros2_type=ros2_type) == f"RIHS01_{HASHES[layout, ros2_type]}"
    assert layout_of_type_hash(type_hash(layout, ros2_type=ros2_type)) == layout
    assert layout_of_type_hash(HASHES[layout, ros2_type]) == layout


def test_layout_is_found_by_hash() -> None:
    """A payload is decoded by the hash of its type as by the name of its layout."""
    fields = downgrade(VehicleLocalPosition(timestamp=1), "1.14")
    payload = encode_cdr(fields, layout=type_hash("1.14"))
    assert payload == encode_cdr(fields, layout="1.14")
    assert upgrade(decode_cdr(payload, layout=type_hash("1.14"))).timestamp == 1
    assert layout_of_type_hash("RIHS01_" + 64 * "0") is None
    with pytest.raises(LayoutError, match=r"unknown layout '1.12': choose from 1.13, 1.14, 1.15, V0, 1.16"):
        decode_cdr(payload, layout="1.12")


def test_dds_type_is_the_keys() -> None:
    """A ROS 2 type is written in a key as rmw_zenoh writes it."""
    assert dds_type(ROS2_TYPE) == "px4_msgs::msg::dds_::VehicleLocalPosition_"
