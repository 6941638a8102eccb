"""The simulated flight: deterministic, at PX4's rates, with an outage, and resets whose deltas explain the jumps."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from datetime import UTC, datetime
from typing import Any

import pytest

from nedbus.errors import ConfigError, SourceError
from nedbus.sources import SourceMessage
from nedbus.sources.simulator import UPTIME, Estimator, truth_at
from nedbus.timeline import is_boot_possible
from nedbus_msgs import (
    BY_TOPIC,
    DEFAULT,
    RESET_COUNTERS,
    TOPICS,
    VehicleLocalPosition,
    upgrade_with,
)
from nedbus_msgs.frames import quaternion_to_euler, to_global
from tests.flights.local_position import FIELD_TYPES, encode, upgrade
from tests.flights.messages import VLP
from tests.flights.replays import open_replay


def seconds_of(message: Any) -> float:
    """Return the time of a message in seconds since the start."""
    return float((message.timestamp - UPTIME) / 1e6)


def simulate(options: str) -> list[SourceMessage]:
    return list(open_replay(f"sim:{options}").messages)


@pytest.fixture(scope="module")
def streams() -> dict[str, list[VehicleLocalPosition]]:
    """Simulate more than one lap, validate all messages, and group them by stream."""
    by_stream: dict[str, list[VehicleLocalPosition]] = defaultdict(list)
    for each in simulate("?duration=140&topics=VehicleLocalPosition"):
        assert set(each.fields) == set(FIELD_TYPES)
        by_stream[each.address.stream].append(upgrade(each.fields))
    return dict(by_stream)


@pytest.fixture(scope="module")
def others() -> dict[str, list[Any]]:
    """Simulate all topics except those of VehicleLocalPosition, validate all messages, and group them by stream."""
    topics = ",".join(TOPICS.keys() - DEFAULT.topics)
    by_stream: dict[str, list[Any]] = defaultdict(list)
    for each in simulate(f"?duration=140&topics={topics}"):
        definition = BY_TOPIC[each.address.topic]
        newest = definition.layout_of_release("main")
        assert newest
        assert each.fields.keys() == newest.types.keys()
        by_stream[each.address.stream].append(upgrade_with(definition, each.fields))
    return dict(by_stream)


def test_origin_option_moves_the_flight() -> None:
    """Another origin moves only the global positions; an impossible one raises."""
    moved, standard = (
        {each.address.stream: each.fields for each in simulate(f"?duration=3{options}")}
        for options in ("&origin=10.5,-20.25,100", "")
    )
    assert moved[VLP]["x"] == standard[VLP]["x"]
    assert (moved[VLP]["ref_lat"], moved[VLP]["ref_lon"], moved[VLP]["ref_alt"]) == (
        10.5,
        -20.25,
        100.0,
    )
    for topic, latitude in (
        ("sensor_gps/0", "latitude_deg"),
        ("vehicle_global_position", "lat"),
        ("home_position", "lat"),
    ):
        assert moved[topic][latitude] == pytest.approx(10.5, abs=1e-3)
        assert standard[topic][latitude] == pytest.approx(47.397742, abs=1e-3)
    for wrong in ("95,0,0", "1,2", "a,b,c"):
        with pytest.raises(ConfigError, match="origin"):
            simulate(f"?origin={wrong}")


def encoded(options: str) -> list[tuple[float, str, bytes]]:
    """Return all messages of a flight, in order."""
    return [
        (
            each.at,
            str(each.address),
            encode(upgrade_with(BY_TOPIC[each.address.topic], each.fields)),
        )
        for each in simulate(options)
    ]


def test_same_seed_yields_identical_flight() -> None:
    one, two, other = (encoded(f"?duration=3&seed={seed}") for seed in (3, 3, 4))
    assert one == two
    assert one != other


@pytest.mark.slow
@pytest.mark.parametrize(
    "topic", ["vehicle_local_position", "estimator_local_position", "vehicle_attitude", "*"]
)
def test_selected_topics_equal_those_of_whole_flight(topic: str) -> None:
    """A flight of selected topics has exactly the messages of these topics in the whole flight."""
    whole, chosen = encoded("?duration=18"), encoded(f"?duration=18&topics={topic}")
    assert chosen == [each for each in whole if topic in ("*", each[1].split("/")[1])]


def test_selection_without_simulated_topic_raises() -> None:
    with pytest.raises(SourceError, match="has no timesync_status"):
        simulate("?duration=1&topics=timesync_status")


@pytest.mark.slow
def test_rates_are_nominal(streams: dict[str, list[VehicleLocalPosition]]) -> None:
    """Each stream has the nominal rate of its topic, without jitter."""
    assert set(streams) == {
        name for name, topic in DEFAULT.topics.items() if not topic.instances
    } | {
        "estimator_local_position/0",
        "estimator_local_position/1",
    }
    for stream, messages in streams.items():
        steps = {
            after.timestamp - before.timestamp for before, after in itertools.pairwise(messages)
        }
        assert steps == {round(1e6 / DEFAULT.topics[stream.split("/")[0]].rate)}


@pytest.mark.parametrize(
    "options", ["?duration=3.3", "?duration=0.5", "?duration=3.3&topics=home_position,SensorGps"]
)
def test_messages_are_in_time_order_and_counted(options: str) -> None:
    """A finite flight has exactly `total` messages, in order of `due`, and only at the announced addresses."""
    run = open_replay(f"sim:{options}")
    messages = list(run.messages)
    due = [each.at for each in messages]
    assert due == sorted(due)
    assert len(due) == run.total
    assert {each.address for each in messages} == set(run.addresses)


@pytest.mark.slow
def test_gps_outage_causes_dead_reckoning(streams: dict[str, list[VehicleLocalPosition]]) -> None:
    """Without GPS dead_reckoning is set, error and sigma grow, and xy becomes invalid after 10 s."""
    outage = [message for message in streams[VLP] if message.dead_reckoning]
    assert [seconds_of(message) // 1 for message in (outage[0], outage[-1])] == [60.0, 74.0]
    assert outage[-1].eph > outage[len(outage) // 2].eph > outage[0].eph
    assert outage[0].xy_valid
    assert not outage[-1].xy_valid
    assert not any(message.dead_reckoning for message in streams["external_ins_local_position"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("quantity", "fields", "motion", "count"),
    [
        ("xy", ("x", "y"), 0.15, 1),
        ("vxy", ("vx", "vy"), 0.05, 1),
        ("z", ("z",), 0.08, 1),
        ("heading", ("heading",), 0.01, 2),
    ],
)
def test_reset_delta_equals_the_jump(
    streams: dict[str, list[VehicleLocalPosition]],
    quantity: str,
    fields: tuple[str, ...],
    motion: float,
    count: int,
) -> None:
    """At a reset the counter increments, and the delta equals the jump up to 10 ms of motion; nothing else jumps."""
    resets = 0
    for before, after in itertools.pairwise(streams[VLP]):
        jump = [getattr(after, name) - getattr(before, name) for name in fields]
        if quantity == "heading" and abs(jump[0]) > 3:
            continue  # the heading wrapped at pi
        rise = getattr(after, f"{quantity}_reset_counter") - getattr(
            before, f"{quantity}_reset_counter"
        )
        assert rise in {0, 1}
        if rise:
            resets += 1
            delta = getattr(after, f"delta_{quantity}")
            jump = [
                a - b
                for a, b in zip(jump, delta if isinstance(delta, tuple) else (delta,), strict=True)
            ]
        elif quantity == "heading" and abs(seconds_of(after) - 115) < 0.02:
            continue  # the heading disturbance that the next alignment corrects
        assert all(abs(value) <= motion for value in jump), (after.timestamp, jump)
    assert resets == count


@pytest.mark.slow
def test_estimate_is_near_groundtruth(streams: dict[str, list[VehicleLocalPosition]]) -> None:
    """With GPS estimates stay within a few sigma of the groundtruth, whose velocity matches its positions."""
    truth = {
        message.timestamp: message for message in streams["vehicle_local_position_groundtruth"]
    }
    for message in streams[VLP]:
        if message.timestamp in truth and not message.dead_reckoning:
            true = truth[message.timestamp]
            assert abs(message.x - true.x) < 3
            assert abs(message.z - true.z) < 3
    positions = streams["vehicle_local_position_groundtruth"]
    assert {(message.eph, message.evh, message.xy_valid) for message in positions} == {(0, 0, True)}
    for before, after in itertools.pairwise(positions):
        mean = (before.vx + after.vx) / 2
        assert (after.x - before.x) / 0.02 == pytest.approx(mean, abs=0.01)
        if math.hypot(after.vx, after.vy) > 1:
            course = math.atan2(after.vy, after.vx)
            assert math.remainder(after.heading - course, math.tau) == pytest.approx(0, abs=1e-3)


def test_z_resets_alternate() -> None:
    """The first z reset steps down by 1 m, the second, a lap later, back up; each delta equals the step."""
    estimator = Estimator("ekf 0", seed=0, noise=0.3)
    for number, time, delta in ((1, 90.0, 1.0), (2, 210.0, -1.0)):
        before, after = (
            estimator.fields(truth_at(at, 0.0, (0.0, 0.0, 0.0))) for at in (time - 0.01, time)
        )
        assert (before["z_reset_counter"], after["z_reset_counter"]) == (number - 1, number)
        assert after["delta_z"] == delta
        assert after["z"] - before["z"] == pytest.approx(delta, abs=0.05)  # type: ignore[operator]  # floats


def test_restart_is_a_possible_reboot() -> None:
    """A simulation that is restarted within half a second is a reboot of its vehicle, not a jump of its clock."""
    assert is_boot_possible(UPTIME, 0.5)


def test_origin_is_set_in_flight(streams: dict[str, list[VehicleLocalPosition]]) -> None:
    """There is no global origin for the first two seconds, as before the first fix."""
    assert all(each.xy_global == (seconds_of(each) >= 2) for each in streams[VLP])
    assert streams[VLP][-1].ref_lat == 47.397742


def test_external_ins_has_neither_outage_nor_resets(
    streams: dict[str, list[VehicleLocalPosition]],
) -> None:
    """The position aiding of the external INS never fails, so its estimate is always valid, and is not reset."""
    for message in streams["external_ins_local_position"]:
        assert message.xy_valid
        assert message.z_valid
        assert not message.dead_reckoning
        assert not any(getattr(message, counter) for counter in RESET_COUNTERS.values())


def test_vehicles_with_different_seeds_fly_apart() -> None:
    """Vehicles with different seeds fly apart once they have climbed."""
    ends = [upgrade(simulate(f"?duration=12&seed={seed}")[-1].fields) for seed in (0, 1)]
    assert abs(ends[0].x - ends[1].x) + abs(ends[0].y - ends[1].y) > 5


@pytest.mark.slow
def test_attitude_is_consistent_with_estimate(
    streams: dict[str, list[VehicleLocalPosition]], others: dict[str, list[Any]]
) -> None:
    """Heading and resets equal those of the estimate, and the thrust explains the acceleration."""
    estimates = {message.timestamp: message for message in streams[VLP]}
    attitudes = others["vehicle_attitude"]
    assert len(attitudes) == 7000
    for message in attitudes:
        estimate = estimates[message.timestamp]
        assert math.hypot(*message.q) == pytest.approx(1.0, abs=1e-6)
        roll, pitch, heading = quaternion_to_euler(message.q)
        assert math.remainder(heading - estimate.heading, math.tau) == pytest.approx(0.0, abs=1e-5)
        assert message.quat_reset_counter == estimate.heading_reset_counter
        assert 2 * math.atan2(message.delta_q_reset[3], message.delta_q_reset[0]) == pytest.approx(
            estimate.delta_heading, abs=1e-5
        )
        thrust = math.hypot(estimate.ax, estimate.ay, estimate.az - 9.80665)
        assert thrust * math.cos(roll) * math.cos(pitch) == pytest.approx(
            9.80665 - estimate.az, abs=1e-4
        )
        if 16 < seconds_of(message) < 114:  # without a heading error
            along = estimate.ax * math.cos(heading) + estimate.ay * math.sin(heading)
            assert -thrust * math.cos(roll) * math.sin(pitch) == pytest.approx(along, abs=1e-4)
            across = estimate.ay * math.cos(heading) - estimate.ax * math.sin(heading)
            assert thrust * math.sin(roll) == pytest.approx(across, abs=1e-4)


@pytest.mark.slow
def test_global_position_matches_local_position(
    streams: dict[str, list[VehicleLocalPosition]], others: dict[str, list[Any]]
) -> None:
    """The global position is the projected local position, and is valid whenever the local position is."""
    estimates = {message.timestamp: message for message in streams[VLP]}
    assert seconds_of(others["vehicle_global_position"][0]) == 2.0  # the origin is known
    for message in others["vehicle_global_position"]:
        estimate = estimates[message.timestamp]
        where = to_global(estimate)
        assert where
        assert (message.lat, message.lon) == pytest.approx(
            (where.latitude, where.longitude), abs=1e-8
        )
        assert message.alt == pytest.approx(where.altitude, abs=1e-4)
        names = ("dead_reckoning", "eph", "epv")
        assert [getattr(message, name) for name in names] == [
            getattr(estimate, name) for name in names
        ]
        assert message.lat_lon_valid == estimate.xy_valid


@pytest.mark.slow
def test_status_and_gps_are_consistent_with_outage(
    streams: dict[str, list[VehicleLocalPosition]], others: dict[str, list[Any]]
) -> None:
    """During the outage the receiver has no fix; while the position is invalid a failsafe is active."""
    estimates = {message.timestamp: message for message in streams[VLP]}
    for message in others["vehicle_status"]:
        estimate = estimates[message.timestamp]
        assert message.failsafe is not estimate.xy_valid
        assert (message.nav_state == message.nav_state_user_intention) is estimate.xy_valid
        assert message.arming_state == message.ARMING_STATE_ARMED
    modes = [
        mode for mode, _ in itertools.groupby(others["vehicle_status"], lambda each: each.nav_state)
    ]
    assert modes == [17, 3, 1, 3]  # take-off, mission, failsafe to altitude mode, mission
    for message in others["sensor_gps/0"]:
        seconds = seconds_of(message)
        has_fix = 2 <= seconds % 120 < 60 or seconds % 120 >= 75 or seconds >= 120
        assert (message.fix_type == 3, message.satellites_used > 5, message.eph < 5) == (
            has_fix,
        ) * 3
        assert message.vel_ned_valid is has_fix
        boot = datetime(2026, 1, 1, tzinfo=UTC).timestamp() * 1e6
        assert message.time_utc_usec == (boot + message.timestamp if seconds >= 2 else 0)
        if has_fix:
            truth = to_global(estimates[message.timestamp])
            assert truth
            assert (message.latitude_deg, message.longitude_deg) == pytest.approx(
                (truth.latitude, truth.longitude), abs=1e-4
            )


@pytest.mark.slow
def test_battery_home_and_land_detection_are_consistent(others: dict[str, list[Any]]) -> None:
    """The battery discharges, home_position is sent at the start and with the origin; the vehicle takes off once."""
    batteries = others["battery_status/0"]
    assert all(
        after.remaining < before.remaining for before, after in itertools.pairwise(batteries)
    )
    assert all(0.8 < each.remaining <= 1 and 14 < each.voltage_v < 17 for each in batteries)
    for before, after in itertools.pairwise(batteries):  # at a constant current
        assert after.time_remaining_s == pytest.approx(before.time_remaining_s - 1, abs=0.01)
    homes = others["home_position"]
    assert [(seconds_of(each), each.valid_hpos, each.update_count) for each in homes] == [
        (0.0, False, 1),
        (2.0, True, 2),
    ]
    landed = [each.landed for each in others["vehicle_land_detected"]]
    assert landed[0]
    assert landed == sorted(landed, reverse=True)
    assert not landed[-1]
