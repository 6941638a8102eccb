"""The msgpack codec: one array `[layout, field 1 ... field 53]` of exactly 244 bytes.

Our encoder writes every field at its full width, so every payload is at once plain msgpack and a fixed record.
Any other valid msgpack of the array is read as well.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, cast

import msgpack
from pydantic import ValidationError

from .errors import DecodeError, EncodeError, UnknownLayoutError
from .layouts import CURRENT, WIRE_LAYOUTS, upgrade
from .position import FIELD_TYPES, NAMES, Values, VehicleLocalPosition, check_row, message_of, row_of
from .px4_types import TypeName
from .rows import Row

PAYLOAD_SIZE: Final = 244
"""Bytes of every payload that `encode` writes."""

PAYLOAD_LIMIT: Final = 4096
"""Bytes of the largest payload that `decode` looks at; no encoding of the array comes near."""

# Per type: its tag, the struct format of tag and value, and which bits of them are value.
# A bool is its tag: 0xc2 or 0xc3, so its last bit is the value.
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
_VALUES = int.from_bytes(bytes(len(_HEAD)) + b"".join(values for _, _, values in _TYPES), "big")
NO_VALUES = ~_VALUES
_RECORD = struct.Struct(f">{len(_HEAD)}x" + "".join(form for _, form, _ in _TYPES))

_FIRST, _SECOND = (NAMES.index(name) for name, kind in FIELD_TYPES.items() if kind == "float32[2]")


def places_on_the_wire() -> Iterator[tuple[str, int, int]]:
    """Yield name, part (of delta_xy and delta_vxy, else 0) and offset of every value in a full-width payload."""
    offset = len(_HEAD)
    for name, kind in FIELD_TYPES.items():
        _, _, bits = _FULL_WIDTH[kind]
        starts = (place for place, each in enumerate(bits) if each and not (place and bits[place - 1]))
        yield from ((name, part, offset + start) for part, start in enumerate(starts))
        offset += len(bits)


def encode(message: VehicleLocalPosition) -> bytes:
    """Return the 244 bytes of a message; ref_lat and ref_lon are float64, all other floats float32.

    Raises EncodeError for a message whose validation was bypassed and that holds what its fields cannot.
    """
    try:
        return _write(tuple(message.__dict__.values()))
    except (struct.error, OverflowError, TypeError) as exc:
        raise EncodeError(str(exc)) from exc


def encode_fields(fields: Mapping[str, object]) -> bytes:
    """Return the 244 bytes of the message that these fields make, without making it.

    Raises pydantic.ValidationError for what the model refuses.
    """
    row = row_of(fields)
    return encode(VehicleLocalPosition.model_validate(fields)) if row is None else _write_row(row)


def encode_row(values: Sequence[object] | Row) -> bytes:
    """Return the 244 bytes of the message with these values of all fields in PX4's order, without making it.

    Raises EncodeError for another number of values, pydantic.ValidationError for what the model refuses.
    """
    values = tuple(values)
    if len(values) != len(NAMES):
        raise EncodeError(f"{len(values)} values, where a row has {len(NAMES)}")
    row = check_row(values)
    return encode(_model_of(values)) if row is None else _write_row(row)


def decode(payload: bytes, *, newer: Mapping[int, Sequence[str]] | None = None) -> VehicleLocalPosition:
    """Return the message of a payload, checked by the model.

    `newer` gives the field names of layouts that this version does not know, by their number on the wire: the fields
    known by name are read, the others ignored.

    Raises UnknownLayoutError for a layout that is neither known nor given, DecodeError for anything else that is not
    one message: other types, other lengths, trailing, missing or too many bytes, values that the model refuses.
    """
    row = _read_full_width(payload)
    return _decode_slowly(payload, newer) if row is None else message_of(row)


def decode_row(payload: bytes, *, newer: Mapping[int, Sequence[str]] | None = None) -> Row:
    """Return the message of a payload as a named tuple, checked by the same validators and rules as by `decode`."""
    row = _read_full_width(payload)
    return Row._make(tuple(_decode_slowly(payload, newer).__dict__.values()) if row is None else row)


def describe(error: ValidationError) -> str:
    """Return what a validation error says, in one line: each field, what is wrong with it, and its value."""
    return "; ".join(
        f"{'.'.join(map(str, detail['loc']))}: {detail['msg']} (is {detail['input']!r:.40})"
        for detail in error.errors()
    )


def _write(row: Values) -> bytes:
    """Pack a row; raise struct.error, OverflowError or TypeError for what its fields cannot hold."""
    one, two = cast("tuple[Values, Values]", (row[_FIRST], row[_SECOND]))
    flat = (*row[:_FIRST], *one, *row[_FIRST + 1 : _SECOND], *two, *row[_SECOND + 1 :])
    # The record has zeros where the tags belong, and the tags have zeros where the values are.
    return (int.from_bytes(_RECORD.pack(*flat), "big") | TAGS).to_bytes(PAYLOAD_SIZE, "big")


def _write_row(row: Values) -> bytes:
    try:
        return _write(row)
    except OverflowError:  # beyond float32: the model says so
        return encode(_model_of(row))


def _model_of(row: Values) -> VehicleLocalPosition:
    return VehicleLocalPosition.model_validate(dict(zip(NAMES, row, strict=True)))


def _read_full_width(payload: bytes) -> Values | None:
    """Read what `encode` writes, validated; None for anything that needs a closer look."""
    if len(payload) != PAYLOAD_SIZE:
        return None
    number = int.from_bytes(payload, "big")
    if number & NO_VALUES != TAGS:
        return None
    flat = _RECORD.unpack((number & _VALUES).to_bytes(PAYLOAD_SIZE, "big"))
    first, second = flat[_FIRST : _FIRST + 2], flat[_SECOND + 1 : _SECOND + 3]
    return check_row((*flat[:_FIRST], first, *flat[_FIRST + 2 : _SECOND + 1], second, *flat[_SECOND + 3 :]))


def _decode_slowly(payload: bytes, newer: Mapping[int, Sequence[str]] | None) -> VehicleLocalPosition:
    try:
        return upgrade(_read_any(payload, newer or {}))
    except ValidationError as exc:
        raise DecodeError(describe(exc)) from exc


def _read_any(payload: bytes, newer: Mapping[int, Sequence[str]]) -> dict[str, object]:
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
        # Deeper nesting is no field of ours, and would exhaust the stack of whoever prints it.
        if isinstance(value, tuple) and any(isinstance(item, tuple) for item in value):
            raise DecodeError(f"{name}: an array within an array")
    return dict(zip(names, values, strict=True))
