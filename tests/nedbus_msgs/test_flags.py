"""Validity flags: their description in words, and properties that are None while their flags are false."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, strategies as st

from nedbus_msgs import (
    DOUBT_FLAGS,
    MESSAGES,
    Definition,
    Message,
    VehicleLocalPosition,
    describe_flags,
    message_doubts,
)
from nedbus_msgs.frames import GlobalPosition, Ned, to_global
from nedbus_msgs.messages import HomePosition, SensorGps, VehicleGlobalPosition
from tests.flights.local_position import row_of

from .strategies import FLAG_FIELDS, messages

GOOD = {"xy_valid": 1.0, "z_valid": 1.0, "v_xy_valid": 1.0, "v_z_valid": 1.0, "dead_reckoning": 0.0}

GUARDED = [
    (definition, name, str(value.__doc__).partition("; None unless ")[2].rstrip(".").split(" and "))
    for definition in MESSAGES.values()
    for name, value in vars(definition.model).items()
    if isinstance(value, property) and "; None unless " in str(value.__doc__)
]
EACH_PROPERTY = pytest.mark.parametrize(
    ("definition", "name", "flags"), GUARDED, ids=[f"{each[0].name}.{each[1]}" for each in GUARDED]
)


def test_doubt_flags_are_validity_and_dead_reckoning() -> None:
    """Doubts come from validity and dead reckoning, not from flags of global reference, terrain and heading."""
    assert DOUBT_FLAGS == ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid", "dead_reckoning")


@pytest.mark.parametrize(
    ("shares", "text"),
    [
        (GOOD, "ok"),
        ({}, "validity unknown"),
        (GOOD | {"heading_good_for_control": 0.0, "xy_global": 0.0, "dist_bottom_valid": 0.0}, "ok"),
        ({"z_valid": 0.0, "v_xy_valid": 1.0, "dead_reckoning": 1.0}, "z invalid, xy vz unknown, dead reckoning"),
        (GOOD | {"xy_valid": 0.0}, "xy invalid"),
        (GOOD | {"xy_valid": 0.0, "z_valid": 0.0, "dead_reckoning": 1.0}, "xy z invalid, dead reckoning"),
        (dict.fromkeys(GOOD, 0.0), "xy z vxy vz invalid"),
        (GOOD | {"xy_valid": 0.8}, "xy invalid 20 %"),
        (GOOD | {"xy_valid": 0.8, "z_valid": 0.0, "dead_reckoning": 0.03},
         "z invalid, xy invalid 20 %, dead reckoning 3 %"),
        (GOOD | {"v_z_valid": 0.9999}, "vz invalid 1 %"),
        (GOOD | {"v_z_valid": 0.0001}, "vz invalid 99 %"),
    ],
)  # fmt: skip
def test_flag_shares_are_described_in_words(shares: dict[str, float], text: str) -> None:
    """Flags that are bad in all messages are grouped; others have a percentage, which is never 0 or 100 %."""
    assert describe_flags(shares) == text


@pytest.mark.slow
@given(messages(), st.booleans())
def test_doubts_of_one_message_have_no_percentage(
    message: VehicleLocalPosition, as_row: bool
) -> None:
    """A single message or row is described by its own flags, without percentages."""
    either = row_of(message) if as_row else message
    assert message_doubts(either) == describe_flags(
        {name: float(getattr(message, name)) for name in DOUBT_FLAGS}
    )
    assert "%" not in message_doubts(either)


def model_and_row(message: Message) -> tuple[Any, Any]:
    return message, tuple.__new__(message.DEFINITION.row, message.__dict__.values())


@EACH_PROPERTY
def test_property_is_none_unless_all_flags_are_true(
    definition: Definition[Any], name: str, flags: list[str]
) -> None:
    """A flag that is false or not provided makes the property None; if all flags are true, zeros are returned."""
    fields = {field: 0.0 for flag in flags for field in definition.flags[flag]}
    for each in model_and_row(
        definition.model(timestamp=1, **fields, **dict.fromkeys(flags, True))
    ):
        assert getattr(each, name) is not None
    for unset in flags:
        others = dict.fromkeys(set(flags) - {unset}, True)
        for given_flags in (others, {**others, unset: False}):
            for each in model_and_row(definition.model(timestamp=1, **fields, **given_flags)):
                assert getattr(each, name) is None, unset


@EACH_PROPERTY
def test_property_names_differ_from_field_names(
    definition: Definition[Any], name: str, flags: list[str]
) -> None:
    """No PX4 layout has a current or renamed field with the name of a property."""
    assert name not in definition.known_types.keys() | definition.older.keys()
    assert name not in definition.row._fields


def test_every_flag_guards_a_property() -> None:
    """For every flag of a FiniteWhile rule there is a property that checks it."""
    guarded = {(definition.name, flag) for definition, _, flags in GUARDED for flag in flags}
    flags = {
        (definition.name, flag) for definition in MESSAGES.values() for flag in definition.flags
    }
    assert flags - guarded == {("SensorGps", "vel_ned_valid")}  # its velocity also requires a fix
    assert VehicleLocalPosition.DEFINITION.flags == FLAG_FIELDS


@given(messages(), st.booleans())
def test_properties_return_the_fields(message: VehicleLocalPosition, as_row: bool) -> None:
    """Each property returns its fields in order, bit for bit; height is positive up, longitudes are wrapped."""
    either = row_of(message) if as_row else message
    has_position, has_origin = (
        message.xy_valid and message.z_valid,
        message.xy_global and message.z_global,
    )
    assert either.position == (Ned(message.x, message.y, message.z) if has_position else None)
    velocity = (
        Ned(message.vx, message.vy, message.vz)
        if message.v_xy_valid and message.v_z_valid
        else None
    )
    assert either.velocity == velocity
    assert either.height == (-message.z if message.z_valid else None)
    assert either.good_heading == (message.heading if message.heading_good_for_control else None)
    assert either.height_above_ground == (
        message.dist_bottom if message.dist_bottom_valid else None
    )
    origin = (
        GlobalPosition.wrapped(message.ref_lat, message.ref_lon, message.ref_alt)
        if has_origin
        else None
    )
    assert either.origin == origin
    assert either.global_position == (to_global(message) if has_position and has_origin else None)


def test_global_and_home_position_properties_follow_their_flags() -> None:
    """A property whose flags are not all true is None; the others return the fields."""
    estimate = VehicleGlobalPosition(
        timestamp=1, lat=47.0, lon=8.0, alt=400.0, lat_lon_valid=True, alt_valid=True
    )
    assert (estimate.global_position, estimate.ground_altitude) == (
        GlobalPosition(47.0, 8.0, 400.0),
        None,
    )
    home = HomePosition(
        timestamp=1, x=1.0, y=2.0, z=-3.0, lat=0.0, lon=0.0, alt=0.0, valid_lpos=True
    )
    assert (home.position, home.global_position) == (Ned(1.0, 2.0, -3.0), None)


@pytest.mark.parametrize(
    ("fix_type", "flag", "has_position", "has_velocity"),
    [(0, True, False, False), (1, True, False, False), (2, True, False, True), (3, True, True, True),
     (6, False, True, False)],
)  # fmt: skip
def test_gnss_position_requires_a_fix(
    fix_type: int, flag: bool, has_position: bool, has_velocity: bool
) -> None:
    """The position requires a 3D fix, the velocity a fix and vel_ned_valid: without a fix, values are zero or old."""
    position = {"latitude_deg": 47.0, "longitude_deg": 8.0, "altitude_msl_m": 400.0}
    velocity = {"vel_n_m_s": 1.0, "vel_e_m_s": 2.0, "vel_d_m_s": 3.0}
    fields: dict[str, Any] = {**position, **velocity, "vel_ned_valid": flag}
    for each in model_and_row(SensorGps(timestamp=1, fix_type=fix_type, **fields)):
        assert each.global_position == (GlobalPosition(47.0, 8.0, 400.0) if has_position else None)
        assert each.velocity == (Ned(1.0, 2.0, 3.0) if has_velocity else None)


def test_arithmetic_on_an_invalid_position_raises() -> None:
    """While the vehicle sends zeros without flags, position is None, so a script that does not check for it fails."""
    message = VehicleLocalPosition(timestamp=1, x=0.0, y=0.0, z=0.0)
    assert math.hypot(message.x, message.y, message.z) == 0.0
    with pytest.raises(TypeError):
        math.dist(message.position, (0.0, 0.0, 0.0))  # type: ignore[arg-type] # may be None
