"""Rows: the fields and types of the model, as a named tuple."""

from __future__ import annotations

from typing import get_type_hints

from nedbus_msgs import CURRENT, FIELD_TYPES, Row, VehicleLocalPosition

PYTHON_TYPES = {
    "uint64": int, "uint8": int, "bool": bool, "float32": float, "float64": float, "float32[2]": tuple[float, float],
}  # fmt: skip


def test_row_has_the_fields_of_the_model() -> None:
    """Names and order of a row are PX4's, and so the model's and the current layout's."""
    assert Row._fields == tuple(FIELD_TYPES) == tuple(VehicleLocalPosition.model_fields) == CURRENT.fields


def test_row_has_the_types_of_the_model() -> None:
    """Each field of a row is annotated with the Python type of its PX4 type, and exactly as in the model."""
    assert get_type_hints(Row) == {name: PYTHON_TYPES[kind] for name, kind in FIELD_TYPES.items()}
    of_row, of_model = (get_type_hints(each, include_extras=True) for each in (Row, VehicleLocalPosition))
    assert of_row == {name: of_model[name] for name in of_row}


def test_row_is_a_tuple_with_names() -> None:
    """A row is as light as a tuple: it has the names of the fields, and none of a model's methods."""
    message = VehicleLocalPosition(timestamp=5, delta_xy=(1.0, 2.0))
    row = Row._make(message.__dict__.values())
    assert (row.timestamp, row.delta_xy, len(row)) == (5, (1.0, 2.0), 53)
    assert list(row._asdict()) == list(FIELD_TYPES)
    assert not hasattr(row, "model_dump")
