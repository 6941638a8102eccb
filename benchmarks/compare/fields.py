"""The message that all forms send, as plain Python values, from a real flight in tests/data/flights.json.

The environment variable BENCH_FLIGHT selects the flight. The sender sets `timestamp`; `timestamp_sample` is 0, because
it must not be later than `timestamp`.
"""

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

VARIABLE: Final = "BENCH_FLIGHT"
DEFAULT_FLIGHT: Final = "no origin"  # no terrain estimate either: dist_bottom_valid is false
FLIGHTS: Final[dict[str, Any]] = json.loads(
    (Path(__file__).parents[2] / "tests/data/flights.json").read_text()
)
FLIGHT: Final = os.environ.get(VARIABLE, DEFAULT_FLIGHT)

_ABSENT: Final = {bool: False, int: 0, float: math.nan, tuple: (math.nan, math.nan)}


def _read(flight: str) -> dict[str, Any]:
    """Return the fields of a flight; JSON has neither NaN nor tuples."""
    fields = {name: _value(value) for name, value in FLIGHTS[flight]["fields"].items()}
    return fields | {"timestamp_sample": 0} if "timestamp_sample" in fields else fields


def _value(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(map(float, value))
    return float(value) if isinstance(value, str) else value


def _complete(provided: Mapping[str, Any]) -> dict[str, Any]:
    """Return all fields in PX4's order, with NaN, False or 0 for fields that the source does not provide."""
    return {
        name: provided.get(name, _ABSENT[type(value)])
        for name, value in _read("everything set").items()
    }


COMPLETE: Final = [
    flight for flight in FLIGHTS if len(_read(flight)) == len(_read("everything set"))
]
"""Flights whose source provides all fields."""

PROVIDED: Final = _read(FLIGHT)
"""Fields that the source of this flight provides; nedbus also transmits which fields are provided."""

FIELDS: Final = _complete(PROVIDED)
"""All 53 fields."""


def _type_of(name: str, value: object) -> str:
    if isinstance(value, bool):
        return "bool"
    if isinstance(value, int):
        return "uint64" if "timestamp" in name else "uint8"
    if isinstance(value, tuple):
        return "float32[2]"
    return "float64" if name in {"ref_lat", "ref_lon"} else "float32"


TYPES: Final = {name: _type_of(name, value) for name, value in FIELDS.items()}
"""PX4's type of each field."""
