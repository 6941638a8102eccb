"""Validation rules: what PX4 publishes in a sound flight is valid; docs/px4-values.md names the code for each case."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import pytest
from pydantic import ValidationError

import nedbus
from nedbus_msgs import MESSAGES
from nedbus_msgs.arrays import arrays_of
from nedbus_msgs.messages import HomePosition, SensorGps, VehicleGlobalPosition
from nedbus_msgs.model import rules
from tests.flights.ulogs import LOGS
from tests.nedbus_msgs.docstrings import printed_line
from tests.peers.command_line import run_command

SHARED: Final = LOGS.parents[1]
FLIGHTS: Final = sorted(
    [
        *LOGS.glob("*.ulg"),
        *SHARED.glob("data/px4/*.ulg"),
        *SHARED.glob("data/px4/ulog_stream/*.ulg"),
    ]
)
SHORT_FLIGHTS: Final = ["boot_time_utc_us.ulg", "uxrce_unix_time.mcap", "fmu_in_topics.mcap"]
DATA: Final = Path(__file__).parents[2] / "data"
PAGE: Final = Path(__file__).parents[3] / "docs" / "px4-values.md"
MANY: Final = 1000  # messages, which are checked by columns
ZEROS, NAN4 = (0.0,) * 4, (math.nan,) * 4

PUBLISHED: Final[list[tuple[str, dict[str, Any]]]] = [
    # MapProjection::reproject
    ("VehicleGlobalPosition", {"lat": -17.0, "lon": 180.0000156, "lat_lon_valid": True}),
    ("VehicleGlobalPosition", {"lat": -17.0, "lon": -359.9}),
    # a copy of the global position
    ("HomePosition", {"lat": -17.0, "lon": 180.01, "valid_hpos": True}),
    # an origin that was moved
    ("VehicleLocalPosition", {"ref_lat": -17.0, "ref_lon": 180.01, "xy_global": True}),
    # add_vector_to_global_position, for blending
    ("SensorGps", {"latitude_deg": -17.0, "longitude_deg": -180.00001}),
    ("SensorGps", {"eph": -1.0, "epv": -1.0}),  # DroneCAN without covariances
    ("SensorGps", {"timestamp_sample": 10_100_000}),  # PpsTimeSync::correct_gps_timestamp
    # vision: a synchronised time of another computer
    ("VehicleOdometry", {"timestamp_sample": 10_100_000}),
    ("BatteryStatus", {"remaining": 1.27}),  # a DroneCAN battery: 127 %
    # a current sensor that reads below 0 on a full battery
    ("BatteryStatus", {"remaining": 1.0001}),
    ("BatteryStatus", {"remaining": -0.01}),  # a MAVLink battery with an unknown charge
    ("VehicleAttitude", {"q": NAN4}),
    ("VehicleOdometry", {"q": ZEROS}),  # vision without attitude, as ODOMETRY is copied
    # copied from ODOMETRY; EKF2 ignores its attitude
    ("VehicleOdometry", {"q": (1.05, 0.0, 0.0, 0.0)}),
]
WRONG: Final[list[tuple[str, dict[str, Any], str]]] = [
    ("VehicleGlobalPosition", {"lon": 360.1}, "lon: must be within +-360"),
    ("HomePosition", {"lat": 90.1}, "lat: must be within +-90"),
    ("SensorGps", {"eph": -0.5}, "eph: must be 0 to inf, or -1 if unknown"),
    ("BatteryStatus", {"remaining": 2.1}, "remaining: must be -1 to 2"),
    ("BatteryStatus", {"remaining": -1.1}, "remaining: must be -1 to 2"),
    # in logs that PX4's replay module wrote
    ("VehicleAttitude", {"q": ZEROS}, "q: must have norm 1"),
    ("VehicleAttitude", {"q": (1.05, 0.0, 0.0, 0.0)}, "q: must have norm 1"),
    ("VehicleAttitude", {"q": (1e-3, 0.0, 0.0, 0.0)}, "q: must have norm 1"),
    ("VehicleOdometry", {"q": (1.2, 0.0, 0.0, 0.0)}, "q: must have norm 1"),
]


def is_valid(name: str, fields: dict[str, Any]) -> tuple[bool, str]:
    """Return whether a message is valid for its model and for the check of columns, and the reason."""
    definition = MESSAGES[name]
    given, reason = {"timestamp": 10_000_000, **fields}, ""
    array = arrays_of(definition).absent(MANY)
    for field, value in given.items():
        array[field] = value
    masks = [arrays_of(definition).valid_mask(array[:count]) for count in (1, MANY)]
    try:
        definition.model(**given)
    except ValidationError as exc:
        [error] = exc.errors()
        reason = f"{error['loc'][0]}: {error['msg']}"
    assert {valid for mask in masks for valid in mask.tolist()} == {not reason}
    return not reason, reason


@pytest.mark.parametrize(("name", "fields"), PUBLISHED, ids=str)
def test_values_of_sound_flights_are_valid(name: str, fields: dict[str, Any]) -> None:
    """Values that PX4 publishes in a sound flight pass, also those that the unit of the field does not suggest."""
    assert is_valid(name, fields) == (True, "")


@pytest.mark.parametrize(("name", "fields", "reason"), WRONG, ids=str)
def test_values_beyond_px4s_range_are_rejected(
    name: str, fields: dict[str, Any], reason: str
) -> None:
    """Values that no code of PX4 can publish are rejected with the reason."""
    valid, why = is_valid(name, fields)
    assert not valid
    assert why.startswith(reason)


def test_page_lists_every_rule() -> None:
    """The table of ranges names each flag and each field that a rule checks, and each message without rules."""
    section = PAGE.read_text().partition("\n## Ranges\n")[2].partition("\n## ")[0]
    introduction, _, table = section.partition("\n|")
    rules = "\n".join(row.split("|")[1] for row in table.splitlines() if row.count("|") > 3)
    for definition in MESSAGES.values():
        if not definition.rules:
            assert f"`{definition.name}`" in introduction
        for rule in definition.rules:
            names = rule.flags or [check.field for check in rule.checks]
            missing = [name for name in names if f"`{name}`" not in rules]
            assert missing == [], (
                f"{definition.name}: add a row with the code of PX4 that publishes the field"
            )


def test_longitudes_are_wrapped_where_they_are_used() -> None:
    """The field keeps PX4's value, and the property is comparable with that of a receiver, east and west."""
    for longitude, wrapped in ((180.5, -179.5), (-180.5, 179.5), (180.0, 180.0), (-180.0, -180.0)):
        estimate = VehicleGlobalPosition(
            timestamp=1, lat=-17.0, lon=longitude, alt=1.0, lat_lon_valid=True, alt_valid=True
        )
        home = HomePosition(
            timestamp=1, lat=-17.0, lon=longitude, alt=1.0, valid_hpos=True, valid_alt=True
        )
        gps = SensorGps(
            timestamp=1, latitude_deg=-17.0, longitude_deg=longitude, altitude_msl_m=1.0, fix_type=3
        )
        assert (estimate.lon, home.lon, gps.longitude_deg) == (longitude,) * 3
        positions = estimate.global_position, home.global_position, gps.global_position
        assert {position and position.longitude for position in positions} == {wrapped}


@pytest.mark.skipif(not (SHARED / "cases").is_dir(), reason="no ../shared/cases")
def test_flight_over_the_antimeridian_has_no_event(tmp_path: Path) -> None:
    """A flight in Fiji with PX4 1.15 is read completely, without a rejection or a contradiction."""
    path = SHARED / "cases/turn6/04_antimeridian_east.ulg"
    result = run_command("convert", str(path), str(tmp_path / "a.mcap"))
    assert (result.exit_code, "rejected" in result.out + result.err) == (0, False)
    assert "no events" in run_command("events", str(path)).err


@pytest.mark.parametrize("name", SHORT_FLIGHTS)
def test_no_message_of_a_short_flight_is_rejected(tmp_path: Path, name: str) -> None:
    """All messages of short recordings are valid, and none contradicts the estimate."""
    result = run_command("convert", str(DATA / name), str(tmp_path / "a.mcap"), "--topics", "*")
    assert (result.exit_code, "rejected" in result.out + result.err) == (0, False), result
    assert [
        event.text for event in nedbus.events(DATA / name) if event.kind.endswith("_contradicted")
    ] == []


@pytest.mark.long
@pytest.mark.logs
@pytest.mark.parametrize("path", FLIGHTS, ids=lambda path: path.stem)
def test_no_message_of_a_real_flight_is_rejected(tmp_path: Path, path: Path) -> None:
    """All messages of a real flight are valid, on hardware and in simulation, from PX4 1.11 to main."""
    result = run_command("convert", str(path), str(tmp_path / "a.mcap"), "--topics", "*")
    assert (result.exit_code, "rejected" in result.out + result.err) == (0, False), result


def test_printed_rules_are_what_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """The docstrings show the expression of two rules, and the first check on columns."""
    finite, not_negative = rules.FiniteWhile(z_valid="z"), rules.NotNegative("eph", "epv")
    names = ["timestamp", "z_valid", "x", "z", "eph", "epv"]
    accessors = {name: f"values[{index}]" for index, name in enumerate(names)}
    expression = rules.expression_of([finite, not_negative], accessors)
    assert expression == printed_line(rules.expression_of)
    sources: list[str] = []
    monkeypatch.setattr(rules, "compile_lambda", lambda text, **_: sources.append(text))
    rules.column_checks([finite, not_negative])
    assert sources[0] == printed_line(rules.column_checks)
