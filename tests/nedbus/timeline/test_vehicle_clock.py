"""A vehicle's own time: what is a reboot, and what is a copy, a late message, a wrap, a wild time or a step."""

import pytest
from hypothesis import given, strategies as st

from nedbus import limits
from nedbus.timeline import RecentTimes, TimeKind, VehicleClock, is_boot_possible

MODULUS = 1000 << 32  # us until `time_boot_ms` is 0 again
UNIX = 1_760_000_000_000_000


def _run(clock: VehicleClock, begin: int, count: int, now: float) -> list[TimeKind]:
    step, kinds = 0.05, list[TimeKind]()
    for number in range(count):
        time = begin + round(1e6 * step) * number
        kinds += [clock.add(stream, time, now + step * number).kind for stream in "ab"]
    return kinds


def test_time_goes_on_after_32_bits() -> None:
    """`time_boot_ms` starts from 0 again after 49.7 days: the vehicle did not reboot, and its time goes on."""
    clock = VehicleClock(MODULUS)
    for number in range(200):
        time = MODULUS - 5_000_000 + 50_000 * number
        reading = clock.add("a", time % MODULUS, 0.05 * number)
        assert reading == (TimeKind.NEW, time, 0)


def test_late_message_from_before_the_wrap_keeps_its_time() -> None:
    """A slower link delivers a message from before the wrap after it."""
    clock = VehicleClock(MODULUS)
    clock.add("a", MODULUS - 100_000, 0.0)
    clock.add("a", 1_400_000, 1.5)
    assert clock.add("a", MODULUS - 60_000, 1.5) == (TimeKind.LATE, MODULUS - 60_000, 0)


@pytest.mark.parametrize("late", [0.3, 0.5, 1.5, 3.0, 5.0])
def test_second_link_delivers_copies(late: float) -> None:
    """A vehicle over two links does not reboot: each message of the slower one is a copy."""
    clock, kinds = VehicleClock(MODULUS), list[TimeKind]()
    for number in range(200):
        now = 0.05 * number
        _run(clock, 100_000_000 + 50_000 * number, 1, now)
        if now > late:
            delayed = 100_000_000 + 50_000 * (number - round(late / 0.05))
            kinds += [clock.add(stream, delayed, now).kind for stream in "ab"]
    assert set(kinds) == {TimeKind.COPY}
    assert clock.copies == len(kinds)
    assert clock.boot == 0


@pytest.mark.parametrize("wild", [0, 1, 2**64 - 5, 900_000_000])
def test_one_wild_time_changes_nothing(wild: int) -> None:
    """One damaged time is neither a reboot nor the vehicle's time."""
    clock = VehicleClock()
    _run(clock, 100_000_000, 20, 0.0)
    assert clock.add("a", wild, 1.0).kind in (TimeKind.WILD, TimeKind.LATE)
    assert set(_run(clock, 101_000_000, 20, 1.0)) == {TimeKind.NEW}
    assert clock.boot == 0


@pytest.mark.parametrize("back", [500_000, 2_000_000, 3_000_000, 3_600_000_000])
def test_a_synchronised_clock_that_is_set_back_is_no_reboot(back: int) -> None:
    """Unix timestamps follow the companion's clock: setting it back is a step."""
    clock = VehicleClock()
    _run(clock, UNIX, 20, 0.0)
    kinds = _run(clock, UNIX + 1_000_000 - back, 100, 1.0)
    assert TimeKind.REBOOT not in kinds
    assert clock.boot == 0
    assert clock.newest == UNIX + 1_000_000 - back + 99 * 50_000


def test_reboot_after_a_pause_that_explains_it() -> None:
    """A vehicle that is up for 4 s, 5 s after its last message, has rebooted once."""
    clock = VehicleClock(MODULUS)
    _run(clock, 100_000_000, 20, 0.0)
    kinds = _run(clock, 4_000_000, 20, 6.0)
    assert kinds.count(TimeKind.REBOOT) == clock.boot == 1
    assert clock.newest == 4_950_000


def test_another_clock_counts_once_it_lasts() -> None:
    """A file may not show the pause before a reboot: times that go on for ten seconds are the vehicle's."""
    clock = VehicleClock()
    _run(clock, 500_000_000, 20, 0.0)
    kinds = _run(clock, 300_000_000, 300, 1.0)
    assert kinds.count(TimeKind.REBOOT) == clock.boot == 1


def test_nothing_runs_for_longer_than_it_exists() -> None:
    """The rule of a reboot."""
    assert is_boot_possible(6_000_000, 5.0)
    assert not is_boot_possible(98_500_000, 0.05)
    assert not is_boot_possible(UNIX, None)


_SEGMENTS = st.lists(
    st.tuples(st.sampled_from(["go on", "pause", "reboot"]), st.integers(5, 600)), max_size=8
)


@given(start=st.integers(3_000_000, MODULUS - 1_000_000), segments=_SEGMENTS)
def test_any_flight_keeps_its_order_and_durations(
    start: int, segments: list[tuple[str, int]]
) -> None:
    """For any pauses, reboots and wraps: boots are counted, and within one, times and durations are the vehicle's."""
    clock, now, time, boots = VehicleClock(MODULUS), 100.0, start, 0
    for kind, seconds in [("go on", 0), *segments]:
        if kind == "pause":
            now, time = now + seconds, time + 1_000_000 * seconds
        if kind == "reboot":
            if time % MODULUS < 700_000_000 or time % MODULUS > MODULUS - 700_000_000:
                continue  # the times alone do not tell: it may have been up, or have wrapped
            boots += 1
            now, time = now + seconds, 2_000_000
        for _ in range(40):
            now, time = now + 0.05, time + 50_000
            for stream in "ab":
                reading = clock.add(stream, time % MODULUS, now)
        assert (clock.newest, clock.boot, reading.time) == (time, boots, time)


def test_known_times_are_bounded_per_stream_and_in_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    """A copy is found among the last times of a stream; older times, and streams beyond the limit, are not kept."""
    monkeypatch.setattr(limits, "KNOWN_TIMES", 3)
    monkeypatch.setattr(limits, "VEHICLE_STREAMS", 2)
    times = RecentTimes()
    for stream in "abc":
        for time in range(1, 5):
            times.add(stream, time)
    known = {
        stream: [time for time in range(1, 5) if times.contains(stream, time)] for stream in "abc"
    }
    assert known == {"a": [2, 3, 4], "b": [2, 3, 4], "c": []}
