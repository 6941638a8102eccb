"""The layout table, compared with PX4's message reference, and conversion between layouts."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest
from hypothesis import given
from pydantic import ValidationError

from nedbus_msgs import VehicleLocalPosition, field_type
from tests.flights.local_position import (
    CURRENT,
    FIELD_TYPES,
    LAYOUTS,
    downgrade,
    find_layout,
    layout_table,
    upgrade,
)
from tests.nedbus_msgs.strategies import DATA, bits, messages

SEEDS = json.loads((DATA / "seeds.json").read_text())
SHARED = Path(__file__).parents[4] / "shared" / "seeds"


@pytest.mark.parametrize("name", SEEDS)
def test_layout_matches_px4_page(name: str) -> None:
    """The table has the names, order and types of each page's message definition."""
    layout = LAYOUTS[name]
    assert [[field, str(kind)] for field, kind in layout.types.items()] == SEEDS[name]["fields"]


@pytest.mark.parametrize("name", SEEDS)
def test_fixture_matches_px4_page(name: str) -> None:
    """tests/data/seeds.json has the fields of the original pages."""
    path = SHARED / SEEDS[name]["seed"]
    if not path.exists():
        pytest.skip(f"page not found: {path.name}")
    rows = re.findall(
        r"^(uint64|uint8|bool|float32(?:\[2\])?|float64)\s+(\w+)\s*(?=#|$)",
        path.read_text(),
        re.MULTILINE,
    )
    assert [[field, kind] for kind, field in rows] == SEEDS[name]["fields"]


def test_layout_table_lists_px4_layouts() -> None:
    """There are five layouts with PX4's field counts, two of them used on the wire, and the table is JSON."""
    table = json.loads(json.dumps(layout_table()))
    assert [(row["name"], row["wire"], len(row["fields"])) for row in table] == [
        ("1.13", None, 45), ("1.14", None, 46), ("1.15", None, 49), ("V0", 0, 52), ("1.16", 1, 53),
    ]  # fmt: skip
    assert {layout.name: layout.wire for layout in LAYOUTS.values() if layout.wire is not None} == {
        "V0": 0,
        "1.16": 1,
    }
    assert [row["name"] for row in table] == list(LAYOUTS)
    assert CURRENT.fields == tuple(FIELD_TYPES)
    assert all(len(set(layout.fields)) == len(layout.fields) for layout in LAYOUTS.values())


@pytest.mark.parametrize("name", LAYOUTS)
def test_layout_is_identified_by_names_in_any_order(name: str) -> None:
    """A ULog sorts fields by size, so field names alone identify the layout."""
    assert find_layout(reversed(LAYOUTS[name].fields)) is LAYOUTS[name]
    assert find_layout(LAYOUTS[name].fields[1:]) is None


@given(messages())
def test_downgrade_and_upgrade_keep_common_fields(message: VehicleLocalPosition) -> None:
    """Fields that both layouts have are unchanged bit for bit; hagl_max follows PX4's translation."""
    for name, layout in LAYOUTS.items():
        older = downgrade(message, name)
        assert tuple(older) == layout.fields
        back = upgrade(older)
        lost = {field: getattr(back, field) for field in FIELD_TYPES if field not in older}
        provided = message.model_copy(update=lost)
        assert bits(back) == bits(provided)
        if "hagl_max" in older:
            assert repr(older["hagl_max"]) == repr(message.hagl_max_z)
            assert (
                repr(lost.pop("hagl_max_z"))
                == repr(lost.pop("hagl_max_xy"))
                == repr(message.hagl_max_z)
            )
            assert {"hagl_max_z", "hagl_max_xy"} <= back.model_fields_set
        assert not set(lost) & back.model_fields_set


def test_fields_missing_in_an_old_layout_are_not_provided() -> None:
    """Fields that 1.13 lacks are NaN, false or 0."""
    older = downgrade(
        VehicleLocalPosition(timestamp=7, dead_reckoning=True, tilt_var=1.0, hagl_max_z=5.0), "1.13"
    )
    message = upgrade(older)
    assert (message.dead_reckoning, message.dist_bottom_reset_counter) == (False, 0)
    assert math.isnan(message.tilt_var)
    assert (message.hagl_max_z, message.hagl_max_xy) == (5.0, 5.0)


def test_yaw_of_px4_1_11_becomes_heading() -> None:
    """In logs of PX4 up to 1.11, yaw is renamed to heading; unknown fields are ignored, missing ones not provided."""
    message = upgrade(
        {"timestamp": 5, "x": 1.0, "yaw": 0.5, "ref_yaw": 9.0, "dist_bottom_rate": 1.0}
    )
    assert (message.heading, message.x) == (0.5, 1.0)
    assert message.model_fields_set == {"timestamp", "x", "heading"}


def test_upgrade_validates_the_message() -> None:
    """Messages of old layouts are validated like current ones."""
    with pytest.raises(ValidationError, match="xy_valid"):
        upgrade({"timestamp": 1, "xy_valid": True})


@pytest.mark.parametrize(
    ("kind", "value", "fitted"),
    [
        ("uint8", 255, 255), ("uint8", 256, None), ("uint8", -1, None), ("uint8", 6.0, 6), ("uint8", 6.5, None),
        ("uint8", math.nan, None), ("uint8", True, 1), ("int64", 2**63, None), ("uint64", -1, None),
        ("bool", 1, True), ("bool", 2, None), ("float32", 16_777_216, 16_777_216.0), ("float32", 16_777_217, None),
        ("float32", 0.1, None), ("float32", 1e39, None), ("float32", math.inf, math.inf), ("float64", 2**53 + 1, None),
        ("uint8[2]", (1, 2.0), (1, 2)), ("uint8[2]", (1, 256), None), ("uint8[3]", (1, 2), (1, 2, 0)),
        ("uint8[1]", (1, 2), None), ("uint8", (1,), None), ("uint8[1]", 1, None),
    ],
)  # fmt: skip
def test_number_fits_only_if_its_value_is_unchanged(
    kind: str, value: object, fitted: object
) -> None:
    """A number of another type, or a shorter array, is converted exactly or not at all."""
    found = field_type(kind).fit(value)
    assert found == fitted
    assert type(found) is type(fitted)


def test_nan_fits_any_float_type() -> None:
    """NaN is kept, and pads a shorter array."""
    assert math.isnan(field_type("float32").fit(math.nan))
    assert repr(field_type("float32[3]").fit((1, math.nan))) == "(1.0, nan, nan)"
