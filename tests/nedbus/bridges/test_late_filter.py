"""The filter for late samples, with unrelated fake clocks for publisher and host."""

from __future__ import annotations

import datetime as dt

import pytest
import zenoh

import nedbus
from nedbus import limits
from nedbus.bridges.late_filter import DRIFT, LateFilter
from nedbus_msgs import Address
from tests.flights.messages import message

ONE = Address("1", "vehicle_local_position")
SECOND = 10**9
NOW = 1_790_000_000 * SECOND  # ns, the vehicle's clock


def sample(
    sent: int | None, *, by: int = 7, address: Address = ONE, retained: bool = False
) -> nedbus.Sample:
    """Return a sample with this publisher timestamp [ns]."""
    stamp = None
    if sent is not None:
        moment = dt.datetime.fromtimestamp(sent // SECOND, dt.UTC)
        moment += dt.timedelta(microseconds=sent % SECOND // 1000)
        stamp = zenoh.Timestamp(moment, bytes([by]))
    return nedbus.Sample(message(1), address, received=0, stamp=stamp, retained=retained)


def admitted(late: LateFilter, *times: tuple[float, float]) -> list[bool]:
    """Return whether each sample is admitted, given the times at which it was sent and received [s]."""
    return [
        late.admits(sample(NOW + round(sent * SECOND)), arrived=round(arrived * SECOND))
        for sent, arrived in times
    ]


@pytest.mark.parametrize("ahead", [-86_400 * 365 * 20, -1.5, 0.0, 1.5, 86_400])
def test_constant_clock_offset_is_ignored(ahead: float) -> None:
    """Samples are current even if the vehicle's clock is wrong by seconds or years."""
    late = LateFilter()
    assert all(admitted(late, *((ahead + each / 100, each / 100) for each in range(500))))
    assert late.report() is None


def test_recovered_samples_are_held_back_and_counted() -> None:
    """After 10 s without a link, a burst of recovered samples arrives; only samples of the last second are current."""
    late = LateFilter()
    assert all(admitted(late, *((each / 100, each / 100) for each in range(200))))
    burst = admitted(late, *((2 + each / 100, 12 + each / 2000) for each in range(1000)))
    assert burst == sorted(burst), "after the first current sample all are current"
    assert 900 <= burst.count(False) <= 960
    assert all(admitted(late, *((13 + each / 100, 13 + each / 100) for each in range(200))))
    assert (
        late.report() == f"held back {burst.count(False)} old messages of {ONE}, up to 10.0 s late"
    )
    assert late.report() is None


def test_slowly_recovered_samples_are_held_back() -> None:
    """Samples of a backlog that shrinks only slowly, over a slow link, are also held back."""
    late = LateFilter()
    admitted(late, (0.0, 0.0))
    slow = admitted(late, *((0.01 + each / 100, 10 + each / 150) for each in range(3_000)))
    assert slow == sorted(slow)
    assert 2_650 <= slow.count(False) <= 2_750


def test_retained_sample_is_held_back() -> None:
    """A retained message is held back, because its age is unknown; the next message is current."""
    late = LateFilter()
    assert not late.admits(sample(NOW, retained=True), arrived=50 * SECOND)
    assert admitted(late, (3600.0, 3650.0)) == [True]
    assert late.report() == f"held back 1 old message of {ONE}"


def test_clock_set_back_is_accepted_within_two_minutes() -> None:
    """A lateness that persists for two minutes is treated as a clock offset."""
    late = LateFilter()
    admitted(late, *((each / 10, each / 10) for each in range(20)))
    steps = admitted(late, *((each / 10 - 3600, each / 10) for each in range(20, 2_000)))
    assert steps == sorted(steps)
    assert 0 < steps.count(False) <= 2 * DRIFT / SECOND * 10


def test_samples_with_stalled_zenoh_timestamps_are_current() -> None:
    """Zenoh's timestamps never decrease: if a clock is set back, they stall, and all samples are current."""
    late = LateFilter()
    admitted(late, *((each / 100, each / 100) for each in range(200)))
    assert all(admitted(late, *((1.99, each / 100) for each in range(200, 2_000))))
    assert all(admitted(late, *((1.99 + each / 100, 20 + each / 100) for each in range(2_000))))
    assert admitted(late, (22.0, 45.0)) == [False]


def test_clock_drift_does_not_make_samples_late() -> None:
    """The fastest sample is the reference for two minutes at most, so a drift of 100 us per second is tolerated."""
    late = LateFilter()
    assert admitted(late, (0.0, 0.0), (60.1, 61.0), (61.0, 62.5)) == [True, True, False]
    late = LateFilter()
    assert all(admitted(late, *((each * (1 - 1e-4), float(each)) for each in range(0, 20_000, 10))))
    assert 10 * late._limit < DRIFT


def test_sample_of_a_restarted_publisher_is_current() -> None:
    """Samples of a vehicle that restarts with a clock from 1970, or was forgotten, are current at once."""
    late = LateFilter()
    admitted(late, (0.0, 0.0))
    assert late.admits(sample(SECOND, by=8), arrived=SECOND)
    late.forget(ONE)
    assert admitted(late, (0.0, 3600.0)) == [True]


def test_sample_without_a_timestamp_is_current() -> None:
    """A sample without a timestamp is admitted, because its age cannot be measured."""
    late = LateFilter()
    assert late.admits(sample(None), arrived=0)
    assert late.admits(sample(None), arrived=3600 * SECOND)


def test_report_names_one_address_and_counts_the_others() -> None:
    """A report of late messages is one line, however many vehicles have sent them."""
    late = LateFilter()
    for name in "abc":
        assert not late.admits(
            sample(NOW, address=Address(name, ONE.topic), retained=True), arrived=0
        )
    assert late.report() == "held back 3 old messages of a/vehicle_local_position and 2 more"


def test_number_of_clocks_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the limit the oldest clock is forgotten, so a late sample of its address counts as current."""
    monkeypatch.setattr(limits, "BRIDGED_STREAMS", 2)
    late, addresses = LateFilter(), [Address(str(number), ONE.topic) for number in range(3)]
    assert all(late.admits(sample(NOW, address=each), arrived=0) for each in addresses)
    assert len(late._clocks) == 2
    assert not late.admits(sample(NOW + SECOND, address=addresses[1]), arrived=60 * SECOND)
    assert late.admits(sample(NOW + SECOND, address=addresses[0]), arrived=60 * SECOND)
