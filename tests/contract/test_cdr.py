"""CDR, compared with what a real ROS 2 serialised, and with rosbags."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from nedbus_msgs import (
    LAYOUTS,
    DecodeError,
    EncodeError,
    LayoutError,
    VehicleLocalPosition,
    decode_cdr,
    downgrade,
    encode_cdr,
)

from .strategies import messages

VECTORS = Path(__file__).parents[1] / "data" / "cdr_vectors.jsonl"
SHARED_VECTORS = Path(__file__).parents[3] / "shared" / "data" / "cdr_vectors.jsonl"

FORMATS = {
    "1.13": "<QQ????fff2fB3xfB3xffff2fB3xfB3xfffffB???Qddff?B2xffffffff",
    "1.14": "<QQ????fff2fB3xfB3xffff2fB3xfB3xfffffB???Qddff?B2xffff?3xffff",
    "1.15": "<QQ????fff2fB3xfB3xffff2fB3xfB3xfffffffB?2xf??2xQddff?B2xffff?3xffff",
    "V0": "<QQ????fff2fB3xfB3xffff2fB3xfB3xfffffffB?2xf??2xQddf?3xfffBB2xffff?3xffff",
    "1.16": "<QQ????fff2fB3xfB3xffff2fB3xfB3xfffffffB?2xf??2xQddf?3xfffBB2xffff?3xfffff",
}
WITH_PADDING = [name for name, form in FORMATS.items() if "x" in form]
STORE = get_typestore(Stores.EMPTY)


def rosbags_type(layout: str) -> str:
    """Return the name under which rosbags knows this layout."""
    name = f"oracle/msg/L{layout.replace('.', '')}"
    if name not in STORE.types:
        lines = [f"{LAYOUTS[layout].type_of(field)} {field}\n" for field in LAYOUTS[layout].fields]
        STORE.register(get_types_from_msg("".join(lines), name))
    return name


def vectors(path: Path) -> Iterator[Any]:
    for line in path.read_text().splitlines() if path.exists() else ():
        vector = json.loads(line)
        fields = {name: as_python(value) for name, value in vector["fields"].items()}
        layout = "V0" if vector["version"] == 0 else "1.16"
        yield pytest.param(layout, vector | {"fields": fields}, id=f"{layout}-{vector['name']}")


def as_python(value: object) -> object:
    return tuple(map(float, value)) if isinstance(value, list) else float(value) if isinstance(value, str) else value


def padding(layout: str) -> list[int]:
    """Return the offsets of all padding bytes of a payload."""
    offsets: list[int] = []
    offset = 4
    form = FORMATS[layout][1:]
    count = ""
    for letter in form:
        if letter.isdigit():
            count += letter
            continue
        size = struct.calcsize("<" + (count or "1") + letter)
        if letter == "x":
            offsets += range(offset, offset + size)
        offset += size
        count = ""
    return offsets


def is_same(one: object, other: object) -> bool:
    """Compare to the bit; NaN equals NaN."""
    if isinstance(one, tuple) and isinstance(other, tuple):
        return all(map(is_same, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return (math.isnan(one) and math.isnan(other)) or struct.pack("<d", one) == struct.pack("<d", other)
    return type(one) is type(other) and one == other


@pytest.mark.parametrize(("layout", "vector"), [*vectors(VECTORS), *vectors(SHARED_VECTORS)])
def test_real_ros_2_is_decoded_and_encoded(layout: str, vector: Mapping[str, Any]) -> None:
    """Payloads of a real rclpy decode to their fields, whatever is in the padding, and the fields encode to them."""
    clean, raw = bytes.fromhex(vector["cdr_hex"]), bytes.fromhex(vector["cdr_hex_raw"])
    fields = decode_cdr(clean, layout=layout)
    assert list(fields) == list(LAYOUTS[layout].fields)
    assert all(is_same(value, decode_cdr(raw, layout=layout)[name]) for name, value in fields.items())
    if vector["exact"]:
        wrong = {name: fields[name] for name in fields if not is_same(fields[name], vector["fields"][name])}
        assert not wrong
    if not any(map(math.isnan, floats(fields))):
        assert encode_cdr(fields, layout=layout) == clean
    assert encode_cdr(vector["fields"], layout=layout) == encode_cdr(fields, layout=layout)


def floats(fields: Mapping[str, object]) -> Iterator[float]:
    for value in fields.values():
        yield from (item for item in (value if isinstance(value, tuple) else (value,)) if isinstance(item, float))


@pytest.mark.parametrize("layout", LAYOUTS)
@given(data=st.data())
def test_rosbags_agrees(layout: str, data: st.DataObject) -> None:
    """In every layout, any message is the same bytes by rosbags' own serialisation, and decodes to the same fields."""
    fields = downgrade(data.draw(messages()), layout)
    kind = rosbags_type(layout)
    payload = encode_cdr(fields, layout=layout)
    theirs = STORE.types[kind](**{name: as_array(value) for name, value in fields.items()})
    assert bytes(STORE.serialize_cdr(theirs, kind)) == payload
    assert all(is_same(value, fields[name]) for name, value in decode_cdr(payload, layout=layout).items())


def as_array(value: object) -> Any:
    return np.array(value, np.float32) if isinstance(value, tuple) else value


@pytest.mark.parametrize("layout", LAYOUTS)
def test_offsets_are_px4s(layout: str) -> None:
    """Derived from the types, every field has the offset that it has in the known struct formats."""
    values = [item + 1 for item in range(len(LAYOUTS[layout].fields) + 2)]
    flat = iter(values)
    fields = {name: a_value(LAYOUTS[layout].type_of(name), flat) for name in LAYOUTS[layout].fields}
    packed = struct.pack(FORMATS[layout], *(item for value in fields.values() for item in as_tuple(value)))
    assert encode_cdr(fields, layout=layout) == b"\x00\x01\x00\x00" + packed
    assert len(packed) + 4 == {"1.13": 184, "1.14": 188, "1.15": 204, "V0": 216, "1.16": 220}[layout]


def a_value(kind: str, numbers: Iterator[int]) -> object:
    if kind == "float32[2]":
        return float(next(numbers)), float(next(numbers))
    number = next(numbers)
    return number % 2 == 1 if kind == "bool" else float(number) if kind.startswith("float") else number


def as_tuple(value: object) -> tuple[object, ...]:
    return value if isinstance(value, tuple) else (value,)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_only_what_px4_appends_is_ignored(layout: str) -> None:
    """PX4 sends the size of its struct and 28 bytes; one byte more, or one less than CDR needs, is rejected."""
    payload = encode_cdr(downgrade(VehicleLocalPosition(timestamp=7), layout), layout=layout)
    longest = {"1.13": 196, "1.14": 196, "1.15": 212, "V0": 220, "1.16": 220}[layout]
    assert decode_cdr(payload + (longest - len(payload)) * b"\xff", layout=layout)["timestamp"] == 7
    for wrong in (payload[:-1], payload[:4], b"", payload + (longest - len(payload) + 1) * b"\x00"):
        with pytest.raises(DecodeError):
            decode_cdr(wrong, layout=layout)


@pytest.mark.parametrize("head", ["00000000", "00030000", "00070000", "01000000"])
def test_other_encapsulation_is_rejected(head: str) -> None:
    """Big-endian, parameter lists and XCDR2 are rejected with that reason."""
    payload = encode_cdr(downgrade(VehicleLocalPosition(timestamp=7), "1.16"), layout="1.16")
    with pytest.raises(DecodeError, match="not little-endian CDR"):
        decode_cdr(bytes.fromhex(head) + payload[4:], layout="1.16")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_bool_is_0_or_1(layout: str) -> None:
    """Any other byte in a bool means that the payload has another layout."""
    payload = bytearray(encode_cdr(downgrade(VehicleLocalPosition(timestamp=7), layout), layout=layout))
    payload[4 + 16] = 2
    with pytest.raises(DecodeError, match="xy_valid: 2"):
        decode_cdr(bytes(payload), layout=layout)


@pytest.mark.parametrize("layout", WITH_PADDING)
@given(data=st.data())
def test_padding_may_hold_anything(layout: str, data: st.DataObject) -> None:
    """ROS leaves garbage of its memory in the padding: it is ignored."""
    payload = bytearray(encode_cdr(downgrade(VehicleLocalPosition(timestamp=7), layout), layout=layout))
    clean = decode_cdr(bytes(payload), layout=layout)
    for index in padding(layout):
        assert payload[index] == 0
        payload[index] = data.draw(st.integers(0, 255))
    assert all(is_same(value, clean[name]) for name, value in decode_cdr(bytes(payload), layout=layout).items())


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("x", None), ("x", "abc"), ("x", True), ("x", 1e39), ("x", 10**40), ("x", 10**400),
        ("xy_reset_counter", 300), ("xy_reset_counter", -1), ("xy_reset_counter", 1.0), ("xy_reset_counter", True),
        ("timestamp", 2**64), ("timestamp", "1"),
        ("xy_valid", 1), ("xy_valid", None),
        ("delta_xy", (1.0,)), ("delta_xy", (1.0, 2.0, 3.0)), ("delta_xy", 1.0), ("delta_xy", (1.0, None)),
        ("delta_xy", (1.0, 1e39)),
        ("ref_lat", 10**400),
    ],
    ids=lambda value: repr(value)[:20],
)  # fmt: skip
def test_value_of_another_type_or_range_is_rejected(name: str, value: object) -> None:
    """ROS 2's Python sends such values as 0, 44 or infinity; here each is rejected with the name of its field."""
    fields = downgrade(VehicleLocalPosition(timestamp=7), "1.16") | {name: value}
    with pytest.raises(EncodeError, match=f"{name}: "):
        encode_cdr(fields, layout="1.16")


def test_whole_numbers_are_floats_too() -> None:
    """An int where a float is meant is that float, as everywhere here."""
    fields = downgrade(VehicleLocalPosition(timestamp=7), "1.16") | {"x": 3, "delta_xy": [1, 2]}
    assert decode_cdr(encode_cdr(fields, layout="1.16"), layout="1.16")["x"] == 3.0


def test_other_fields_are_rejected() -> None:
    """Fields of another layout are not encoded in this one."""
    fields = downgrade(VehicleLocalPosition(timestamp=7), "1.14")
    with pytest.raises(LayoutError, match=r"these are the fields of layout 1\.14"):
        encode_cdr(fields, layout="1.15")


@given(st.binary(max_size=300))
def test_garbage_is_rejected_or_decoded(payload: bytes) -> None:
    """Random bytes decode to fields or raise DecodeError, nothing else."""
    for layout in LAYOUTS:
        for data in (payload, b"\x00\x01\x00\x00" + payload):
            with suppress(DecodeError):
                assert list(decode_cdr(data, layout=layout)) == list(LAYOUTS[layout].fields)
