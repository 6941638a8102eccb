"""Fast paths for fields, rows and arrays, which accept and reject exactly what the model does."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import example, given, strategies as st
from pydantic import ValidationError, field_validator

from nedbus_msgs import (
    DEFAULT,
    DecodeError,
    EncodeError,
    InvalidMessageError,
    Row,
    VehicleLocalPosition,
)
from nedbus_msgs.arrays import DTYPE, to_array, to_message
from tests.flights.local_position import (
    CURRENT,
    FIELD_TYPES,
    decode,
    decode_array,
    decode_row,
    describe,
    downgrade,
    encode,
    encode_array,
    encode_cdr,
    encode_cdr_array,
    encode_fields,
    encode_row,
    row_of,
    valid_mask,
)
from tests.nedbus_msgs.strategies import POSSIBLE_VIOLATIONS, bits, messages, pack_full_width

GOOD = VehicleLocalPosition(timestamp=5, vxy_max=math.inf, eph=math.inf)
# Valid and invalid values, for fields of any type.
ANY_VALUE = st.one_of(
    st.integers(-(2**70), 2**70),
    st.floats(allow_subnormal=True),
    st.floats(width=32),
    st.booleans(),
    st.none(),
    st.sampled_from(["", "x", "NaN"]),
    st.sampled_from(
        [
            math.nan,
            math.inf,
            -math.inf,
            1e39,
            -0.0,
            -1e-50,
            2**64,
            2**64 - 1,
            256,
            255,
            math.pi,
            90.5,
        ]
    ),
    st.tuples(st.floats(), st.floats()),
    st.lists(st.floats(), max_size=3),
)
CHANGES = st.dictionaries(st.sampled_from(list(FIELD_TYPES)), ANY_VALUE, max_size=3)


def payload_by_model(fields: Mapping[str, object]) -> bytes | None:
    """Return the payload of the message with these fields; None if the model rejects them."""
    try:
        return encode(VehicleLocalPosition.model_validate(fields))
    except ValidationError:
        return None


def reasons(encode_values: Callable[[Any], bytes], values: object) -> str:
    """Return the reasons why the model or the encoder rejects these values."""
    with pytest.raises((ValidationError, InvalidMessageError)) as info:
        encode_values(values)
    if isinstance(info.value, InvalidMessageError):
        return info.value.reason
    assert isinstance(info.value, ValidationError)
    return describe(info.value)


@given(messages(), CHANGES)
@example(GOOD, {"x": 1e39})
@example(GOOD, {"delta_xy": (0.0, -1e39)})
@example(GOOD, {"x": "1"})
def test_fields_and_rows_are_validated_like_the_model(
    message: VehicleLocalPosition, changes: dict[str, object]
) -> None:
    """Keywords, fields and rows are encoded to the same bytes, or rejected for the same reasons."""
    fields = {**message.model_dump(), **changes}
    expected = payload_by_model(fields)
    if expected is not None:
        created = VehicleLocalPosition(**fields)
        assert (
            encode(created)
            == encode_fields(fields)
            == encode_row(list(fields.values()))
            == expected
        )
        assert bits(created) == bits(VehicleLocalPosition.model_validate(fields))
        return
    expected_reasons = reasons(
        lambda each: encode(VehicleLocalPosition.model_validate(each)), fields
    )
    assert reasons(lambda each: encode(VehicleLocalPosition(**each)), fields) == expected_reasons
    assert (
        reasons(encode_fields, fields)
        == reasons(encode_row, list(fields.values()))
        == expected_reasons
    )


def test_misspelled_field_with_right_field_count_is_rejected() -> None:
    """If a field is misspelled, the fast path leaves the error to the model, even if the field count is right."""
    fields = {
        ("hagl" if name == "hagl_min" else name): value for name, value in GOOD.model_dump().items()
    }
    expected = reasons(lambda each: encode(VehicleLocalPosition.model_validate(each)), fields)
    assert reasons(lambda each: encode(VehicleLocalPosition(**each)), fields) == expected
    assert reasons(encode_fields, fields) == expected


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"eph": -1.0}, "eph: must not be negative (is -1.0)"),
        (
            {"x": "1", "xy_reset_counter": 300},
            "x: Input should be a valid number (is '1'); xy_reset_counter: ",
        ),
        ({"delta_xy": (0.0, None)}, "delta_xy.1: Input should be a valid number (is None)"),
        ({"z_dervi": 1.0}, "unknown field 'z_dervi': did you mean z_deriv or "),
        ({"Heading": 1.0}, "unknown field 'Heading': did you mean heading or "),
        (
            {"temperature": 20.0},
            "unknown field 'temperature': 'nedbus schema VehicleLocalPosition' lists the fields",
        ),
        ({"timestamp": None}, "timestamp: Field required"),
    ],
)
def test_invalid_message_error_names_field_rule_and_value(
    changes: dict[str, object], text: str
) -> None:
    """InvalidMessageError is a ValueError that names each field, its rule and value, and suggests a field."""
    fields = {
        name: value
        for name, value in {"timestamp": 1, **changes}.items()
        if name != "timestamp" or value
    }
    with pytest.raises(InvalidMessageError) as info:
        encode_fields(MappingProxyType(fields))
    assert str(info.value).startswith(f"not a valid VehicleLocalPosition: {text}")
    assert isinstance(info.value, ValueError)
    assert [field for field, _ in info.value.violations] == list(changes)
    assert str(pickle.loads(pickle.dumps(info.value))) == str(info.value)


@pytest.mark.slow
@given(
    st.lists(
        st.tuples(messages(), st.lists(POSSIBLE_VIOLATIONS, max_size=3)), min_size=1, max_size=5
    )
)
def test_payloads_are_validated_like_the_model(
    cases: list[tuple[VehicleLocalPosition, list[tuple[str, object]]]],
) -> None:
    """Models, rows and arrays decode to bit-identical values, or are all rejected."""
    payloads = [
        pack_full_width({**message.model_dump(), **dict(broken)}) for message, broken in cases
    ]
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
            assert DEFAULT.row._fields == tuple(FIELD_TYPES)
            assert isinstance(decode_row(payload), DEFAULT.row)
    assert encode_array(array) == b"".join(payloads)


@pytest.mark.slow
@given(st.lists(messages(), max_size=4))
def test_array_round_trip(many: list[VehicleLocalPosition]) -> None:
    """Messages survive the round trip through an array and its payloads; the array's CDR is that of messages."""
    array = to_array(many)
    assert array.dtype == DTYPE
    assert valid_mask(array).all()
    assert [bits(to_message(element)) for element in array] == [bits(message) for message in many]
    assert encode_array(array) == b"".join(map(encode, many))
    assert decode_array(encode_array(array))[0].tobytes() == array.tobytes()
    payloads = [encode_cdr(downgrade(message, "1.16"), layout="1.16") for message in many]
    assert encode_cdr_array(array).tobytes() == b"".join(payloads)


def test_columns_have_px4_types() -> None:
    """Each column of an array has exactly PX4's type."""
    kinds = {"uint64": "u8", "uint8": "u1", "bool": "?", "float32": "f4", "float64": "f8"}
    for name, kind in FIELD_TYPES.items():
        expected = np.dtype(("f4", 2)) if kind == "float32[2]" else np.dtype(kinds[kind])
        assert DTYPE[name] == expected


@pytest.mark.parametrize("values", [[], [1], range(54)])
def test_row_of_wrong_length_raises(values: list[object]) -> None:
    """Too few or too many values raise EncodeError."""
    with pytest.raises(EncodeError, match="values, expected 53"):
        encode_row(values)


class StricterPosition(VehicleLocalPosition):
    """A user's subclass with an additional rule."""

    @field_validator("z")
    @classmethod
    def _low(cls, z: float) -> float:
        if z < -10:
            raise ValueError("too high")
        return z


def test_subclass_validators_run() -> None:
    """A subclass does not use the fast path, so its validators run."""
    fields = {name: value for name, value in GOOD.model_dump().items() if name != "z"}
    assert type(StricterPosition(z=-5.0, **fields)) is StricterPosition
    with pytest.raises(ValidationError, match="too high"):
        StricterPosition(z=-20.0, **fields)


def test_validation_of_dicts_and_json_bypasses_the_constructor() -> None:
    """Pydantic validates JSON without calling the constructor, so JSON may contain strings for NaN and infinities."""
    assert not VehicleLocalPosition.__pydantic_custom_init__


def test_row_has_the_fields_of_the_model() -> None:
    """Row, model and current layout have PX4's names in PX4's order."""
    assert (
        DEFAULT.row._fields
        == tuple(FIELD_TYPES)
        == tuple(VehicleLocalPosition.model_fields)
        == CURRENT.fields
    )


def test_row_is_a_named_tuple() -> None:
    """A row has named fields, but no Pydantic methods."""
    row = row_of(VehicleLocalPosition(timestamp=5, delta_xy=(1.0, 2.0)))
    assert isinstance(row, Row)
    assert (row.timestamp, row.delta_xy, len(row)) == (5, (1.0, 2.0), 53)
    assert list(row._asdict()) == list(FIELD_TYPES)
    assert repr(pickle.loads(pickle.dumps(row))) == repr(row)
    assert not hasattr(row, "model_dump")


@pytest.mark.parametrize(
    "change",
    [
        lambda message, y: message.__dict__.update(y=y),
        lambda message, y: object.__setattr__(message, "y", y),
    ],
)
def test_forced_change_of_a_constructed_message_is_encoded(
    change: Callable[[VehicleLocalPosition, object], None],
) -> None:
    """A message encodes the values that it has, even if a frozen message was changed by force after its construction.

    A value that does not fit its field raises EncodeError.
    """
    message = VehicleLocalPosition(timestamp=5, y=1.0)
    assert decode(encode(message)).y == 1.0
    change(message, 2.0)
    assert decode(encode(message)).y == 2.0
    change(message, "north")
    with pytest.raises(EncodeError):
        encode(message)
