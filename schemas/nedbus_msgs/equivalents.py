"""What stands for a field's value and is not of its type: NumPy's scalars, and what JSON has in its place."""

from __future__ import annotations

import operator
from collections.abc import Mapping
from typing import Any, Final

from .rows import FIELD_TYPES

_FLOAT_NAMES: Final = frozenset({"NaN", "Infinity", "-Infinity"})


def to_python(fields: Mapping[str, object]) -> dict[str, object]:
    """Return fields with Python's own values: NumPy's scalars and pairs, lists for pairs, the names of floats in JSON.

    Anything else stays as it is, for the model to reject.
    """
    return {name: _value(value, FIELD_TYPES.get(name, "")) for name, value in fields.items()}


def _value(value: Any, kind: str) -> object:
    if type(value).__module__ == "numpy":
        value = value.tolist()
    if kind == "float32[2]" and isinstance(value, list | tuple):
        parts = tuple(_value(part, "float32") for part in value)
        return value if all(map(operator.is_, parts, value)) and isinstance(value, tuple) else parts
    if kind.startswith("float") and isinstance(value, str) and value in _FLOAT_NAMES:
        return float(value)
    return value
