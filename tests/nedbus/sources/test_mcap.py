"""Order and times of recordings: those of the vehicle's clock."""

from __future__ import annotations

from itertools import repeat
from pathlib import Path

import numpy as np
import pytest

import nedbus
from nedbus.flights import RecordingWriter, read_file_events
from nedbus_msgs import DEFAULT, Address, Provenance
from nedbus_msgs.arrays import to_array
from tests.flights.messages import VLP, message
from tests.flights.replays import convert_replay, open_replay


def write_recording(path: Path, stamps: list[float], logged: list[float]) -> Path:
    """Write positions with these timestamps and log times [s]."""
    with RecordingWriter(path) as writer:
        for stamp, time in zip(stamps, logged, strict=True):
            rows, stream = (
                to_array([message(round(stamp * 1e6))]),
                (Address("1", VLP), Provenance()),
            )
            writer.write(rows, DEFAULT, [stream], logged=[round(time * 1e9)], published=[0])
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "after"),
    [(-0.5, 500), (-3.0, 300), (-5.0, 700), (20.0, 500), (3600.0, 10), (1e10, 999), (-1e9, 1)],
)
def test_step_of_the_recorders_clock_changes_nothing(
    tmp_path: Path, change: float, after: int
) -> None:
    """The vehicle's timestamps determine order and duration, whatever the recorder's clock does, even converted."""
    stamps = [100 + number / 50 for number in range(1000)]
    logged = [
        1.76e9 + stamp + (change if number >= after else 0) for number, stamp in enumerate(stamps)
    ]
    convert_replay(
        f"mcap:{write_recording(tmp_path / 'a.mcap', stamps, logged)}", tmp_path / "b.mcap"
    )
    for name in ("a.mcap", "b.mcap"):
        with nedbus.open(tmp_path / name) as flight:
            assert [each.message.timestamp / 1e6 for each in flight()] == pytest.approx(stamps)
            assert flight.duration == pytest.approx(19.98)
    found = read_file_events(tmp_path / "a.mcap")
    assert [each.kind for each in found.event_log.events] == []


@pytest.mark.parametrize("change", [-0.5, -2.0, -3.0, 20.0])
def test_step_of_a_unix_clock_keeps_the_order_of_the_file(tmp_path: Path, change: float) -> None:
    """A synchronized clock that is set is no pause and no reboot: the log times show how much time passed."""
    stamps = [1.76e9 + number / 25 + (change if number >= 250 else 0) for number in range(500)]
    path = write_recording(
        tmp_path / "a.mcap", stamps, [1.76e9 + number / 25 for number in range(500)]
    )
    with nedbus.open(path) as flight:
        assert [each.message.timestamp / 1e6 for each in flight()] == pytest.approx(stamps)
        assert flight.duration == pytest.approx(19.96, abs=0.1)


def test_reboot_begins_a_new_part(tmp_path: Path) -> None:
    """After a reboot the order is that of the file, and the log times show the pause."""
    stamps = [100 + number / 10 for number in range(100)] + [
        5 + number / 10 for number in range(100)
    ]
    logged = [1.76e9 + number / 10 + (20 if number >= 100 else 0) for number in range(200)]
    with nedbus.open(write_recording(tmp_path / "a.mcap", stamps, logged)) as flight:
        assert [each.message.timestamp / 1e6 for each in flight()] == pytest.approx(stamps)
        assert flight.duration == pytest.approx(39.9)


@pytest.mark.slow
def test_replay_is_ordered_across_batches_of_streams(tmp_path: Path) -> None:
    """Up to 8,192 messages that a recorder wrote stream by stream are replayed in the order of their log times."""
    # of two streams, alternately
    count, stamps = 4096, np.arange(8192, dtype=np.int64).reshape(-1, 2).T
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        for vehicle, own in zip("12", stamps, strict=True):
            rows = np.repeat(to_array([message(1)]), count)
            rows["timestamp"] = 1_000_000 + own
            stream = repeat((Address(vehicle, VLP), Provenance()))
            writer.write(rows, DEFAULT, stream, logged=(own * 1000).tolist(), published=repeat(0))
    replayed = [
        each.fields["timestamp"] for each in open_replay(f"mcap:{tmp_path / 'a.mcap'}").messages
    ]
    assert replayed == list(range(1_000_000, 1_000_000 + 2 * count))
