"""Codecs, layouts and schema of a message as plain functions, for VehicleLocalPosition by default."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError, create_model
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
    describe as _describe,
    encode_with,
    encoding_of as _encoding_of,
    hash_of,
    message_of_type_hash,
    provenance_of as _provenance_of,
    ros2_type,
    upgrade_with,
)
from nedbus_msgs.arrays import MessageArray, arrays_of
from nedbus_msgs.codecs.msgpack import NewerLayouts
from nedbus_msgs.model.px4_types import Float32, field

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


def row_of(message: VehicleLocalPosition) -> VehicleLocalPosition:
    """Return a message as a Row, typed as the message."""
    return cast("VehicleLocalPosition", tuple.__new__(DEFAULT.row, message.__dict__.values()))


def layout_of_type_hash(text: str) -> str | None:
    """Return the name of the layout with this hash, or None."""
    found = message_of_type_hash(text)
    return found[1].name if found else None


_DEFAULT: Any = VehicleLocalPosition


def encode(message: Message) -> bytes:
    """Return the payload of a message; raise EncodeError if its validation was bypassed and a value does not fit."""
    return codec_of(message.DEFINITION).encode(message)


def decode(payload: bytes, message: type[M] = _DEFAULT, *, newer: NewerLayouts | None = None) -> M:
    """Return the validated message of a payload; raise DecodeError if it is invalid.

    `newer`: field names of layouts unknown to this version, by layout number; unknown fields are ignored.
    """
    return codec_of(definition_of(message)).decode(payload, newer=newer)


def encode_fields(fields: Mapping[str, object], message: type[M] = _DEFAULT) -> bytes:
    """Return the payload of a message with these fields, validated; raise InvalidMessageError if it is invalid."""
    return codec_of(definition_of(message)).encode_fields(fields)


def encode_row(values: Sequence[object] | Message, message: type[M] = _DEFAULT) -> bytes:
    """Return the payload of a message with these values of all fields, validated.

    Raises EncodeError for a wrong number of values, InvalidMessageError for an invalid message.
    """
    return codec_of(definition_of(message)).encode_row(cast("Sequence[object]", values))


def decode_row(
    payload: bytes, message: type[M] = _DEFAULT, *, newer: NewerLayouts | None = None
) -> M:
    """Return the message of a payload as a Row, validated as by `decode`."""
    return codec_of(definition_of(message)).decode_row(payload, newer=newer)


def describe(error: ValidationError, message: type[Message] | str = _DEFAULT) -> str:
    """Format a validation error as one line: each field with the reason and its value."""
    return _describe(error, definition_of(message))


def upgrade(fields: Mapping[str, object], message: type[M] = _DEFAULT) -> M:
    """Build a message from the fields of any PX4 release; raise pydantic.ValidationError if it is invalid."""
    return upgrade_with(definition_of(message), fields)


def downgrade(message: Message, layout: str) -> dict[str, object]:
    """Return the fields of a message in an older layout, in that layout's order."""
    return message.DEFINITION.downgrade(message.__dict__, message.DEFINITION.layouts[layout])


def find_layout(names: Iterable[str], message: type[Message] | str = _DEFAULT) -> Layout | None:
    """Return the layout with exactly these field names, in any order, or None."""
    return definition_of(message).find_layout(names)


def decode_cdr(
    payload: bytes, *, layout: str, message: type[Message] | str = _DEFAULT
) -> dict[str, object]:
    """Decode a CDR payload to fields, in layout order; `layout`: a layout name, or the RIHS01 hash of a ROS 2 type."""
    definition, found = _layout(layout, message)
    return decode_with(definition, payload, found)


def encode_cdr(
    fields: Mapping[str, object], *, layout: str, message: type[Message] | str = _DEFAULT
) -> bytes:
    """Encode the fields of a layout, as returned by `downgrade`, as CDR; `layout`: as in `decode_cdr`."""
    definition, found = _layout(layout, message)
    return encode_with(definition, fields, found)


def type_hash(
    layout: str, *, message: type[Message] | str = _DEFAULT, name: str | None = None
) -> str:
    """Return the RIHS01 hash of a ROS 2 type with the fields of a layout; `name`: the type, if not that of px4_msgs."""
    definition = definition_of(message)
    return hash_of(definition.layouts[layout], name or ros2_type(definition))


def message_definition(layout: str, message: type[Message] | str = _DEFAULT) -> str:
    """Return the .msg definition of a layout, with unit and meaning of each field."""
    definition = definition_of(message)
    return definition_text(definition, definition.layouts[layout])


def json_schema(message: type[Message] | str = _DEFAULT) -> dict[str, object]:
    """Return the JSON Schema (2020-12) of a message."""
    schema: dict[str, object] = definition_of(message).schema()["json_schema"]
    return schema


def layout_table(message: type[Message] | str = _DEFAULT) -> list[dict[str, object]]:
    """Return name, layout number (or None), and fields with name and type, of every layout."""
    layouts: list[dict[str, object]] = definition_of(message).schema()["layouts"]
    return layouts


def next_release() -> Definition[Any]:
    """Return VehicleLocalPosition of a newer release: with another field at the end, and so with layout number 2."""
    new: Any = (Float32, field("A field that this release does not have"))
    model = cast(
        "Any", create_model("VehicleLocalPosition", __base__=VehicleLocalPosition, brand_new=new)
    )
    *older, last = VehicleLocalPosition.LAYOUTS
    model.LAYOUTS = (
        *older,
        replace(last, base="2.0", without="brand_new"),
        Layout("2.0", "*", wire=2),
    )
    model.DEFINITION = definition = Definition[Any](model)
    return definition


def _layout(text: str, message: type[Message] | str) -> tuple[Definition[Any], Layout]:
    found = message_of_type_hash(text)
    if found is None:
        definition = definition_of(message)
        return definition, definition.layouts[text]
    return found


def valid_mask(
    array: MessageArray, message: type[Message] | str = DEFAULT.model
) -> npt.NDArray[np.bool_]:
    """Return a mask of the messages that pass the rules."""
    return arrays_of(definition_of(message)).valid_mask(array)


def decode_array(
    payloads: bytes, message: type[Message] | str = DEFAULT.model
) -> tuple[MessageArray, npt.NDArray[np.bool_]]:
    """Decode concatenated full-width payloads; return the messages and a mask of the valid ones."""
    return arrays_of(definition_of(message)).decode(payloads)


def encode_array(array: MessageArray, message: type[Message] | str = DEFAULT.model) -> bytes:
    """Encode messages as concatenated payloads, without validating them."""
    return arrays_of(definition_of(message)).encode(array)
