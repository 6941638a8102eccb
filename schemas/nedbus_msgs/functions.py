"""Functions of the contract: find definitions, and describe their schemas."""

from typing import Any, Final

from typing_extensions import TypeVar

from .messages.vehicle_local_position import VehicleLocalPosition
from .model.declaration import DEFAULT_TOPIC
from .model.definition import BY_TOPIC, MESSAGES, Definition
from .model.message import Message

M = TypeVar("M", bound=Message, default=VehicleLocalPosition)


def definition_of(message: type[M] | str) -> Definition[M]:
    """Return the definition of a message by class, name or topic; raise KeyError if it is unknown."""
    if isinstance(message, str):
        return MESSAGES[message] if message in MESSAGES else BY_TOPIC[message]
    return message.DEFINITION


DEFAULT: Final[Definition[VehicleLocalPosition]] = definition_of(DEFAULT_TOPIC)
"""The default message of functions that take one."""


def schema_of(definition: Definition[Any]) -> dict[str, object]:
    """Return the description of a message for queries: its JSON Schema and its layouts."""
    return {"json_schema": json_schema_of(definition), "layouts": layout_table_of(definition)}


def json_schema_of(definition: Definition[Any]) -> dict[str, object]:
    """Return the JSON Schema (2020-12) of a message; NaN and infinities are strings of those names."""
    schema = definition.model.model_json_schema()
    # No defaults: JSON has no NaN, and a writer should omit fields that are not provided.
    for field in schema["properties"].values():
        field.pop("default", None)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def layout_table_of(definition: Definition[Any]) -> list[dict[str, object]]:
    """Return all layouts with name, number on the wire (or None), and fields in order, each with name and type."""
    return [
        {
            "name": layout.name,
            "wire": layout.wire,
            "fields": [{"name": name, "type": str(kind)} for name, kind in layout.types.items()],
        }
        for layout in definition.layouts.values()
    ]
