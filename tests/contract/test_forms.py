"""One by one, as rows and by the thousand: every form accepts and refuses exactly what the model does."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
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
    VehicleLocalPosition,
    decode,
    decode_row,
    encode,
    encode_fields,
    encode_row,
)
from nedbus_msgs.arrays import DTYPE, find_sound, read_records, to_message, to_records, write_records

from .strategies import FLAGGED, NOT_NEGATIVE, WITHIN, bits, messages

GOOD = encode(VehicleLocalPosition.model_validate({"timestamp": 5, **dict.fromkeys(["vxy_max", "eph"], math.inf)}))
# What a field may be given, good or bad, whatever its type.
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
# Values that the field's own type allows, and perhaps not the rules.
SAME_TYPE = {
    "uint64": st.integers(0, 2**64 - 1),
    "uint8": st.integers(0, 255),
    "bool": st.booleans(),
    "float32": st.floats(width=32) | st.sampled_from([-1.0, 3.2, math.nan]),
    "float32[2]": st.tuples(st.floats(width=32), st.floats(width=32)),
    "float64": st.floats() | st.sampled_from([90.0, 90.5, -180.0, 181.0]),
}
RULED = ["timestamp", "timestamp_sample", *FLAGGED, *(n for names in FLAGGED.values() for n in names), *NOT_NEGATIVE]
BROKEN = st.sampled_from([*RULED, *WITHIN]).flatmap(lambda name: st.tuples(st.just(name), SAME_TYPE[FIELD_TYPES[name]]))


def judged(fields: Mapping[str, object]) -> bytes | None:
    """Return the payload of the message that the model makes of these, None if it refuses them."""
    try:
        return encode(VehicleLocalPosition.model_validate(fields))
    except ValidationError:
        return None


def reasons(send: Callable[[Any], bytes], values: object) -> str:
    """Return why this is refused."""
    with pytest.raises(ValidationError) as info:
        send(values)
    return str(info.value)


@given(messages(), CHANGES)
def test_fields_and_rows_are_judged_as_by_the_model(message: VehicleLocalPosition, changes: dict[str, object]) -> None:
    """Made by keywords, sent as fields or as a row: the same bytes, or the same refusal, with the same reasons."""
    fields = {**message.model_dump(), **changes}
    right = judged(fields)
    if right is not None:
        made = VehicleLocalPosition(**fields)
        assert encode(made) == encode_fields(fields) == encode_row(list(fields.values())) == right
        assert bits(made) == bits(VehicleLocalPosition.model_validate(fields))
        return
    why = reasons(lambda each: encode(VehicleLocalPosition.model_validate(each)), fields)
    assert reasons(lambda each: encode(VehicleLocalPosition(**each)), fields) == why
    assert reasons(encode_fields, fields) == reasons(encode_row, list(fields.values())) == why


def pack_full_width(values: Mapping[str, object]) -> bytes:
    """Return the payload of values that their types allow, whatever the rules say of them."""
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


@given(st.lists(st.tuples(messages(), st.lists(BROKEN, max_size=3)), min_size=1, max_size=5))
def test_payloads_are_judged_as_by_the_model(
    cases: list[tuple[VehicleLocalPosition, list[tuple[str, object]]]],
) -> None:
    """Read one by one, as rows, or as an array: the same values to the bit, or the same refusal."""
    payloads = [pack_full_width({**message.model_dump(), **dict(broken)}) for message, broken in cases]
    records, valid = read_records(b"".join(payloads))
    for place, payload in enumerate(payloads):
        fields = dict(zip(FIELD_TYPES, msgpack.unpackb(payload, use_list=False)[1:], strict=True))
        right = judged(fields)
        assert (right is not None) == valid[place]
        if right is None:
            for read in (decode, decode_row):
                with pytest.raises(DecodeError):
                    read(payload)
            with pytest.raises(ValidationError):
                to_message(records[place])
        else:
            message = decode(payload)
            assert right == payload == encode(message) == encode_row(decode_row(payload))
            assert bits(message) == bits(VehicleLocalPosition.model_validate(fields))
            assert message.model_fields_set == set(FIELD_TYPES)
            assert encode(to_message(records[place])) == payload
            assert decode_row(payload)._fields == tuple(FIELD_TYPES)
    assert write_records(records) == b"".join(payloads)


@given(messages(), st.integers(0, 243), st.integers(0, 255))
def test_damaged_payload_is_never_taken_for_a_good_one(message: VehicleLocalPosition, place: int, byte: int) -> None:
    """Whatever one byte becomes: an array's quick look accepts only what one by one is accepted too."""
    payload = bytearray(encode(message))
    payload[place] = byte
    _, valid = read_records(bytes(payload))
    try:
        read = decode(bytes(payload))
    except DecodeError:
        assert not valid[0]
    else:
        row = decode_row(bytes(payload))
        assert bits(VehicleLocalPosition.model_validate(dict(zip(FIELD_TYPES, row, strict=True)))) == bits(read)


@given(messages())
def test_any_encoding_is_read_as_a_row(message: VehicleLocalPosition) -> None:
    """What another encoder writes shorter is the same row."""
    values = [1, *(list(value) if isinstance(value, tuple) else value for value in message.model_dump().values())]
    payload = msgpack.packb(values)
    assert encode_row(decode_row(payload)) == encode(message)


@given(st.lists(messages(), max_size=4))
def test_arrays_are_messages(many: list[VehicleLocalPosition]) -> None:
    """There and back, with exact types."""
    records = to_records(many)
    assert records.dtype == DTYPE
    assert find_sound(records).all()
    assert [bits(to_message(record)) for record in records] == [bits(message) for message in many]
    assert write_records(records) == b"".join(map(encode, many))


def test_dtypes_are_px4s() -> None:
    """The columns have PX4's types: nothing is widened."""
    kinds = {"uint64": "u8", "uint8": "u1", "bool": "?", "float32": "f4", "float64": "f8"}
    for name, kind in FIELD_TYPES.items():
        expected = np.dtype(("f4", 2)) if kind == "float32[2]" else np.dtype(kinds[kind])
        assert DTYPE[name] == expected


@pytest.mark.parametrize("values", [[], [1], range(54)])
def test_row_of_another_length_is_refused(values: list[object]) -> None:
    """Too few or too many values are no message."""
    with pytest.raises(EncodeError, match="where a row has 53"):
        encode_row(values)


class Low(VehicleLocalPosition):
    """A user's own model, which wants more."""

    @field_validator("z")
    @classmethod
    def _low(cls, z: float) -> float:
        if z < -10:
            raise ValueError("too high")
        return z


def test_subclass_keeps_its_own_rules() -> None:
    """The quick lane is for the model itself: whoever derives from it is asked."""
    fields = {name: value for name, value in decode(GOOD).model_dump().items() if name != "z"}
    assert type(Low(z=-5.0, **fields)) is Low
    with pytest.raises(ValidationError, match="too high"):
        Low(z=-20.0, **fields)


def test_dicts_and_json_do_not_pass_through_the_constructor() -> None:
    """Pydantic takes the constructor for its own: JSON keeps its words for what is no number."""
    assert not VehicleLocalPosition.__pydantic_custom_init__
    message = decode(GOOD)
    assert bits(VehicleLocalPosition.model_validate_json(message.model_dump_json())) == bits(message)
