"""The table of flags, and how doubts are shown."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

import nedbus_msgs
from nedbus_msgs import DOUBT_FLAGS, VehicleLocalPosition, describe_flags, message_doubts
from tests.flights.first_message import row_of

from .strategies import FLAG_FIELDS, messages

GOOD = {"xy_valid": 1.0, "z_valid": 1.0, "v_xy_valid": 1.0, "v_z_valid": 1.0, "dead_reckoning": 0.0}


def test_doubts_are_validity_and_dead_reckoning() -> None:
    """Validity and dead reckoning are shown; global references, terrain and heading are not."""
    assert DOUBT_FLAGS == ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid", "dead_reckoning")
    assert nedbus_msgs.FLAG_FIELDS == FLAG_FIELDS


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
def test_shares_are_described(shares: dict[str, float], text: str) -> None:
    """Flags that are bad in all messages are grouped; others have a percentage, which is never 0 or 100."""
    assert describe_flags(shares) == text


@given(messages(), st.booleans())
def test_doubts_have_no_percentage_in_one_message(message: VehicleLocalPosition, as_row: bool) -> None:
    """A message, or a row, is described by its own flags: it either has a doubt or not."""
    either = row_of(message) if as_row else message
    assert message_doubts(either) == describe_flags({name: float(getattr(message, name)) for name in DOUBT_FLAGS})
    assert "%" not in message_doubts(either)
