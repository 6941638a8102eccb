"""The msgpack codec: golden bytes, round trips, foreign encodings, hostile input."""

from __future__ import annotations

import json
import struct

import msgpack
import pytest
from hypothesis import example, given, strategies as st

from nedbus_msgs import (
    PAYLOAD_LIMIT,
    DecodeError,
    EncodeError,
    UnknownLayoutError,
    VehicleLocalPosition,
)
from nedbus_msgs.arrays import to_message
from tests.flights.local_position import (
    FIELD_TYPES,
    PAYLOAD_SIZE,
    decode,
    decode_array,
    decode_row,
    downgrade,
    encode,
    encode_row,
)
from tests.nedbus_msgs.strategies import DATA, FLIGHTS, MANY_EXAMPLES, REAL, bits, messages

GOLDEN = json.loads((DATA / "golden.json").read_text())


@pytest.mark.parametrize("name", GOLDEN)
def test_payload_equals_golden_bytes(name: str) -> None:
    """Messages encode to the golden bytes, which are the wire format: a change breaks compatibility."""
    message = VehicleLocalPosition.model_validate_json(json.dumps(GOLDEN[name]["message"]))
    payload = bytes.fromhex(GOLDEN[name]["payload"])
    assert encode(message) == payload
    assert bits(decode(payload)) == bits(message)


@given(messages())
def test_payload_is_244_bytes_of_plain_msgpack(message: VehicleLocalPosition) -> None:
    """Any msgpack decoder returns an array of layout number and 53 fields; the codec returns the same message."""
    payload = encode(message)
    assert len(payload) == PAYLOAD_SIZE
    array = msgpack.unpackb(payload, use_list=False)
    assert array[0] == 1
    assert [repr(value) for value in array[1:]] == [
        repr(getattr(message, name)) for name in FIELD_TYPES
    ]
    assert bits(decode(payload)) == bits(message)


@given(messages(), st.booleans(), st.booleans())
def test_other_msgpack_encodings_are_decoded(
    message: VehicleLocalPosition, single: bool, whole: bool
) -> None:
    """Short ints, doubles, and ints in float fields decode to the same message and row."""
    values = [value for name, value in message.model_dump().items()]
    if whole:
        values = [
            int(each) if isinstance(each, float) and each.is_integer() and each else each
            for each in values
        ]
        values = [
            each if not isinstance(each, int) or -(2**63) <= each < 2**64 else float(each)
            for each in values
        ]
    payload = msgpack.packb(
        [1, *values], use_single_float=single and not (message.ref_lat or message.ref_lon)
    )
    assert bits(decode(payload)) == bits(message)
    assert encode_row(decode_row(payload)) == encode(message)


@pytest.mark.slow
@given(messages())
def test_layout_0_is_decoded(message: VehicleLocalPosition) -> None:
    """A payload of layout 0 has 52 fields, and a single hagl_max for hagl_max_z and hagl_max_xy."""
    older = downgrade(message, "V0")
    decoded = decode(msgpack.packb([0, *older.values()]))
    assert bits(decoded) == bits(message.model_copy(update={"hagl_max_xy": message.hagl_max_z}))


def test_newer_layout_is_decoded_by_field_names() -> None:
    """Given the field names of an unknown layout, known fields are decoded and all others ignored."""
    names = ["timestamp", "x", "y", "brand_new"]
    payload = msgpack.packb([2, 5, 1.0, 2.0, True])
    with pytest.raises(
        UnknownLayoutError, match=r"unknown layout 2 with 4 fields \(known: 0, 1\)"
    ) as info:
        decode(payload)
    assert (info.value.layout, info.value.count, info.value.known) == (2, 4, (0, 1))
    message = decode(payload, newer={2: names})
    assert (message.timestamp, message.x, message.y) == (5, 1.0, 2.0)
    with pytest.raises(DecodeError, match="3 fields, expected 4 for layout 2"):
        decode(msgpack.packb([2, 5, 1.0, 2.0]), newer={2: names})


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "the 0-byte payload is not a single msgpack value"),
        (b"\xc1", "the 1-byte payload"),
        (b"hello", "the 5-byte payload"),
        (msgpack.packb({"x": 1}), "not a single msgpack value"),
        (msgpack.packb([]), "does not start|not an array that starts"),
        (msgpack.packb(["1"]), "not an array that starts"),
        (msgpack.packb([True, 1]), "not an array that starts"),
        (msgpack.packb([1, 2, 3]), "2 fields, expected 53 for layout 1"),
        (msgpack.packb(7), "not an array"),
        (b"\x00" * (PAYLOAD_LIMIT + 1), "4097 bytes, more than the limit of 4096"),
        (b"\xdd\xff\xff\xff\xff", "not a single msgpack value"),
        (b"\x91" * 4000, "not a single msgpack value"),
        (REAL[0] + b"\x00", "the 245-byte payload is not a single msgpack value"),
        (REAL[0][:-1], "the 243-byte payload is not a single msgpack value"),
        (REAL[0][1:], "the 243-byte payload is not a single msgpack value"),
    ],
)
def test_invalid_payload_error_states_the_reason(payload: bytes, reason: str) -> None:
    """The error states what is wrong with the payload."""
    with pytest.raises(DecodeError, match=reason):
        decode(payload)


def test_payload_that_breaks_a_rule_is_rejected() -> None:
    """A received message is validated like a sent one, on the fast and the general path of the decoder."""
    values = [1, *VehicleLocalPosition(timestamp=1).model_dump().values()]
    values[3] = True  # xy_valid, while x is NaN
    with pytest.raises(DecodeError, match="x: must be finite while xy_valid"):
        decode(msgpack.packb(values))
    payload = bytearray(encode(VehicleLocalPosition(timestamp=1)))
    assert payload[22] == 0xC2
    payload[22] = 0xC3
    with pytest.raises(DecodeError, match="x: must be finite while xy_valid"):
        decode(bytes(payload))


@pytest.mark.slow
def test_flipped_bit_has_the_same_effect_in_model_row_and_array() -> None:
    """A payload with one flipped bit is decoded, or rejected, identically as a model, as a row and in an array."""
    number = int.from_bytes(REAL[0], "big")
    payloads = [
        (number ^ 1 << bit).to_bytes(PAYLOAD_SIZE, "big") for bit in range(8 * PAYLOAD_SIZE)
    ]
    array, valid = decode_array(b"".join(payloads))
    for index, payload in enumerate(payloads):
        try:
            message = decode(payload)
        except DecodeError:
            assert not valid[index]
            with pytest.raises(DecodeError):
                decode_row(payload)
        else:
            assert encode(message) == encode_row(decode_row(payload))
            assert not valid[index] or bits(to_message(array[index])) == bits(message)
    assert 1000 < valid.sum() < len(payloads)


@given(st.binary(max_size=600))
@example(b"\xdc\x00\x36")
@example(b"\xc7\x0c\xff" + bytes(12))
@MANY_EXAMPLES
def test_random_bytes_decode_or_raise_decode_error(payload: bytes) -> None:
    """Decoding random bytes succeeds or raises DecodeError, but never another error."""
    try:
        decode(payload)
    except DecodeError as exc:
        assert exc.reason


SHORT = st.binary(max_size=5)
msgpack_values = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(-(2**63), 2**64 - 1),
        st.floats(),
        st.text(max_size=5),
        SHORT,
    ),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3)
    ),
    max_leaves=8,
)


@pytest.mark.slow
@given(st.sampled_from(FLIGHTS), st.integers(0, 53), msgpack_values)
@MANY_EXAMPLES
def test_random_value_is_decoded_unchanged_or_rejected(
    good: VehicleLocalPosition, index: int, value: object
) -> None:
    """In an otherwise valid payload, a value is decoded unchanged up to float32 rounding, or raises DecodeError."""
    array: list[object] = [1, *good.model_dump().values()]
    array[index] = value
    try:
        message = decode(msgpack.packb(array))
    except DecodeError:
        return
    forms = [value]
    if isinstance(value, int | float):
        forms += [float(value), *struct.unpack("<f", struct.pack("<f", value))]
    elif isinstance(value, list) and len(value) == 2:
        forms += [tuple(map(float, value)), struct.unpack("<2f", struct.pack("<2f", *value))]
    assert index == 0 or repr(message.model_dump()[list(FIELD_TYPES)[index - 1]]) in map(
        repr, forms
    )


def test_encoding_after_bypassed_validation_raises() -> None:
    """Encoding a message from model_construct raises if a value does not fit; it never encodes another value."""
    for field, value in (
        ("x", 1e39),
        ("timestamp", -1),
        ("xy_reset_counter", 300),
        ("x", "1"),
        ("delta_xy", None),
    ):
        message = VehicleLocalPosition.model_construct(
            **{**VehicleLocalPosition(timestamp=1).__dict__, field: value}
        )
        with pytest.raises(EncodeError, match="VehicleLocalPosition"):
            encode(message)


def test_deeply_nested_array_is_rejected() -> None:
    """An array nested 400 deep is rejected before it is formatted, which would overflow the stack."""
    deep = b"\x91" * 400 + b"\x01"
    values = [
        msgpack.packb(value) for value in VehicleLocalPosition(timestamp=1).model_dump().values()
    ]
    values[6] = deep
    with pytest.raises(DecodeError, match="x has a nested array"):
        decode(b"\xdc\x00\x36\x01" + b"".join(values))
