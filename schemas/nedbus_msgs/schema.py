"""The schema of the contract: the JSON Schema of the message, and the layouts with their fields and types."""

from __future__ import annotations

from .layouts import LAYOUTS
from .position import VehicleLocalPosition


def json_schema() -> dict[str, object]:
    """Return the JSON Schema (2020-12) of a message as JSON; NaN and infinities are the strings of those names."""
    schema = VehicleLocalPosition.model_json_schema()
    # JSON has no NaN, and a writer should leave out what is not provided: defaults stay in the model.
    for field in schema["properties"].values():
        field.pop("default", None)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def layout_table() -> list[dict[str, object]]:
    """Return every layout as name, number on the wire (or None), and its fields in order, each with name and type."""
    return [
        {
            "name": layout.name,
            "wire": layout.wire,
            "fields": [{"name": field, "type": layout.type_of(field)} for field in layout.fields],
        }
        for layout in LAYOUTS.values()
    ]
