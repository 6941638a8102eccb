"""The CDR codec: the message as ROS 2, PX4's Zenoh module and rosbag2 have it, in every layout.

This layer gives fields by name; whether they make a message is for the model to judge.
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

# Per type: the letters of struct, and what the type is aligned to.
_FORMS: Final[Mapping[TypeName, tuple[str, int]]] = {
    "uint64": ("Q", 8),
    "uint8": ("B", 1),
    "bool": ("B", 1),
    "float32": ("f", 4),
    "float32[2]": ("2f", 4),
    "float64": ("d", 8),
}
_LARGEST: Final[Mapping[TypeName, int]] = {"uint64": 2**64 - 1, "uint8": 2**8 - 1}


@dataclass(frozen=True, slots=True)
class _Form:
    """One layout in CDR: its body, where each field stands in a payload, and the most bytes that it can have."""

    body: struct.Struct
    types: tuple[tuple[str, TypeName], ...]
    places: tuple[int, ...]
    limit: int


def decode_cdr(payload: bytes, *, layout: str) -> dict[str, object]:
    """Return the fields of a CDR payload, in the order of the layout; `delta_xy` and `delta_vxy` are tuples of 2.

    `layout` is a layout's name, or the RIHS01 hash of a ROS 2 type.
    What stands in the padding is ignored, and so is what PX4 appends.
    `upgrade` makes a message of the fields.

    Raises DecodeError for another encapsulation than little-endian XCDR1, for missing or too many bytes and for a bool
    that is neither 0 nor 1; LayoutError for the name of no layout.
    """
    form = _form(_get_layout(layout))
    shortest = len(_HEAD) + form.body.size
    if payload[:2] != _HEAD[:2]:
        raise DecodeError(f"a payload that starts with {payload[:2].hex(' ') or 'nothing'}: not little-endian CDR")
    if not shortest <= len(payload) <= form.limit:
        least = f"{shortest}" if form.limit == shortest else f"{shortest} to {form.limit}"
        raise DecodeError(f"{len(payload)} bytes, where layout {layout} has {least}")
    return dict(_take(form, form.body.unpack_from(payload, len(_HEAD))))


def encode_cdr(fields: Mapping[str, object], *, layout: str) -> bytes:
    """Return the CDR payload of the fields of a layout, with zeros in its padding; `downgrade` gives such fields.

    `layout` is a layout's name, or the RIHS01 hash of a ROS 2 type.
    Floats are rounded to the nearest float32 where PX4 has one.

    Raises LayoutError for other fields than the layout's, EncodeError for a value that its type cannot hold.
    """
    form = _form(_get_layout(layout))
    require_fields(fields, _get_layout(layout))
    values = [item for name, kind in form.types for item in _give(name, kind, fields[name])]
    try:
        return _HEAD + form.body.pack(*values)
    except (OverflowError, struct.error):  # the latter for an int that is no float at all
        large = next(name for name, kind in form.types if not _fits(kind, fields[name]))
        raise EncodeError(f"{large}: {fields[large]!r:.40} is beyond {dict(form.types)[large]}") from None


def places_in_cdr(layout: str) -> tuple[Mapping[str, int], bytes]:
    """Return where each field stands in a payload of a layout, and that payload with nothing but zeros."""
    form = _form(_get_layout(layout))
    names = (name for name, _ in form.types)
    return dict(zip(names, form.places, strict=True)), _HEAD + bytes(form.body.size)


def _get_layout(name: str) -> Layout:
    return get_layout(layout_of_type_hash(name) or name)


@cache
def _form(layout: Layout) -> _Form:
    """Lay the fields of a layout out: each at the next multiple of its alignment."""
    letters, size, unpadded = "<", 0, 0
    types = tuple((name, layout.type_of(name)) for name in layout.fields)
    places = []
    for _, kind in types:
        form, alignment = _FORMS[kind]
        gap = -size % alignment
        letters += f"{gap}x{form}" if gap else form
        places.append(len(_HEAD) + size + gap)
        size += gap + struct.calcsize("<" + form)
        unpadded += struct.calcsize("<" + form)
    px4_struct = unpadded + -unpadded % 8
    limit = len(_HEAD) + max(size, px4_struct + _PX4_EXTRA)
    return _Form(struct.Struct(letters), types, tuple(places), limit)


def _take(form: _Form, values: tuple[object, ...]) -> Iterator[tuple[str, object]]:
    rest = iter(values)
    for name, kind in form.types:
        value = next(rest)
        if kind == "float32[2]":
            value = (value, next(rest))
        elif kind == "bool":
            if value not in (0, 1):
                raise DecodeError(f"{name}: {value}, where a bool is 0 or 1")
            value = value == 1
        yield name, value


def _give(name: str, kind: TypeName, value: object) -> tuple[object, ...]:
    """Return the value as struct packs it; raise EncodeError for what struct would let through, or tell less of."""
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
    raise EncodeError(f"{name}: {value!r:.40} is no {kind}")


def _is_number(value: object) -> bool:
    return isinstance(value, float) or type(value) is int


def _fits(kind: TypeName, value: object) -> bool:
    form = "<" + _FORMS[kind][0]
    try:
        struct.pack(form, *(cast("tuple[float, float]", value) if kind == "float32[2]" else (value,)))
    except (OverflowError, struct.error):
        return False
    return True
