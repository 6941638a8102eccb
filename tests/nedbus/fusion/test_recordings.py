"""Fusion in recordings of a real PX4: right input, and the mistakes that it ignores without a word."""

from __future__ import annotations

from functools import cache
from typing import Final

import pytest

import nedbus
from nedbus.fusion import FUSION_TOPICS, Cause, Fusion, FusionTracker
from tests.flights.ulogs import LOGS
from tests.peers.command_line import run_command

PX4: Final = LOGS.parent / "px4"
RIGHT: Final = PX4 / "ev_right.ulg"
REFUSED: Final = PX4 / "ev_refused.ulg"
ALL: Final = ("position", "height", "velocity", "yaw")
# The mistakes in ev_refused, by the time of their first message [s since boot], from its timeline; and which quantities
# are not fused because of it.
MISTAKES: Final = {
    "frame 0": (13.10, Cause.POSE_FRAME, ("position", "height", "velocity")),
    "q zero": (17.18, Cause.QUATERNION, ("yaw",)),
    "z NaN": (21.24, Cause.POSE_FRAME, ("position", "height", "velocity")),
    "estimator type": (33.58, Cause.TYPE, ALL),
    "EKF2_EV_CTRL": (36.40, "bit ", ALL),
    "4.2 Hz": (41.70, Cause.RATE, ALL),
    "reset_counter": (45.70, Cause.COUNTER, ("position", "height", "yaw")),
    "old": (57.84, "time_usec is 0.3 s old", ALL),
    "ahead": (65.96, "a message was stamped 3600 s ahead", ALL),
}
pytestmark = [
    pytest.mark.logs,
    pytest.mark.skipif(not RIGHT.exists(), reason=f"no recording: {RIGHT}"),
]


@cache
def reports(name: str) -> list[tuple[float, Fusion]]:
    """Return the report after each message, with its time since boot [s]."""
    tracker, found = FusionTracker(), list[tuple[float, Fusion]]()
    with nedbus.open(PX4 / name) as flight:
        for sample in flight("*"):
            if sample.topic in FUSION_TOPICS:
                tracker.add(sample.topic, sample.message)
                found.append((tracker.now / 1e6, tracker.fusion(sample.vehicle)))
    return found


def causes_at(report: Fusion) -> dict[str, str]:
    return {quantity.name: quantity.cause for quantity in report.quantities if quantity.cause}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistake_is_named_within_1_s(mistake: str) -> None:
    """1 s after the first wrong message, each quantity that EKF2 does not fuse has the cause of the mistake."""
    begin, cause, names = MISTAKES[mistake]
    after = [
        report for time, report in reports("ev_refused.ulg") if begin + 1.0 <= time <= begin + 1.2
    ]
    assert after
    for report in after:
        found = causes_at(report)
        assert {*names} <= found.keys() | ({*ALL} - {*names})
        assert all(found[name].startswith(cause) for name in names), found
        assert all(q.state == "fused" for q in report.quantities if q.name not in names)


def test_large_variances_are_fused_but_not_used() -> None:
    """With variances of 1e6, EKF2 reports fusion; the remark says that it has no effect."""
    after = [report for time, report in reports("ev_refused.ulg") if 26.5 <= time <= 27.5]
    assert all(report.used and Cause.VARIANCES in report.remarks for report in after)


@pytest.mark.slow
def test_right_input_is_fused_within_1_s() -> None:
    """One second after the first message, all quantities are fused."""
    for begin in (3.31, 35.2):  # at the start, and after 2.5 s without vision
        _, report = next(each for each in reports("ev_right.ulg") if each[0] >= begin + 1.0)
        assert [quantity.state for quantity in report.quantities] == ["fused"] * 4
        assert report.used


@pytest.mark.slow
def test_jump_with_reset_counter_is_no_rejection() -> None:
    """A jump of 2.2 m with a new reset_counter leaves position fused; back without it, it is rejected for 1 s."""
    states = [(time, report.quantities[0]) for time, report in reports("ev_right.ulg")]
    assert {quantity.state for time, quantity in states if 20 < time < 26.9} == {"fused"}
    [rejected] = {quantity.cause for _, quantity in states if quantity.state == "rejected"}
    assert rejected == Cause.JUMP
    times = [time for time, quantity in states if quantity.state == "rejected"]
    assert 27.0 < times[0] < 27.6
    assert times[-1] < 29.2


def test_right_input_has_no_cause() -> None:
    """While vision arrives as it should, no quantity has a cause, and there is no remark."""
    calm = [
        report for time, report in reports("ev_right.ulg") if 4.5 < time < 26.9 or 36.5 < time < 52
    ]
    assert len(calm) > 1000
    assert not any(report.causes or report.remarks or report.missing for report in calm)


def test_end_of_vision_is_seen() -> None:
    """0.6 s after the last message nothing is received, and the sender has stopped."""
    [*_, (_, last)] = reports("ev_right.ulg")
    assert {quantity.state for quantity in last.quantities} == {"not received"}
    assert last.causes == (Cause.STOPPED,)


@pytest.mark.slow
def test_command_reports_a_log() -> None:
    """`nedbus fusion FILE` prints one report per change, with times since boot."""
    out = run_command("fusion", str(RIGHT)).out
    assert "2: 3.9 s: position, height, velocity, yaw fused since 3.5 s" in out
    assert "position rejected (test ratio 14) since 27.1 s: the position jumped" in " ".join(
        out.split()
    )
