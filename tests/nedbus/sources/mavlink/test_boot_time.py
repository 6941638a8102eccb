"""Reboots of a MAVLink vehicle: found from the times of several messages, not of one that is late."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as dialect

from nedbus.mavlink import SequenceCounter, Vehicle, new_clock, read_time
from nedbus.mavlink.parser import new_parser
from nedbus.samples import Rejection, SourceMessage
from nedbus.timeline import TimeKind, VehicleClock
from tests.peers.px4_log_stream import STREAMS, datagrams

BOOT = 60_000
"""Time since boot of the vehicle before its reboot [ms]."""


def position(ms: int) -> Any:
    return dialect.MAVLink_local_position_ned_message(ms, 0, 0, 0, 0, 0, 0)


def attitude(ms: int) -> Any:
    return dialect.MAVLink_attitude_message(ms, 0, 0, 0, 0, 0, 0)


def pressure(ms: int) -> Any:
    return dialect.MAVLink_scaled_pressure_message(ms, 0, 0, 0)


def distance(ms: int, sensor: int) -> Any:
    return dialect.MAVLink_distance_sensor_message(ms, 0, 100, 50, 0, sensor, 0, 0)


def is_reboot(clock: VehicleClock, message: Any, now: float) -> bool:
    reading = read_time(clock, message, now)
    return reading is not None and reading.kind is TimeKind.REBOOT


def reboots(*messages: Any, interval: float = 0.1) -> list[bool]:
    """Return for each message of a vehicle whether it showed a reboot."""
    clock = new_clock()
    return [is_reboot(clock, message, interval * number) for number, message in enumerate(messages)]


def test_message_with_the_time_of_an_old_sample_is_no_reboot() -> None:
    """A sensor without new data repeats the time of its last sample: neither its lag nor the messages show a reboot."""
    assert not any(
        reboots(
            position(BOOT),
            *(pressure(1000 + 10 * number) for number in range(50)),
            position(BOOT + 1),
        )
    )
    assert not any(
        reboots(position(1000), pressure(1000), position(BOOT), pressure(1000), pressure(1000))
    )


def test_second_sensor_of_a_kind_without_data_is_no_reboot() -> None:
    """Two sensors that share a kind of message, of which one lags, are not mistaken for a clock that went back."""
    both = [
        each for number in range(30) for each in (distance(BOOT + 50 * number, 0), distance(500, 1))
    ]
    assert not any(reboots(position(BOOT), *both))


def test_single_time_far_ahead_is_no_reboot() -> None:
    """One message with a wild time in the future neither sets the clock nor makes the messages after it older."""
    flight = [kind(BOOT + 100 * number) for number in range(40) for kind in (position, attitude)]
    flight[20] = position(10**8)
    clock = new_clock()
    assert not any(
        is_reboot(clock, message, 0.05 * number) for number, message in enumerate(flight)
    )
    assert clock.newest == 1000 * (BOOT + 3900)


def test_time_far_ahead_counts_once_it_is_confirmed() -> None:
    """Two messages in a row that are ahead, as of a simulation that runs fast, set the clock."""
    clock = new_clock()
    for each in (position(1000), position(BOOT), attitude(BOOT + 10)):
        assert not is_reboot(clock, each, 0.0)
    assert clock.newest == 1000 * (BOOT + 10)


def test_two_kinds_in_a_row_that_went_back_show_a_reboot() -> None:
    """The second kind whose own time went back shows the reboot, and is the first message of the new boot."""
    assert reboots(position(BOOT), attitude(BOOT), position(300), attitude(310)) == [
        False,
        False,
        False,
        True,
    ]
    clock = new_clock()
    for each in (position(BOOT), attitude(BOOT), position(300), attitude(310), position(320)):
        is_reboot(clock, each, 0.0)
    assert clock.newest == 320_000


def test_current_message_disproves_a_reboot() -> None:
    """Kinds that went back do not add up if a current message arrives between them."""
    both = attitude(BOOT), position(BOOT)
    assert not any(
        reboots(*both, position(300), attitude(BOOT), attitude(310), position(BOOT), position(320))
    )
    clock = new_clock()
    found = []
    for each in (position(BOOT), attitude(BOOT), position(300), attitude(310)):
        clock.confirm()  # such as by a ULog stream that continues
        found.append(is_reboot(clock, each, 0.0))
    assert not any(found)


def test_single_kind_that_went_back_shows_a_reboot() -> None:
    """If no other kind of message arrives any more, one is enough after a second; at once if it is the only one."""
    rows = [position(BOOT), attitude(BOOT), *(position(100 * number) for number in range(20))]
    assert reboots(*rows).index(True) == 12
    assert reboots(position(BOOT), position(300)) == [False, True]


def test_delay_of_less_than_a_second_is_no_reboot() -> None:
    """A reordered datagram, and a reboot in the first second, do not show a reboot."""
    assert not any(
        reboots(position(BOOT), attitude(BOOT), position(BOOT - 1000), attitude(BOOT - 1000))
    )


@pytest.mark.logs
@pytest.mark.slow
@pytest.mark.skipif(
    not STREAMS.exists(), reason=f"no recordings of a PX4: {STREAMS} does not exist"
)
@pytest.mark.parametrize(
    ("recording", "expected"),
    [
        ("../baro_failure_mavlink", 0), ("../gps_off_in_flight", 0), ("../link_cut_20s_in_flight", 0),
        ("../slow_link_header_stalls", 0), ("ulog_stream_session", 2), ("ulog_stream_session_second", 2),
    ],
)  # fmt: skip
def test_recorded_reboots_are_found_within_two_seconds(recording: str, expected: int) -> None:
    """Each reboot of a real PX4 (SITL) is found within 2 s; failed sensors and cut links are not taken for one."""
    clock, parser, starts, found = new_clock(), new_parser(), list[float](), list[float]()
    last = 0
    for when, from_vehicle, frame in datagrams(STREAMS / f"{recording}.bin.gz"):
        for message in parser.parse_buffer(frame) or [] if from_vehicle else []:
            if message.get_type() == "LOCAL_POSITION_NED":
                starts += [when] * (message.time_boot_ms < last - 1000)
                last = message.time_boot_ms
            found += [when] * is_reboot(clock, message, when)
    assert len(found) == len(starts) == expected
    assert all(0 <= when - start < 2 for when, start in zip(found, starts, strict=True))


def handled(
    vehicle: Vehicle, messages: Iterable[Any], interval: float = 0.01
) -> list[SourceMessage | Rejection]:
    return [
        item
        for number, message in enumerate(messages)
        for item in vehicle.handle_all(message, 100 + interval * number)
    ]


def odometry(ms: int) -> Any:
    position, velocity, rates = [0.0] * 3, [0.0] * 3, [0.0] * 3
    covariance = [0.0] * 21
    level = [1.0, 0.0, 0.0, 0.0]
    return dialect.MAVLink_odometry_message(
        1000 * ms, 1, 12, *position, level, *velocity, *rates, covariance, covariance, 0
    )


def test_reboot_rejects_nothing() -> None:
    """The time of a sample confirms a reboot; what came before it is certain is neither used nor rejected."""
    before = [
        message for ms in range(10_000, 11_000, 20) for message in (position(ms), odometry(ms))
    ]
    after = [position(250), odometry(252), position(270), odometry(272)]
    items = handled(Vehicle("1", ["vehicle_local_position"]), [*before, *after])
    assert not [item for item in items if isinstance(item, Rejection)]
    reboots = [
        item.timestamp for item in items if isinstance(item, SourceMessage) and item.rebooted
    ]
    assert reboots == [270_000]


@pytest.mark.logs
@pytest.mark.slow
@pytest.mark.skipif(
    not STREAMS.exists(), reason=f"no recordings of a PX4: {STREAMS} does not exist"
)
@pytest.mark.parametrize("recording", ["ulog_stream_session", "ulog_stream_session_second"])
def test_recorded_reboots_lose_and_reject_nothing(recording: str) -> None:
    """The first second after each reboot of a real PX4 (SITL) has no rejected message, and no loss is counted."""
    vehicle, parser, sequence = Vehicle("1"), new_parser(), SequenceCounter()
    reboots, rejections, lost = 0, 0, 0
    certain = 0.0  # time of the last reboot
    for when, from_vehicle, frame in datagrams(STREAMS / f"{recording}.bin.gz"):
        for message in parser.parse_buffer(frame) or [] if from_vehicle else []:
            vehicle.count_lost(sequence.add(message.get_msgbuf()[4], when), when)
            for item in vehicle.handle_all(message, when):
                if isinstance(item, Rejection):
                    rejections += 1
                    continue
                if item.rebooted:
                    certain = when
                    reboots += 1
                if when - certain < 1:
                    lost += item.lost
    assert (reboots, rejections, lost) == (2, 0, 0)
