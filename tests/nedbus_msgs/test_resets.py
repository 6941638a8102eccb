"""Tracks without jumps: constructed cases, real logs with resets, and a simulation with ground truth."""

from __future__ import annotations

import math
import operator
from collections import defaultdict
from itertools import pairwise
from types import SimpleNamespace
from typing import cast

import pytest
from benchmarks.resets import UNITS, residuals

from nedbus_msgs import Continuous, ResetTracker, VehicleLocalPosition
from nedbus_msgs.frames import MapProjection
from tests.flights.local_position import upgrade
from tests.flights.messages import VLP
from tests.flights.replays import open_replay
from tests.flights.ulogs import LOGS

PLAIN: dict[str, object] = {
    "x": 0.0, "y": 0.0, "z": 0.0, "vx": 0.0, "vy": 0.0, "vz": 0.0, "heading": 0.0, "dist_bottom": 1.0,
    "delta_xy": (0.0, 0.0), "delta_vxy": (0.0, 0.0),
}  # fmt: skip


def at(seconds: float, **fields: object) -> VehicleLocalPosition:
    return VehicleLocalPosition.model_validate(
        {"timestamp": round(seconds * 1e6), **PLAIN, **fields}
    )


def track(*messages: VehicleLocalPosition) -> list[Continuous]:
    tracker = ResetTracker()
    return [tracker.add(message) for message in messages]


def test_delta_is_removed_when_counter_rises_by_one() -> None:
    """If the counter rises by one, the delta equals the jump and is subtracted from the track."""
    first, second, third = track(
        at(1, x=1.0, y=1.0),
        at(2, x=11.5, y=-3.5, xy_reset_counter=1, delta_xy=(10.0, -5.0)),
        at(3, x=12.0, y=-3.0, xy_reset_counter=1, delta_xy=(10.0, -5.0)),
    )
    assert (first.x, first.y) == (1.0, 1.0)
    assert (second.x, second.y) == (1.5, 1.5)
    assert (third.x, third.y) == (2.0, 2.0)
    assert second.reset == {"xy"}
    assert not second.discontinued
    assert not third.reset
    assert third.resets["xy"] == 1


@pytest.mark.parametrize(
    ("values", "delta", "counter", "jump"),
    [
        (("z",), "delta_z", "z_reset_counter", -4.0),
        (("vz",), "delta_vz", "vz_reset_counter", 0.5),
        (("heading",), "delta_heading", "heading_reset_counter", 0.25),
        (("dist_bottom",), "delta_dist_bottom", "dist_bottom_reset_counter", 2.0),
        (("vx", "vy"), "delta_vxy", "vxy_reset_counter", (0.5, -0.5)),
    ],
)
def test_every_quantity_has_its_own_delta(
    values: tuple[str, ...], delta: str, counter: str, jump: float | tuple[float, float]
) -> None:
    """Each counter applies to its own delta only."""
    steps = jump if isinstance(jump, tuple) else (jump,)
    jumped = {
        name: cast("float", PLAIN[name]) + step for name, step in zip(values, steps, strict=True)
    }
    first, second = track(at(1), at(2, **jumped, **{delta: jump, counter: 1}))
    for name in PLAIN:
        if not name.startswith("delta"):
            assert getattr(second, name) == getattr(first, name), name


def test_counter_wrap_counts_as_one_reset() -> None:
    """A counter that wraps from 255 to 0 counts one reset."""
    _, second = track(at(1, z_reset_counter=255), at(2, z=5.0, z_reset_counter=0, delta_z=5.0))
    assert second.z == 0.0
    assert second.resets["z"] == 1


def test_incomplete_delta_is_not_used() -> None:
    """After two resets between two messages the delta covers only the last one, so the step is removed."""
    _, second, third = track(
        at(1, z=1.0, vz=2.0),
        at(2, z=50.0, vz=2.0, z_reset_counter=2, delta_z=3.0),
        at(3, z=52.0, vz=2.0, z_reset_counter=2, delta_z=3.0),
    )
    assert not second.discontinued
    assert (second.z, third.z) == (3.0, 5.0)
    assert second.resets["z"] == 2


def test_incomplete_delta_after_a_long_pause_restarts_the_track() -> None:
    """After two resets and a pause, neither the delta nor the step is the jump, so the track restarts."""
    _, second, third = track(
        at(1, z=1.0),
        at(6, z=50.0, z_reset_counter=2, delta_z=3.0),
        at(7, z=51.0, z_reset_counter=2, delta_z=3.0),
    )
    assert second.discontinued == {"z"}
    assert (second.z, third.z) == (50.0, 51.0)
    assert not third.discontinued


def test_step_is_removed_where_the_delta_contradicts_it() -> None:
    """A real PX4 announced (5.80, -4.72) m, but its position stepped by (3.57, -2.73) m plus the motion."""
    _, second = track(
        at(14.0, x=1.0, vx=1.0, vy=0.5),
        at(14.02, x=4.59, y=-2.72, vx=1.0, vy=0.5, xy_reset_counter=1, delta_xy=(5.80, -4.72)),
    )
    assert (second.x, second.y) == pytest.approx((1.02, 0.01))


def test_rows_have_the_same_track_as_models() -> None:
    """The tracker accepts rows, which have the fields of models as attributes."""
    messages = at(1), at(1.1, x=5.0, xy_reset_counter=1, delta_xy=(5.0, 0.0))
    rows = [cast("VehicleLocalPosition", SimpleNamespace(**vars(message))) for message in messages]
    assert track(*rows) == track(*messages)


def test_announced_reset_of_zero_leaves_noise_in_the_track() -> None:
    """Millimetres of correction are no jump if the delta is zero."""
    _, second = track(at(1), at(1.02, x=-0.002, xy_reset_counter=1))
    assert second.x == pytest.approx(-0.002)


@pytest.mark.parametrize(("seconds", "kept"), [(0.1, 9.6), (0.02, 10.1)])
def test_acceleration_between_distant_messages_is_no_contradiction(
    seconds: float, kept: float
) -> None:
    """A difference of 7 mm from the delta is unknown motion after 100 ms, but not after 20 ms."""
    _, second = track(
        at(1), at(1 + seconds, x=kept + 0.007, xy_reset_counter=1, delta_xy=(kept, 0.0))
    )
    assert second.x == pytest.approx(0.007 if seconds == 0.1 else 0.0, abs=1e-6)


def test_turn_during_a_heading_reset_stays_in_the_track() -> None:
    """The heading turns on by as much as the gyroscopes' heading, whatever the delta says."""
    _, second = track(
        at(1, heading=3.1, unaided_heading=3.1, delta_heading=0.0),
        at(1.1, heading=-1.0, unaided_heading=-3.083, heading_reset_counter=1, delta_heading=1.5),
    )
    assert second.heading == pytest.approx(-3.083, abs=1e-3)


def test_height_rate_is_preferred_to_the_vertical_velocity() -> None:
    """The motion of z is z_deriv, the rate of the published z, and not vz, the velocity of the filter."""
    _, second = track(
        at(1, vz=5.0, z_deriv=1.0),
        at(1.1, z=20.1, vz=5.0, z_deriv=1.0, z_reset_counter=1, delta_z=0.0),
    )
    assert second.z == pytest.approx(0.1)


def test_reset_without_delta_restarts_the_track() -> None:
    """A reset without a delta, as in old layouts and from some sources, restarts the track."""
    _, second = track(at(1), at(2, heading=1.0, heading_reset_counter=1))
    assert second.discontinued == {"heading"}


def test_reordered_message_is_no_reboot() -> None:
    """A message that arrives late by less than a second continues the track."""
    _, _, late = track(
        at(10, x=1.0), at(10.1, x=4.0, xy_reset_counter=1, delta_xy=(3.0, 0.0)), at(10.05, x=1.0)
    )
    assert not late.discontinued & {"z", "heading"}


def test_backward_timestamp_restarts_the_track() -> None:
    """A timestamp that steps back, as after a reboot, starts a new track."""
    _, second, third = track(
        at(100, x=5.0),
        at(101, x=6.0, xy_reset_counter=1, delta_xy=(1.0, 0.0)),
        at(1, x=0.5, xy_reset_counter=0),
    )
    assert second.x == 5.0
    assert third.discontinued == {"xy", "z", "vxy", "vz", "heading", "dist_bottom"}
    assert third.x == 0.5
    assert not third.reset
    assert third.resets["xy"] == 1  # the counter begins again, which is no reset


def test_heading_without_a_jump_stays_within_half_a_turn() -> None:
    """A heading whose reset was removed is wrapped again when the vehicle turns through south."""
    *_, third = track(
        at(1, heading=0.0),
        at(2, heading=-1.0, heading_reset_counter=1, delta_heading=-1.0),
        at(3, heading=2.5, heading_reset_counter=1, delta_heading=-1.0),
    )
    assert third.heading == pytest.approx(3.5 - 2 * math.pi)


def test_delta_without_a_jump_at_a_new_origin_is_ignored() -> None:
    """A delta without a jump is ignored: as in a real log, delta_z is -179.5 m at a new origin, but z moves by 2 mm."""
    first, second = track(
        at(21.574, z=-0.2),
        at(21.674, z=-0.198, z_reset_counter=1, delta_z=-179.5362, z_global=True, ref_alt=179.5362),
    )
    assert second.origin_changed
    assert second.reset == {"z"}
    assert not second.discontinued
    assert second.z == pytest.approx(first.z + 0.002)


@pytest.mark.parametrize("counted", [0, 1])
def test_moved_origin_is_compensated(counted: int) -> None:
    """Coordinates shift by the distance between the origins, whether or not this is counted as a reset."""
    old, new = (47.0, 8.0, 400.0), (47.001, 8.002, 410.0)
    north, east = MapProjection(new[0], new[1]).project(old[0], old[1])

    def origin(*position: float) -> dict[str, object]:
        return {
            "xy_global": True,
            "z_global": True,
            **dict(zip(("ref_lat", "ref_lon", "ref_alt"), position, strict=True)),
        }

    moved = {"xy_reset_counter": counted, "z_reset_counter": counted, **origin(*new)}
    first, second = track(
        at(1.0, x=3.0, vx=1.0, **origin(*old)),
        at(1.1, x=3.1 + north, y=east, z=10.0, vx=1.0, **moved),
    )
    assert second.origin_changed
    assert not second.discontinued
    assert (second.x, second.y, second.z) == pytest.approx((first.x + 0.1, 0.0, 0.0), abs=1e-3)


def test_unexplained_jump_at_a_new_origin_restarts_the_track() -> None:
    """After a pause, a jump explained neither by the delta nor by the origins is kept, and restarts the track."""
    _, second = track(at(1), at(6, x=500.0, xy_global=True, ref_lat=47.0, ref_lon=8.0))
    assert second.discontinued == {"xy"}
    assert second.x == 500.0


@pytest.mark.slow
def test_track_follows_simulated_ground_truth() -> None:
    """The track follows the ground truth through a GPS outage and the resets of a simulated lap."""
    truth: dict[object, tuple[float, ...]] = {}
    tracker = ResetTracker()
    estimates: list[tuple[VehicleLocalPosition, Continuous]] = []
    for source_message in open_replay("sim:?duration=95").messages:
        fields = source_message.fields
        if source_message.address.topic == "vehicle_local_position_groundtruth":
            truth[fields["timestamp"]] = tuple(cast("float", fields[name]) for name in "xyz")
        elif source_message.address.topic == VLP:
            message = upgrade(fields)
            estimates.append((message, tracker.add(message)))
    raw_worst = worst = 0.0
    for (before, smooth), (after, smooth_after) in pairwise(estimates[::2]):
        then, now = truth[before.timestamp], truth[after.timestamp]
        raw = (after.x - before.x, after.y - before.y, after.z - before.z)
        moved = (smooth_after.x - smooth.x, smooth_after.y - smooth.y, smooth_after.z - smooth.z)
        real = tuple(map(operator.sub, now, then))
        raw_worst, worst = max(raw_worst, math.dist(raw, real)), max(worst, math.dist(moved, real))
    resets = estimates[-1][1].resets
    assert {name for name, count in resets.items() if count} == {"xy", "z", "vxy", "heading"}
    assert raw_worst > 1.0
    assert worst < 0.2
    assert not any(smooth.discontinued for _, smooth in estimates)


@pytest.mark.logs
@pytest.mark.long
@pytest.mark.parametrize("thinned", [False, True])
def test_track_is_closer_than_with_deltas_or_steps_alone(thinned: bool) -> None:
    """At the resets of all logs, at full rate and at 10 Hz, the track is off by less than with either rule alone."""
    sums: defaultdict[tuple[str, str], float] = defaultdict(float)
    for quantity, by_rule in residuals(LOGS.parent, thinned=thinned).items():
        for rule, found in by_rule.items():
            sums[UNITS[quantity], rule] += sum(found)
    for unit in set(UNITS.values()):
        assert sums[unit, "rule"] < min(sums[unit, "delta"], sums[unit, "step"])


@pytest.mark.slow
@pytest.mark.logs
@pytest.mark.parametrize(
    ("name", "raw", "smooth"),
    [("fmuv6c_1.17_selector_whipsaw.ulg", 130.0, 3.0), ("nxp_v0_ekf_failure.ulg", 25.0, 6.0)],
)
def test_resets_in_real_logs_are_removed(name: str, raw: float, smooth: float) -> None:
    """Steps that velocity does not explain are large in the messages and small in the track."""
    if not (LOGS / name).exists():
        pytest.skip(f"real logs not found: {LOGS}")
    worst: dict[str, float] = defaultdict(float)
    tracker = ResetTracker()
    last: tuple[VehicleLocalPosition, Continuous] | None = None
    for source_message in open_replay(f"ulog:{LOGS / name}").messages:
        if source_message.address.topic != VLP:
            continue
        message = upgrade(source_message.fields)
        track = tracker.add(message)
        assert not track.discontinued
        if last is not None:
            before, smooth_before = last
            seconds = (message.timestamp - before.timestamp) / 1e6
            expected = (before.vx * seconds, before.vy * seconds, before.vz * seconds)
            step = (message.x - before.x, message.y - before.y, message.z - before.z)
            smooth_step = (
                track.x - smooth_before.x,
                track.y - smooth_before.y,
                track.z - smooth_before.z,
            )
            worst["raw"] = max(worst["raw"], math.dist(step, expected))
            worst["smooth"] = max(worst["smooth"], math.dist(smooth_step, expected))
        last = message, track
    assert worst["raw"] > raw
    assert worst["smooth"] < smooth
