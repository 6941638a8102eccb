"""Table of event kinds."""

import pytest

from nedbus.vehicle_events import KINDS, Event, Kind, spans_of, state_at, stories_of

from .flight import Flight


def test_causes_are_kinds_in_the_table() -> None:
    """Every cause listed for a kind is itself a kind in the table."""
    for name, kind in KINDS.items():
        assert set(kind.causes) <= set(KINDS), name


def test_row_in_the_table_defines_a_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    """A row in the table is sufficient for a flag to become an event, a state, a cause and a story."""
    row = Kind(
        "freefall", "bad", "VehicleLandDetected", ("gps_fix_lost",), flags={"freefall": "freefall"},
        begin="free fall", end="free fall ended",
    )  # fmt: skip
    monkeypatch.setitem(KINDS, "freefall", row)
    flight = Flight()
    flight.send()
    flight.send("vehicle_land_detected", landed=False, freefall=False)
    flight.gps(fix_type=3)
    flight.wait(1.0).gps(fix_type=0)
    [begun] = flight.wait(1.0).send("vehicle_land_detected", landed=False, freefall=True)
    assert (begun.kind, begun.severity, begun.text) == ("freefall", "bad", "free fall")
    assert [each.kind for each in begun.evidence] == ["gps_fix_lost"]
    assert flight.event_log.state("1", flight.now).text == "free fall"
    flight.wait(1.0).send("vehicle_land_detected", landed=False, freefall=False)
    [story] = [each for each in stories_of(flight.event_log.events) if each.what == "free fall"]
    assert [each.kind for each in story.before] == ["gps_fix_lost"]
    flight.wait(1.0).send("battery_status", warning=3, connected=True)
    assert "free fall" in [each.what for each in stories_of(flight.event_log.events)]


def test_unknown_kind_is_shown() -> None:
    """An event of an unknown kind, as from a newer service, is shown with its text and severity."""
    begun = Event("1", "lightning", "begin", "watch", "struck", 1.0)
    assert [each.text for each in spans_of([begun])] == ["struck"]
    assert state_at(spans_of([begun]), 2.0).text == "struck"
