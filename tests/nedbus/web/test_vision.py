"""VisionWatch: reports about the external positions of the vehicles on a page."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, Final

from nedbus.client import Sample
from nedbus.health import PositionStatus
from nedbus.web.vision import VisionWatch
from nedbus_msgs import Address

SENT: Final = {
    "wing": PositionStatus(
        vehicle="wing", address="mocap/vehicle_visual_odometry", sent=3, rate=50.0
    )
}


def add(
    watch: VisionWatch, topic: str, time: float, vehicle: str = "wing", **fields: object
) -> None:
    """Add a message of PX4 at its time since boot [s]."""
    message: Any = SimpleNamespace(timestamp=round(1e6 * time), **fields)
    watch.add(Sample(message, Address(vehicle, topic), 0))


def test_vehicle_without_vision_has_no_report() -> None:
    """Topics that a vehicle also sends without an external position do not create a report."""
    watch = VisionWatch()
    add(watch, "vehicle_local_position", 5.0, eph=0.1)
    add(watch, "vehicle_attitude", 5.0)
    assert watch.reports({"wing"}, {}) == {}


def test_report_of_fused_positions() -> None:
    """A vehicle with aid messages has a report of what is fused."""
    watch = VisionWatch()
    for step in range(40):
        time = 5 + step / 40
        add(
            watch,
            "estimator_aid_src_ev_pos",
            time,
            fused=True,
            innovation_rejected=False,
            test_ratio=(0.1, 0.2),
        )
    report = watch.reports({"wing", "quad"}, {})["wing"]
    assert report.used
    assert report.lines[0] == "position fused since 5.0 s"


def test_sent_positions_without_evidence_have_a_report() -> None:
    """A vehicle into which a service sends positions has a report, which names the evidence that lacks."""
    reports = VisionWatch().reports({"wing", "quad"}, SENT)
    assert set(reports) == {"wing"}
    assert reports["wing"].used is None
    assert (
        reports["wing"]
        .lines[0]
        .startswith("sent: 3 positions of mocap/vehicle_visual_odometry sent, 50.0 Hz")
    )
    assert any(
        line.startswith("not in the data: estimator_aid_src_ev_*") for line in reports["wing"].lines
    )


def test_vehicles_that_left_the_page_are_forgotten() -> None:
    """A vehicle that is no longer on the page costs no memory, and begins anew when it returns."""
    watch = VisionWatch()
    add(watch, "vehicle_mocap_odometry", 5.0)
    assert set(watch.reports({"wing"}, {})) == {"wing"}
    assert watch.reports(set(), SENT) == {}
    assert watch.reports({"wing"}, {}) == {}
