"""CDR codec, compared with payloads recorded from ROS 2 and with the library `rosbags`."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from nedbus_msgs import DecodeError, EncodeError, VehicleLocalPosition
from tests.flights.local_position import LAYOUTS, decode_cdr, downgrade, encode_cdr
from tests.nedbus_msgs.strategies import DATA, messages

VECTORS = DATA / "cdr_vectors.jsonl"
SHARED_VECTORS = Path(__file__).parents[4] / "shared" / "data" / "cdr_vectors.jsonl"

STORE = get_typestore(Stores.EMPTY)


def rosbags_type(layout: str) -> str:
    """Register a layout with rosbags, and return its type name there."""
    name = f"oracle/msg/L{layout.replace('.', '')}"
    if name not in STORE.types:
        lines = [f"{LAYOUTS[layout].types[field]!s} {field}\n" for field in LAYOUTS[layout].fields]
        STORE.register(get_types_from_msg("".join(lines), name))
    return name


def vectors(path: Path) -> Iterator[Any]:
    for line in path.read_text().splitlines() if path.exists() else ():
        vector = json.loads(line)
        fields = {name: as_python(value) for name, value in vector["fields"].items()}
        layout = "V0" if vector["version"] == 0 else "1.16"
        yield pytest.param(layout, vector | {"fields": fields}, id=f"{layout}-{vector['name']}")


def as_python(value: object) -> object:
    return (
        tuple(map(float, value))
        if isinstance(value, list)
        else float(value)
        if isinstance(value, str)
        else value
    )


@pytest.mark.parametrize(("layout", "vector"), [*vectors(VECTORS), *vectors(SHARED_VECTORS)])
def test_ros_2_payload_round_trip(layout: str, vector: Mapping[str, Any]) -> None:
    """Payloads from rclpy decode to their fields, whatever the padding bytes; the fields encode with zero padding."""
    clean, raw = bytes.fromhex(vector["cdr_hex"]), bytes.fromhex(vector["cdr_hex_raw"])
    fields = decode_cdr(clean, layout=layout)
    assert list(fields) == list(LAYOUTS[layout].fields)
    assert repr(decode_cdr(raw, layout=layout)) == repr(fields)
    if vector["exact"]:
        assert repr(fields) == repr({name: vector["fields"][name] for name in fields})
    if "nan" not in repr(fields):
        assert encode_cdr(fields, layout=layout) == clean
    assert encode_cdr(vector["fields"], layout=layout) == encode_cdr(fields, layout=layout)


@pytest.mark.slow
@given(messages())
def test_payload_matches_rosbags(message: VehicleLocalPosition) -> None:
    """Any message in any layout encodes to the same bytes as with rosbags, and decodes to the same fields."""
    for layout in LAYOUTS:
        fields = downgrade(message, layout)
        kind = rosbags_type(layout)
        payload = encode_cdr(fields, layout=layout)
        expected = STORE.types[kind](**{name: as_array(value) for name, value in fields.items()})
        assert bytes(STORE.serialize_cdr(expected, kind)) == payload
        assert repr(decode_cdr(payload, layout=layout)) == repr(fields)


def as_array(value: object) -> Any:
    return np.array(value, np.float32) if isinstance(value, tuple) else value


@pytest.mark.parametrize("layout", LAYOUTS)
def test_payload_of_wrong_length_is_rejected(layout: str) -> None:
    """Up to 28 bytes beyond PX4's struct size are accepted; one byte more, or one less than CDR needs, is rejected."""
    payload = encode_cdr(downgrade(VehicleLocalPosition(timestamp=7), layout), layout=layout)
    longest = {"1.13": 196, "1.14": 196, "1.15": 212, "V0": 220, "1.16": 220}[layout]
    assert decode_cdr(payload + (longest - len(payload)) * b"\xff", layout=layout)["timestamp"] == 7
    for wrong in (payload[:-1], payload[:4], b"", payload + (longest - len(payload) + 1) * b"\x00"):
        with pytest.raises(DecodeError):
            decode_cdr(wrong, layout=layout)


@pytest.mark.parametrize("head", ["00000000", "00030000", "00070000", "01000000"])
def test_other_encapsulation_is_rejected(head: str) -> None:
    """Big-endian CDR, parameter lists and XCDR2 are rejected as not little-endian CDR."""
    payload = encode_cdr(downgrade(VehicleLocalPosition(timestamp=7), "1.16"), layout="1.16")
    with pytest.raises(DecodeError, match="not little-endian CDR"):
        decode_cdr(bytes.fromhex(head) + payload[4:], layout="1.16")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_bool_other_than_0_or_1_is_rejected(layout: str) -> None:
    """A bool byte other than 0 or 1 is rejected, because it means that the payload has another layout."""
    payload = bytearray(
        encode_cdr(downgrade(VehicleLocalPosition(timestamp=7), layout), layout=layout)
    )
    payload[4 + 16] = 2
    with pytest.raises(DecodeError, match="xy_valid is 2"):
        decode_cdr(bytes(payload), layout=layout)


@pytest.mark.parametrize(
    ("layout", "size"), {"1.13": 184, "1.14": 188, "1.15": 204, "V0": 216, "1.16": 220}.items()
)
def test_padding_is_ignored(layout: str, size: int) -> None:
    """Padding bytes may have any value, because ROS leaves uninitialized memory there."""
    # No byte of these values is 0, so each 0 is padding.
    filled = {"bool": True, "uint8": 255, "uint64": 2**64 - 1, "float32": 0.1, "float64": 0.1}
    values = {
        name: filled.get(str(LAYOUTS[layout].types[name]), (0.1, 0.1))
        for name in LAYOUTS[layout].fields
    }
    payload = encode_cdr(values, layout=layout)
    head, data = payload[:4], payload[4:]
    dirty = head + bytes(byte or 255 - index % 200 for index, byte in enumerate(data))
    assert (len(payload), dirty == payload) == (size, False)
    assert repr(decode_cdr(dirty, layout=layout)) == repr(decode_cdr(payload, layout=layout))


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
def test_value_of_wrong_type_or_range_raises(name: str, value: object) -> None:
    """A value that does not fit raises, with the name of the field; rclpy would send it as 0, 44 or infinity."""
    fields = downgrade(VehicleLocalPosition(timestamp=7), "1.16") | {name: value}
    with pytest.raises(EncodeError, match=f"{name}="):
        encode_cdr(fields, layout="1.16")


def test_int_is_accepted_for_float() -> None:
    """An int in a float field is encoded as a float, as in the model."""
    fields = downgrade(VehicleLocalPosition(timestamp=7), "1.16") | {"x": 3, "delta_xy": (1, 2)}
    assert decode_cdr(encode_cdr(fields, layout="1.16"), layout="1.16")["x"] == 3.0


@given(st.binary(max_size=300))
def test_random_bytes_decode_or_raise_decode_error(payload: bytes) -> None:
    """Decoding random bytes succeeds or raises DecodeError, but never another error."""
    for layout in LAYOUTS:
        for data in (payload, b"\x00\x01\x00\x00" + payload):
            with suppress(DecodeError):
                assert list(decode_cdr(data, layout=layout)) == list(LAYOUTS[layout].fields)
