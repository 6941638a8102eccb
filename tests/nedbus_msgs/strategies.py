"""Hypothesis strategies for valid messages, with the rules restated independently of nedbus_msgs."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from hypothesis import settings, strategies as st

from nedbus_msgs import VehicleLocalPosition
from tests.flights.local_position import FIELD_TYPES, encode

DATA = Path(__file__).parents[1] / "data"
FLIGHTS = [
    VehicleLocalPosition(**each["fields"])
    for each in json.loads((DATA / "flights.json").read_text()).values()
]
"""One message from each of four real flights: with all fields, without an origin, and with fields missing."""
REAL = [encode(message) for message in FLIGHTS]

FLAG_FIELDS: Mapping[str, tuple[str, ...]] = {
    "xy_valid": ("x", "y"),
    "z_valid": ("z",),
    "v_xy_valid": ("vx", "vy"),
    "v_z_valid": ("vz",),
    "heading_good_for_control": ("heading",),
    "xy_global": ("ref_lat", "ref_lon"),
    "z_global": ("ref_alt",),
    "dist_bottom_valid": ("dist_bottom",),
}
NOT_NEGATIVE = ("heading_var", "tilt_var", "dist_bottom_var", "eph", "epv", "evh", "evv")
WITHIN = {
    "heading": struct.unpack("<f", struct.pack("<f", math.pi))[0],
    "ref_lat": 90.0,
    "ref_lon": 360.0,
}
BEYOND = {"heading": float(np.nextafter(np.float32(math.pi), np.float32(4)))} | {
    name: math.nextafter(bound, math.inf) for name, bound in WITHIN.items() if name != "heading"
}
VIOLATIONS: list[Mapping[str, object]] = [
    *(
        {flag: True, **{other: 1.0 for other in names if other != name}, name: value}
        for flag, names in FLAG_FIELDS.items()
        for name in names
        for value in (math.nan, math.inf)
    ),
    *({name: -1e-30} for name in NOT_NEGATIVE),
    *({name: value} for name, bound in BEYOND.items() for value in (bound, -bound, math.inf)),
    {"timestamp": 2**63, "timestamp_sample": 2**63 + 1},
]
"""For each rule, values that just break it; the last one breaks the rule."""
EXTREMES: list[Mapping[str, object]] = [
    *({flag: True, **dict.fromkeys(names, 1.0)} for flag, names in FLAG_FIELDS.items()),
    *({flag: False, name: math.nan} for flag, names in FLAG_FIELDS.items() for name in names),
    *({name: value} for name in NOT_NEGATIVE for value in (math.nan, math.inf, -0.0)),
    *({name: value} for name, bound in WITHIN.items() for value in (bound, -bound)),
    {"timestamp": 2**64 - 1, "timestamp_sample": 2**64 - 1},
]
"""Extreme values that break no rule."""

float32s = st.floats(width=32)
TYPES: Mapping[str, st.SearchStrategy[object]] = {
    "uint64": st.integers(0, 2**64 - 1),
    "uint8": st.integers(0, 255),
    "bool": st.booleans(),
    "float32": float32s,
    "float32[2]": st.tuples(float32s, float32s),
    "float64": st.floats(),
}
# Values of the right type that may break a rule.
SAME_TYPE = {
    **TYPES,
    "float32": float32s | st.sampled_from([-1.0, 3.2, math.nan]),
    "float64": st.floats() | st.sampled_from([90.0, 90.5, -360.0, 361.0]),
}
FIELDS_WITH_FLAGS = [name for names in FLAG_FIELDS.values() for name in names]
FIELDS_WITH_RULES = [
    "timestamp",
    "timestamp_sample",
    *FLAG_FIELDS,
    *FIELDS_WITH_FLAGS,
    *NOT_NEGATIVE,
    *WITHIN,
]
POSSIBLE_VIOLATIONS = st.sampled_from(FIELDS_WITH_RULES).flatmap(
    lambda name: st.tuples(st.just(name), SAME_TYPE[FIELD_TYPES[name]])
)
MANY_EXAMPLES = settings(max_examples=10 * settings().max_examples)
"""Settings for hostile input, which is fast to generate and needs many examples."""


def make_valid(fields: dict[str, object]) -> dict[str, object]:
    """Change correctly typed fields so that they pass every rule."""
    for name in NOT_NEGATIVE:
        value = fields[name]
        assert isinstance(value, float)
        fields[name] = abs(value)
    for name, bound in WITHIN.items():
        value = fields[name]
        assert isinstance(value, float)
        if abs(value) > bound:
            fields[name] = math.copysign(bound, value)
    for flag, names in FLAG_FIELDS.items():
        if not all(
            math.isfinite(value) for name in names if isinstance(value := fields[name], float)
        ):
            fields[flag] = False
    first, second = fields["timestamp_sample"], fields["timestamp"]
    assert isinstance(first, int)
    assert isinstance(second, int)
    fields["timestamp_sample"], fields["timestamp"] = min(first, second), max(first, second)
    return fields


def fields() -> st.SearchStrategy[dict[str, object]]:
    """Return a strategy for the fields of any valid VehicleLocalPosition."""
    return st.fixed_dictionaries({name: TYPES[kind] for name, kind in FIELD_TYPES.items()}).map(
        make_valid
    )


def messages() -> st.SearchStrategy[VehicleLocalPosition]:
    """Return a strategy for any valid VehicleLocalPosition."""
    return fields().map(VehicleLocalPosition.model_validate)


def bits(message: VehicleLocalPosition) -> dict[str, str]:
    """Return the values of a message as text, where NaN equals NaN but -0.0 differs from 0.0."""
    return {name: repr(value) for name, value in message.model_dump().items()}


def pack_full_width(values: Mapping[str, object]) -> bytes:
    """Encode correctly typed values at full width, without checking the rules."""
    forms = {"uint64": ">BQ", "uint8": ">BB", "float32": ">Bf", "float64": ">Bd"}
    tags = {"uint64": 0xCF, "uint8": 0xCC, "float32": 0xCA, "float64": 0xCB}
    parts = [b"\xdc\x00\x36\x01"]
    for name, kind in FIELD_TYPES.items():
        value = values[name]
        if kind == "bool":
            parts.append(b"\xc3" if value else b"\xc2")
        elif kind == "float32[2]":
            assert isinstance(value, tuple)
            parts.append(b"\x92" + b"".join(struct.pack(">Bf", 0xCA, each) for each in value))
        else:
            parts.append(struct.pack(forms[kind], tags[kind], value))
    return b"".join(parts)
