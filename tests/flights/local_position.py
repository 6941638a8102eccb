"""The facts of VehicleLocalPosition, which most tests send, and its forms as functions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError
from typing_extensions import TypeVar

from nedbus_msgs import (
    DEFAULT,
    Definition,
    Layout,
    Message,
    VehicleLocalPosition,
    codec_of,
    decode_with,
    definition_of,
    definition_text,
    encode_with,
    hash_of,
    message_of_type_hash,
    ros2_type,
    upgrade_with,
)
from nedbus_msgs import describe as _describe
from nedbus_msgs import encoding_of as _encoding_of
from nedbus_msgs import provenance_of as _provenance_of
from nedbus_msgs.arrays import MessageArray, arrays_of
from nedbus_msgs.codecs.msgpack import NewerLayouts

M = TypeVar("M", bound=Message, default=VehicleLocalPosition)
LAYOUTS: Final = DEFAULT.layouts
CURRENT: Final = DEFAULT.current
FIELD_TYPES: Final = {name: str(kind) for name, kind in DEFAULT.types.items()}
PAYLOAD_SIZE: Final = codec_of(DEFAULT).size
ROS2_TYPE: Final = ros2_type(DEFAULT)
ENCODING: Final = _encoding_of(DEFAULT, None)

encoding_of = partial(_encoding_of, DEFAULT)
provenance_of = partial(_provenance_of, DEFAULT)
to_row = arrays_of(DEFAULT).to_row


def encode_cdr_array(array: MessageArray) -> npt.NDArray[np.void]:
    """Return the CDR payloads of messages in the current layout."""
    return arrays_of(DEFAULT).encode_cdr(array, CURRENT)


def decode_cdr_array(payloads: Sequence[bytes]) -> tuple[MessageArray, npt.NDArray[np.bool_]]:
    """Return the messages of CDR payloads of the current layout, and a mask of those that are valid."""
    return arrays_of(DEFAULT).decode_cdr(payloads, CURRENT)


def row_of(message: VehicleLocalPosition) -> VehicleLocalPosition:
    """Return a message as a row, which is the message itself for type checkers."""
    return cast("VehicleLocalPosition", tuple.__new__(DEFAULT.row, message.__dict__.values()))


def layout_of_type_hash(text: str) -> str | None:
    """Return the name of the layout with this hash."""
    found = message_of_type_hash(text)
    return found[1].name if found else None


_FIRST: Any = VehicleLocalPosition


def encode(message: Message) -> bytes:
    """Return the payload of a message; float32 fields are rounded.

    Raises EncodeError if values do not fit their fields, in a message whose validation was bypassed.
    """
    return codec_of(message.DEFINITION).encode(message)


def decode(payload: bytes, message: type[M] = _FIRST, *, newer: NewerLayouts | None = None) -> M:
    """Return the validated message of a payload.

    `newer`: field names of layouts unknown to this version, by number on the wire; fields with known names are decoded,
    others ignored.

    Raises UnknownLayoutError for a layout that is neither known nor in `newer`, DecodeError for anything else that is
    not one message: other types, other lengths, trailing, missing or too many bytes, values that the model rejects.
    """
    return codec_of(definition_of(message)).decode(payload, newer=newer)


def encode_fields(fields: Mapping[str, object], message: type[M] = _FIRST) -> bytes:
    """Return the payload of a message with these fields, validated; raise InvalidMessageError if it is invalid."""
    return codec_of(definition_of(message)).encode_fields(fields)


def encode_row(values: Sequence[object] | Message, message: type[M] = _FIRST) -> bytes:
    """Return the payload of a message with these values of all fields, validated.

    Raises EncodeError for another number of values, InvalidMessageError for an invalid message.
    """
    return codec_of(definition_of(message)).encode_row(cast("Sequence[object]", values))


def decode_row(payload: bytes, message: type[M] = _FIRST, *, newer: NewerLayouts | None = None) -> M:
    """Return the message of a payload as a named tuple, a Row, validated by the same types and rules as in `decode`."""
    return codec_of(definition_of(message)).decode_row(payload, newer=newer)


def describe(error: ValidationError, message: type[Message] | str = _FIRST) -> str:
    """Return a validation error in one line: each field, the reason, and its value."""
    return _describe(error, definition_of(message))


def upgrade(fields: Mapping[str, object], message: type[M] = _FIRST) -> M:
    """Return the message with these fields of any PX4 release; arrays are tuples.

    All known fields are used, by their present name, and unknown names are ignored.
    A missing field is "not provided": NaN, false or 0, and absent from the message's `model_fields_set`.

    Raises pydantic.ValidationError for an invalid message.
    """
    return upgrade_with(definition_of(message), fields)


def downgrade(message: Message, layout: str) -> dict[str, object]:
    """Return a message as the fields of an older layout, in that layout's order; what the layout lacks is dropped."""
    return message.DEFINITION.downgrade(message.__dict__, message.DEFINITION.layouts[layout])


def find_layout(names: Iterable[str], message: type[Message] | str = _FIRST) -> Layout | None:
    """Return the layout with exactly these field names, in any order, or None."""
    return definition_of(message).find_layout(names)


def decode_cdr(payload: bytes, *, layout: str, message: type[Message] | str = _FIRST) -> dict[str, object]:
    """Return the fields of a CDR payload, in the order of the layout; arrays are tuples; `upgrade` validates them.

    `layout` is the name of a layout, or the RIHS01 hash of a ROS 2 type, which says which message it is.
    Padding is ignored, and so are the bytes that PX4 appends.

    Raises DecodeError for another encapsulation than little-endian XCDR1, for missing or too many bytes and for a bool
    that is neither 0 nor 1; LayoutError for an unknown layout.
    """
    definition, found = _layout(layout, message)
    return decode_with(definition, payload, found)


def encode_cdr(fields: Mapping[str, object], *, layout: str, message: type[Message] | str = _FIRST) -> bytes:
    """Return the CDR payload of the fields of a layout, such as `downgrade` returns, with zeros in its padding.

    `layout` is that of `decode_cdr`. Floats are rounded to the nearest float32 where PX4 has one.

    Raises EncodeError for a value that its type cannot hold.
    """
    definition, found = _layout(layout, message)
    return encode_with(definition, fields, found)


def type_hash(layout: str, *, message: type[Message] | str = _FIRST, name: str | None = None) -> str:
    """Return the RIHS01 hash of a ROS 2 type with the fields of a layout (ROS REP 2016), `RIHS01_` and 64 hex digits.

    `name` is the type, if it is not px4_msgs' own.
    """
    definition = definition_of(message)
    return hash_of(definition.layouts[layout], name or ros2_type(definition))


def message_definition(layout: str, message: type[Message] | str = _FIRST) -> str:
    """Return the .msg file of a layout, with unit and meaning of each field."""
    definition = definition_of(message)
    return definition_text(definition, definition.layouts[layout])


def json_schema(message: type[Message] | str = _FIRST) -> dict[str, object]:
    """Return the JSON Schema (2020-12) of a message as JSON; NaN and infinities are the strings of those names."""
    schema: dict[str, object] = definition_of(message).schema()["json_schema"]
    return schema


def layout_table(message: type[Message] | str = _FIRST) -> list[dict[str, object]]:
    """Return every layout as name, number on the wire (or None), and its fields in order, each with name and type."""
    layouts: list[dict[str, object]] = definition_of(message).schema()["layouts"]
    return layouts


def _layout(text: str, message: type[Message] | str) -> tuple[Definition[Any], Layout]:
    found = message_of_type_hash(text)
    if found is None:
        definition = definition_of(message)
        return definition, definition.layouts[text]
    return found


def valid_mask(array: MessageArray, message: type[Message] | str = DEFAULT.model) -> npt.NDArray[np.bool_]:
    """Return a mask of the messages that pass the rules between fields."""
    return arrays_of(definition_of(message)).valid_mask(array)


def decode_array(
    payloads: bytes, message: type[Message] | str = DEFAULT.model
) -> tuple[MessageArray, npt.NDArray[np.bool_]]:
    """Return the messages of concatenated payloads of full width, and a mask of those that are valid.

    A payload that is False in the mask may still be valid: `decode` decides.
    """
    return arrays_of(definition_of(message)).decode(payloads)


def encode_array(array: MessageArray, message: type[Message] | str = DEFAULT.model) -> bytes:
    """Return the concatenated payloads of messages, without validating them."""
    return arrays_of(definition_of(message)).encode(array)
