"""Definitions: of messages with a file, by class, name or topic, and of others at run time, by their fields."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from pydantic import Field, create_model
from typing_extensions import TypeVar

from .codecs.msgpack import PAYLOAD_LIMIT, full_width
from .messages.vehicle_local_position import VehicleLocalPosition
from .model.declaration import DEFAULT_TOPIC, Layout
from .model.definition import BY_TOPIC, MESSAGES, Definition
from .model.message import Message
from .model.px4_types import FieldType, Timestamp
from .model.rules import Rule

_NAME = re.compile(r"[A-Z][A-Za-z0-9]{0,63}")
_FIELD = re.compile(r"[a-z][a-z0-9_]{0,63}")
_MOST: Final = 256  # fields per message; PX4's largest has a third of that
M = TypeVar("M", bound=Message, default=VehicleLocalPosition)


def definition_of(message: type[M] | str) -> Definition[M]:
    """Return the definition of a message by class, name or topic; raise KeyError if it is unknown."""
    if isinstance(message, str):
        return MESSAGES[message] if message in MESSAGES else BY_TOPIC[message]
    return message.DEFINITION


DEFAULT: Final[Definition[VehicleLocalPosition]] = definition_of(DEFAULT_TOPIC)
"""The default message of functions that take one."""


def define(
    name: str,
    fields: Iterable[tuple[str, FieldType]],
    *,
    meanings: Mapping[str, str] = {},
    rules: Sequence[Rule] = (),
) -> Definition[Message]:
    """Define a message without a file, from a log, a .msg file or a publisher; `fields`: in the order of its CDR.

    `meanings`: unit and meaning of fields, by name.

    Raises ValueError for an invalid name, a missing timestamp, too many fields or too many bytes.
    """
    if not _NAME.fullmatch(name):
        raise ValueError(f"{name!r:.100} is not a message name: expected CamelCase of at most 64 characters")
    types: dict[str, FieldType] = {}
    for field, kind in fields:
        if not _FIELD.fullmatch(field):
            raise ValueError(f"a field cannot be called {field!r:.100}: expected lower_snake_case")
        if hasattr(Message, field):
            raise ValueError(f"a field cannot be called {field!r}: a message has a method of that name in Python")
        if field in types:
            raise ValueError(f"two fields are called {field!r}, including those of nested messages")
        types[field] = kind
    if len(types) > _MOST:
        raise ValueError(f"{len(types)} fields, more than the {_MOST} that a message can have")
    if str(types.get("timestamp")) != "uint64":
        raise ValueError("it lacks the field 'uint64 timestamp'")
    size = 4 + sum(len(full_width(kind)[0]) for kind in types.values())
    if size > PAYLOAD_LIMIT:
        raise ValueError(f"{size} bytes, more than the {PAYLOAD_LIMIT} that a message can have")
    annotated: dict[str, Any] = {
        name: (Timestamp if name == "timestamp" else kind.annotation, Field(description=meanings.get(name)))
        for name, kind in types.items()
    }
    model = create_model(name, __base__=Message, __doc__="A message of PX4 that has no file in nedbus.", **annotated)
    model.LAYOUTS, model.RULES = (Layout("PX4", "*"),), rules
    model.DEFINITION = Definition(model)
    return model.DEFINITION
