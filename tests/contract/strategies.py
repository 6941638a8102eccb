"""Hypothesis strategies for valid messages, with the rules spelled out once more, independently of nedbus_msgs."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping

from hypothesis import strategies as st

from nedbus_msgs import FIELD_TYPES, VehicleLocalPosition

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
WITHIN = {"heading": struct.unpack("<f", struct.pack("<f", math.pi))[0], "ref_lat": 90.0, "ref_lon": 180.0}

float32s = st.floats(width=32)
TYPES: Mapping[str, st.SearchStrategy[object]] = {
    "uint64": st.integers(0, 2**64 - 1),
    "uint8": st.integers(0, 255),
    "bool": st.booleans(),
    "float32": float32s,
    "float32[2]": st.tuples(float32s, float32s),
    "float64": st.floats(),
}
# Values that the field's own type allows, but perhaps not the rules.
SAME_TYPE = {
    "uint64": st.integers(0, 2**64 - 1),
    "uint8": st.integers(0, 255),
    "bool": st.booleans(),
    "float32": st.floats(width=32) | st.sampled_from([-1.0, 3.2, math.nan]),
    "float32[2]": st.tuples(st.floats(width=32), st.floats(width=32)),
    "float64": st.floats() | st.sampled_from([90.0, 90.5, -180.0, 181.0]),
}
FLAGGED = [name for names in FLAG_FIELDS.values() for name in names]
RULED = ["timestamp", "timestamp_sample", *FLAG_FIELDS, *FLAGGED, *NOT_NEGATIVE, *WITHIN]
BROKEN = st.sampled_from(RULED).flatmap(lambda name: st.tuples(st.just(name), SAME_TYPE[FIELD_TYPES[name]]))


def make_valid(fields: dict[str, object]) -> dict[str, object]:
    """Change any fields of the right types so that they pass every rule between fields."""
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
        if not all(math.isfinite(value) for name in names if isinstance(value := fields[name], float)):
            fields[flag] = False
    first, second = fields["timestamp_sample"], fields["timestamp"]
    assert isinstance(first, int)
    assert isinstance(second, int)
    fields["timestamp_sample"], fields["timestamp"] = min(first, second), max(first, second)
    return fields


def fields() -> st.SearchStrategy[dict[str, object]]:
    """Return a strategy for the fields of any valid message."""
    return st.fixed_dictionaries({name: TYPES[kind] for name, kind in FIELD_TYPES.items()}).map(make_valid)


def messages() -> st.SearchStrategy[VehicleLocalPosition]:
    """Return a strategy for any valid message."""
    return fields().map(VehicleLocalPosition.model_validate)


def bits(message: VehicleLocalPosition) -> dict[str, str]:
    """Return the values of a message as text: NaN equals NaN, and -0.0 does not equal 0.0."""
    return {name: repr(value) for name, value in message.model_dump().items()}


def pack_full_width(values: Mapping[str, object]) -> bytes:
    """Return the payload of values of the right types, whether they pass the rules or not."""
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
