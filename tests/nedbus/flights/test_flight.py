"""An open flight: its axis counts pauses, its samples end with it, and its file is read twice at most."""

from __future__ import annotations

import gc
import math
import os
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import pytest
from hypothesis import example, given, strategies as st

import nedbus
from nedbus.errors import AddressError, ArgumentError, ClosedError
from nedbus.flights import flight as flight_module, follow, read_file_events
from nedbus.samples import SourceMessage
from nedbus.timeline import Order
from nedbus.vehicle_events import EventLog
from nedbus_msgs import VehicleLocalPosition
from tests.flights.messages import VALID, VLP, message
from tests.flights.ulogs import UlogWriter, write_log
from tests.peers.command_line import run_command

BOOT: Final = 1_700_000_000_000_000
"""Unix time of the first message [us]."""

PAUSE: Final = 600_000_000  # us


def steps(begin: int, count: int, *, step: int = 100_000) -> list[int]:
    return [begin + step * number for number in range(count)]


def paused(path: Path) -> Path:
    """Write 10 s at 10 Hz, from 0 s and from 600 s on, with Unix timestamps."""
    return write_log(path, [*steps(BOOT, 100), *steps(BOOT + PAUSE, 100)])


def test_start_and_end_count_pauses(tmp_path: Path) -> None:
    """Seconds and UTC mean the same place behind a pause of minutes."""
    begin = datetime.fromtimestamp(BOOT / 1e6 + 605, UTC)
    with nedbus.open(paused(tmp_path / "a.ulg")) as flight:
        by_utc = [
            each.message.timestamp for each in flight(start=begin, end=begin + timedelta(seconds=3))
        ]
        by_seconds = [each.message.timestamp for each in flight(start=605.0, end=608.0)]
        assert by_utc == by_seconds == steps(BOOT + PAUSE + 5_000_000, 31)
        assert flight.duration == pytest.approx(609.9)


def two_topics(path: Path, begin: int) -> Path:
    """Write 20 s of one topic at 10 Hz, and the last 12 s of them of another one."""
    writer = UlogWriter()
    writer.define(["vehicle_local_position", "external_ins_local_position"])
    for number, stamp in enumerate(steps(begin, 200)):
        message = VehicleLocalPosition.model_validate({"timestamp": stamp})
        writer.add("vehicle_local_position", message)
        if number >= 80:
            writer.add("external_ins_local_position", message)
    return writer.write(path)


@pytest.mark.parametrize("several", [False, True])
def test_start_and_end_mean_the_same_for_every_topic(tmp_path: Path, *, several: bool) -> None:
    """The axis begins with the first message of the files, also for a topic that begins later."""
    path = two_topics(tmp_path / "a.ulg", BOOT)
    files = [path, two_topics(tmp_path / "b.ulg", BOOT + 1_000_000)] if several else path
    begin = datetime.fromtimestamp(BOOT / 1e6 + 10, UTC)
    with nedbus.open(files) as flight:
        for topic in ("vehicle_local_position", "external_ins_local_position"):
            for start in (10.0, begin):
                samples = list(flight(topic, start=start, end=12.0))
                assert samples[0].message.timestamp == BOOT + 10_000_000
                assert samples[-1].message.timestamp == BOOT + 12_000_000
                assert len(samples) == (42 if several else 21)


@pytest.mark.parametrize("option", ["start", "end"])
def test_datetime_without_a_time_zone_is_an_error(tmp_path: Path, option: str) -> None:
    """A naive datetime would mean another period in Tokyo than in London; the error shows the remedy."""
    naive = datetime.fromtimestamp(BOOT / 1e6 + 5, UTC).replace(tzinfo=None)
    with (
        nedbus.open(paused(tmp_path / "a.ulg")) as flight,
        pytest.raises(ArgumentError, match="tzinfo=UTC"),
    ):
        flight(**{option: naive})  # type: ignore[call-overload] # mypy does not know which of the options it is


@pytest.mark.parametrize("option", ["start", "end"])
@pytest.mark.parametrize("value", ["10", math.nan, pytest.param(10**400, id="large")])
def test_start_and_end_that_are_no_time_raise(tmp_path: Path, option: str, value: Any) -> None:
    """A string, NaN and an integer beyond float64 raise ArgumentError."""
    with (
        nedbus.open(paused(tmp_path / "a.ulg")) as flight,
        pytest.raises(ArgumentError, match=f"{option} .* expected seconds, or a datetime"),
    ):
        flight(**{option: value})


def test_utc_in_a_flight_without_utc_is_an_error(tmp_path: Path) -> None:
    """The error names the remedy: seconds."""
    path = write_log(tmp_path / "a.ulg", steps(1_000_000, 20))
    with (
        nedbus.open(path) as flight,
        pytest.raises(ArgumentError, match="seconds since the first message"),
    ):
        flight(start=datetime.fromtimestamp(BOOT / 1e6, UTC))


def test_file_is_opened_twice_at_most(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Duration, UTC and warnings come from one pass, the samples from another one."""
    opened: list[Path] = []
    real = flight_module.open_reader

    def count(path: Path, options: flight_module.ReadOptions) -> object:
        opened.append(path)
        return real(path, options)

    monkeypatch.setattr(flight_module, "open_reader", count)
    path = paused(tmp_path / "a.ulg")
    with nedbus.open(path) as flight:
        assert flight.utc is not None
        assert flight.duration == pytest.approx(609.9)
        assert not flight.warnings
        begin = datetime.fromtimestamp(BOOT / 1e6 + 605, UTC)
        assert len(list(flight(start=begin))) == 50
    assert opened == [path, path]


@pytest.mark.slow
def test_samples_end_with_their_flight(tmp_path: Path) -> None:
    """After the `with` block, samples raise ClosedError, and no file stays open."""
    path = write_log(tmp_path / "a.ulg", steps(1_000_000, 20_000))
    with nedbus.open(path) as flight:
        samples = flight()
        next(samples)
    with pytest.raises(ClosedError):
        next(samples)
    links = [link for link in Path("/proc/self/fd").iterdir() if os.path.lexists(link)]
    assert path not in [link.readlink() for link in links]


@pytest.mark.slow
def test_dropped_flight_closes_its_file(tmp_path: Path) -> None:
    """A script that opens many files without `with` does not run out of file descriptors."""
    path = write_log(tmp_path / "a.ulg", steps(1_000_000, 20_000))
    gc.disable()  # which would close them, too, but later
    try:
        nedbus.open(path)
        links = [link for link in Path("/proc/self/fd").iterdir() if os.path.lexists(link)]
        assert path not in [link.readlink() for link in links]
    finally:
        gc.enable()


def test_rows_do_not_change_the_samples(tmp_path: Path) -> None:
    """Iterating over rows leaves the iterator over models as it is."""
    with nedbus.open(write_log(tmp_path / "a.ulg", steps(1_000_000, 10))) as flight:
        samples = flight()
        assert isinstance(next(samples).message, nedbus.VehicleLocalPosition)
        assert isinstance(next(samples.rows()).message, tuple)
        assert isinstance(next(samples).message, nedbus.VehicleLocalPosition)


@pytest.mark.parametrize("end", [None, 5.0])
def test_misspelt_vehicle_is_an_error(tmp_path: Path, end: float | None) -> None:
    """A vehicle that the file does not have is an AddressError, also with `end`."""
    path = write_log(tmp_path / "a.ulg", steps(1_000_000, 100))
    with nedbus.open(path) as flight, pytest.raises(AddressError):
        list(flight(vehicle="99", end=end))


def test_last_message_after_a_pause_is_in_order(tmp_path: Path) -> None:
    """One message after 85 s is no timestamp out of order."""
    path = write_log(tmp_path / "a.ulg", [*steps(1_000_000, 5, step=1_000_000), 90_000_000])
    with nedbus.open(path) as flight:
        assert flight.warnings == ()
        assert flight.duration == pytest.approx(89.0)


def test_several_files_are_chronological_whatever_pauses_they_have(tmp_path: Path) -> None:
    """`open` and `read` merge a file with a pause of minutes and one without by UTC."""
    first = write_log(
        tmp_path / "a.ulg",
        [*steps(BOOT, 10, step=10**6), *steps(BOOT + 300_000_000, 10, step=10**6)],
    )
    second = write_log(tmp_path / "b.ulg", steps(BOOT, 310, step=10**6))
    with nedbus.open([first, second]) as flight:
        times = [each.message.timestamp for each in flight()]
        assert flight.duration == pytest.approx(309.0)
    assert times == sorted(times)
    arrays = nedbus.read([first, second], ["vehicle_local_position"])
    assert sorted(time for each in arrays.values() for time in each["timestamp"].tolist()) == times


@pytest.mark.slow
def test_events_of_several_files_are_chronological(tmp_path: Path) -> None:
    """A pause in one file does not shift its later events against those of the other one."""
    stamps = [*steps(BOOT, 2000), *steps(BOOT + PAUSE, 200)]
    first = write_log(tmp_path / "a.ulg", stamps)
    second = write_log(tmp_path / "b.ulg", steps(BOOT, 3100, step=200_000))
    events = read_file_events(first, second).event_log.events
    silent = [(each.vehicle, each.change, round(each.time)) for each in events]
    assert silent == [("a", "begin", 203), ("a", "end", 600)]


def test_why_at_a_time_before_a_pause(tmp_path: Path) -> None:
    """`why --at` looks at the axis with its pauses: the fault of that moment is explained."""
    path = tmp_path / "a.ulg"
    write_log(path, [*steps(1_000_000, 2000), *steps(PAUSE, 200)])
    found = run_command("why", str(path), "--at", "300")
    assert "silent" in found.out, found.err


_STEP: Final = 100_000  # us between two messages
_PARTS = st.lists(
    st.tuples(
        st.sampled_from(["pause", "reboot", "host"]), st.integers(20, 60), st.integers(5, 900)
    ),
    max_size=5,
)


_SOUND: Final = {
    **dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"), True),
    **dict.fromkeys(("x", "y", "z", "vx", "vy", "vz", "heading"), 0.0),
}


@pytest.mark.slow
@given(_PARTS)
# the third boot reaches the time of the second
@example([("reboot", 20, 199), ("reboot", 20, 558)])
def test_no_event_is_invented_by_any_sequence_of_clocks(parts: list[tuple[str, int, int]]) -> None:
    """Pauses are silences, reboots are reboots, and steps of the recorder's clock are nothing; times are the axis."""
    address = nedbus.Address("1", "vehicle_local_position")
    stamp, host, place = 5_000_000, BOOT, 0
    messages: list[SourceMessage] = []
    expected: list[tuple[str, float]] = []
    for change, count, seconds in [("begin", 30, 0), *parts]:
        gap = 1_000_000 * seconds
        if change == "host":
            host += 1_000_000 * (seconds - 450)
        elif change != "begin":
            if change == "reboot":
                expected.append(("reboot", place + gap))
                host += stamp + gap - 1_000_000
                stamp = 1_000_000
            else:
                stamp += gap
            expected.append(("silent", place + gap))
            place += gap
        for _ in range(count):
            messages.append(
                SourceMessage(0.0, address, {"timestamp": stamp, **_SOUND}, time=stamp + host)
            )
            stamp, place = stamp + _STEP, place + _STEP
    event_log = EventLog()
    for _ in follow(Order[SourceMessage]().arrange(messages), event_log):
        pass
    found = [(each.kind, each.time) for each in event_log.events if each.change != "begin"]
    texts = [each.text for each in event_log.events]
    assert sorted(kind for kind, _ in found) == sorted(kind for kind, _ in expected), texts
    assert sorted(time for _, time in found) == pytest.approx(
        sorted(time / 1e6 for _, time in expected), abs=0.5
    )


def test_warning_names_the_first_reason_of_invalid_messages(tmp_path: Path) -> None:
    """Invalid messages of a stream are skipped with one warning: their number, and what is wrong with the first."""
    writer = UlogWriter()
    writer.define([VLP])
    for number in range(10):
        fields: dict[str, Any] = dict(VALID)
        if number in (3, 7):
            fields |= {"x": math.nan} if number == 3 else {"vz": math.nan}
        writer.add(VLP, message(1_000_000 + 100_000 * number), **fields)
    with nedbus.open(writer.write(tmp_path / "a.ulg")) as flight:
        samples = flight()
        assert len(list(samples)) == 8
        [warning] = samples.warnings
    assert warning.startswith(f"skipped 2 messages of 1/{VLP} as invalid (x: must be finite")


def test_truncated_log_has_lost_nothing_to_damage(tmp_path: Path) -> None:
    """A log whose end was not written is not damaged, unlike one with a message of no definition; both are warnings."""
    path = write_log(tmp_path / "a.ulg", [1_000_000, 2_000_000, 3_000_000])
    content = path.read_bytes()
    path.write_bytes(content[:-5])
    with nedbus.open(path) as flight:
        assert flight.warnings == (f"{path}: truncated (the file ends inside a message)",)
        assert not flight.damaged
    unknown = b"\x0a\x00D" + b"\x63\x00" + bytes(8)  # message id 99 was not subscribed to
    path.write_bytes(content + unknown)
    with nedbus.open(path) as flight:
        assert flight.warnings == (f"{path}: skipped messages without a definition (1)",)
        assert flight.damaged


@pytest.mark.parametrize(("system_id", "vehicle"), [(255, "255"), (0, "1"), (256, "1")])
def test_system_id_outside_mavlinks_range_is_not_used(
    tmp_path: Path, system_id: int, vehicle: str
) -> None:
    """A log is of the vehicle 1 unless MAV_SYS_ID is from 1 to 255."""
    writer = UlogWriter(system_id=system_id)
    writer.define([VLP])
    writer.add(VLP, message())
    with nedbus.open(writer.write(tmp_path / "a.ulg")) as flight:
        assert [address.vehicle for address in flight.addresses] == [vehicle]
