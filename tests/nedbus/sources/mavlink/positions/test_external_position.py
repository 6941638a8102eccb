"""External position: what is sent as ODOMETRY, what is refused, and the time that it carries."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, strategies as st
from pymavlink.dialects.v20 import common as dialect

from nedbus import VehicleLocalPosition, VehicleOdometry
from nedbus.mavlink import AGE_LIMIT, RATE_LIMIT, UNKNOWN_VARIANCE, ExternalPosition
from nedbus.mavlink.external_position import Outcome, odometry_of
from nedbus_msgs import codec_of

NAN = math.nan
SECOND = 1_000_000  # us


def odometry(time: float = 0.0, **changes: Any) -> VehicleOdometry:
    """Return a valid position, measured and published at `time` [s] of the publisher's clock."""
    stamp = round(time * SECOND) + 5_000_000_000
    fields: dict[str, Any] = {
        "timestamp": stamp, "timestamp_sample": stamp, "pose_frame": 1, "position": [1.0, 2.0, -3.0],
        "q": [1.0, 0.0, 0.0, 0.0], "velocity_frame": 1, "velocity": [0.1, 0.2, 0.3], "angular_velocity": [0.0] * 3,
        "position_variance": [0.01, 0.02, 0.03], "orientation_variance": [0.04, 0.05, 0.06],
        "velocity_variance": [0.07, 0.08, 0.09], "reset_counter": 7, "quality": 90,
    }  # fmt: skip
    return VehicleOdometry.model_validate(fields | changes)


def local_position(time: float = 0.0, **changes: Any) -> VehicleLocalPosition:
    stamp = round(time * SECOND) + 5_000_000_000
    fields: dict[str, Any] = {
        "timestamp": stamp, "timestamp_sample": stamp, "xy_valid": True, "z_valid": True, "v_xy_valid": True,
        "v_z_valid": True, "x": 1.0, "y": 2.0, "z": -3.0, "vx": 0.1, "vy": 0.2, "vz": 0.3, "heading": 1.0,
        "heading_good_for_control": True, "heading_var": 0.25, "eph": 2.0, "epv": 3.0, "evh": 0.4, "evv": 0.5,
    }  # fmt: skip
    return VehicleLocalPosition.model_validate(fields | changes)


def send(position: Any, now: float = 100.0) -> Outcome:
    return ExternalPosition().add(position, "a", now)


def sent(outcome: Outcome) -> Any:
    """Return the ODOMETRY message that pymavlink finds in the frame of an outcome."""
    assert outcome.odometry is not None
    frame = outcome.odometry.frame(outcome.time_usec, system=4, sequence=200)
    return dialect.MAVLink(None).decode(bytearray(frame))


def refusal(position: Any) -> tuple[str, str]:
    """Return kind and text of the refusal of a single position."""
    outcome = send(position)
    assert outcome.odometry is None
    assert outcome.refusal is not None
    return outcome.refusal


def test_odometry_is_sent_as_published() -> None:
    """Frames, values, variances, counter and quality of VehicleOdometry stand in ODOMETRY; the type is VISION."""
    message = sent(send(odometry()))
    assert (message.frame_id, message.child_frame_id, message.estimator_type) == (1, 1, 2)
    assert (message.x, message.y, message.z) == pytest.approx((1, 2, -3))
    assert (message.vx, message.vy, message.vz) == pytest.approx((0.1, 0.2, 0.3))
    assert [message.pose_covariance[each] for each in (0, 6, 11, 15, 18, 20)] == pytest.approx(
        [0.01, 0.02, 0.03, 0.04, 0.05, 0.06]
    )
    assert [message.velocity_covariance[each] for each in (0, 6, 11)] == pytest.approx(
        [0.07, 0.08, 0.09]
    )
    assert sum(map(math.isnan, message.pose_covariance)) == 15
    assert (message.reset_counter, message.quality) == (7, 90)
    assert (message.get_srcSystem(), message.get_srcComponent(), message.get_seq()) == (4, 197, 200)


@given(
    st.fixed_dictionaries({
        "position": st.lists(st.floats(-1000, 1000, width=32), min_size=3, max_size=3),
        "reset_counter": st.integers(0, 255),
        "quality": st.integers(-1, 100),
    }),
    st.integers(1, 250), st.integers(0, 255), st.integers(0, 2**60),
)  # fmt: skip
def test_frame_is_that_of_pymavlink(
    fields: dict[str, Any], system: int, sequence: int, time_usec: int
) -> None:
    """The frame is byte for byte the one that pymavlink packs from the same fields, also with zeros at its end."""
    packed = odometry_of(odometry(**fields))
    frame = packed.frame(time_usec, system=system, sequence=sequence)
    encoder = dialect.MAVLink(None, system, 197)
    encoder.seq = sequence
    message = dialect.MAVLink(None).decode(bytearray(frame))
    assert message.pack(encoder) == frame


@pytest.mark.parametrize("model", [odometry(), local_position()])
def test_row_is_converted_like_its_model(model: Any) -> None:
    """A service decodes positions as rows, which take less processor time than models."""
    codec = codec_of(type(model).DEFINITION)
    row = codec.decode_row(codec.encode(model))
    assert type(row) is not type(model)
    assert repr(odometry_of(row)) == repr(odometry_of(model))


@pytest.mark.parametrize(
    ("pose", "velocity", "frames"), [(2, 2, (20, 20)), (1, 3, (1, 12)), (2, 3, (20, 12))]
)
def test_frames_are_those_that_px4_knows(pose: int, velocity: int, frames: tuple[int, int]) -> None:
    """FRD is MAV_FRAME_LOCAL_FRD (20), body FRD is MAV_FRAME_BODY_FRD (12)."""
    message = sent(send(odometry(pose_frame=pose, velocity_frame=velocity)))
    assert (message.frame_id, message.child_frame_id) == frames


@pytest.mark.parametrize(
    ("changes", "kind", "words"),
    [
        ({"pose_frame": 0}, "pose_frame", "pose_frame is 0: set it to POSE_FRAME_NED (1)"),
        ({"pose_frame": 16}, "pose_frame", "pose_frame is 16"),
        ({"velocity_frame": 0}, "velocity_frame", "velocity_frame is 0: set it to 1 (NED)"),
        ({"position": [1.0, 2.0, NAN]}, "position", "position is [1.0, 2.0, nan]: PX4 drops all three"),
        ({"position": [1.0, math.inf, 0.0]}, "position", "its variance to 1e+06"),
        ({"velocity": [1.0, NAN, 0.0]}, "velocity", "velocity is [1.0, nan, 0.0]"),
        ({"q": [0.95, 0.0, 0.0, 0.0]}, "q", "norm 0.95: send a unit quaternion (w, x, y, z)"),
        ({"position_variance": [-0.1, 0.1, 0.1]}, "variance", "position_variance is -0.1: set NaN"),
        ({"velocity_variance": [0.1, 1e9, 0.1]}, "variance", "velocity_variance is 1e+09"),
        ({"orientation_variance": [0.1, 0.1, math.inf]}, "variance", "orientation_variance is inf"),
    ],
)  # fmt: skip
def test_position_that_px4_would_ignore_is_refused(
    changes: dict[str, Any], kind: str, words: str
) -> None:
    """A refusal names the field, its value and the remedy."""
    found, text = refusal(odometry(**changes))
    assert found == kind
    assert words in text


@given(
    st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: math.hypot(*q) > 0.1),
    st.floats(0.991, 1.009),
)
def test_quaternion_is_normalised_within_a_hundredth(q: list[float], scale: float) -> None:
    """A quaternion of few decimals is sent with the norm that EKF2 requires: 1 within 1e-5."""
    norm = math.hypot(*q)
    unit = sent(send(odometry(q=[scale * part / norm for part in q]))).q
    assert abs(math.hypot(*unit) - 1) < 1e-5
    assert unit == pytest.approx([part / norm for part in q], abs=1e-6)


@pytest.mark.parametrize("q", [[NAN] * 4, [0.0] * 4])
def test_unknown_attitude_is_nan(q: list[float]) -> None:
    """An unknown attitude is NaN, with which PX4 ends the fusion of yaw alone."""
    assert all(map(math.isnan, sent(send(odometry(q=q))).q))


def test_unknown_position_has_a_large_variance() -> None:
    """A message without a position has no NaN in a coordinate, which would also end the fusion of velocity."""
    message = sent(send(odometry(position=[NAN] * 3, position_variance=[NAN] * 3)))
    assert (message.x, message.y, message.z) == (0, 0, 0)
    assert [message.pose_covariance[each] for each in (0, 6, 11)] == [UNKNOWN_VARIANCE] * 3


def test_unknown_velocity_is_left_out() -> None:
    """A message without a velocity is sent, whatever its velocity_frame."""
    message = sent(send(odometry(velocity=[NAN] * 3, velocity_frame=0)))
    assert all(map(math.isnan, (message.vx, message.vy, message.vz)))
    assert message.child_frame_id == 12


def test_local_position_is_sent_with_a_yaw_only_attitude() -> None:
    """Eph^2 / 2 and epv^2 are variances of position, evh and evv those of velocity; roll and pitch are unknown."""
    message = sent(send(local_position()))
    assert (message.frame_id, message.child_frame_id) == (1, 1)
    assert message.q == pytest.approx([math.cos(0.5), 0, 0, math.sin(0.5)])
    assert [message.pose_covariance[each] for each in (0, 6, 11)] == pytest.approx([2, 2, 9])
    assert [message.pose_covariance[each] for each in (15, 18, 20)] == pytest.approx(
        [1e6, 1e6, 0.25]
    )
    assert [message.velocity_covariance[each] for each in (0, 6, 11)] == pytest.approx(
        [0.08, 0.08, 0.25]
    )


def test_invalid_parts_of_a_local_position_get_a_large_variance() -> None:
    """What is not valid is no NaN: x and y keep their values with the variance of an unknown quantity."""
    message = sent(
        send(
            local_position(xy_valid=False, v_z_valid=False, vz=NAN, heading_good_for_control=False)
        )
    )
    assert (message.x, message.y) == (1, 2)
    assert [message.pose_covariance[each] for each in (0, 6, 11)] == pytest.approx([1e6, 1e6, 9])
    assert message.vz == 0
    assert message.velocity_covariance[11] == UNKNOWN_VARIANCE
    assert all(map(math.isnan, message.q))


def test_local_position_without_anything_valid_is_refused() -> None:
    """A position without a valid quantity is not sent."""
    nothing = dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"), False)
    assert refusal(local_position(**nothing))[0] == "validity"


def test_reset_counter_of_a_local_position_counts_all_resets() -> None:
    """A reset of any quantity changes reset_counter, and the number depends on the message alone."""
    counters = {"xy_reset_counter": 250, "z_reset_counter": 3, "heading_reset_counter": 5}
    assert sent(send(local_position(**counters))).reset_counter == (250 + 3 + 5) % 256


def play(core: ExternalPosition, times: list[tuple[float, float]], **changes: Any) -> list[Outcome]:
    """Add positions, each with (publisher's clock, arrival)."""
    return [core.add(odometry(stamp, **changes), "a", now) for stamp, now in times]


def test_rate_is_at_most_50_per_second() -> None:
    """Of 200 positions a second, 50 are sent; the others are counted."""
    core = ExternalPosition()
    play(core, [(each / 200, 100 + each / 200) for each in range(400)])
    assert core.sent == pytest.approx(2 * RATE_LIMIT, abs=2)
    assert core.sent + core.left_out["rate"] == 400


@pytest.mark.slow
@given(st.lists(st.floats(-0.004, 0.004), min_size=100, max_size=100))
def test_jitter_costs_no_message(jitter: list[float]) -> None:
    """At 50 Hz all positions are sent, although they arrive up to 4 ms early or late."""
    core = ExternalPosition()
    play(core, [(each / 50, 100 + each / 50 + late) for each, late in enumerate(jitter)])
    assert core.left_out["rate"] <= 2


def test_slow_publisher_is_warned() -> None:
    """Below 5 Hz, positions are sent with a warning, because PX4 never starts to fuse them."""
    last = play(ExternalPosition(), [(each / 4.2, 100 + each / 4.2) for each in range(20)])[-1]
    assert last.odometry is not None
    assert last.warning.startswith("4.2 messages per second: PX4 fuses none below 5")


def test_old_position_is_left_out() -> None:
    """A position that waited more than 100 ms on its way is not sent; the next one is."""
    core = ExternalPosition()
    outcomes = play(
        core, [(0.0, 100.0), (0.02, 100.02), (0.04, 100.16), (0.06, 100.165), (0.16, 100.17)]
    )
    assert [each.odometry is not None for each in outcomes] == [True, True, False, False, True]
    assert core.left_out == {"age": 2}
    assert "it is 120 ms old, more than 100" in (outcomes[2].refusal or ("", ""))[1]


def test_age_includes_that_of_the_measurement() -> None:
    """The age is `timestamp - timestamp_sample` plus the way on the bus; it is subtracted from time_usec."""
    core = ExternalPosition()
    core.add(odometry(0.0), "a", 100.0)
    late = odometry(0.02)
    older = late.model_copy(update={"timestamp_sample": late.timestamp - 30_000})
    outcome = core.add(older, "a", 100.03)
    assert core.age == pytest.approx(0.04)
    assert outcome.time_usec == pytest.approx(1e6 * 99.99, abs=2)


def test_time_must_rise() -> None:
    """The same message twice, and one that is older than the last, are refused."""
    core = ExternalPosition()
    outcomes = play(core, [(0.1, 100.1), (0.1, 100.12), (0.05, 100.13), (0.15, 100.15)])
    assert [each.odometry is not None for each in outcomes] == [True, False, False, True]
    assert core.left_out == {"time": 2}


def test_clock_step_of_the_publisher_costs_less_than_fusion_needs_to_stop() -> None:
    """After a step of a day in either direction, positions are sent again within 0.4 s, the limit of EKF2."""
    for step in (86_400.0, -86_400.0):
        core, sent = ExternalPosition(), []
        for index in range(200):
            stamp = 1e6 + index / 50 + (step if index >= 100 else 0.0)
            if core.add(odometry(stamp), "a", 100 + index / 50).odometry is not None:
                sent.append(index / 50)
        assert max(after - before for before, after in pairwise(sent)) < 0.4
        assert core.left_out["clock"] == 200 - len(sent)


def test_backlog_after_a_stall_is_not_sent() -> None:
    """Positions that arrive at once after a stall of 5 s are old, although their delay looks steady."""
    core = ExternalPosition()
    stall = [(1 + each / 50, 106 + each / 10_000) for each in range(250)]
    outcomes = play(core, [(each / 50, 100 + each / 50) for each in range(50)] + stall)
    assert not any(each.odometry for each in outcomes[50:295])


def test_wild_time_of_one_message_does_not_stop_the_others() -> None:
    """A single timestamp a day ahead is refused, and the next position is sent."""
    core = ExternalPosition()
    outcomes = play(core, [(0.0, 100.0), (86_400.0, 100.02), (0.04, 100.04)])
    assert [each.odometry is not None for each in outcomes] == [True, False, True]


@given(
    st.lists(
        st.tuples(st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1), st.floats(0, 10)),
        min_size=1,
        max_size=50,
    )
)
def test_nothing_is_stamped_ahead(messages: list[tuple[int, int, float]]) -> None:
    """Whatever the times of a publisher are, time_usec is never later than the transmission, nor older than 100 ms."""
    core, now = ExternalPosition(), 100.0
    for stamp, sample, pause in messages:
        now += pause
        outcome = core.add(odometry(timestamp=stamp, timestamp_sample=sample), "a", now)
        if outcome.odometry is not None:
            assert now - AGE_LIMIT - 1e-5 <= outcome.time_usec / 1e6 <= now


@given(st.lists(st.tuples(st.floats(-1e5, 1e5), st.floats(0, 0.2)), min_size=1, max_size=50))
def test_clock_steps_stamp_nothing_ahead(steps: list[tuple[float, float]]) -> None:
    """Steps of the publisher's clock, in any direction, stamp nothing ahead, and each position is counted."""
    core, now, clock = ExternalPosition(), 100.0, 1e6
    for step, pause in steps:
        now, clock = now + pause, clock + pause + step
        outcome = core.add(odometry(max(0.0, clock)), "a", now)
        assert outcome.odometry is None or outcome.time_usec / 1e6 <= now
    assert core.sent + core.left_out.total() == len(steps)


def test_wild_sample_time_is_not_used() -> None:
    """A timestamp_sample of another clock changes nothing, with a warning."""
    for wild in (3_600 * SECOND, -3_600 * SECOND):
        position = odometry(4000.0)
        outcome = send(position.model_copy(update={"timestamp_sample": position.timestamp + wild}))
        assert outcome.time_usec == 100 * SECOND
        assert "is 3600.0 s" in outcome.warning


def test_reset_counter_rises_exactly_with_the_publisher() -> None:
    """The counter of each message is sent unchanged, so a restarted service continues with it."""
    counters = [0, 0, 1, 1, 1, 2, 255, 0]
    core, restarted = ExternalPosition(), ExternalPosition()
    for index, counter in enumerate(counters):
        used = core if index < 4 else restarted
        position = odometry(index / 50, reset_counter=counter)
        assert sent(used.add(position, "a", 100 + index / 50)).reset_counter == counter


def test_reset_counter_that_counts_messages_is_refused() -> None:
    """PX4 would reset its estimate with each message; once the counter stays, positions are sent again."""
    core = ExternalPosition()
    for index in range(20):
        outcome = core.add(odometry(index / 50, reset_counter=index), "a", 100 + index / 50)
    assert outcome.refusal is not None
    assert outcome.refusal.text.startswith("reset_counter 19 changes with each message")
    assert play(core, [(0.4, 100.4), (0.42, 100.42)], reset_counter=19)[-1].odometry is not None


def test_jump_without_a_new_counter_is_warned() -> None:
    """PX4 rejects such a jump for a second; with a new counter it follows."""
    core = ExternalPosition()
    core.add(odometry(0.0), "a", 100.0)
    outcome = core.add(odometry(0.02, position=[3.0, 2.0, -3.0]), "a", 100.02)
    assert outcome.odometry is not None
    assert outcome.warning.startswith("position jumped by 2.0 m and reset_counter stayed 7")
    assert not core.add(odometry(0.04, reset_counter=8), "a", 100.04).warning


@given(st.floats(0, 19), st.integers(6, 50))
def test_motion_is_no_jump(speed: float, rate: int) -> None:
    """A position that moves with less than 20 m/s, or with its velocity, is no jump."""
    core = ExternalPosition()
    for index in range(20):
        now = index / rate
        assert not core.add(odometry(now, position=[speed * now, 0.0, 0.0]), "a", 100 + now).warning


def test_second_sender_is_refused_with_the_name_of_the_first() -> None:
    """One sender at a time; another one is used once the first has been silent for a second."""
    core = ExternalPosition()
    core.add(odometry(0.0), "mocap (session 1)", 100.0)
    outcome = core.add(odometry(0.01), "vio (session 2)", 100.01)
    assert outcome.refusal is not None
    assert (
        "vio (session 2) publishes, too, but mocap (session 1) is the sender"
        in outcome.refusal.text
    )
    assert core.add(odometry(7.0), "vio (session 2)", 101.5).odometry is not None
    assert core.sender == "vio (session 2)"


def test_each_position_is_sent_or_counted() -> None:
    """The numbers of positions sent and left out add up."""
    core = ExternalPosition()
    kinds: list[dict[str, Any]] = [
        {},
        {"pose_frame": 0},
        {"q": [0.95, 0.0, 0.0, 0.0]},
        {"position": [NAN, 0.0, 0.0]},
    ]
    for index in range(100):
        core.add(odometry(index / 50, **kinds[index % 4]), "a", 100 + index / 50)
    assert core.sent + core.left_out.total() == 100
    assert core.left_out == {"pose_frame": 25, "q": 25, "position": 25}
