"""The model of VehicleLocalPosition: types, ranges, rules and error texts."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from pydantic import ValidationError

from nedbus_msgs import InvalidMessageError, VehicleLocalPosition
from nedbus_msgs.arrays import to_array
from tests.flights.local_position import FIELD_TYPES, describe, encode, encode_fields, json_schema
from tests.nedbus_msgs.strategies import EXTREMES, VIOLATIONS, WITHIN, bits, fields, messages

FLOATS = [name for name, kind in FIELD_TYPES.items() if kind == "float32"]


def rejection(**fields: object) -> str:
    with pytest.raises(ValidationError) as info:
        VehicleLocalPosition.model_validate({"timestamp": 1, **fields})
    return describe(info.value)


def test_omitted_field_is_nan_false_or_zero() -> None:
    """An omitted field is NaN, false or 0, and is absent from model_fields_set."""
    message = VehicleLocalPosition(timestamp=1)
    assert math.isnan(message.x)
    assert all(map(math.isnan, message.delta_xy))
    assert (message.xy_valid, message.xy_reset_counter, message.timestamp_sample) == (False, 0, 0)
    assert message.model_fields_set == {"timestamp"}


@pytest.mark.parametrize("name", FLOATS)
def test_float32_field_is_rounded_to_float32(name: str) -> None:
    """A double is rounded, and rejected beyond the range; NaN and infinity pass unless a rule forbids them."""
    message = VehicleLocalPosition.model_validate({"timestamp": 1, name: 0.1})
    assert getattr(message, name) == float(np.float32(0.1)) != 0.1
    for value in (3.5e38, 1e39, 1e308):
        assert rejection(**{name: value}).startswith(f"{name}: ")
    for value in (math.nan, *([math.inf] if name not in WITHIN else ())):
        message = VehicleLocalPosition.model_validate({"timestamp": 1, name: value})
        assert str(getattr(message, name)) == str(value)


@pytest.mark.parametrize("name", ["ref_lat", "ref_lon"])
def test_origin_keeps_double_precision(name: str) -> None:
    """Latitude and longitude of the origin keep double precision; float32 would have a resolution of 0.4 m."""
    message = VehicleLocalPosition.model_validate({"timestamp": 1, name: 47.397742123456789})
    assert getattr(message, name) == 47.397742123456789


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("x", "1"), ("x", True), ("x", None), ("x", 10**400), ("x", 1 + 0j),
        ("timestamp", 1.0), ("timestamp", -1), ("timestamp", 2**64), ("timestamp", True), ("timestamp", "1"),
        ("xy_reset_counter", 256), ("xy_reset_counter", -1), ("xy_reset_counter", 1.0), ("xy_reset_counter", False),
        ("xy_valid", 1), ("xy_valid", "true"), ("xy_valid", None), ("xy_vaild", True), ("delta_xy", 0.0),
        ("delta_xy", (0.0,)), ("delta_xy", (0.0, 0.0, 0.0)), ("delta_xy", (0.0, "0")), ("delta_xy", (0.0, -1e39)),
    ],
)  # fmt: skip
def test_wrong_type_is_rejected(field: str, value: object) -> None:
    """A value of a wrong type or out of range is rejected, not converted silently as in rclpy."""
    assert field in rejection(**{field: value})


def test_int_is_accepted_for_float() -> None:
    """An int in a float field is converted to float."""
    message = VehicleLocalPosition(timestamp=1, x=3)
    assert (message.x, type(message.x)) == (3.0, float)


@pytest.mark.parametrize("changes", VIOLATIONS)
def test_error_for_broken_rule_names_the_field(changes: dict[str, object]) -> None:
    """The error for a value just beyond a rule (flags, signs, bounds, order of timestamps) names the field."""
    assert list(changes)[-1] in rejection(**changes)


def test_extreme_valid_values_pass() -> None:
    """A value on its bound, -0.0, NaN and infinity are valid unless a rule forbids them, as is NaN without its flag."""
    for changes in EXTREMES:
        VehicleLocalPosition.model_validate({"timestamp": 1, **changes})


def test_all_violations_are_reported_at_once() -> None:
    """One error lists every field that breaks a rule."""
    text = rejection(xy_valid=True, eph=-1.0, heading=7.0)
    assert all(name in text for name in ("x:", "y:", "eph:", "heading:"))
    assert "-1.0" in text


def test_message_is_immutable() -> None:
    """Assigning to a field raises, so a message can be shared between threads."""
    name = "x"
    with pytest.raises(ValidationError, match="frozen"):
        setattr(VehicleLocalPosition(timestamp=1), name, 1.0)


def test_copy_with_updates_is_validated() -> None:
    """model_copy validates updates, and preserves model_fields_set."""
    message = VehicleLocalPosition(timestamp=1, y=2.0)
    copy = message.model_copy(update={"x": 0.1})
    assert copy.x == np.float32(0.1)
    assert copy.model_fields_set == {"timestamp", "x", "y"}
    assert message.model_copy().y == 2.0
    with pytest.raises(ValidationError):
        message.model_copy(update={"x": 1e39})


@pytest.mark.slow
@given(messages())
def test_json_round_trip_is_exact(message: VehicleLocalPosition) -> None:
    """JSON contains NaN and infinities as strings, and is parsed to a bit-identical message."""
    text = message.model_dump_json()
    assert "nan" not in text
    assert "inf" not in text
    document = json.loads(text)
    again = [
        VehicleLocalPosition.model_validate_json(text),
        VehicleLocalPosition.model_validate(document),
    ]
    for each in (*again, VehicleLocalPosition(**document)):
        assert bits(each) == bits(message)


@given(messages(), st.sampled_from(sorted(FIELD_TYPES)))
def test_copy_with_unchanged_value_equals_the_message(
    message: VehicleLocalPosition, name: str
) -> None:
    """Validation does not change a valid value."""
    assert bits(message.model_copy(update={name: getattr(message, name)})) == bits(message)


def test_json_schema_matches_the_model() -> None:
    """In the schema every field has a description and no default; floats may be "NaN", "Infinity" or "-Infinity"."""
    schema = json_schema()
    properties = schema["properties"]
    assert isinstance(properties, dict)
    assert list(properties) == list(FIELD_TYPES)
    assert all(field["description"] and "default" not in field for field in properties.values())
    assert properties["x"]["anyOf"][0] == {"type": "number"}
    assert properties["x"]["anyOf"][1:] == [
        {"enum": ["NaN", "Infinity", "-Infinity"], "type": "string"}
    ]
    assert schema["additionalProperties"] is False


def test_messages_are_compared_by_value() -> None:
    """NaN equals NaN, so a message equals its copy and can be found in a set."""
    one, two = VehicleLocalPosition(timestamp=1, x=0.5), VehicleLocalPosition(timestamp=1, x=0.5)
    assert one == two
    assert len({one, two}) == 1
    assert one != VehicleLocalPosition(timestamp=1, x=0.5, delta_xy=(0.0, math.nan))
    assert one != VehicleLocalPosition(timestamp=1)
    assert one != "message"


@pytest.mark.parametrize(
    "fields",
    [
        {"x": "nan"},
        {"x": "1.0"},
        {"timestamp": "NaN"},
        {"xy_valid": "NaN"},
        {"delta_xy": [1.0]},
        {"x": [1.0]},
    ],
)
def test_unexpected_strings_and_lengths_are_rejected(fields: dict[str, object]) -> None:
    """The model accepts only the strings and lengths that its own JSON contains."""
    with pytest.raises(ValidationError) as info:
        VehicleLocalPosition.model_validate({"timestamp": 1, **fields})
    assert [detail["loc"][0] for detail in info.value.errors()] == list(fields)


def test_numpy_scalars_are_accepted() -> None:
    """NumPy scalars can be mixed with Python values; those that do not fit are rejected."""
    array = np.array([1.5, np.nan], "f4")
    scalars = {
        "timestamp": np.uint64(2**63),
        "xy_reset_counter": np.uint8(7),
        "xy_valid": np.bool_(True),
        "x": array[0],
    }
    message = VehicleLocalPosition.model_validate({**scalars, "y": 0.5, "delta_xy": array})
    plain = {"timestamp": 2**63, "xy_reset_counter": 7, "xy_valid": True, "x": 1.5, "y": 0.5}
    assert message == VehicleLocalPosition.model_validate({**plain, "delta_xy": (1.5, math.nan)})
    assert {type(value) for value in message.__dict__.values()} == {int, bool, float, tuple}
    wrong_values = {
        "xy_valid": np.uint8(1),
        "timestamp": np.int64(-1),
        "xy_reset_counter": np.uint16(256),
        "x": array,
    }
    for name, wrong in wrong_values.items():
        rejection(**{name: wrong})


def test_array_element_is_accepted() -> None:
    """The columns of an element returned by `nedbus.read` are valid fields of a message."""
    [element] = to_array([VehicleLocalPosition(timestamp=3, x=1.0, delta_vxy=(1.0, 2.0))])
    fields = {name: element[name] for name in FIELD_TYPES}
    assert VehicleLocalPosition(**fields) == VehicleLocalPosition(
        timestamp=3, x=1.0, delta_vxy=(1.0, 2.0)
    )


@pytest.mark.slow
@given(fields=fields(), names=st.sets(st.sampled_from(sorted(FIELD_TYPES))))
def test_omitted_fields_are_the_same_on_the_fast_path(
    fields: dict[str, object], names: set[str]
) -> None:
    """The fast path creates and encodes a message with omitted fields exactly as the model's validator does."""
    given_fields: dict[str, Any] = {
        "timestamp": fields["timestamp"],
        **{name: fields[name] for name in sorted(names)},
    }
    try:
        slow = VehicleLocalPosition.model_validate(given_fields)
    except ValidationError:
        with pytest.raises(ValidationError):
            VehicleLocalPosition(**given_fields)
        with pytest.raises(InvalidMessageError):
            encode_fields(given_fields)
        return
    fast = VehicleLocalPosition(**given_fields)
    assert fast == slow
    assert fast.model_fields_set == slow.model_fields_set == given_fields.keys()
    assert encode_fields(given_fields) == encode(slow)
