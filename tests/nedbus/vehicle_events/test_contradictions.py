"""Estimates contradicted by GNSS, barometer or ground truth."""

from __future__ import annotations

from typing import Any, Final

import pytest

from nedbus.vehicle_events import Event
from nedbus.vehicle_events.contradictions import Comparison, ReferenceDetector

from .flight import ARMED, DISARMED, GOOD_GPS, Flight

ORIGIN: Final[dict[str, Any]] = {
    "xy_global": True, "z_global": True, "ref_lat": 47.0, "ref_lon": 8.0, "ref_alt": 500.0, "z": -20.0,
}  # fmt: skip
METRE: Final = 1 / 111_194.9266  # deg of latitude
GPS: Final = {
    **GOOD_GPS,
    "latitude_deg": 47.0,
    "longitude_deg": 8.0,
    "altitude_msl_m": 520.0,
    "eph": 1.0,
    "epv": 1.0,
}
TRUTH: Final = "vehicle_local_position_groundtruth"


def fly(
    flight: Flight, seconds: float, *, up: float = 0.0, north: float = 0.0, baro: float | None = None,
    truth: float | None = None, gps: dict[str, Any] | None = None, missing: tuple[str, ...] = (), **fields: Any,
) -> list[Event]:  # fmt: skip
    """Fly with an estimate that is off by `up` and `north` from GNSS, by `baro` and `truth` from other sources [m]."""
    reported: list[Event] = []
    for _ in range(round(seconds * 10)):
        reported += flight.wait(0.1).send(
            missing=missing, **{**ORIGIN, "z": -20.0 - up, "x": north, **fields}
        )
        reported += flight.send("vehicle_gps_position", **(GPS if gps is None else {**GPS, **gps}))
        if baro is not None:
            reported += flight.send(
                "vehicle_air_data", baro_alt_meter=1000.0 + up - baro, baro_device_id=1
            )
        if truth is not None:
            reported += flight.send(
                TRUTH, **{**ORIGIN, "ref_alt": 0.0, "z": truth - up, "x": north - truth, "y": 0.0}
            )
    return [each for each in reported if each.kind != "jump"]


@pytest.fixture
def flight() -> Flight:
    """Return an armed vehicle whose references agree."""
    flight = Flight()
    flight.status(ARMED)
    assert fly(flight, 5.0, baro=0.0) == []
    return flight


def test_height_is_contradicted_when_all_references_disagree(flight: Flight) -> None:
    """A contradiction begins after all references have disagreed for 1.5 s, and ends when one agrees."""
    since = flight.now
    begun = fly(flight, 4.0, up=36.0, baro=36.0)
    assert [(each.kind, each.change, each.severity, each.text) for each in begun] == [
        (
            "height_contradicted",
            "begin",
            "bad",
            "height 36 m above GNSS and barometer while z_valid is true",
        )
    ]
    assert begun[0].time == pytest.approx(since, abs=0.5)
    assert (flight.severity, flight.kinds) == ("bad", ["height_contradicted"])
    ended = fly(flight, 1.0, baro=0.0)
    assert [(each.kind, each.change, each.severity) for each in ended] == [
        ("height_contradicted", "end", "info")
    ]
    assert ended[0].text.startswith("height no longer contradicted after ")
    assert ended[0].lasted == pytest.approx(4.0, abs=0.4)  # comparison interval
    assert flight.kinds == []


def test_position_is_contradicted_beyond_its_limit(flight: Flight) -> None:
    """A position is contradicted beyond 4 m plus three times the receiver's accuracy plus the distance of 0.5 s."""
    assert fly(flight, 10.0, north=6.9) == []
    assert fly(flight, 10.0, north=12.0, vx=12.0, x=12.0) == []
    assert fly(flight, 10.0, north=30.0, gps={"eph": 9.0}) == []
    assert fly(flight, 10.0, north=30.0, gps={"eph": 0.0}) == [], "unknown accuracy"
    (begun,) = fly(flight, 10.0, north=7.6)
    assert begun.text == "position 8 m off GNSS while xy_valid is true"
    assert begun.numbers == {"distance": pytest.approx(7.6, abs=0.01)}


@pytest.mark.parametrize(
    "how",
    [
        {"baro": 0.0},  # one reference agrees
        {"baro": -36.0},  # opposite directions
        {"truth": 0.0},
        {"z_valid": False},
        {"missing": ("z_valid",)},  # not provided by MAVLink
        {"gps": {"fix_type": 0, "satellites_used": 0}},
        {"gps": {"latitude_deg": 0.0, "longitude_deg": 0.0}},
        {"gps": {"epv": 10.0}},
        {"up": 23.0},  # below 2 x (8 m + 5 % of z + 3 x epv), the limit for one reference
        {"xy_global": False, "z_global": False, "ref_lat": float("nan"), "ref_lon": float("nan"),
         "ref_alt": float("nan")},
    ],
)  # fmt: skip
def test_height_is_not_contradicted_without_sufficient_evidence(
    flight: Flight, how: dict[str, Any]
) -> None:
    """A height is not contradicted if a reference agrees, the estimate is invalid, or the limit is not exceeded."""
    fly(flight, 2.0)
    reported = fly(flight, 10.0, **{"up": 30.0, **how})
    assert not [each for each in reported if each.kind == "height_contradicted"]


def test_short_contradiction_is_ignored(flight: Flight) -> None:
    """Contradictions of a height for less than 1.5 s, or a position for less than 3 s, are ignored."""
    assert (
        fly(flight, 1.2, up=100.0, baro=100.0)
        == fly(flight, 2.0)
        == fly(flight, 2.5, north=9.0)
        == []
    )


def test_barometer_is_compared_relative_to_its_first_height(flight: Flight) -> None:
    """Barometer heights are relative to the first comparison; dynamic pressure at 25 m/s is tolerated."""
    none = {"fix_type": 0, "satellites_used": 0}
    fly(flight, 5.0, gps=none, baro=0.0)
    assert fly(flight, 5.0, gps=none, baro=17.0) == []
    assert fly(flight, 5.0, gps=none, baro=-24.0) == [], "within 15 % of the change"
    (begun,) = fly(flight, 5.0, gps=none, baro=-30.0)
    assert begun.text == "height 30 m below barometer while z_valid is true"
    fast = Flight()
    fast.status(ARMED)
    fly(fast, 5.0, gps=none, baro=0.0)
    assert not [
        each
        for each in fly(fast, 5.0, gps=none, baro=50.0, vx=25.0, x=0.0)
        if "contra" in each.kind
    ]


def test_ground_truth_contradicts_height_and_position(flight: Flight) -> None:
    """Ground truth contradicts height and position, even with another altitude origin."""
    fly(flight, 2.0, truth=0.0, gps={"fix_type": 0})
    reported = fly(flight, 5.0, truth=40.0, gps={"fix_type": 0})
    assert [each.text for each in reported if each.change == "begin" and "contradicted" in each.kind] == [
        "height 40 m above ground truth while z_valid is true", "position 40 m off ground truth while xy_valid is true",
    ]  # fmt: skip


def test_contradiction_while_disarmed_is_info() -> None:
    """A contradiction while disarmed has severity "info", because GNSS receivers are inaccurate indoors."""
    flight = Flight()
    flight.status(DISARMED)
    reported = fly(flight, 10.0, north=50.0)
    assert [(each.kind, each.severity) for each in reported] == [("position_contradicted", "info")]
    assert flight.severity == "info"


def test_malformed_air_data_is_ignored(flight: Flight) -> None:
    """Air data with missing fields or unexpected types is ignored, because any publisher can define the message."""
    for odd in ({}, {"baro_alt_meter": "high"}, {"baro_alt_meter": None, "baro_device_id": (1, 2)}):
        for _ in range(20):
            assert flight.wait(0.5).send("vehicle_air_data", **odd) == []
            flight.send(**ORIGIN)


def test_reboot_ends_contradiction(flight: Flight) -> None:
    """A reboot ends a contradiction and resets the barometer's offset."""
    fly(flight, 5.0, up=36.0, baro=36.0)
    assert flight.kinds == ["height_contradicted"]
    flight.booted = flight.now
    fly(flight, 5.0, up=36.0, gps={"altitude_msl_m": 556.0}, baro=36.0)
    assert flight.kinds == ["reboot"]


@pytest.mark.parametrize("baro", [None, 0.0])
def test_constant_difference_is_an_error_of_the_origin(baro: float | None) -> None:
    """A height that is off from the first comparison on, and changes as GNSS does, has a wrong origin altitude."""
    flight = Flight()
    flight.status(ARMED)
    reported = fly(flight, 20.0, up=-488.0, baro=baro)
    [begun] = [event for event in reported if "contradicted" in event.kind]
    text = "origin altitude (ref_alt) 488 m below GNSS (z is right)"
    assert (begun.kind, begun.severity, begun.text) == ("origin_contradicted", "watch", text)
    assert begun.time == pytest.approx(100.1, abs=1.0)
    reported = fly(flight, 5.0, up=-638.0, baro=None if baro is None else -150.0)
    assert [event.kind for event in reported if event.change == "begin"] == ["height_contradicted"]


@pytest.mark.parametrize("up", [-25.0, -488.0, 60.0])
def test_wrong_origin_is_one_statement_during_climbs(up: float) -> None:
    """A climb and a worse accuracy increase the limit of a height; the origin stays contradicted meanwhile."""
    flight = Flight()
    flight.status(ARMED)
    reported = fly(flight, 10.0, up=up, baro=0.0)
    reported += fly(flight, 10.0, up=up + 300.0, baro=0.0, gps={"altitude_msl_m": 820.0})
    reported += fly(flight, 10.0, up=up, baro=0.0, gps={"epv": 7.0})
    assert [(event.kind, event.change) for event in reported] == [("origin_contradicted", "begin")]
    ended = fly(flight, 10.0, ref_alt=500.0 - up, up=up)
    assert [event.change for event in ended if event.kind == "origin_contradicted"] == ["end"]


def test_barometer_alone_is_compared_as_a_standard_atmosphere_allows() -> None:
    """A barometer is not compared above 11 km, and below it differs by up to 15 % of the climb."""
    for height, error, is_contradicted in (
        (23_000.0, 3000.0, False),
        (3000.0, 300.0, False),
        (3000.0, 2000.0, True),
    ):
        flight = Flight()
        flight.status(ARMED)
        none = {"fix_type": 0, "satellites_used": 0}
        fly(flight, 2.0, gps=none, baro=1000.0 - 100.0)
        reported = fly(flight, 5.0, gps=none, up=height, baro=error + 900.0)
        assert any(event.kind == "height_contradicted" for event in reported) == is_contradicted, (
            height
        )


def test_ground_truth_is_compared_in_the_local_frame_without_a_global_origin(
    flight: Flight,
) -> None:
    """Without a global origin, the motion since the first comparison is compared with the ground truth's."""
    nowhere: dict[str, Any] = dict.fromkeys(("ref_lat", "ref_lon", "ref_alt"), float("nan"))
    nowhere |= {"xy_global": False, "z_global": False}
    none = {"fix_type": 0, "satellites_used": 0}
    fly(flight, 5.0, truth=0.0, gps=none, north=7.0, **nowhere)
    reported = fly(flight, 6.0, truth=0.0, gps=none, north=7.0, **nowhere)
    assert [event for event in reported if "contradicted" in event.kind] == []
    reported = fly(flight, 6.0, truth=46.0, gps=none, north=7.0, z=-20.0, **nowhere)
    texts = [event.text for event in reported if event.kind == "position_contradicted"]
    assert texts == ["position 46 m off ground truth while xy_valid is true"]


def test_order_of_topics_does_not_matter() -> None:
    """Measurements are compared with the estimate of their own time, in whatever order the topics arrive.

    A log holds the messages as PX4 wrote them, its conversion by their timestamps: nxp_v0_ekf_failure had two faults
    as .ulg and one as .mcap.
    """
    found = []
    for delay in (0, 3):
        flight, late = Flight(), list[tuple[float, str, dict[str, Any]]]()
        flight.status(ARMED)
        for step in range(200):
            up = 36.0 if 100 <= step < 120 else 0.0
            flight.wait(0.1).send(**{**ORIGIN, "z": -20.0 - up})
            late.append((flight.now, "vehicle_gps_position", GPS))
            late.append(
                (flight.now, "vehicle_air_data", {"baro_alt_meter": 1000.0, "baro_device_id": 1})
            )
            now = flight.now
            while late and late[0][0] <= now - 0.1 * delay + 1e-9:
                flight.now, topic, fields = late.pop(0)
                flight.send(topic, **fields)
            flight.now = now
        found.append([(event.kind, event.change, round(event.time, 3)) for event in flight.event_log.events
                      if event.kind == "height_contradicted"])  # fmt: skip
    assert found[0] == found[1]
    assert [change for _, change, _ in found[0]] == ["begin", "end"]


def test_waiting_messages_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """A topic with more measurements than the limit before the next estimate keeps the earliest of them."""
    monkeypatch.setattr("nedbus.limits.COMPARED_MESSAGES", 5)
    comparison = Comparison()
    detector = ReferenceDetector(TRUTH, comparison, None)
    for number in range(8):
        stamp = 1_000_000 + number * 1_000_000
        list(detector.add({"timestamp": stamp, **ORIGIN, "x": 0.0, "y": 0.0}, frozenset()) or ())
    assert [measurement.stamp for measurement in comparison._waiting] == [
        1_000_000 + number * 1_000_000 for number in range(5)
    ]
    for number in range(8):
        comparison.add_estimate(10_000 + number, ORIGIN, frozenset())
    assert len(comparison._estimates) == 5
