"""The msgpack codec: one array `[layout, field 1 ... field 53]` of exactly 244 bytes.

The encoder writes every field at its full width, so a payload is both plain msgpack and a fixed-size struct.
Any other valid msgpack encoding of the array is decoded as well.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Final, cast

import msgpack
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from .errors import DecodeError, EncodeError, InvalidMessageError, UnknownLayoutError
from .fast_path import check_row, passes_rules, row_of
from .layouts import CURRENT, WIRE_LAYOUTS, upgrade
from .position import VehicleLocalPosition, message_of
from .px4_types import TypeName
from .rows import FIELD_TYPES, NAMES, Row, Values, explain_unknown_field

PAYLOAD_SIZE: Final = 244
"""Bytes of every payload that `encode` returns."""

PAYLOAD_LIMIT: Final = 4096
"""Bytes of the largest payload that `decode` accepts; every encoding of the array is much smaller."""

# Per type: its tag, the struct format of tag and value, and the mask of the value's bits.
# A bool is only a tag, 0xc2 or 0xc3: its last bit is the value.
_FULL_WIDTH: Final[Mapping[TypeName, tuple[bytes, str, bytes]]] = {
    "uint64": (b"\xcf" + bytes(8), "xQ", b"\x00" + b"\xff" * 8),
    "uint8": (b"\xcc" + bytes(1), "xB", b"\x00\xff"),
    "bool": (b"\xc2", "?", b"\x01"),
    "float32": (b"\xca" + bytes(4), "xf", b"\x00" + b"\xff" * 4),
    "float32[2]": (b"\x92" + (b"\xca" + bytes(4)) * 2, "xxfxf", b"\x00" + (b"\x00" + b"\xff" * 4) * 2),
    "float64": (b"\xcb" + bytes(8), "xd", b"\x00" + b"\xff" * 8),
}
_HEAD = struct.pack(">BHB", 0xDC, 1 + len(FIELD_TYPES), cast("int", CURRENT.wire))
_TYPES = [_FULL_WIDTH[kind] for kind in FIELD_TYPES.values()]
TAGS = int.from_bytes(_HEAD + b"".join(tags for tags, _, _ in _TYPES), "big")
_VALUE_MASK = int.from_bytes(bytes(len(_HEAD)) + b"".join(values for _, _, values in _TYPES), "big")
TAG_MASK = ((1 << 8 * PAYLOAD_SIZE) - 1) ^ _VALUE_MASK
_FIXED = struct.Struct(f">{len(_HEAD)}x" + "".join(form for _, form, _ in _TYPES))

_make_row = cast("Callable[[Values], Row]", partial(tuple.__new__, Row))  # as _make, without a look at the length
_FIRST, _SECOND = (NAMES.index(name) for name, kind in FIELD_TYPES.items() if kind == "float32[2]")


def value_offsets() -> Iterator[tuple[str, int, int]]:
    """Yield name, part (of delta_xy and delta_vxy, else 0) and offset of every value in a full-width payload."""
    offset = len(_HEAD)
    for name, kind in FIELD_TYPES.items():
        _, _, bits = _FULL_WIDTH[kind]
        starts = (index for index, each in enumerate(bits) if each and not (index and bits[index - 1]))
        yield from ((name, part, offset + start) for part, start in enumerate(starts))
        offset += len(bits)


def encode(message: VehicleLocalPosition) -> bytes:
    """Return the 244 bytes of a message; ref_lat and ref_lon are float64, all other floats float32.

    Raises EncodeError for values that do not fit their fields, in a message whose validation was bypassed.
    """
    try:
        return _pack(tuple(message.__dict__.values()))
    except (struct.error, OverflowError, TypeError) as exc:
        raise EncodeError(str(exc)) from exc


def encode_fields(fields: Mapping[str, object]) -> bytes:
    """Return the 244 bytes of the message with these fields, validated without making a model of them.

    Raises InvalidMessageError for an invalid message.
    """
    row = row_of(fields)
    return encode(_to_model(fields)) if row is None else _encode_valid_row(row)


def encode_row(values: Sequence[object] | Row) -> bytes:
    """Return the 244 bytes of the message with these values of all fields, validated without making a model of them.

    The values are in PX4's order.
    Raises EncodeError for another number of values, InvalidMessageError for an invalid message.
    """
    values = tuple(values)
    if len(values) != len(NAMES):
        raise EncodeError(f"{len(values)} values, where a row has {len(NAMES)}")
    row = check_row(values)
    return encode(_to_model(dict(zip(NAMES, values, strict=True)))) if row is None else _encode_valid_row(row)


def decode(payload: bytes, *, newer: Mapping[int, Sequence[str]] | None = None) -> VehicleLocalPosition:
    """Return the message of a payload, validated by the model.

    `newer` has the field names of layouts that this version does not know, by their number on the wire: fields with a
    known name are decoded, the others ignored.

    Raises UnknownLayoutError for a layout that is neither known nor in `newer`, DecodeError for anything else that is
    not one message: other types, other lengths, trailing, missing or too many bytes, values that the model rejects.
    """
    row = _decode_full_width(payload)
    return _decode_any(payload, newer) if row is None else message_of(row)


def decode_row(payload: bytes, *, newer: Mapping[int, Sequence[str]] | None = None) -> Row:
    """Return the message of a payload as a named tuple, validated by the same types and rules as in `decode`."""
    row = _decode_full_width(payload)
    return _make_row(tuple(_decode_any(payload, newer).__dict__.values()) if row is None else row)


def describe(error: ValidationError) -> str:
    """Return a validation error in one line: each field, the reason, and its value."""
    return "; ".join(map(_describe, error.errors(include_url=False)))


def _describe(detail: ErrorDetails) -> str:
    text = f"{'.'.join(map(str, detail['loc']))}: {detail['msg']}"
    if detail["type"] == "missing":
        return text
    if detail["type"] == "extra_forbidden":
        text = explain_unknown_field(str(detail["loc"][0]))
    return f"{text} (is {detail['input']!r:.40})"


def _pack(row: Values) -> bytes:
    """Pack a row; raise struct.error, OverflowError or TypeError for values that do not fit their fields."""
    one, two = cast("tuple[Values, Values]", (row[_FIRST], row[_SECOND]))
    flat = (*row[:_FIRST], *one, *row[_FIRST + 1 : _SECOND], *two, *row[_SECOND + 1 :])
    # The packed struct has zeros in place of the tags, and TAGS has zeros in place of the values.
    return (int.from_bytes(_FIXED.pack(*flat), "big") | TAGS).to_bytes(PAYLOAD_SIZE, "big")


def _encode_valid_row(row: Values) -> bytes:
    try:
        return _pack(row)
    except OverflowError:  # beyond float32: the model raises the error for it
        return encode(_to_model(dict(zip(NAMES, row, strict=True))))


def _to_model(fields: Mapping[str, object]) -> VehicleLocalPosition:
    try:
        return VehicleLocalPosition.model_validate(dict(fields))
    except ValidationError as exc:
        violations = [(str(detail["loc"][0]), detail["msg"]) for detail in exc.errors(include_url=False)]
        raise InvalidMessageError(describe(exc), violations) from exc


def _decode_full_width(payload: bytes) -> Values | None:
    """Return the values of a payload as `encode` writes it, validated; None if `_decode_any` has to decide."""
    if len(payload) != PAYLOAD_SIZE:
        return None
    number = int.from_bytes(payload, "big")
    if number & TAG_MASK != TAGS:
        return None
    # With these tags each value has its type and range: there is nothing left to validate but the rules.
    row: Values = msgpack.unpackb(payload, use_list=False)[1:]
    return row if passes_rules(row) else None


def _decode_any(payload: bytes, newer: Mapping[int, Sequence[str]] | None) -> VehicleLocalPosition:
    """Return the message of any msgpack encoding, in any known layout."""
    try:
        return upgrade(_unpack_fields(payload, newer or {}))
    except ValidationError as exc:
        raise DecodeError(describe(exc)) from exc


def _unpack_fields(payload: bytes, newer: Mapping[int, Sequence[str]]) -> dict[str, object]:
    if len(payload) > PAYLOAD_LIMIT:
        raise DecodeError(f"{len(payload)} bytes, more than the {PAYLOAD_LIMIT} that a message can have")
    try:
        array = msgpack.unpackb(payload, use_list=False, max_map_len=0, max_ext_len=0)
    except (ValueError, msgpack.UnpackException) as exc:
        raise DecodeError(f"{len(payload)} bytes that are not one msgpack value ({exc or type(exc).__name__})") from exc
    if not isinstance(array, tuple) or not array or type(array[0]) is not int:
        raise DecodeError("not an array that starts with the number of its layout")
    layout, *values = array
    names = WIRE_LAYOUTS[layout].fields if layout in WIRE_LAYOUTS else newer.get(layout)
    if names is None:
        raise UnknownLayoutError(layout, len(values), (*WIRE_LAYOUTS, *newer))
    if len(values) != len(names):
        raise DecodeError(f"{len(values)} fields where layout {layout} has {len(names)}")
    for name, value in zip(names, values, strict=True):
        # No field is nested deeper, and printing a deeply nested value would exhaust the stack.
        parts = value if isinstance(value, tuple) else (value,)
        if isinstance(value, tuple) and any(isinstance(part, tuple) for part in parts):
            raise DecodeError(f"{name}: an array within an array")
        if any(isinstance(part, str) for part in parts):  # which the model accepts as "NaN", from JSON
            raise DecodeError(f"{name}: text, where msgpack has numbers and bools")
    return dict(zip(names, values, strict=True))
