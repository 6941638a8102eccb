"""The ROS 2 types of this message: their names, definitions and RIHS01 hashes, computed from the layouts."""

from __future__ import annotations

import json
from collections.abc import Mapping
from hashlib import sha256
from typing import Final

from .layouts import LAYOUTS, Layout, get_layout
from .position import VehicleLocalPosition
from .px4_types import TypeName

ROS2_TYPE: Final = "px4_msgs/msg/VehicleLocalPosition"
"""The type of all four topics in ROS 2."""

_V0_TYPES: Final = ("px4_msgs_old/msg/VehicleLocalPositionV0", "px4_msgs/msg/VehicleLocalPositionV0")
ROS2_TYPES: Final = (ROS2_TYPE, *_V0_TYPES)
"""All types that hold this message; the last two are those of PX4's translation node for layout V0."""

# type_description_interfaces/msg/FieldType: number and, for an array of fixed size, its capacity.
_FIELD_TYPES: Final[Mapping[TypeName, tuple[int, int]]] = {
    "uint8": (3, 0),
    "uint64": (9, 0),
    "float32": (10, 0),
    "float64": (11, 0),
    "bool": (15, 0),
    "float32[2]": (48 + 10, 2),
}


def dds_type(name: str) -> str:
    """Return the DDS name of a ROS 2 type, as in a key: `px4_msgs::msg::dds_::VehicleLocalPosition_`."""
    package, kind, type_name = name.split("/")
    return f"{package}::{kind}::dds_::{type_name}_"


def type_hash(layout: str, *, ros2_type: str = ROS2_TYPE) -> str:
    """Return the RIHS01 hash of a ROS 2 type with the fields of a layout (ROS REP 2016), `RIHS01_` and 64 hex digits.

    Raises LayoutError for an unknown layout.
    """
    return _hash(get_layout(layout), ros2_type)


def message_definition(layout: str) -> str:
    """Return the .msg file of a layout, with unit and meaning of each field.

    Raises LayoutError for an unknown layout.
    """
    described = VehicleLocalPosition.model_fields
    lines = []
    for name in get_layout(layout).fields:
        meaning = described[name].description if name in described else "Greatest height above ground [m]"
        lines.append(f"{get_layout(layout).type_of(name)} {name}  # {meaning}\n")
    return "".join(lines)


def layout_of_type_hash(text: str) -> str | None:
    """Return the name of the layout whose type has this hash, with `RIHS01_` or without; None if it is unknown."""
    return _LAYOUTS.get(text.removeprefix(_RIHS01).lower())


def _hash(layout: Layout, ros2_type: str) -> str:
    fields = [_describe(name, layout.type_of(name)) for name in layout.fields]
    description = {
        "type_description": {"type_name": ros2_type, "fields": fields},
        "referenced_type_descriptions": [],
    }
    return _RIHS01 + sha256(json.dumps(description).encode()).hexdigest()


def _describe(name: str, kind: TypeName) -> dict[str, object]:
    number, capacity = _FIELD_TYPES[kind]
    type_description = {"type_id": number, "capacity": capacity, "string_capacity": 0, "nested_type_name": ""}
    return {"name": name, "type": type_description}


_RIHS01 = "RIHS01_"
_LAYOUTS: Final = {
    _hash(layout, ros2_type).removeprefix(_RIHS01): layout.name
    for layout in LAYOUTS.values()
    for ros2_type in (ROS2_TYPES if layout.name == "V0" else (ROS2_TYPE,))
}
