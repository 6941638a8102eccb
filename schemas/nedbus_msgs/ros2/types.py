"""ROS 2 types of messages: names, .msg definitions and RIHS01 hashes, computed from layouts."""

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from hashlib import sha256
from typing import Any, Final

from nedbus_msgs.model.declaration import Layout
from nedbus_msgs.model.definition import MESSAGES, Definition
from nedbus_msgs.model.px4_types import BASES

PACKAGE: Final = "px4_msgs/msg"
NESTED: Final = 1  # type id of a nested message
BYTE: Final = 16  # type id of a byte, which has the values of a uint8
LITERAL_CHAR: Final = 13  # type id of the IDL's char, which some libraries give a char; in a .msg file, that is a uint8
_ARRAY: Final = 48  # offset of fixed-size arrays in type_description_interfaces/msg/FieldType
_RIHS01: Final = "RIHS01_"


def ros2_type(definition: Definition[Any]) -> str:
    """Return the ROS 2 type of a message, such as px4_msgs/msg/VehicleAttitude."""
    return f"{PACKAGE}/{definition.name}"


def dds_type(name: str) -> str:
    """Return the DDS name of a ROS 2 type, as used in keys: `px4_msgs::msg::dds_::VehicleLocalPosition_`."""
    package, kind, type_name = name.split("/")
    return f"{package}::{kind}::dds_::{type_name}_"


@cache
def ros2_types() -> Mapping[str, Definition[Any]]:
    """Return the definitions of built-in messages by ROS 2 type, including the types of PX4's translation node."""
    return {name: definition for name, definition, _ in _named_layouts()}


def _named_layouts() -> Iterator[tuple[str, Definition[Any], Layout]]:
    """Yield the layouts of built-in messages, each with its ROS 2 types."""
    for definition in MESSAGES.values():
        for layout in definition.layouts.values():
            yield from ((name, definition, layout) for name in (ros2_type(definition), *layout.aliases))


def hash_of(layout: Layout, ros2_type: str, *, char: int = BASES["char"].ros2) -> str:
    """Return the RIHS01 hash (REP 2016) of a ROS 2 type with the fields of a layout: `RIHS01_` and 64 hex digits."""
    ids = ((name, char if kind.is_text else BASES[kind.base].ros2, kind.length) for name, kind in layout.types.items())
    return type_hash((ros2_type, [describe_field(name, type_id, length or 0) for name, type_id, length in ids]))


def type_hash(*types: tuple[str, Sequence[Mapping[str, object]]]) -> str:
    """Return the RIHS01 hash of the first type, as name and fields; its nested types follow, sorted by name."""
    root, *referenced = [{"type_name": name, "fields": fields} for name, fields in types]
    content = {"type_description": root, "referenced_type_descriptions": referenced}
    return _RIHS01 + sha256(json.dumps(content).encode()).hexdigest()


def describe_field(name: str, type_id: int, length: int, nested: str = "") -> Mapping[str, object]:
    """Return a field of a type description; `length`: 0 unless it is an array; `nested`: type of a nested message."""
    type_id += _ARRAY if length else 0
    kind = {"type_id": type_id, "capacity": length, "string_capacity": 0, "nested_type_name": nested}
    return {"name": name, "type": kind}


def definition_text(definition: Definition[Any], layout: Layout) -> str:
    """Return the .msg definition of a layout, with the unit and meaning of each field."""
    lines = ((f"{kind} {name}", definition.meaning(name)) for name, kind in layout.types.items())
    return "".join(f"{field}  # {meaning}\n" if meaning else f"{field}\n" for field, meaning in lines)


def message_of_type_hash(text: str) -> tuple[Definition[Any], Layout] | None:
    """Return the message and layout with a type hash, given with or without `RIHS01_`; None if unknown."""
    digits = text.removeprefix(_RIHS01).lower()
    return _by_hash().get(digits) or _by_hash(LITERAL_CHAR).get(digits)


def has_literal_char(text: str) -> bool:
    """Return whether a type hash is that of a built-in message whose `char` is taken literally, unlike in ROS 2."""
    digits = text.removeprefix(_RIHS01).lower()
    return digits in _by_hash(LITERAL_CHAR) and digits not in _by_hash()


@cache
def _by_hash(char: int = BASES["char"].ros2) -> Mapping[str, tuple[Definition[Any], Layout]]:
    hashes = ((hash_of(layout, name, char=char), each, layout) for name, each, layout in _named_layouts())
    return {text.removeprefix(_RIHS01): (each, layout) for text, each, layout in hashes}
