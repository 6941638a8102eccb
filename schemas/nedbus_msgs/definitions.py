"""Look up definitions of built-in messages, and define other messages at run time."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from pydantic import Field, create_model
from typing_extensions import TypeVar

from . import limits
from .codecs.msgpack import PAYLOAD_LIMIT, full_width
from .messages.vehicle_local_position import VehicleLocalPosition
from .model.declaration import DEFAULT_TOPIC, Layout
from .model.definition import BY_TOPIC, MESSAGES, Definition
from .model.message import Message
from .model.px4_types import FieldType, Timestamp
from .model.rules import Rule

_NAME = re.compile(r"[A-Z][A-Za-z0-9]{0,63}")
_FIELD = re.compile(r"[a-z][a-z0-9_]{0,63}")

M = TypeVar("M", bound=Message, default=VehicleLocalPosition)


def definition_of(message: type[M] | str) -> Definition[M]:
    """Return the definition of a message by class, name or topic; raise KeyError if it is unknown."""
    if isinstance(message, str):
        if message in MESSAGES:
            return MESSAGES[message]
        return BY_TOPIC[message]
    return message.DEFINITION


DEFAULT: Final[Definition[VehicleLocalPosition]] = definition_of(DEFAULT_TOPIC)
"""Definition of the default message, VehicleLocalPosition."""


def define(
    name: str,
    fields: Iterable[tuple[str, FieldType]],
    *,
    meanings: Mapping[str, str] = {},
    rules: Sequence[Rule] = (),
) -> Definition[Message]:
    """Define a message that is not built in, from a log, a .msg file or a publisher.

    `fields`: names and types in CDR order, the order of layout "PX4". `meanings`: unit and meaning of fields, by name.

    Raises ValueError for an invalid name, a missing timestamp, too many fields, or a payload beyond the size limit.
    """
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"{name!r:.100} is not a message name; expected CamelCase of at most 64 characters"
        )
    types: dict[str, FieldType] = {}
    for field, kind in fields:
        check_field_name(field)
        if field in types:
            raise ValueError(f"duplicate field {field!r}, after flattening nested messages")
        types[field] = kind
    if len(types) > limits.FIELDS:
        raise ValueError(f"{len(types)} fields, more than the limit of {limits.FIELDS}")
    if str(types.get("timestamp")) != "uint64":
        raise ValueError("missing field 'uint64 timestamp'")
    size = 4 + sum(len(full_width(kind).tags) for kind in types.values())
    if size > PAYLOAD_LIMIT:
        raise ValueError(f"a payload of {size} bytes, more than the limit of {PAYLOAD_LIMIT}")
    annotated: dict[str, Any] = {}
    for field, kind in types.items():
        is_required = field == "timestamp"
        if is_required:
            annotation = Timestamp
        else:
            annotation = kind.annotation
        annotated[field] = annotation, Field(description=meanings.get(field))
    doc = "A message defined at run time."
    model = create_model(name, __base__=Message, __doc__=doc, **annotated)
    # the model has timestamp first
    model.LAYOUTS = (Layout("PX4", " ".join(types)),)
    model.RULES = rules
    model.DEFINITION = Definition(model)
    return model.DEFINITION


def check_field_name(name: str) -> None:
    """Raise ValueError for a name that no field can have."""
    if not _FIELD.fullmatch(name):
        raise ValueError(f"invalid field name {name!r:.100}; expected lower_snake_case")
    if hasattr(Message, name):
        raise ValueError(
            f"invalid field name {name!r}, which is a member of the Python class Message"
        )
