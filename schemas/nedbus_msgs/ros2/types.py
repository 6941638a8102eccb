"""ROS 2 types of messages: names, .msg definitions and RIHS01 hashes, computed from layouts."""

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from hashlib import sha256
from typing import Any, Final, NamedTuple

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
    return {known.name: known.definition for known in _known_types()}


class _KnownType(NamedTuple):
    """A ROS 2 type of a built-in message, and the layout that it stands for."""

    name: str
    definition: Definition[Any]
    layout: Layout


def _known_types() -> Iterator[_KnownType]:
    for definition in MESSAGES.values():
        for layout in definition.layouts.values():
            yield _KnownType(ros2_type(definition), definition, layout)
            for alias in layout.aliases:
                yield _KnownType(alias, definition, layout)


def hash_of(layout: Layout, ros2_type: str, *, literal_char: bool = False) -> str:
    """Return the RIHS01 hash (REP 2016) of a ROS 2 type with the fields of a layout: `RIHS01_` and 64 hex digits."""
    ids = TYPE_IDS[literal_char]
    fields = []
    for name, kind in layout.types.items():
        length = kind.length or 0
        field = describe_field(name, ids[kind.base], length)
        fields.append(field)
    return type_hash((ros2_type, fields))


def type_hash(*types: tuple[str, Sequence[Mapping[str, object]]]) -> str:
    """Return the RIHS01 hash of the first type, as name and fields; its nested types follow, sorted by name."""
    described = [{"type_name": name, "fields": fields} for name, fields in types]
    root, *referenced = described
    content = {"type_description": root, "referenced_type_descriptions": referenced}
    digest = sha256(json.dumps(content).encode())
    return _RIHS01 + digest.hexdigest()


def describe_field(name: str, type_id: int, length: int, nested: str = "") -> Mapping[str, object]:
    """Return a field of a type description; `length`: 0 unless it is an array; `nested`: type of a nested message."""
    if length:
        type_id += _ARRAY
    kind = {
        "type_id": type_id,
        "capacity": length,
        "string_capacity": 0,
        "nested_type_name": nested,
    }
    return {"name": name, "type": kind}


def definition_text(definition: Definition[Any], layout: Layout) -> str:
    """Return the .msg definition of a layout, with the unit and meaning of each field."""
    text = ""
    for name, kind in layout.types.items():
        text += f"{kind} {name}"
        meaning = definition.meaning(name)
        if meaning:
            text += f"  # {meaning}"
        text += "\n"
    return text


def message_of_type_hash(text: str) -> tuple[Definition[Any], Layout] | None:
    """Return the message and layout with a type hash, given with or without `RIHS01_`; None if unknown."""
    digits = _digits_of(text)
    known = _by_hash(False).get(digits)
    if known is not None:
        return known
    return _by_hash(True).get(digits)


def has_char_hash(text: str) -> bool:
    """Return whether a type hash is known only with `literal_char`."""
    digits = _digits_of(text)
    if digits in _by_hash(False):
        return False
    return digits in _by_hash(True)


def _digits_of(text: str) -> str:
    return text.removeprefix(_RIHS01).lower()


@cache
def _by_hash(literal_char: bool) -> Mapping[str, tuple[Definition[Any], Layout]]:
    layouts: dict[str, tuple[Definition[Any], Layout]] = {}
    for known in _known_types():
        text = hash_of(known.layout, known.name, literal_char=literal_char)
        layouts[_digits_of(text)] = known.definition, known.layout
    return layouts
