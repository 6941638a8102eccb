"""Files of users whose clocks were set, wrapped, reset or damaged: order, duration, and no invented event."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Final

import pytest

import nedbus
from nedbus.flights import read_file_events

CASES: Final = Path(__file__).parents[4] / "shared/cases/turn6"

pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason="no ../shared/cases")

# Positions, seconds, and steps back of the timestamps; only a Unix clock that was set has one.
EXPECTED: Final = [
    ("01_clock_back_5s.mcap", 1000, 19.98, 0),
    ("01d_clock_forward_20s.mcap", 1000, 19.98, 0),
    ("01f_own_recording_clock_back_3s.mcap", 813, 8.12, 0),
    ("01g_tlog_forward_20s.tlog", 200, 19.9, 0),
    ("02_sim_time_zero.mcap", 500, 9.98, 0),
    ("06_boot_ms_wrap.tlog", 400, 19.95, 0),
    ("12_unix_back_3s.mcap", 500, 19.92, 1),
    ("16_system_time_2000.tlog", 200, 19.9, 0),
    ("17_header_start_unix.ulg", 250, 24.9, 0),
    ("22_unix_sync_back_2s.mcap", 500, 19.96, 1),
    ("24b_rollover_three.mcap", 500, 19.96, 0),
]


@pytest.mark.parametrize(("name", "count", "duration", "steps"), EXPECTED)
def test_order_and_duration_are_the_vehicles(
    name: str, count: int, duration: float, steps: int
) -> None:
    """`open` and `read` give the same order and duration, whatever happened to the clock of the recorder."""
    with nedbus.open(CASES / name) as flight:
        times = [each.message.timestamp for each in flight()]
        assert flight.duration == pytest.approx(duration, abs=0.001)
    assert nedbus.read(CASES / name)["timestamp"].tolist() == times
    assert len(times) == count
    assert sum(after < before for before, after in pairwise(times)) == steps


@pytest.mark.parametrize("name", [name for name, *_ in EXPECTED if not name.startswith("17")])
def test_no_event_is_invented(name: str) -> None:
    """A clock that was set, wrapped or damaged is no reboot, no jump and no silence."""
    assert not read_file_events(CASES / name).event_log.events


def test_start_in_a_header_on_another_clock_hides_no_fault() -> None:
    """Messages that advance together decide where the flight begins: xy is invalid from 30 to 35 s since boot."""
    events = read_file_events(CASES / "17_header_start_unix.ulg").event_log.events
    assert [(each.kind, each.time) for each in events] == [
        ("xy_invalid", 10.0),
        ("xy_invalid", 15.0),
    ]


def test_clock_that_was_never_set_is_no_utc() -> None:
    """A SYSTEM_TIME of 2000 is ignored; the clock of the ground station is used."""
    utc = nedbus.utc_of(CASES / "16_system_time_2000.tlog")
    assert utc is not None
    assert str(utc.at(20_000_000)).startswith("2025-10-09")


def test_wrapped_time_has_utc() -> None:
    """`time_boot_ms` wraps after 49.7 days, and UTC stays known."""
    utc = nedbus.utc_of(CASES / "06_boot_ms_wrap.tlog")
    assert utc is not None
    assert utc.source == "sensor_gps/0"
