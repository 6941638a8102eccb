"""Replays of recordings: paced and ordered by log time."""

from __future__ import annotations

from itertools import repeat
from pathlib import Path

import numpy as np
import pytest

from nedbus.flights import RecordingWriter
from nedbus_msgs import DEFAULT, Address, Provenance
from nedbus_msgs.arrays import to_array
from tests.flights.messages import VLP, message
from tests.flights.replays import convert_replay, open_replay


def due_times(path: Path, *logged: float) -> list[float]:
    """Return the replay times of messages recorded at these times [s], with unrelated publish times."""
    with RecordingWriter(path) as writer:
        for number, time in enumerate(logged):
            address = Address(str(number % 2), VLP)
            published = number % 2 * 3600 * 10**9 + (10**19 if number == 3 else number)
            rows = to_array([message(number)])
            writer.write(rows, DEFAULT, [(address, Provenance())], logged=[round(time * 1e9)], published=[published])
    return [round(each.due, 6) for each in open_replay(f"mcap:{path}").messages]


@pytest.mark.parametrize(
    ("logged", "due"),
    [
        ([0, 1, 2, 3, 4], [0, 1, 2, 3, 4]),  # two vehicles whose clocks differ by an hour
        ([0, 10800, 10801, 10802], [0, 0, 1, 2]),  # a retained message that is three hours old
        ([0, 1, 1.7e10, 2, 3], [0, 1, 1, 2, 3]),  # an outlier
        ([5, 6, 5.5, 7], [0, 0.5, 1, 2]),  # a message that was written late
        ([5000, 5001, 0, 1], [0, 1, 1, 2]),  # the recorder's clock was set back
    ],
)
def test_replay_is_paced_by_recording_times(tmp_path: Path, logged: list[float], due: list[float]) -> None:
    """Recording times pace a replay, not publishers' clocks; gaps above a minute are skipped, even after conversion."""
    assert due_times(tmp_path / "a.mcap", *logged) == due
    convert_replay(f"mcap:{tmp_path / 'a.mcap'}", tmp_path / "b.mcap")
    assert [each.due for each in open_replay(f"mcap:{tmp_path / 'b.mcap'}").messages] == due


def test_replay_is_ordered_across_batches_of_streams(tmp_path: Path) -> None:
    """Up to 8,192 messages that a recorder wrote stream by stream are replayed in the order of their log times."""
    count, stamps = 4096, np.arange(8192, dtype=np.int64).reshape(-1, 2).T  # of two streams, alternately
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        for vehicle, own in zip("12", stamps, strict=True):
            rows = np.repeat(to_array([message(1)]), count)
            rows["timestamp"] = 1_000_000 + own
            stream = repeat((Address(vehicle, VLP), Provenance()))
            writer.write(rows, DEFAULT, stream, logged=(own * 1000).tolist(), published=repeat(0))
    replayed = [each.fields["timestamp"] for each in open_replay(f"mcap:{tmp_path / 'a.mcap'}").messages]
    assert replayed == list(range(1_000_000, 1_000_000 + 2 * count))
