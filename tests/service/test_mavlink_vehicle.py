"""What one MAVLink vehicle is asked for, and its estimates, at times that the test gives."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import common as dialect

from nedbus.sources.mavlink_vehicle import ORIGIN, STREAMS, OutOfOrderError, Vehicle, request_rates


@pytest.fixture
def vehicle() -> Vehicle:
    """Return a vehicle that has sent nothing, at 30 positions a second over a telemetry radio."""
    return Vehicle(30.0, 57600)


def estimate(vehicle: Vehicle, ms: int, now: float) -> dict[str, object]:
    """Return what a position at this time since boot [ms] makes."""
    fields = vehicle.handle(dialect.MAVLink_local_position_ned_message(ms, 0, 0, 0, 0, 0, 0), now)
    assert fields is not None
    return fields


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (0b1111111111, True),  # at rest, since 48f1687d3a
        (0b1101111111, True),  # in flight
        (0b1101100101, False),  # GPS lost
        (0b0010100101, False),  # the constant position mode, up to 1.15: no velocity, and no position
        (0b0010111101, False),  # the same, of a release that keeps a position all the same
    ],
)
def test_constant_position_mode_is_no_sign_of_rest(vehicle: Vehicle, flags: int, expected: bool) -> None:
    """Its bit counts where no horizontal velocity is valid: it was the opposite of that until PX4's 48f1687d3a."""
    vehicle.handle(dialect.MAVLink_estimator_status_message(0, flags, 0, 0, 0, 0, 0, 0, 1.0, 1.0), 100.0)
    assert estimate(vehicle, 1, 100.0)["xy_valid"] is expected


@pytest.mark.parametrize(
    ("rate", "baud", "status"),
    [(30.0, 57600, 13.04), (20.0, 57600, 20.0), (45.0, 57600, 2.0), (50.0, 115200, 50.0), (0.5, 57600, 2.0)],
)
def test_flags_are_requested_as_often_as_the_link_carries(rate: float, baud: int, status: float) -> None:
    """ESTIMATOR_STATUS comes with each position where there is room for it, else with what room there is."""
    rates = request_rates(rate, baud)
    assert rates.keys() == STREAMS.keys()
    assert (rates[32], rates[331]) == (rate, 10.0)
    assert rates[230] == pytest.approx(status, abs=0.01)
    if status > 2:
        assert sum(STREAMS[number] * hertz for number, hertz in rates.items()) <= 0.9 * baud / 10 + 0.01


def test_requests_are_repeated_five_times(vehicle: Vehicle) -> None:
    """Each stream is requested up to five times, 1 s apart, then the next; the origin until it is known."""
    requested: list[int] = []
    for tick in range(200):
        now = 100.0 + tick / 2
        vehicle.track_sequence(1, tick % 256, now)
        requested += [number for number, _ in vehicle.requests(now)]
    for number in STREAMS:
        assert requested.count(number) == 5
    assert requested.count(ORIGIN) > 10


def test_answer_ends_a_request(vehicle: Vehicle) -> None:
    """After any answer the next stream is requested; once all are and the origin is known, nothing is requested."""
    requested: list[tuple[int, float]] = []
    for tick in range(20):
        now = 100.0 + tick
        vehicle.track_sequence(1, tick, now)
        estimate(vehicle, 1000 * tick, now)
        for request in list(vehicle.requests(now)):
            requested.append(request)
            assert vehicle.acknowledge(now) == request[0]
        if tick == 10:
            origin = dialect.MAVLink_gps_global_origin_message(1, 2, 3, 4)
            assert vehicle.handle(origin, now) is None
    assert [number for number, _ in requested[:6]] == [*STREAMS, ORIGIN]
    assert requested[0] == (32, 30.0)
    assert len(requested) < 9
    assert vehicle.acknowledge(1000.0) is None


def test_reordered_and_duplicate_messages_are_not_lost(vehicle: Vehicle) -> None:
    """Datagrams that arrive out of order, or twice, do not count as lost."""
    for sequence in (10, 12, 11, 13, 13, 14, 100, 200, 0):
        vehicle.track_sequence(1, sequence, 100.0)
    assert vehicle.lost == 85 + 99 + 55


def test_positions_that_stop_are_requested_again(vehicle: Vehicle) -> None:
    """The streams of a vehicle that sends messages, but no positions, are requested again."""
    requested: list[int] = []
    for tick in range(400):
        now = 100.0 + tick / 10
        vehicle.track_sequence(1, tick % 256, now)
        if now < 110:
            estimate(vehicle, tick * 100, now)
        for number, _ in list(vehicle.requests(now)):
            vehicle.acknowledge(now)
            if now >= 110:
                requested.append(number)
    assert requested.count(32) >= 3


def test_time_goes_on_when_its_counter_wraps(vehicle: Vehicle) -> None:
    """time_boot_ms overflows after 49.7 days; the timestamp does not."""
    for ms in range(2**32 - 500, 2**32 + 500, 100):
        assert estimate(vehicle, ms % 2**32, 100.0)["timestamp"] == 1000 * ms
    assert not vehicle.rebooted


def test_expired_values_are_not_provided(vehicle: Vehicle) -> None:
    """A heading that is not repeated is not provided after 2 s; an origin stays until a reboot."""
    vehicle.handle(dialect.MAVLink_global_position_int_message(0, 0, 0, 0, 0, 0, 0, 0, 9000), 100.0)
    vehicle.handle(dialect.MAVLink_gps_global_origin_message(473977418, 85455939, 488000), 100.0)
    assert estimate(vehicle, 1000, 101.0)["heading"] == pytest.approx(math.pi / 2)
    later = estimate(vehicle, 4000, 104.0)
    assert "heading" not in later
    assert later["ref_lat"] == 47.3977418
    assert "ref_timestamp" not in later
    assert "ref_lat" not in estimate(vehicle, 500, 105.0)
    assert vehicle.rebooted
    with pytest.raises(OutOfOrderError):
        estimate(vehicle, 499, 105.0)


def test_yaw_of_the_attitude_replaces_the_heading(vehicle: Vehicle) -> None:
    """Without a global position PX4 sends no GLOBAL_POSITION_INT; the heading is then the yaw of its attitude."""
    vehicle.handle(dialect.MAVLink_attitude_message(0, 0, 0, 1.25, 0, 0, 0), 100.0)
    vehicle.handle(dialect.MAVLink_global_position_int_message(0, 0, 0, 0, 0, 0, 0, 0, 65535), 100.0)
    assert estimate(vehicle, 1, 100.0)["heading"] == pytest.approx(1.25)
