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
_IDS: Final = {name: base.ros2 for name, base in BASES.items()} | {"byte": 16}
TYPE_IDS: Final = {False: _IDS, True: _IDS | {"char": 13}}
"""Type ids of base types; True: as libraries have them that take the char of a .msg file, a uint8, for the IDL's."""

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
            yield from (
                (name, definition, layout) for name in (ros2_type(definition), *layout.aliases)
            )


def hash_of(layout: Layout, ros2_type: str, *, literal_char: bool = False) -> str:
    """Return the RIHS01 hash (REP 2016) of a ROS 2 type with the fields of a layout: `RIHS01_` and 64 hex digits."""
    ids = TYPE_IDS[literal_char]
    fields = [
        describe_field(name, ids[kind.base], kind.length or 0)
        for name, kind in layout.types.items()
    ]
    return type_hash((ros2_type, fields))


def type_hash(*types: tuple[str, Sequence[Mapping[str, object]]]) -> str:
    """Return the RIHS01 hash of the first type, as name and fields; its nested types follow, sorted by name."""
    root, *referenced = [{"type_name": name, "fields": fields} for name, fields in types]
    content = {"type_description": root, "referenced_type_descriptions": referenced}
    return _RIHS01 + sha256(json.dumps(content).encode()).hexdigest()


def describe_field(name: str, type_id: int, length: int, nested: str = "") -> Mapping[str, object]:
    """Return a field of a type description; `length`: 0 unless it is an array; `nested`: type of a nested message."""
    type_id += _ARRAY if length else 0
    kind = {
        "type_id": type_id,
        "capacity": length,
        "string_capacity": 0,
        "nested_type_name": nested,
    }
    return {"name": name, "type": kind}


def definition_text(definition: Definition[Any], layout: Layout) -> str:
    """Return the .msg definition of a layout, with the unit and meaning of each field."""
    lines = ((f"{kind} {name}", definition.meaning(name)) for name, kind in layout.types.items())
    return "".join(
        f"{field}  # {meaning}\n" if meaning else f"{field}\n" for field, meaning in lines
    )


def message_of_type_hash(text: str) -> tuple[Definition[Any], Layout] | None:
    """Return the message and layout with a type hash, given with or without `RIHS01_`; None if unknown."""
    digits = text.removeprefix(_RIHS01).lower()
    return _by_hash(False).get(digits) or _by_hash(True).get(digits)


def has_char_hash(text: str) -> bool:
    """Return whether a type hash is known only with `literal_char`."""
    return message_of_type_hash(text) is not None and text.removeprefix(
        _RIHS01
    ).lower() not in _by_hash(False)


@cache
def _by_hash(literal_char: bool) -> Mapping[str, tuple[Definition[Any], Layout]]:
    hashes = [
        (hash_of(at, name, literal_char=literal_char), each, at)
        for name, each, at in _named_layouts()
    ]
    return {text.removeprefix(_RIHS01): (each, layout) for text, each, layout in hashes}
