"""The filter of late samples, with fake clocks that have nothing in common."""

from __future__ import annotations

import datetime as dt

import pytest
import zenoh

import nedbus
from nedbus.bridges.late_filter import DRIFT, LateFilter
from nedbus_msgs import Address
from tests.flights.messages import message

ONE = Address("1", "vehicle_local_position")
SECOND = 10**9
NOW = 1_790_000_000 * SECOND  # what a vehicle's clock shows


def sample(sent: int | None, *, by: int = 7, address: Address = ONE, retained: bool = False) -> nedbus.Sample:
    """Return a sample with this timestamp of its publisher [ns]."""
    stamp = None
    if sent is not None:
        moment = dt.datetime.fromtimestamp(sent // SECOND, dt.UTC)
        moment += dt.timedelta(microseconds=sent % SECOND // 1000)
        stamp = zenoh.Timestamp(moment, bytes([by]))
    return nedbus.Sample(message(1), address, received=0, stamp=stamp, retained=retained)


def admitted(late: LateFilter, *times: tuple[float, float]) -> list[bool]:
    """Return the admitted samples, each given by the times at which it was sent and received [s]."""
    return [late.admits(sample(NOW + round(sent * SECOND)), arrived=round(arrived * SECOND)) for sent, arrived in times]


@pytest.mark.parametrize("ahead", [-86_400 * 365 * 20, -1.5, 0.0, 1.5, 86_400])
def test_difference_of_two_clocks_does_not_matter(ahead: float) -> None:
    """Samples of a vehicle are current even if its clock is wrong by seconds or years."""
    late = LateFilter()
    assert all(admitted(late, *((ahead + each / 100, each / 100) for each in range(500))))
    assert late.report() is None


def test_recovered_samples_are_held_back_and_counted() -> None:
    """After 10 s without a link a burst of recovered samples arrives; only those of the last second are current."""
    late = LateFilter()
    assert all(admitted(late, *((each / 100, each / 100) for each in range(200))))
    burst = admitted(late, *((2 + each / 100, 12 + each / 2000) for each in range(1000)))
    assert burst == sorted(burst), "once current, always current"
    assert 900 <= burst.count(False) <= 960
    assert all(admitted(late, *((13 + each / 100, 13 + each / 100) for each in range(200))))
    assert late.report() == f"{ONE}: {burst.count(False)} old messages held back, up to 10.0 s late"
    assert late.report() is None


def test_slow_recovery_is_held_back_as_well() -> None:
    """A slow link catches up slowly; old samples are still held back."""
    late = LateFilter()
    admitted(late, (0.0, 0.0))
    slow = admitted(late, *((0.01 + each / 100, 10 + each / 150) for each in range(3_000)))
    assert slow == sorted(slow)
    assert 2_650 <= slow.count(False) <= 2_750


def test_last_value_from_before_is_held_back() -> None:
    """The age of the last message of a silent vehicle is unknown; its next message is current."""
    late = LateFilter()
    assert not late.admits(sample(NOW, retained=True), arrived=50 * SECOND)
    assert admitted(late, (3600.0, 3650.0)) == [True]
    assert late.report() == f"{ONE}: 1 old message held back"


def test_clock_that_is_set_back_by_another_implementation() -> None:
    """A lateness that lasts two minutes is a clock difference."""
    late = LateFilter()
    admitted(late, *((each / 10, each / 10) for each in range(20)))
    steps = admitted(late, *((each / 10 - 3600, each / 10) for each in range(20, 2_000)))
    assert steps == sorted(steps)
    assert 0 < steps.count(False) <= 2 * DRIFT / SECOND * 10


def test_clock_that_is_set_back_stands_in_zenohs_timestamps() -> None:
    """Zenoh's timestamps never go back: they stand still for an hour and then continue; all samples are current."""
    late = LateFilter()
    admitted(late, *((each / 100, each / 100) for each in range(200)))
    assert all(admitted(late, *((1.99, each / 100) for each in range(200, 2_000))))
    assert all(admitted(late, *((1.99 + each / 100, 20 + each / 100) for each in range(2_000))))
    assert admitted(late, (22.0, 45.0)) == [False]


def test_clocks_that_drift_apart() -> None:
    """The fastest sample counts for two minutes, so a drift of 100 us per second does not make samples late."""
    late = LateFilter()
    assert admitted(late, (0.0, 0.0), (60.1, 61.0), (61.0, 62.5)) == [True, True, False]
    late = LateFilter()
    assert all(admitted(late, *((each * (1 - 1e-4), float(each)) for each in range(0, 20_000, 10))))
    assert 10 * late._limit < DRIFT


def test_new_publisher_has_a_clock_of_its_own() -> None:
    """A vehicle that restarts with a clock of 1970 is current at once; withdrawn publishers are forgotten."""
    late = LateFilter()
    admitted(late, (0.0, 0.0))
    assert late.admits(sample(SECOND, by=8), arrived=SECOND)
    late.forget(ONE)
    assert admitted(late, (0.0, 3600.0)) == [True]


def test_sample_without_a_timestamp_is_current() -> None:
    """Its age is unknown."""
    late = LateFilter()
    assert late.admits(sample(None), arrived=0)
    assert late.admits(sample(None), arrived=3600 * SECOND)


def test_others_are_named_in_short() -> None:
    """There is one log line for any number of vehicles."""
    late = LateFilter()
    for name in "abc":
        assert not late.admits(sample(NOW, address=Address(name, ONE.topic), retained=True), arrived=0)
    assert late.report() == "a/vehicle_local_position and 2 others: 3 old messages held back"
