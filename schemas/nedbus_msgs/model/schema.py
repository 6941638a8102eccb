"""The schema of a message: its JSON Schema, and its layouts with their fields and types."""

from __future__ import annotations

from typing import Any

from .definition import Definition


def schema_of(definition: Definition[Any]) -> dict[str, object]:
    """Return the description of a message that publishers answer queries with: its JSON Schema and its layouts."""
    return {"json_schema": json_schema_of(definition), "layouts": layout_table_of(definition)}


def json_schema_of(definition: Definition[Any]) -> dict[str, object]:
    """Return the JSON Schema (2020-12) of a message as JSON; NaN and infinities are the strings of those names."""
    schema = definition.model.model_json_schema()
    # JSON has no NaN, and a writer should leave out what is not provided: defaults stay in the model.
    for field in schema["properties"].values():
        field.pop("default", None)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def layout_table_of(definition: Definition[Any]) -> list[dict[str, object]]:
    """Return every layout as name, number on the wire (or None), and its fields in order, each with name and type."""
    return [
        {
            "name": layout.name,
            "wire": layout.wire,
            "fields": [{"name": name, "type": str(kind)} for name, kind in layout.types.items()],
        }
        for layout in definition.layouts.values()
    ]
