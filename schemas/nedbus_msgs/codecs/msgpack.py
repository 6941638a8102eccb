"""The msgpack codec: one array `[layout, field 1 ... field n]`, with every field at full width.

A payload is therefore both plain msgpack and a fixed-size struct, 244 bytes for a VehicleLocalPosition.
Any other valid msgpack encoding of the array is decoded as well.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, NamedTuple, cast

import msgpack
from pydantic import ValidationError

from nedbus_msgs.errors import DecodeError, EncodeError, InvalidMessageError, UnknownLayoutError
from nedbus_msgs.model.declaration import cached_on_owner
from nedbus_msgs.model.definition import Definition, M, upgrade_with
from nedbus_msgs.model.message import fill
from nedbus_msgs.model.px4_types import BASES, FieldType, decode_text
from nedbus_msgs.model.validation import Values
from nedbus_msgs.text import counted

PAYLOAD_LIMIT: Final = 4096
"""Maximum size of a payload [bytes]."""

NewerLayouts = Mapping[int, Sequence[str]]
"""Field names of layouts unknown to this version, by layout number."""


class FullWidth(NamedTuple):
    """The msgpack encoding of one field, or of a whole payload, at full width.

    `tags`: its bytes with zeros for the values. `code`: the struct format of the values, without byte order.
    `bits`: the bit mask of the values. `offsets`: the offset of each value.

    For float32[2]:

        tags     92 ca 00 00 00 00 ca 00 00 00 00
        code     "1x1xf1xf"
        bits     00 00 ff ff ff ff 00 ff ff ff ff
        offsets  2, 7
    """

    tags: bytes
    code: str
    bits: bytes
    offsets: tuple[int, ...]


def full_width(kind: FieldType) -> FullWidth:
    """Return the encoding of a type.

    A bool is a tag alone, 0xc2 or 0xc3: its last bit is the value. Text is a str 16, padded with NUL.
    """
    tag = bytes([BASES[kind.base].tag])
    if kind.is_text:
        tag += kind.size.to_bytes(2, "big")
        return _tagged(tag, kind.form, kind.size)
    if kind.base == "bool":
        value = FullWidth(tag, "?", b"\x01", (0,))
    else:
        value = _tagged(tag, BASES[kind.base].code, kind.size)
    if kind.length is None:
        return value
    return _array_of(value, kind.length)


def _tagged(tag: bytes, code: str, size: int) -> FullWidth:
    """Return the encoding of a value of `size` bytes after its tag."""
    bits = bytes(len(tag)) + b"\xff" * size
    return FullWidth(tag + bytes(size), f"{len(tag)}x{code}", bits, (len(tag),))


def _array_of(value: FullWidth, length: int) -> FullWidth:
    head = b"\xdc" + length.to_bytes(2, "big")
    if length < 16:
        head = bytes([0x90 | length])
    (first,) = value.offsets
    step = len(value.tags)
    return FullWidth(
        head + value.tags * length,
        f"{len(head)}x" + value.code * length,
        bytes(len(head)) + value.bits * length,
        tuple(len(head) + first + index * step for index in range(length)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Codec(Generic[M]):
    """The codec of one message.

    `size`: payload size [bytes].
    `tags`: the payload with all values zero, as an integer; `tag_mask`: a mask of the bits that are not values.
    `offsets`: field, array index and payload offset of every value.
    `encode_flat(values)`: return the payload of valid values, flattened by the validation; raise OverflowError for one
    beyond the range of its float32 field.

    `encode(message)`: return the payload of a message; float32 fields are rounded.
    Raises EncodeError for a value that does not fit its field, in a message whose validation was bypassed.
    `encode_fields(fields)`: validate fields and return their payload, without building a model.
    Raises InvalidMessageError for an invalid message.
    `encode_row(values)`: the same for the values of all fields in order.
    Also raises EncodeError for a wrong number of values.
    `decode(payload, newer=...)`: return the validated message of a payload.
    Raises UnknownLayoutError for a layout number that is neither known nor in `newer`, DecodeError for any other
    invalid payload: wrong types or lengths, missing or trailing bytes, values that the model rejects.
    `decode_row(payload, newer=...)`: the same, as a Row.
    """

    definition: Definition[M]
    size: int
    tags: int
    tag_mask: int
    offsets: tuple[tuple[str, int, int], ...]
    encode_flat: Callable[[Values], bytes]
    encode: Callable[[M], bytes]
    encode_fields: Callable[[Mapping[str, object]], bytes]
    encode_row: Callable[[Sequence[object]], bytes]
    decode: Callable[..., M]
    decode_row: Callable[..., M]


@cached_on_owner
def codec_of(definition: Definition[M]) -> Codec[M]:
    """Return the codec of a message; its functions are closures, to avoid attribute access on the hot path."""
    name = definition.name
    types = definition.types
    model = definition.model
    make_row = definition.row
    has_text = definition.has_text
    all_fields = definition.all_fields
    count = len(types)
    validation = definition.validation
    check_row = validation.check_row
    row_of = validation.row_of
    passes_rules = validation.passes_rules
    by_name = validation.by_name
    flatten = validation.flatten
    unflatten = validation.unflatten
    form, offsets = _payload_form(types, cast("int", definition.current.wire))
    packed = struct.Struct(">" + form.code)
    size = packed.size
    pack_flat = packed.pack
    unpack_flat = packed.unpack
    from_bytes = int.from_bytes
    tags = from_bytes(form.tags, "big")
    all_bits = (1 << 8 * size) - 1
    tag_mask = all_bits ^ from_bytes(form.bits, "big")
    new_row = tuple.__new__
    unpack = msgpack.unpackb

    def pack(row: Values) -> bytes:
        """Pack a row; raise struct.error, OverflowError or TypeError for values that do not fit their fields."""
        return encode_flat(flatten(row))

    def encode_flat(values: Values) -> bytes:
        # The packed struct has zeros for the tags, and `tags` has zeros for the values.
        return (from_bytes(pack_flat(*values), "big") | tags).to_bytes(size, "big")

    def encode(message: M) -> bytes:
        try:
            return pack(tuple(message.__dict__.values()))
        except (struct.error, OverflowError, TypeError) as exc:
            raise EncodeError(str(exc), name) from exc

    def encode_fields(fields: Mapping[str, object]) -> bytes:
        row = row_of(fields)
        return encode(to_model(fields)) if row is None else encode_valid(row)

    def encode_row(values: Sequence[object]) -> bytes:
        values = tuple(values)
        if len(values) != count:
            raise EncodeError(f"{len(values)} values, expected {count}", name)
        row = check_row(values)
        return encode(to_model(by_name(values))) if row is None else encode_valid(row)

    def encode_valid(row: Values) -> bytes:
        try:
            return pack(row)
        except OverflowError:  # beyond float32; the model raises the error
            return encode(to_model(by_name(row)))

    def to_model(fields: Mapping[str, object]) -> M:
        try:
            return model.model_validate(dict(fields))
        except ValidationError as exc:
            details = exc.errors(include_url=False)
            violations = [(str(detail["loc"][0]), detail["msg"]) for detail in details]
            raise InvalidMessageError(describe(exc, definition), violations, message=name) from exc

    def decode_full_width(payload: bytes) -> Values | None:
        """Decode a payload in the form that `encode` writes; return None for any other, which `decode_any` decodes."""
        if len(payload) != size or from_bytes(payload, "big") & tag_mask != tags:
            return None
        # The tags prove type and range of every value; only the rules are left to check.
        row: Values
        if has_text:
            row = decode_values(payload)
        else:
            row = unpack(payload, use_list=False)[1:]
        return row if passes_rules(row) else None

    def decode_values(payload: bytes) -> Values:
        """Decode a payload with text, which ends at the first NUL and may contain invalid UTF-8."""
        values = (from_bytes(payload, "big") ^ tags).to_bytes(size, "big")
        return unflatten(unpack_flat(values))

    def decode_any(payload: bytes, newer: NewerLayouts | None) -> M:
        """Decode any msgpack encoding of any known layout."""
        fields = _unpack_fields(definition, payload, newer or {})
        try:
            return upgrade_with(definition, fields)
        except ValidationError as exc:
            raise DecodeError(describe(exc, definition), name) from exc

    def decode(payload: bytes, *, newer: NewerLayouts | None = None) -> M:
        row = decode_full_width(payload)
        if row is None:
            return decode_any(payload, newer)
        return fill(model.__new__(model), by_name(row), all_fields)

    def decode_row(payload: bytes, *, newer: NewerLayouts | None = None) -> M:  # a Row at run time
        row = decode_full_width(payload)
        if row is None:
            row = tuple(decode_any(payload, newer).__dict__.values())
        return cast("M", new_row(make_row, row))

    return Codec(
        definition, size, tags, tag_mask, offsets,
        encode_flat, encode, encode_fields, encode_row, decode, decode_row,
    )  # fmt: skip


def _payload_form(
    types: Mapping[str, FieldType], layout: int
) -> tuple[FullWidth, tuple[tuple[str, int, int], ...]]:
    """Return the encoding of a payload, and field, array index and offset of every value."""
    head = struct.pack(">BHB", 0xDC, 1 + len(types), layout)
    tags = head
    code = f"{len(head)}x"
    bits = bytes(len(head))
    offsets: list[tuple[str, int, int]] = []
    for name, kind in types.items():
        field = full_width(kind)
        for index, offset in enumerate(field.offsets):
            offsets.append((name, index, len(tags) + offset))
        tags += field.tags
        code += field.code
        bits += field.bits
    form = FullWidth(tags, code, bits, tuple(offset for _, _, offset in offsets))
    return form, tuple(offsets)


def describe(error: ValidationError, definition: Definition[Any]) -> str:
    """Format a validation error as one line: each field with the reason and its value."""
    reasons = []
    for detail in error.errors(include_url=False):
        reason = f"{'.'.join(map(str, detail['loc']))}: {detail['msg']}"
        if detail["type"] == "extra_forbidden":
            reason = definition.explain_unknown_field(str(detail["loc"][0]))
        if detail["type"] != "missing":
            reason += f" (is {detail['input']!r:.40})"
        reasons.append(reason)
    return "; ".join(reasons)


def _unpack_fields(
    definition: Definition[Any], payload: bytes, newer: NewerLayouts
) -> dict[str, object]:
    def reject(reason: str) -> DecodeError:
        return DecodeError(reason, definition.name)

    if len(payload) > PAYLOAD_LIMIT:
        raise reject(f"{len(payload)} bytes, more than the limit of {PAYLOAD_LIMIT}")
    try:
        array = msgpack.unpackb(
            payload, use_list=False, max_map_len=0, max_ext_len=0, unicode_errors="surrogateescape"
        )
    except (ValueError, msgpack.UnpackException) as exc:
        reason = exc or type(exc).__name__
        raise reject(
            f"the {len(payload)}-byte payload is not a single msgpack value ({reason})"
        ) from exc
    if not isinstance(array, tuple) or not array or type(array[0]) is not int:
        raise reject("the payload is not an array that starts with a layout number")
    number, *values = array
    known: dict[int, Sequence[str]] = {}
    for layout in definition.layouts.values():
        if layout.wire is not None:
            known[layout.wire] = layout.fields
    names = known.get(number) or newer.get(number)
    if names is None:
        raise UnknownLayoutError(number, len(values), (*known, *newer), definition.name)
    if len(values) != len(names):
        raise reject(f"{counted(len(values), 'field')}, expected {len(names)} for layout {number}")
    fields: dict[str, object] = {}
    for name, value in zip(names, values, strict=True):
        # No field has nested arrays, and formatting a deeply nested value would overflow the stack.
        parts = value if isinstance(value, tuple) else (value,)
        if any(isinstance(part, tuple) for part in parts):
            raise reject(f"{name} has a nested array")
        is_text = name in definition.types and definition.types[name].is_text
        # The model would accept floats as text, such as "NaN", for JSON.
        if not is_text and any(isinstance(part, str) for part in parts):
            raise reject(f"{name} has text, expected numbers or bools")
        fields[name] = value
        if isinstance(value, str):
            fields[name] = decode_text(value.encode(errors="surrogateescape"))
    return fields
