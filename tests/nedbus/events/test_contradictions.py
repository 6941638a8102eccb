"""Estimates that GNSS, barometer or ground truth contradict, from hand-made messages."""

from __future__ import annotations

from typing import Any, Final

import pytest

from nedbus.events import Event

from .flight import ARMED, DISARMED, GOOD_GPS, Flight

ORIGIN: Final[dict[str, Any]] = {
    "xy_global": True, "z_global": True, "ref_lat": 47.0, "ref_lon": 8.0, "ref_alt": 500.0, "z": -20.0,
}  # fmt: skip
METRE: Final = 1 / 111_194.9266  # deg of latitude
GPS: Final = {**GOOD_GPS, "latitude_deg": 47.0, "longitude_deg": 8.0, "altitude_msl_m": 520.0, "eph": 1.0, "epv": 1.0}
TRUTH: Final = "vehicle_local_position_groundtruth"


def fly(
    flight: Flight, seconds: float, *, up: float = 0.0, north: float = 0.0, baro: float | None = None,
    truth: float | None = None, gps: dict[str, Any] | None = None, missing: tuple[str, ...] = (), **fields: Any,
) -> list[Event]:  # fmt: skip
    """Fly with an estimate that is off from GNSS, and by other values from other references [m]."""
    told: list[Event] = []
    for _ in range(round(seconds * 10)):
        told += flight.wait(0.1).send(missing=missing, **{**ORIGIN, "z": -20.0 - up, "x": north, **fields})
        told += flight.send("vehicle_gps_position", **(GPS if gps is None else {**GPS, **gps}))
        if baro is not None:
            told += flight.send("vehicle_air_data", baro_alt_meter=1000.0 + up - baro, baro_device_id=1)
        if truth is not None:
            told += flight.send(TRUTH, **{**ORIGIN, "ref_alt": 0.0, "z": truth - up, "x": north - truth, "y": 0.0})
    return [each for each in told if each.kind != "jump"]


@pytest.fixture
def flight() -> Flight:
    """Return an armed vehicle whose references agree."""
    flight = Flight()
    flight.status(ARMED)
    assert fly(flight, 5.0, baro=0.0) == []
    return flight


def test_contradicted_height(flight: Flight) -> None:
    """A contradiction begins when all references disagree for long enough, and ends when the first one agrees."""
    since = flight.now
    begun = fly(flight, 4.0, up=36.0, baro=36.0)
    assert [(each.kind, each.change, each.severity, each.text) for each in begun] == [
        ("height_contradicted", "begin", "bad", "height 36 m above GNSS and barometer while z_valid is true")
    ]
    assert begun[0].time == pytest.approx(since, abs=0.5)
    assert (flight.severity, flight.kinds) == ("bad", ["height_contradicted"])
    ended = fly(flight, 1.0, baro=0.0)
    assert [(each.kind, each.change, each.severity) for each in ended] == [("height_contradicted", "end", "info")]
    assert ended[0].text.startswith("height no longer contradicted after ")
    assert ended[0].lasted == pytest.approx(4.0, abs=0.4)  # the interval between two comparisons
    assert flight.kinds == []


def test_contradicted_position(flight: Flight) -> None:
    """The limit is 4 m, three times the receiver's accuracy, and the way flown in half a second."""
    assert fly(flight, 10.0, north=6.9) == []
    assert fly(flight, 10.0, north=12.0, vx=12.0, x=12.0) == []
    assert fly(flight, 10.0, north=30.0, gps={"eph": 9.0}) == []
    assert fly(flight, 10.0, north=30.0, gps={"eph": 0.0}) == [], "an accuracy that the receiver does not know"
    (begun,) = fly(flight, 10.0, north=7.6)
    assert begun.text == "position 8 m off GNSS while xy_valid is true"
    assert begun.numbers == {"distance": pytest.approx(7.6, abs=0.01)}


@pytest.mark.parametrize(
    "how",
    [
        {"baro": 0.0},  # one reference agrees
        {"baro": -36.0},  # they contradict each other
        {"truth": 0.0},
        {"z_valid": False},
        {"missing": ("z_valid",)},  # MAVLink does not have it
        {"gps": {"fix_type": 0, "satellites_used": 0}},
        {"gps": {"latitude_deg": 0.0, "longitude_deg": 0.0}},
        {"gps": {"epv": 10.0}},
        {"up": 23.0},  # twice (8 m, 5 % of z, 3 x epv) by one reference
        {"xy_global": False, "z_global": False, "ref_lat": float("nan"), "ref_lon": float("nan"),
         "ref_alt": float("nan")},
    ],
)  # fmt: skip
def test_height_that_is_not_contradicted(flight: Flight, how: dict[str, Any]) -> None:
    """All references that are there have to say so, of a valid estimate, by more than they may be wrong."""
    fly(flight, 2.0)
    told = fly(flight, 10.0, **{"up": 30.0, **how})
    assert not [each for each in told if each.kind == "height_contradicted"]


def test_short_contradiction_is_no_event(flight: Flight) -> None:
    """A height for less than 1.5 s, a position for less than 3 s."""
    assert fly(flight, 1.2, up=100.0, baro=100.0) == fly(flight, 2.0) == fly(flight, 2.5, north=9.0) == []


def test_barometer_is_compared_with_its_beginning(flight: Flight) -> None:
    """Its heights have no origin; another barometer, and an origin that is set, begin anew."""
    none = {"fix_type": 0, "satellites_used": 0}
    fly(flight, 5.0, gps=none, baro=0.0)
    assert fly(flight, 5.0, gps=none, baro=17.0) == []
    (begun,) = fly(flight, 5.0, gps=none, baro=-24.0)
    assert begun.text == "height 24 m below barometer while z_valid is true"
    fast = Flight()
    fast.status(ARMED)
    fly(fast, 5.0, gps=none, baro=0.0)
    assert not [each for each in fly(fast, 5.0, gps=none, baro=50.0, vx=25.0, x=0.0) if "contra" in each.kind]


def test_ground_truth(flight: Flight) -> None:
    """A simulation has a reference for both; its altitude may have another origin."""
    fly(flight, 2.0, truth=0.0, gps={"fix_type": 0})
    told = fly(flight, 5.0, truth=40.0, gps={"fix_type": 0})
    assert [each.text for each in told if each.change == "begin" and "contradicted" in each.kind] == [
        "height 40 m above ground truth while z_valid is true", "position 40 m off ground truth while xy_valid is true",
    ]  # fmt: skip


def test_contradiction_on_the_ground_is_information() -> None:
    """A receiver indoors may be wrong."""
    flight = Flight()
    flight.status(DISARMED)
    told = fly(flight, 10.0, north=50.0)
    assert [(each.kind, each.severity) for each in told] == [("position_contradicted", "info")]
    assert flight.severity == "info"


def test_odd_air_data_is_ignored(flight: Flight) -> None:
    """Its fields are whatever its publisher defines."""
    for odd in ({}, {"baro_alt_meter": "high"}, {"baro_alt_meter": None, "baro_device_id": (1, 2)}):
        for _ in range(20):
            assert flight.wait(0.5).send("vehicle_air_data", **odd) == []
            flight.send(**ORIGIN)


def test_contradiction_is_over_after_a_reboot(flight: Flight) -> None:
    """The barometer is compared anew then."""
    fly(flight, 5.0, up=36.0, baro=36.0)
    assert flight.kinds == ["height_contradicted"]
    flight.booted = flight.now
    fly(flight, 5.0, up=36.0, gps={"altitude_msl_m": 556.0}, baro=36.0)
    assert flight.kinds == ["reboot"]
