"""Models, rows, fields and arrays: each form accepts and rejects exactly what the model does."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError, field_validator

from nedbus_msgs import (
    FIELD_TYPES,
    DecodeError,
    EncodeError,
    InvalidMessageError,
    VehicleLocalPosition,
    decode,
    decode_row,
    describe,
    downgrade,
    encode,
    encode_cdr,
    encode_fields,
    encode_row,
)
from nedbus_msgs.arrays import (
    DTYPE,
    decode_array,
    decode_cdr_array,
    encode_array,
    encode_cdr_array,
    to_array,
    to_message,
    valid_mask,
)

from .strategies import BROKEN, bits, messages, pack_full_width

GOOD = encode(VehicleLocalPosition.model_validate({"timestamp": 5, **dict.fromkeys(["vxy_max", "eph"], math.inf)}))
# Values for any field, valid or not, whatever its type.
ODD = st.one_of(
    st.integers(-(2**70), 2**70),
    st.floats(allow_subnormal=True),
    st.floats(width=32),
    st.booleans(),
    st.none(),
    st.sampled_from(["", "x", "NaN"]),
    st.sampled_from([math.nan, math.inf, -math.inf, 1e39, -0.0, -1e-50, 2**64, 2**64 - 1, 256, 255, math.pi, 90.5]),
    st.tuples(st.floats(), st.floats()),
    st.lists(st.floats(), max_size=3),
)
CHANGES = st.dictionaries(st.sampled_from(list(FIELD_TYPES)), ODD, max_size=3)


def payload_by_model(fields: Mapping[str, object]) -> bytes | None:
    """Return the payload of the message with these fields, None if the model rejects them."""
    try:
        return encode(VehicleLocalPosition.model_validate(fields))
    except ValidationError:
        return None


def reasons(encode_values: Callable[[Any], bytes], values: object) -> str:
    """Return the reasons for which these values are rejected, by the model or by what encodes them."""
    with pytest.raises((ValidationError, InvalidMessageError)) as info:
        encode_values(values)
    error = info.value
    if isinstance(error, InvalidMessageError):
        return error.reason
    assert isinstance(error, ValidationError)
    return describe(error)


@given(messages(), CHANGES)
def test_fields_and_rows_are_validated_as_by_the_model(
    message: VehicleLocalPosition, changes: dict[str, object]
) -> None:
    """As keywords, as fields or as a row: the same bytes, or the same rejection, with the same reasons."""
    fields = {**message.model_dump(), **changes}
    expected = payload_by_model(fields)
    if expected is not None:
        made = VehicleLocalPosition(**fields)
        assert encode(made) == encode_fields(fields) == encode_row(list(fields.values())) == expected
        assert bits(made) == bits(VehicleLocalPosition.model_validate(fields))
        return
    expected_reasons = reasons(lambda each: encode(VehicleLocalPosition.model_validate(each)), fields)
    assert reasons(lambda each: encode(VehicleLocalPosition(**each)), fields) == expected_reasons
    assert reasons(encode_fields, fields) == reasons(encode_row, list(fields.values())) == expected_reasons


@pytest.mark.parametrize("changes", [{"x": 1e39}, {"delta_xy": (0.0, -1e39)}, {"x": "1"}, {"hagl": 1.0}])
def test_model_decides_what_the_fast_path_does_not_accept(changes: dict[str, object]) -> None:
    """A number beyond float32, a wrong type or a misspelled field among all the others has the model's reasons."""
    fields = {**decode(GOOD).model_dump(), **changes}
    if "hagl" in changes:
        del fields["hagl_min"]
    expected = reasons(lambda each: encode(VehicleLocalPosition.model_validate(each)), fields)
    assert (
        reasons(lambda each: encode(VehicleLocalPosition(**each)), fields) == reasons(encode_fields, fields) == expected
    )
    if "hagl" not in changes:
        assert reasons(encode_row, list(fields.values())) == expected


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"eph": -1.0}, "eph: must not be negative (is -1.0)"),
        ({"x": "1", "xy_reset_counter": 300}, "x: Input should be a valid number (is '1'); xy_reset_counter: "),
        ({"delta_xy": (0.0, None)}, "delta_xy.1: Input should be a valid number (is None)"),
        ({"z_dervi": 1.0}, "there is no field 'z_dervi': did you mean z_deriv or "),
        ({"Heading": 1.0}, "there is no field 'Heading': did you mean heading or "),
        ({"temperature": 20.0}, "there is no field 'temperature': 'nedbus schema' lists them (is 20.0)"),
        ({"timestamp": None}, "timestamp: Field required"),
    ],
)
def test_invalid_message_is_explained(changes: dict[str, object], told: str) -> None:
    """An error of ours, and a ValueError, names each field, its rule and value, and the field that was meant."""
    fields = {name: value for name, value in {"timestamp": 1, **changes}.items() if name != "timestamp" or value}
    with pytest.raises(InvalidMessageError) as info:
        encode_fields(MappingProxyType(fields))
    assert str(info.value).startswith(f"not a valid VehicleLocalPosition: {told}")
    assert isinstance(info.value, ValueError)
    assert [field for field, _ in info.value.violations] == list(changes)
    assert str(pickle.loads(pickle.dumps(info.value))) == str(info.value)


@given(st.lists(st.tuples(messages(), st.lists(BROKEN, max_size=3)), min_size=1, max_size=5))
def test_payloads_are_valid_as_by_the_model(
    cases: list[tuple[VehicleLocalPosition, list[tuple[str, object]]]],
) -> None:
    """Decoded one by one, as rows, or as an array: the same values to the bit, or the same rejection."""
    payloads = [pack_full_width({**message.model_dump(), **dict(broken)}) for message, broken in cases]
    array, valid = decode_array(b"".join(payloads))
    for index, payload in enumerate(payloads):
        fields = dict(zip(FIELD_TYPES, msgpack.unpackb(payload, use_list=False)[1:], strict=True))
        expected = payload_by_model(fields)
        assert (expected is not None) == valid[index]
        if expected is None:
            for decode_payload in (decode, decode_row):
                with pytest.raises(DecodeError):
                    decode_payload(payload)
            with pytest.raises(ValidationError):
                to_message(array[index])
        else:
            message = decode(payload)
            assert expected == payload == encode(message) == encode_row(decode_row(payload))
            assert bits(message) == bits(VehicleLocalPosition.model_validate(fields))
            assert message.model_fields_set == set(FIELD_TYPES)
            assert encode(to_message(array[index])) == payload
            assert decode_row(payload)._fields == tuple(FIELD_TYPES)
    assert encode_array(array) == b"".join(payloads)


@given(messages(), st.integers(0, 243), st.integers(0, 255))
def test_damaged_payload_is_valid_in_an_array_only_if_it_decodes(
    message: VehicleLocalPosition, index: int, byte: int
) -> None:
    """Whatever one byte becomes: an array's mask accepts only what `decode` accepts too."""
    payload = bytearray(encode(message))
    payload[index] = byte
    _, valid = decode_array(bytes(payload))
    try:
        message = decode(bytes(payload))
    except DecodeError:
        assert not valid[0]
    else:
        row = decode_row(bytes(payload))
        assert bits(VehicleLocalPosition.model_validate(dict(zip(FIELD_TYPES, row, strict=True)))) == bits(message)


@given(messages())
def test_any_encoding_is_decoded_as_a_row(message: VehicleLocalPosition) -> None:
    """A shorter encoding by another encoder is the same row."""
    values = [1, *(list(value) if isinstance(value, tuple) else value for value in message.model_dump().values())]
    payload = msgpack.packb(values)
    assert encode_row(decode_row(payload)) == encode(message)


@given(st.lists(messages(), max_size=4))
def test_arrays_are_messages(many: list[VehicleLocalPosition]) -> None:
    """Messages survive the round trip through an array and its payloads, with exact types."""
    array = to_array(many)
    assert array.dtype == DTYPE
    assert valid_mask(array).all()
    assert [bits(to_message(element)) for element in array] == [bits(message) for message in many]
    assert encode_array(array) == b"".join(map(encode, many))


@given(st.lists(messages(), max_size=4))
def test_cdr_arrays_are_messages(many: list[VehicleLocalPosition]) -> None:
    """An array has the same CDR payloads as its messages, and they decode to the same array."""
    array = to_array(many)
    payloads = [encode_cdr(downgrade(message, "1.16"), layout="1.16") for message in many]
    assert encode_cdr_array(array).tobytes() == b"".join(payloads)
    decoded, valid = decode_cdr_array(payloads)
    assert valid.all()
    assert decoded.tobytes() == array.tobytes()


def test_dtypes_are_px4s() -> None:
    """The columns have PX4's types: nothing is widened."""
    kinds = {"uint64": "u8", "uint8": "u1", "bool": "?", "float32": "f4", "float64": "f8"}
    for name, kind in FIELD_TYPES.items():
        expected = np.dtype(("f4", 2)) if kind == "float32[2]" else np.dtype(kinds[kind])
        assert DTYPE[name] == expected


@pytest.mark.parametrize("values", [[], [1], range(54)])
def test_row_of_another_length_is_rejected(values: list[object]) -> None:
    """Too few or too many values are not a message."""
    with pytest.raises(EncodeError, match="where a row has 53"):
        encode_row(values)


class Low(VehicleLocalPosition):
    """A user's own model, with a rule more."""

    @field_validator("z")
    @classmethod
    def _low(cls, z: float) -> float:
        if z < -10:
            raise ValueError("too high")
        return z


def test_subclass_keeps_its_own_rules() -> None:
    """The fast path is for the model itself: the validators of a subclass run."""
    fields = {name: value for name, value in decode(GOOD).model_dump().items() if name != "z"}
    assert type(Low(z=-5.0, **fields)) is Low
    with pytest.raises(ValidationError, match="too high"):
        Low(z=-20.0, **fields)


def test_dicts_and_json_do_not_call_the_constructor() -> None:
    """Pydantic treats the constructor as its own: JSON keeps its strings for NaN and infinities."""
    assert not VehicleLocalPosition.__pydantic_custom_init__
    message = decode(GOOD)
    assert bits(VehicleLocalPosition.model_validate_json(message.model_dump_json())) == bits(message)
