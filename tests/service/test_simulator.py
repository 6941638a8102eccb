"""The simulated flight: deterministic, at PX4's rates, with outage and resets whose deltas explain the jumps."""

from __future__ import annotations

import itertools
from collections import defaultdict

import pytest

from nedbus.sources import SourceMessage
from nedbus_msgs import FIELD_TYPES, TOPICS, VehicleLocalPosition, encode, upgrade
from tests.messages import VLP
from tests.replays import open_replay


def simulate(options: str) -> list[SourceMessage]:
    return list(open_replay(f"sim:{options}").messages)


@pytest.fixture(scope="module")
def streams() -> dict[str, list[VehicleLocalPosition]]:
    """Simulate more than one lap, validate everything, and group it by stream."""
    by_stream: dict[str, list[VehicleLocalPosition]] = defaultdict(list)
    for each in simulate("?duration=140"):
        assert set(each.fields) == set(FIELD_TYPES)
        by_stream[each.address.stream].append(upgrade(each.fields))
    return by_stream


def test_same_seed_same_bits() -> None:
    """The flight is a function of its seed."""
    one, two, other = ([encode(upgrade(each.fields)) for each in simulate(f"?duration=3&seed={s}")] for s in (3, 3, 4))
    assert one == two
    assert one != other


def test_rates_are_px4s(streams: dict[str, list[VehicleLocalPosition]]) -> None:
    """Each stream has its topic's nominal rate, evenly."""
    assert set(streams) == {name for name, topic in TOPICS.items() if not topic.instances} | {
        "estimator_local_position/0",
        "estimator_local_position/1",
    }
    for stream, messages in streams.items():
        steps = {after.timestamp - before.timestamp for before, after in itertools.pairwise(messages)}
        assert steps == {round(1e6 / TOPICS[stream.split("/")[0]].rate)}


def test_messages_are_in_time_order_and_counted() -> None:
    """A finite flight has as many messages as its total, in order of `due`."""
    run = open_replay("sim:?duration=3.3")
    due = [each.due for each in run.messages]
    assert due == sorted(due)
    assert len(due) == run.total


def test_outage_is_dead_reckoning_with_growing_error(streams: dict[str, list[VehicleLocalPosition]]) -> None:
    """Without GPS dead_reckoning is set, error and sigma grow, and after 10 s xy is no longer valid."""
    outage = [message for message in streams[VLP] if message.dead_reckoning]
    assert [(message.timestamp / 1e6 - 10.0) // 1 for message in (outage[0], outage[-1])] == [60.0, 74.0]
    assert outage[-1].eph > outage[len(outage) // 2].eph > outage[0].eph
    assert outage[0].xy_valid
    assert not outage[-1].xy_valid
    assert not any(message.dead_reckoning for message in streams["external_ins_local_position"])


@pytest.mark.parametrize(
    ("quantity", "fields", "motion", "count"),
    [
        ("xy", ("x", "y"), 0.15, 1),
        ("vxy", ("vx", "vy"), 0.05, 1),
        ("z", ("z",), 0.08, 1),
        ("heading", ("heading",), 0.01, 2),
    ],
)
def test_reset_delta_explains_the_jump(
    streams: dict[str, list[VehicleLocalPosition]], quantity: str, fields: tuple[str, ...], motion: float, count: int
) -> None:
    """At a reset the counter rises by one, and the delta is the jump but for 10 ms of motion; else nothing jumps."""
    resets = 0
    for before, after in itertools.pairwise(streams[VLP]):
        jump = [getattr(after, name) - getattr(before, name) for name in fields]
        if quantity == "heading" and abs(jump[0]) > 3:
            continue  # the heading went through pi
        rise = getattr(after, f"{quantity}_reset_counter") - getattr(before, f"{quantity}_reset_counter")
        assert rise in {0, 1}
        if rise:
            resets += 1
            delta = getattr(after, f"delta_{quantity}")
            jump = [a - b for a, b in zip(jump, delta if isinstance(delta, tuple) else (delta,), strict=True)]
        elif quantity == "heading" and abs(after.timestamp / 1e6 - 10 - 115) < 0.02:
            continue  # the compass is disturbed here: that is what the next alignment resets
        assert all(abs(value) <= motion for value in jump), (after.timestamp, jump)
    assert resets == count


def test_estimate_is_near_the_truth(streams: dict[str, list[VehicleLocalPosition]]) -> None:
    """With GPS the estimates stay within a few sigma of the groundtruth, and the velocity fits the positions."""
    truth = {message.timestamp: message for message in streams["vehicle_local_position_groundtruth"]}
    for message in streams[VLP]:
        if message.timestamp in truth and not message.dead_reckoning:
            true = truth[message.timestamp]
            assert abs(message.x - true.x) < 3
            assert abs(message.z - true.z) < 3
    positions = streams["vehicle_local_position_groundtruth"]
    for before, after in itertools.pairwise(positions):
        mean = (before.vx + after.vx) / 2
        assert (after.x - before.x) / 0.02 == pytest.approx(mean, abs=0.01)


def test_origin_is_set_in_flight(streams: dict[str, list[VehicleLocalPosition]]) -> None:
    """The first two seconds have no global origin, as before the first fix."""
    first, last = streams[VLP][0], streams[VLP][-1]
    assert (first.xy_global, last.xy_global, last.ref_lat) == (False, True, 47.397742)


def test_seeds_have_different_directions() -> None:
    """Vehicles with different seeds fly apart, as soon as they have climbed."""
    ends = [upgrade(simulate(f"?duration=12&seed={seed}")[-1].fields) for seed in (0, 1)]
    assert abs(ends[0].x - ends[1].x) + abs(ends[0].y - ends[1].y) > 5
