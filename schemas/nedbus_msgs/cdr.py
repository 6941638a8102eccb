"""The CDR codec of ROS 2, PX4's Zenoh module and rosbag2, for every layout.

It converts between payloads and fields by name; the model validates the fields.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Final, cast

from .errors import DecodeError, EncodeError
from .layouts import Layout, get_layout, require_fields
from .px4_types import TypeName
from .ros2_types import layout_of_type_hash

_HEAD: Final = b"\x00\x01\x00\x00"  # XCDR1, little-endian, no options
_PX4_EXTRA: Final = 24  # bytes that PX4 sends beyond the header and its own struct, of which CDR may need less

# Per type: its struct format and its alignment.
_FORMATS: Final[Mapping[TypeName, tuple[str, int]]] = {
    "uint64": ("Q", 8),
    "uint8": ("B", 1),
    "bool": ("B", 1),
    "float32": ("f", 4),
    "float32[2]": ("2f", 4),
    "float64": ("d", 8),
}
_LARGEST: Final[Mapping[TypeName, int]] = {"uint64": 2**64 - 1, "uint8": 2**8 - 1}


@dataclass(frozen=True, slots=True)
class _CdrLayout:
    """One layout in CDR: its body, the offset of each field in a payload, and the size limit of a payload."""

    body: struct.Struct
    types: tuple[tuple[str, TypeName], ...]
    offsets: tuple[int, ...]
    limit: int


def decode_cdr(payload: bytes, *, layout: str) -> dict[str, object]:
    """Return the fields of a CDR payload, in the order of the layout; `delta_xy` and `delta_vxy` are tuples of 2.

    `layout` is a layout's name, or the RIHS01 hash of a ROS 2 type.
    Padding is ignored, and so are the bytes that PX4 appends.
    `upgrade` makes a message of the fields.

    Raises DecodeError for another encapsulation than little-endian XCDR1, for missing or too many bytes and for a bool
    that is neither 0 nor 1; LayoutError for an unknown layout.
    """
    cdr = _cdr_layout(_get_layout(layout))
    shortest = len(_HEAD) + cdr.body.size
    if payload[:2] != _HEAD[:2]:
        raise DecodeError(f"a payload that starts with {payload[:2].hex(' ') or 'nothing'}: not little-endian CDR")
    if not shortest <= len(payload) <= cdr.limit:
        sizes = f"{shortest}" if cdr.limit == shortest else f"{shortest} to {cdr.limit}"
        raise DecodeError(f"{len(payload)} bytes, where layout {layout} has {sizes}")
    return dict(_unflatten(cdr.types, cdr.body.unpack_from(payload, len(_HEAD))))


def encode_cdr(fields: Mapping[str, object], *, layout: str) -> bytes:
    """Return the CDR payload of the fields of a layout, such as `downgrade` returns, with zeros in its padding.

    `layout` is a layout's name, or the RIHS01 hash of a ROS 2 type.
    Floats are rounded to the nearest float32 where PX4 has one.

    Raises LayoutError for other fields than the layout's, EncodeError for a value that its type cannot hold.
    """
    cdr = _cdr_layout(_get_layout(layout))
    require_fields(fields, _get_layout(layout))
    values = [item for name, kind in cdr.types for item in _flatten(name, kind, fields[name])]
    try:
        return _HEAD + cdr.body.pack(*values)
    except (OverflowError, struct.error):  # the latter for an int beyond float64
        large, kind = next((name, kind) for name, kind in cdr.types if not _fits(kind, fields[name]))
        raise EncodeError(f"{large}: {fields[large]!r:.40} is beyond the range of {kind}") from None


def cdr_offsets(layout: str) -> tuple[Mapping[str, int], bytes]:
    """Return the offset of each field in a payload of a layout, and a payload with all fields zero."""
    cdr = _cdr_layout(_get_layout(layout))
    names = (name for name, _ in cdr.types)
    return dict(zip(names, cdr.offsets, strict=True)), _HEAD + bytes(cdr.body.size)


def _get_layout(name: str) -> Layout:
    return get_layout(layout_of_type_hash(name) or name)


@cache
def _cdr_layout(layout: Layout) -> _CdrLayout:
    """Place each field of a layout at the next multiple of its alignment."""
    body, size, unpadded = "<", 0, 0
    types = tuple((name, layout.type_of(name)) for name in layout.fields)
    offsets = []
    for _, kind in types:
        form, alignment = _FORMATS[kind]
        padding = -size % alignment
        body += f"{padding}x{form}" if padding else form
        offsets.append(len(_HEAD) + size + padding)
        size += padding + struct.calcsize("<" + form)
        unpadded += struct.calcsize("<" + form)
    px4_struct = unpadded + -unpadded % 8
    limit = len(_HEAD) + max(size, px4_struct + _PX4_EXTRA)
    return _CdrLayout(struct.Struct(body), types, tuple(offsets), limit)


def _unflatten(types: tuple[tuple[str, TypeName], ...], values: tuple[object, ...]) -> Iterator[tuple[str, object]]:
    """Yield name and value of each field, given the values that struct unpacked; raise DecodeError for a bad bool."""
    rest = iter(values)
    for name, kind in types:
        value = next(rest)
        if kind == "float32[2]":
            value = (value, next(rest))
        elif kind == "bool":
            if value not in (0, 1):
                raise DecodeError(f"{name}: {value}, where a bool is 0 or 1")
            value = value == 1
        yield name, value


def _flatten(name: str, kind: TypeName, value: object) -> tuple[object, ...]:
    """Return a value as struct packs it; raise EncodeError where struct would convert it, or not name the field."""
    if kind == "float32[2]":
        if isinstance(value, tuple | list) and len(value) == 2 and all(map(_is_number, value)):
            return tuple(value)
    elif kind == "bool":
        if type(value) is bool:
            return (value,)
    elif kind in _LARGEST:
        if type(value) is int and 0 <= value <= _LARGEST[kind]:
            return (value,)
    elif _is_number(value):
        return (value,)
    raise EncodeError(f"{name}: {value!r:.40} is not a {kind}")


def _is_number(value: object) -> bool:
    return isinstance(value, float) or type(value) is int


def _fits(kind: TypeName, value: object) -> bool:
    form = "<" + _FORMATS[kind][0]
    try:
        struct.pack(form, *(cast("tuple[float, float]", value) if kind == "float32[2]" else (value,)))
    except (OverflowError, struct.error):
        return False
    return True
