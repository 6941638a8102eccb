"""Fusion of synthetic messages: the mistakes that no recording has, with the numbers of a PX4 that flew them."""

from __future__ import annotations

import math
import random
from typing import Any, Final

import pytest
from hypothesis import given, strategies as st

from nedbus.fusion import FUSION_TOPICS, QUANTITIES, Cause, Fusion, FusionTracker
from nedbus.health import PositionStatus

RATE: Final = 40  # Hz
RIGHT: Final = dict.fromkeys(QUANTITIES, 0.0)  # share of rejected measurements
ECHO: Final[dict[str, Any]] = {
    "pose_frame": 1, "velocity_frame": 1, "velocity": (0.0, 0.0, 0.0), "q": (1.0, 0.0, 0.0, 0.0),
    "position_variance": (0.01, 0.01, 0.01), "reset_counter": 0, "quality": 100,
}  # fmt: skip


class Vehicle:
    """PX4's messages while vision arrives at RATE: measurements are fused, or rejected with the given shares."""

    def __init__(self) -> None:
        self.tracker, self.time, self._random = FusionTracker(), 100_000_000, random.Random(1)

    def fly(
        self,
        seconds: float,
        rejected: dict[str, float] = RIGHT,
        *,
        ratio: float = 0.01,
        **echo: Any,
    ) -> list[Fusion]:
        """Return the report after each step."""
        reports = []
        for _ in range(round(seconds * RATE)):
            self.time += 1_000_000 // RATE
            fields = {"timestamp": self.time, "timestamp_sample": self.time} | ECHO | echo
            self.tracker.add("vehicle_visual_odometry", fields)
            for name, share in rejected.items():
                is_rejected = self._random.random() < share
                self.tracker.add(
                    f"estimator_aid_src_ev_{QUANTITIES[name]}",
                    {
                        "timestamp": self.time, "fused": not is_rejected, "innovation_rejected": is_rejected,
                        "test_ratio": ratio, "estimator_instance": 0,
                    },
                )  # fmt: skip
            reports.append(self.tracker.fusion("1"))
        return reports


# Shares of rejected measurements of a PX4 in flight, of main of 2026-08-21.
IN_FLIGHT: Final = {
    "z up": (RIGHT | {"height": 256 / 291}, {"height": Cause.UP}),
    "ENU as NED": (
        {"position": 79 / 220, "height": 202 / 220, "velocity": 180 / 220, "yaw": 0.0},
        dict.fromkeys(("position", "height", "velocity"), Cause.ENU),
    ),
    "turned by 90 degrees": (
        {"position": 241 / 435, "height": 0.0, "velocity": 326 / 435},
        dict.fromkeys(("position", "velocity"), Cause.TURNED),
    ),
    "240 ms late": (RIGHT | {"velocity": 118 / 448}, {"velocity": Cause.DELAY}),
    "q in another order": (RIGHT | {"yaw": 1.0}, {"yaw": Cause.QUATERNION_ORDER}),
}


@pytest.mark.parametrize("mistake", IN_FLIGHT)
def test_mistake_in_flight_is_named_within_2_s(mistake: str) -> None:
    """The rejected quantities together show which axes, order or delay are wrong."""
    rejected, causes = IN_FLIGHT[mistake]
    vehicle = Vehicle()
    vehicle.fly(2.0)
    reports = vehicle.fly(2.0, rejected, ratio=140.0 if "order" in mistake else 3.0)
    seen = [
        {each.name: each.cause for each in report.quantities if each.state == "rejected"}
        for report in reports
    ]
    assert causes in seen


def test_body_flu_is_named() -> None:
    """An unknown child_frame_id costs the velocity alone."""
    [*_, report] = Vehicle().fly(
        2.0, {"position": 0.0, "height": 0.0, "yaw": 0.0}, velocity_frame=0
    )
    assert report.causes == (Cause.VELOCITY_FRAME,)
    assert [each.state for each in report.quantities] == ["fused", "fused", "not received", "fused"]


def test_velocity_alone_is_not_fused_without_its_bit() -> None:
    """A velocity that EKF2 does not report while it fuses the position has no bit in EKF2_EV_CTRL."""
    [*_, report] = Vehicle().fly(2.0, {"position": 0.0, "height": 0.0, "yaw": 0.0})
    assert report.causes == (
        "bit 4 of EKF2_EV_CTRL is not set, or quality 100 is below EKF2_EV_QMIN",
    )


def test_bias_against_gnss_is_named() -> None:
    """With GNSS, a position that is 8.6 m off is fused with a tiny test ratio: the bias alone shows the offset."""
    vehicle = Vehicle()
    vehicle.fly(2.0, ratio=1e-7)
    assert vehicle.tracker.fusion("1").remarks == ()
    vehicle.tracker.add(
        "estimator_ev_pos_bias", {"timestamp": vehicle.time, "bias": (7.0, -5.0, 0.0)}
    )
    report = vehicle.fly(1.0, ratio=1e-7)[-1]
    assert report.used
    assert report.bias == (7.0, -5.0)
    [remark] = report.remarks
    assert remark.startswith(
        "with GNSS, EKF2 gives vision a bias of 8.6 m: the estimate follows GNSS"
    )
    assert "bias against GNSS 7.0 m north, -5.0 m east" in "\n".join(report.lines)
    vehicle.tracker.add(
        "estimator_ev_pos_bias", {"timestamp": vehicle.time, "bias": (0.3, -0.2, 0.0)}
    )
    assert vehicle.fly(1.0)[-1].remarks == ()


def test_norm_of_q_within_1e_5_is_right() -> None:
    """A norm of 0.99999 is fused; 0.999 is not, although a validator accepts it."""
    [*_, right] = Vehicle().fly(2.0, q=(0.999995, 0.0, 0.0, 0.0))
    assert not right.causes
    [*_, wrong] = Vehicle().fly(2.0, RIGHT | {"yaw": 1.0}, q=(0.999, 0.0, 0.0, 0.0), ratio=math.nan)
    assert wrong.causes == (Cause.QUATERNION,)


def test_motion_capture_is_named() -> None:
    """Messages on vehicle_mocap_odometry instead of the echo show the wrong estimator_type."""
    vehicle = Vehicle()
    vehicle.fly(2.0)
    for _ in range(2 * RATE):
        vehicle.time += 1_000_000 // RATE
        vehicle.tracker.add("vehicle_mocap_odometry", {"timestamp": vehicle.time})
        vehicle.tracker.add("vehicle_local_position", {"timestamp": vehicle.time, "eph": 0.1})
    report = vehicle.tracker.fusion("1")
    assert report.causes == (Cause.MOCAP,)
    assert report.used is False


def test_sent_without_an_echo_is_named() -> None:
    """A service sends positions, and PX4 publishes none of them."""
    vehicle = Vehicle()
    vehicle.fly(2.0)
    vehicle.tracker.add(
        "vehicle_local_position", {"timestamp": vehicle.time + 1_000_000, "eph": 0.1}
    )
    report = vehicle.tracker.fusion("1", PositionStatus(vehicle="1", sent=100, rate=50.0))
    assert report.causes == (Cause.NO_ECHO,)


def test_messages_that_decide_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of more measurements within a second than the limit, only the newest decide: all are fused."""
    monkeypatch.setattr("nedbus.limits.FUSION_MESSAGES", 10)
    vehicle = Vehicle()
    vehicle.fly(0.7, RIGHT | {"height": 1.0})
    report = vehicle.fly(0.25)[-1]  # ten messages
    height = next(quantity for quantity in report.quantities if quantity.name == "height")
    assert height.state == "fused"
    assert len(vehicle.tracker._echo_times) == 10


def test_missing_evidence_is_named_and_flags_are_used() -> None:
    """Without aid topics, the flags of EKF2 show what is fused, and the report names the topics to log."""
    tracker, time = FusionTracker(), 100_000_000
    flags = {"cs_ev_pos": True, "cs_ev_hgt": True, "cs_ev_vel": False, "cs_ev_yaw": False}
    for _ in range(3 * RATE):
        time += 1_000_000 // RATE
        tracker.add("vehicle_visual_odometry", {"timestamp": time, "timestamp_sample": time} | ECHO)
        tracker.add("estimator_status_flags", {"timestamp": time} | flags)
    report = tracker.fusion("1")
    assert [each.state for each in report.quantities] == ["fused", "fused", "not used", "not used"]
    assert report.missing[0].startswith("estimator_aid_src_ev_*")
    assert "logger_topics.txt" in report.missing[0]


@pytest.mark.parametrize(("is_valid", "remarks"), [(True, ()), (False, (Cause.NOT_VALID,))])
def test_validity_is_the_evidence_without_a_log_stream(
    is_valid: bool, remarks: tuple[str, ...]
) -> None:
    """MAVLink has neither echo nor aid messages: xy_valid, from ESTIMATOR_STATUS, shows that nothing is used."""
    tracker = FusionTracker()
    tracker.add(
        "vehicle_local_position", {"timestamp": 5_000_000, "eph": 0.1, "xy_valid": is_valid}
    )
    assert tracker.fusion("1").remarks == ()
    report = tracker.fusion("1", PositionStatus(vehicle="1", sent=90, rate=30.0))
    assert report.remarks == remarks
    assert set(remarks) <= {*report.lines}
    assert report.missing


@pytest.mark.parametrize(("clock", "is_named"), [("arrival", True), ("timesync", False)])
def test_measured_age_is_the_delay_to_set(clock: str, is_named: bool) -> None:
    """While PX4 stamps positions on arrival, the report names their age as the value of EKF2_EV_DELAY."""
    sent = PositionStatus(
        vehicle="1", address="mocap/vehicle_odometry", sent=90, rate=30.0, age=0.0124, clock=clock
    )
    [line] = [line for line in FusionTracker().fusion("1", sent).lines if line.startswith("sent: ")]
    assert ("; set EKF2_EV_DELAY to 12 ms, plus the delay of the link" in line) == is_named


def test_vehicle_without_vision_has_no_cause() -> None:
    """Without vision nothing is known, and nothing is wrong."""
    tracker = FusionTracker()
    for index in range(100):
        tracker.add("vehicle_local_position", {"timestamp": 1_000_000 + index * 20_000, "eph": 0.3})
    report = tracker.fusion("1")
    assert (report.used, report.causes) == (None, ())
    assert {each.state for each in report.quantities} == {"unknown"}


def test_other_ekf_does_not_count() -> None:
    """Aid messages of an EKF that is not primary change nothing."""
    vehicle = Vehicle()
    vehicle.fly(1.0)
    vehicle.tracker.add(
        "estimator_aid_src_ev_pos",
        {
            "timestamp": vehicle.time,
            "fused": False,
            "innovation_rejected": True,
            "test_ratio": 9.0,
            "estimator_instance": 1,
        },
    )
    assert vehicle.tracker.fusion("1").quantities[0].ratio == 0.01


@pytest.mark.parametrize("seconds", [20, pytest.param(600, marks=pytest.mark.slow)])
def test_right_input_raises_no_alarm(seconds: int) -> None:
    """Right input of which EKF2 rejects a measurement in a hundred has no cause, also not in 10 minutes."""
    vehicle = Vehicle()
    vehicle.fly(1.0)
    for _ in range(seconds):
        assert not any(
            report.causes for report in vehicle.fly(1.0, dict.fromkeys(QUANTITIES, 0.01))
        )


def test_reboot_begins_anew() -> None:
    """After a reboot, two messages in a row from before, the state is that of the new boot."""
    vehicle = Vehicle()
    vehicle.fly(2.0, RIGHT | {"yaw": 1.0})
    vehicle.time = 5_000_000
    [*_, report] = vehicle.fly(2.0)
    assert {each.state for each in report.quantities} == {"fused"}
    assert all(each.since is not None and each.since < 7 for each in report.quantities)


def test_single_wild_time_changes_nothing() -> None:
    """One damaged timestamp, far ahead or back, has no effect on the states."""
    vehicle = Vehicle()
    vehicle.fly(2.0)
    for wild in (2**63, 1):
        vehicle.tracker.add("vehicle_local_position", {"timestamp": wild, "eph": 0.1})
        [*_, report] = vehicle.fly(0.2)
        assert {each.state for each in report.quantities} == {"fused"}


_VALUES: Final = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**70), 2**70), st.floats(), st.text(max_size=3), st.binary(max_size=3),
    st.lists(st.one_of(st.floats(), st.text(max_size=2), st.none()), max_size=4),
)  # fmt: skip
_FIELDS: Final = (
    "timestamp_sample", "fused", "innovation_rejected", "test_ratio", "estimator_instance", "bias", "text",
    "primary_instance", "eph", "cs_ev_pos",
)  # fmt: skip


@pytest.mark.slow
@given(
    st.lists(
        st.tuples(
            st.sampled_from([topic for topic in FUSION_TOPICS if topic != "vehicle_visual_odometry"]),
            st.integers(0, 2**64 - 1), st.dictionaries(st.sampled_from(_FIELDS), _VALUES),
        ),
        max_size=30,
    )
)  # fmt: skip
def test_fields_of_any_type_raise_nothing(messages: list[tuple[str, int, dict[str, Any]]]) -> None:
    """Topics that nedbus does not define may hold fields of any type; each report can be printed."""
    tracker = FusionTracker()
    for topic, time, fields in messages:
        tracker.add(topic, {"timestamp": time} | fields)
        assert tracker.fusion("1").lines
