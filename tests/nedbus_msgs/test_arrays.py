"""Arrays of any length decode, encode and validate exactly like single messages."""

from __future__ import annotations

import random
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given, strategies as st

from nedbus_msgs import DEFAULT, DecodeError, VehicleLocalPosition, codec_of
from nedbus_msgs.arrays import DTYPE, arrays_of, mask_invalid, to_array
from nedbus_msgs.messages import HomePosition, VehicleAttitude
from tests.flights.local_position import (
    PAYLOAD_SIZE,
    decode_array,
    decode_row,
    encode_array,
    encode_row,
    to_row,
    valid_mask,
)
from tests.nedbus_msgs.strategies import (
    EXTREMES,
    FLAG_FIELDS,
    FLIGHTS,
    POSSIBLE_VIOLATIONS,
    REAL,
    VIOLATIONS,
    messages,
    pack_full_width,
)

# Lengths around those at which the algorithm changes.
SIZES = [1, 2, 19, 20, 21, 255, 256, 257, 1000]
ARRAYS = arrays_of(DEFAULT)
# a message, and values that may break its rules
Case = tuple[VehicleLocalPosition, list[tuple[str, object]]]
CASES = st.lists(
    st.tuples(messages(), st.lists(POSSIBLE_VIOLATIONS, max_size=2)), min_size=1, max_size=4
)


def row_or_none(payload: bytes) -> VehicleLocalPosition | None:
    try:
        return decode_row(payload)
    except DecodeError:
        return None


@pytest.mark.slow
@given(st.sampled_from(SIZES), CASES, st.randoms(use_true_random=False))
def test_array_equals_its_rows(size: int, cases: list[Case], order: random.Random) -> None:
    """An array of valid and invalid messages is decoded exactly like each message alone, at any length."""
    choices = [
        *REAL,
        *(pack_full_width({**message.model_dump(), **dict(broken)}) for message, broken in cases),
    ]
    payloads = order.choices(choices, k=size)
    rows = {payload: row_or_none(payload) for payload in choices}
    array, valid = decode_array(b"".join(payloads))
    assert array.dtype == DTYPE
    assert valid.tolist() == [rows[payload] is not None for payload in payloads]
    assert (
        array[valid].tobytes()
        == np.array([row for payload in payloads if (row := rows[payload])], DTYPE).tobytes()
    )
    assert encode_array(array) == b"".join(payloads)
    assert valid_mask(array).tolist() == valid.tolist()
    few = ARRAYS.decode_few(payloads)
    assert (few is None) == (not valid.all())
    assert few is None or (few.dtype == DTYPE and few.tobytes() == array.tobytes())


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    ("changes", "expected"), [(VIOLATIONS, False), (EXTREMES, True)], ids=["violation", "extreme"]
)
def test_each_rule_is_checked_at_any_length(
    size: int, changes: list[Mapping[str, object]], expected: bool
) -> None:
    """A message that breaks a rule is invalid, one on its bound is valid, and neither affects other messages."""
    for change in changes:
        payload = pack_full_width({**FLIGHTS[0].model_dump(), **change})
        assert (row_or_none(payload) is not None) == expected, change
        payloads = [REAL[index % len(REAL)] for index in range(size)]
        payloads[size // 2] = payload
        _, valid = decode_array(b"".join(payloads))
        assert valid[size // 2] == expected, change
        assert np.count_nonzero(~valid) == (not expected), change


@given(
    st.sampled_from(SIZES),
    st.integers(0, PAYLOAD_SIZE - 1),
    st.integers(0, 255),
    st.sampled_from(REAL),
)
def test_corrupt_payload_does_not_affect_others(
    size: int, offset: int, byte: int, flight: bytes
) -> None:
    """A payload with one changed byte is valid only if it decodes; all other messages are unchanged."""
    corrupt = bytearray(flight)
    corrupt[offset] = byte
    payloads = [flight] * size
    payloads[size // 2] = bytes(corrupt)
    array, valid = decode_array(b"".join(payloads))
    row = row_or_none(payloads[size // 2])
    if valid[size // 2]:
        assert row is not None
        assert repr(to_row(array[size // 2])) == repr(tuple(row))  # as text, NaN equals NaN
    elif row is not None:  # not full-width
        assert encode_row(row) != payloads[size // 2]
    others = np.arange(size) != size // 2
    assert valid[others].all()
    few = ARRAYS.decode_few(payloads)
    assert (few is None) == (not valid.all())
    assert few is None or few.tobytes() == array.tobytes()
    assert array[others].tobytes() == np.array([decode_row(flight)] * (size - 1), DTYPE).tobytes()
    for name in DTYPE.names or ():
        if DTYPE[name] == np.bool_:
            assert array[name].view(np.uint8).max() <= 1, "bools other than 0 and 1 are undefined"


@pytest.mark.parametrize("size", SIZES)
def test_decoded_array_is_a_writable_copy(size: int) -> None:
    """Writing to the array does not change the payloads."""
    payloads = REAL[0] * size
    for array in (decode_array(payloads)[0], ARRAYS.decode_few([REAL[0]] * size)):
        assert array is not None
        array["x"] = 5.0
        array["xy_valid"] = False
        assert payloads == REAL[0] * size
        assert decode_row(encode_array(array)[-PAYLOAD_SIZE:]).x == 5.0


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("step", [-1, 2])
def test_array_with_strides_is_encoded_and_validated(size: int, step: int) -> None:
    """Reversed and strided views are encoded and validated like contiguous arrays."""
    payloads = [REAL[index % len(REAL)] for index in range(size * abs(step))]
    view = decode_array(b"".join(payloads))[0][::step]
    assert encode_array(view) == b"".join(payloads[::step])
    view["eph"][size // 2] = -1.0
    assert np.flatnonzero(~valid_mask(view)).tolist() == [size // 2]


@pytest.mark.parametrize("number", ["7fa00001", "ffa00001", "7fc00001", "80000001"])
def test_bits_of_a_float_are_kept(number: str) -> None:
    """A signalling NaN, a NaN with a payload and a denormal number are decoded bit for bit."""
    payload = bytearray(REAL[0])
    [at] = [offset for name, _, offset in codec_of(DEFAULT).offsets if name == "delta_heading"]
    payload[at : at + 4] = bytes.fromhex(number)
    for array in (decode_array(bytes(payload))[0], ARRAYS.decode_few([bytes(payload)])):
        assert array is not None
        assert array["delta_heading"].astype(">f4").view("V4").tobytes().hex() == number


@pytest.mark.parametrize("excess", [-1, 1])
def test_incomplete_payload_raises(excess: int) -> None:
    """Bytes that are not a whole number of payloads raise ValueError."""
    with pytest.raises(ValueError, match="reshape"):
        decode_array(bytes(2 * PAYLOAD_SIZE + excess))


@pytest.mark.slow
@given(st.lists(messages(), max_size=5))
def test_mask_invalid_sets_nan_where_the_flag_is_false(sent: list[VehicleLocalPosition]) -> None:
    """Fields whose flag is false are NaN; all other values, and the original array, are unchanged."""
    array = to_array(sent)
    before, masked = array.tobytes(), mask_invalid(array)
    assert array.tobytes() == before
    assert masked.dtype == array.dtype
    flag_of = {name: flag for flag, names in FLAG_FIELDS.items() for name in names}
    for name in DTYPE.names or ():
        known = array[flag_of[name]] if name in flag_of else np.ones(len(array), bool)
        assert masked[name][known].tobytes() == array[name][known].tobytes()
        assert np.isnan(masked[name][~known]).all()


def test_mask_invalid_supports_any_message() -> None:
    """The array's own flags are used; a message without flags is copied unchanged."""
    home = mask_invalid(
        to_array(
            [HomePosition(timestamp=1, lat=0.0, lon=0.0, x=1.0, y=2.0, z=3.0, valid_lpos=True)]
        )
    )
    assert np.isnan([home["lat"], home["lon"]]).all()
    assert [home[name].tolist() for name in "xyz"] == [[1.0], [2.0], [3.0]]
    attitudes = to_array([VehicleAttitude(timestamp=1, q=(1.0, 0.0, 0.0, 0.0))])
    assert mask_invalid(attitudes).tobytes() == attitudes.tobytes()
