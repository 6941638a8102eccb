"""The fast path of validation: all fields as one tuple, which takes a fifth of the time of the model.

It uses the model's types and rules, and accepts only what the model accepts.
What it does not accept goes to the model, which decides and gives the reasons.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from pydantic import TypeAdapter, ValidationError
from pydantic_core import CoreConfig, SchemaValidator, core_schema

from .float32 import name_rounded
from .px4_types import NAN, TYPES, TypeName
from .rows import FIELD_TYPES, NAMES, Values, values_of
from .rules import make_fast_check

_SCHEMAS: Final = {name: TypeAdapter(annotation).core_schema for name, annotation in TYPES.items()}
_VALIDATE: Final = SchemaValidator(
    core_schema.tuple_positional_schema([_SCHEMAS[kind] for kind in FIELD_TYPES.values()]), CoreConfig(strict=True)
).validate_python

_ABSENT: Final[Mapping[TypeName, object]] = {
    "uint64": 0, "uint8": 0, "bool": False, "float32": NAN, "float32[2]": (NAN, NAN), "float64": NAN,
}  # fmt: skip
_DEFAULTS: Final = {name: _ABSENT[kind] for name, kind in FIELD_TYPES.items() if name != "timestamp"}
passes_rules: Final = make_fast_check({name: index for index, name in enumerate(NAMES)})
"""Return whether the values of all fields, which have the right types, pass the rules between fields."""


def check_row(values: Values) -> Values | None:
    """Return the values of all fields, validated but not rounded; None if the model has to decide."""
    try:
        row: Values = _VALIDATE(values)
    except ValidationError:
        return None
    return row if passes_rules(row) else None


def row_of(fields: Mapping[str, object]) -> Values | None:
    """Return the values of all fields in their order, validated but not rounded; None if the model has to decide.

    Fields that are not given, but for `timestamp`, have their defaults.
    """
    if len(fields) < len(NAMES):
        fields = {**_DEFAULTS, **fields}
    if len(fields) != len(NAMES):
        return None
    try:
        return check_row(values_of(fields))
    except KeyError:  # no timestamp, and another name among as many
        return None


def validate_fields(fields: Mapping[str, object]) -> dict[str, object] | None:
    """Return all fields in their order, validated and rounded to float32; None if the model has to decide."""
    row = row_of(fields)
    if row is None:
        return None
    try:
        return name_rounded(row)
    except OverflowError:
        return None
