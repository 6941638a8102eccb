"""The msgpack codec: one array `[layout, field 1 ... field n]`, with every field at full width.

A payload is therefore both plain msgpack and a fixed-size struct, 244 bytes for a VehicleLocalPosition.
Any other valid msgpack encoding of the array is decoded as well.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
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
    """The msgpack encoding of one field at full width.

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


class Codec(Generic[M]):
    """The codec of one message.

    `size`: payload size [bytes].
    `tags`: the payload with all values zero, as an integer; `tag_mask`: a mask of the bits that are not values.
    `offsets`: field, array index and payload offset of every value.
    `encode_flat(values)`: return the payload of valid values, flattened by the validation; raise OverflowError for one
    beyond the range of its float32 field.
    """

    __slots__ = (
        "_all_fields",
        "_by_name",
        "_decode_full_width",
        "_flatten",
        "_make_row",
        "_validation",
        "definition",
        "encode_flat",
        "offsets",
        "size",
        "tag_mask",
        "tags",
    )

    def __init__(self, definition: Definition[M]) -> None:
        self.definition = definition
        tags = struct.pack(">BHB", 0xDC, 1 + len(definition.types), definition.current.wire)
        code = f">{len(tags)}x"
        bits = bytes(len(tags))
        offsets: list[tuple[str, int, int]] = []
        for name, kind in definition.types.items():
            field = full_width(kind)
            for index, offset in enumerate(field.offsets):
                offsets.append((name, index, len(tags) + offset))
            tags += field.tags
            code += field.code
            bits += field.bits
        self.offsets = tuple(offsets)
        self.size = len(tags)
        self.tags = int.from_bytes(tags, "big")
        all_bits = (1 << 8 * self.size) - 1
        self.tag_mask = all_bits ^ int.from_bytes(bits, "big")
        self._validation = definition.validation
        self._flatten = self._validation.flatten
        self._by_name = self._validation.by_name
        self._all_fields = definition.all_fields
        self._make_row = definition.row
        packed = struct.Struct(code)
        self.encode_flat = self._encoder(packed)
        self._decode_full_width = self._decoder(packed)

    # The two functions of every message are closures, because that avoids attribute access on the hot path.

    def _encoder(self, packed: struct.Struct) -> Callable[[Values], bytes]:
        pack = packed.pack
        from_bytes = int.from_bytes
        size = self.size
        tags = self.tags

        def encode_flat(values: Values) -> bytes:
            # The packed struct has zeros for the tags, and `tags` has zeros for the values.
            return (from_bytes(pack(*values), "big") | tags).to_bytes(size, "big")

        return encode_flat

    def _decoder(self, packed: struct.Struct) -> Callable[[bytes], Values | None]:
        from_bytes = int.from_bytes
        size = self.size
        tags = self.tags
        tag_mask = self.tag_mask
        passes_rules = self._validation.passes_rules
        unflatten = self._validation.unflatten
        has_text = self.definition.has_text
        unpack = msgpack.unpackb

        def decode_full_width(payload: bytes) -> Values | None:
            """Decode a payload in the form that `encode` writes; return None for any other, or a broken rule."""
            if len(payload) != size or from_bytes(payload, "big") & tag_mask != tags:
                return None
            # The tags prove type and range of every value; only the rules are left to check.
            row: Values
            if has_text:  # which ends at the first NUL, and may contain invalid UTF-8
                values = (from_bytes(payload, "big") ^ tags).to_bytes(size, "big")
                row = unflatten(packed.unpack(values))
            else:
                row = unpack(payload, use_list=False)[1:]
            if passes_rules(row):
                return row
            return None

        return decode_full_width

    def encode(self, message: M) -> bytes:
        """Return the payload of a message; float32 fields are rounded.

        Raises EncodeError for a value that does not fit its field, in a message whose validation was bypassed.
        """
        try:
            return self.encode_flat(self._flatten(tuple(message.__dict__.values())))
        except (struct.error, OverflowError, TypeError) as exc:
            raise EncodeError(str(exc), self.definition.name) from exc

    def encode_fields(self, fields: Mapping[str, object]) -> bytes:
        """Validate fields and return their payload, without building a model.

        Raises InvalidMessageError for an invalid message.
        """
        row = self._validation.row_of(fields)
        if row is None:
            return self.encode(self._to_model(fields))
        return self._encode_valid(row)

    def encode_row(self, values: Sequence[object]) -> bytes:
        """Validate the values of all fields in order, and return their payload.

        Raises InvalidMessageError for an invalid message, EncodeError for a wrong number of values.
        """
        values = tuple(values)
        count = len(self.definition.names)
        if len(values) != count:
            raise EncodeError(f"{len(values)} values, expected {count}", self.definition.name)
        row = self._validation.check_row(values)
        if row is None:
            fields = self._by_name(values)
            return self.encode(self._to_model(fields))
        return self._encode_valid(row)

    def _encode_valid(self, row: Values) -> bytes:
        try:
            return self.encode_flat(self._flatten(row))
        except OverflowError:  # beyond float32; the model raises the error
            fields = self._by_name(row)
            return self.encode(self._to_model(fields))

    def _to_model(self, fields: Mapping[str, object]) -> M:
        try:
            return self.definition.model.model_validate(dict(fields))
        except ValidationError as exc:
            details = exc.errors(include_url=False)
            violations = []
            for detail in details:
                name = str(detail["loc"][0])
                violations.append((name, detail["msg"]))
            reason = describe(exc, self.definition)
            raise InvalidMessageError(reason, violations, message=self.definition.name) from exc

    def decode(self, payload: bytes, *, newer: NewerLayouts | None = None) -> M:
        """Return the validated message of a payload; `newer`: layouts unknown to this version.

        Raises UnknownLayoutError for a layout number that is neither known nor in `newer`, DecodeError for any other
        invalid payload: wrong types or lengths, missing or trailing bytes, values that the model rejects.
        """
        row = self._decode_full_width(payload)
        if row is None:
            return self._decode_any(payload, newer)
        model = self.definition.model
        return fill(model.__new__(model), self._by_name(row), self._all_fields)

    def decode_row(self, payload: bytes, *, newer: NewerLayouts | None = None) -> M:
        """Return the same as a Row, which type checkers treat as the message."""
        row = self._decode_full_width(payload)
        if row is None:
            row = tuple(self._decode_any(payload, newer).__dict__.values())
        return cast("M", tuple.__new__(self._make_row, row))

    def _decode_any(self, payload: bytes, newer: NewerLayouts | None) -> M:
        """Decode any msgpack encoding of any known layout."""
        fields = _unpack_fields(self.definition, payload, newer or {})
        try:
            return upgrade_with(self.definition, fields)
        except ValidationError as exc:
            reason = describe(exc, self.definition)
            raise DecodeError(reason, self.definition.name) from exc


@cached_on_owner
def codec_of(definition: Definition[M]) -> Codec[M]:
    """Return the cached codec of a message."""
    return Codec(definition)


def describe(error: ValidationError, definition: Definition[Any]) -> str:
    """Format a validation error as one line: each field with the reason and its value."""
    reasons = []
    for detail in error.errors(include_url=False):
        place = ".".join(map(str, detail["loc"]))
        reason = f"{place}: {detail['msg']}"
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
