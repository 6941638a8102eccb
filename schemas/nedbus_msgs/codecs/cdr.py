"""The CDR codec of ROS 2, PX4's Zenoh module and rosbag2, for every layout.

It converts between payloads and fields by name; the model validates the fields.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import islice
from typing import Any, Final

from nedbus_msgs.errors import DecodeError, EncodeError
from nedbus_msgs.model.declaration import Layout
from nedbus_msgs.model.definition import Definition
from nedbus_msgs.model.layouts import require_fields
from nedbus_msgs.model.px4_types import BASES, FieldType

HEAD: Final = b"\x00\x01\x00\x00"  # XCDR1, little-endian, no options
_PX4_EXTRA: Final = 24  # bytes that PX4 sends beyond the header and its own struct, of which CDR may need less


@dataclass(frozen=True, slots=True)
class CdrLayout:
    """One layout in CDR: its body, and the offset of each field in a payload; no payload is longer than `limit`."""

    body: struct.Struct
    offsets: Mapping[str, int]
    limit: int

    @property
    def zeros(self) -> bytes:
        """A payload with all fields zero."""
        return HEAD + bytes(self.body.size)


def decode_with(definition: Definition[Any], payload: bytes, layout: Layout) -> dict[str, object]:
    """Return the fields of a CDR payload, in the order of the layout; arrays are tuples.

    Padding is ignored, and so are the bytes that PX4 appends.

    Raises DecodeError for another encapsulation than little-endian XCDR1, for missing or too many bytes and for a bool
    that is neither 0 nor 1.
    """
    cdr = cdr_layout(layout)
    shortest = len(HEAD) + cdr.body.size
    if payload[:2] != HEAD[:2]:
        start = payload[:2].hex(" ") or "nothing"
        raise DecodeError(f"a payload that starts with {start}: not little-endian CDR", definition.name)
    if not shortest <= len(payload) <= cdr.limit:
        sizes = f"{shortest}" if cdr.limit == shortest else f"{shortest} to {cdr.limit}"
        raise DecodeError(f"{len(payload)} bytes, where layout {layout.name} has {sizes}", definition.name)
    return dict(_unflatten(definition, layout.types, cdr.body.unpack_from(payload, len(HEAD))))


def encode_with(definition: Definition[Any], fields: Mapping[str, object], layout: Layout) -> bytes:
    """Return the CDR payload of the fields of a layout, such as `downgrade` returns, with zeros in its padding.

    Floats are rounded to the nearest float32 where PX4 has one.

    Raises LayoutError for other fields than the layout's, EncodeError for a value that its type cannot hold.
    """
    cdr = cdr_layout(layout)
    require_fields(definition, fields, layout)
    values = [item for name, kind in layout.types.items() for item in _flatten(definition, name, kind, fields[name])]
    try:
        return HEAD + cdr.body.pack(*values)
    except (OverflowError, struct.error):  # the latter for an int beyond float64
        large, kind = next((name, kind) for name, kind in layout.types.items() if not _fits(kind, fields[name]))
        reason = f"{large}: {fields[large]!r:.40} is beyond the range of {kind}"
        raise EncodeError(reason, definition.name) from None


@cache
def cdr_layout(layout: Layout) -> CdrLayout:
    """Return how a layout lies in a payload: each field at the next multiple of its alignment."""
    body, size, unpadded = "<", 0, 0
    offsets = {}
    for name, kind in layout.types.items():
        padding = -size % kind.size
        body += (f"{padding}x" if padding else "") + _format(kind)
        offsets[name] = len(HEAD) + size + padding
        size += padding + kind.size * kind.count
        unpadded += kind.size * kind.count
    px4_struct = unpadded + -unpadded % 8
    limit = len(HEAD) + max(size, px4_struct + _PX4_EXTRA)
    return CdrLayout(struct.Struct(body), offsets, limit)


def _format(kind: FieldType) -> str:
    return f"{kind.count}{'B' if kind.base == 'bool' else BASES[kind.base].code}"


def _unflatten(
    definition: Definition[Any], types: Mapping[str, FieldType], values: tuple[object, ...]
) -> Iterator[tuple[str, object]]:
    """Yield name and value of each field, given the values that struct unpacked; raise DecodeError for a bad bool."""
    rest = iter(values)
    for name, kind in types.items():
        value: Any = next(rest) if kind.length is None else tuple(islice(rest, kind.length))
        if kind.base == "bool":
            for part in (value,) if kind.length is None else value:
                if part not in (0, 1):
                    raise DecodeError(f"{name}: {part}, where a bool is 0 or 1", definition.name)
            value = value == 1 if kind.length is None else tuple(map(bool, value))
        yield name, value


def _flatten(definition: Definition[Any], name: str, kind: FieldType, value: object) -> tuple[object, ...]:
    """Return a value as struct packs it; raise EncodeError where struct would convert it, or not name the field."""
    if kind.length is None:
        if _is_of(kind, value):
            return (value,)
    elif isinstance(value, tuple | list) and len(value) == kind.length and all(_is_of(kind, part) for part in value):
        return tuple(value)
    raise EncodeError(f"{name}: {value!r:.40} is not a {kind}", definition.name)


def _is_of(kind: FieldType, value: object) -> bool:
    if kind.base == "bool":
        return type(value) is bool
    if kind.is_float:
        return isinstance(value, float) or type(value) is int
    least, greatest = kind.limits
    return type(value) is int and least <= value <= greatest


def _fits(kind: FieldType, value: Any) -> bool:
    try:
        struct.pack("<" + _format(kind), *(value if kind.length else (value,)))
    except (OverflowError, struct.error):
        return False
    return True
