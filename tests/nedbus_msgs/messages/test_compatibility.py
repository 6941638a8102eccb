"""Snapshot of VehicleLocalPosition: payloads, hashes, dtype, schema and error texts.

A changed payload, hash or dtype breaks compatibility; a changed text needs a new snapshot.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from hashlib import sha256
from typing import Any, Final

import pytest
from pydantic import ValidationError

from nedbus_msgs import NedbusError, VehicleLocalPosition
from nedbus_msgs.arrays import DTYPE
from tests.flights.local_position import (
    LAYOUTS,
    decode as decode_payload,
    decode_row,
    describe,
    encode_fields,
    json_schema,
    layout_table,
    message_definition,
    type_hash,
)
from tests.nedbus_msgs.strategies import DATA, FLIGHTS, REAL

SNAPSHOT: Final = DATA / "vehicle_local_position.json"
VALID: Final[dict[str, Any]] = {
    "timestamp": 5,
    "timestamp_sample": 4,
    "xy_valid": True,
    "x": 1.0,
    "y": 2.0,
}
INVALID: Final[Mapping[str, Mapping[str, object]]] = {
    "no timestamp": {"x": 1.0},
    "text": {**VALID, "x": "north"},
    "int out of range": {**VALID, "xy_reset_counter": 256},
    "negative": {**VALID, "timestamp": -1, "timestamp_sample": 0},
    "int for a bool": {**VALID, "z_valid": 1},
    "array too short": {**VALID, "delta_xy": (1.0,)},
    "text in an array": {**VALID, "delta_vxy": (1.0, "2")},
    "beyond float32": {**VALID, "vx": 1e39, "delta_xy": (1e39, 0.0)},
    "not finite while valid": {**VALID, "x": math.nan, "y": math.inf},
    "several rules": {
        **VALID,
        "timestamp_sample": 6,
        "eph": -1.0,
        "heading": 4.0,
        "ref_lat": -91.0,
    },
    "unknown field": {**VALID, "hight": 1.0},
    "unknown field without a suggestion": {**VALID, "qqqq": 1.0},
}
PAYLOADS: Final[Mapping[str, Callable[[bytes], bytes]]] = {
    "empty": lambda whole: b"",
    "truncated": lambda whole: whole[:-1],
    "trailing byte": lambda whole: whole + b"\x00",
    "too large": lambda whole: whole * 20,
    "a map": lambda whole: b"\x80",
    "another layout": lambda whole: b"\xdc\x00\x02\x07\x01",
    "too few fields": lambda whole: b"\xdc\x00\x02\x01\x01",
    "a wrong type": lambda whole: whole[:4] + b"\xc2" + whole[13:],
    "text": lambda whole: whole[:4] + b"\xa3abc" + whole[13:],
    "a broken rule": lambda whole: whole[:5] + bytes(8) + whole[13:],
}


def reasons() -> dict[str, str]:
    """Return the error text of each invalid message and payload."""
    texts = {}
    for name, fields in INVALID.items():
        for form in (lambda fields: VehicleLocalPosition(**fields), encode_fields):
            try:
                form(fields)
            except ValidationError as exc:
                texts[f"model: {name}"] = describe(exc)
            except NedbusError as exc:
                texts[f"{type(exc).__name__}: {name}"] = str(exc)
    for name, change in PAYLOADS.items():
        for decode in (decode_payload, decode_row):
            try:
                decode(change(REAL[0]))
            except NedbusError as exc:
                texts[f"{type(exc).__name__} of {decode.__name__}: {name}"] = str(exc)
    return texts


def snapshot() -> dict[str, object]:
    """Return everything that other programs may depend on."""
    texts = {f".msg {name}": message_definition(name) for name in LAYOUTS}
    texts |= {"json_schema": json.dumps(json_schema()), "layouts": json.dumps(layout_table())}
    texts |= {f"json {index}": each.model_dump_json() for index, each in enumerate(FLIGHTS)}
    return {
        "reasons": reasons(),
        "payloads": [payload.hex() for payload in REAL],
        "hashes": {name: type_hash(name) for name in LAYOUTS},
        "dtype": [list(map(str, each)) for each in DTYPE.descr],
        "texts": {name: sha256(text.encode()).hexdigest() for name, text in texts.items()},
    }


@pytest.mark.parametrize("part", ["reasons", "payloads", "hashes", "dtype", "texts"])
def test_message_equals_its_snapshot(part: str) -> None:
    """Payloads, hashes, dtype, JSON Schema, definitions and error texts are unchanged."""
    assert snapshot()[part] == json.loads(SNAPSHOT.read_text())[part]
