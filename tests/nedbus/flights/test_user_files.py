"""Small files that reproduce user reports, with expected values from independent tools."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import pytest

import nedbus
from nedbus.errors import SourceError
from nedbus.flights import FileEvents, read_file_events
from nedbus.sources import parse_source
from tests.flights.messages import VLP
from tests.flights.replays import convert_replay, open_replay
from tests.peers.command_line import run_command

CASES: Final = Path(__file__).parents[4] / "shared/cases"

pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason="no ../shared/cases")


def utc(name: str) -> str:
    """Return the UTC of the first position."""
    found = nedbus.utc_of(CASES / name)
    assert found is not None
    return str(found.at(nedbus.read(CASES / name)["timestamp"][0]))[:19]


def count(name: str) -> dict[str, int]:
    """Return the number of messages of each stream."""
    return {stream: len(each) for stream, each in nedbus.read(CASES / name, ["*"]).items()}


def due_times(name: str) -> tuple[float, float]:
    """Return the replay times of the first and the last position [s]."""
    found = [
        each.at
        for each in open_replay(f"ulog:{CASES / name}").messages
        if each.address.topic == VLP
    ]
    return round(found[0], 2), round(found[-1], 2)


def events(name: str) -> set[tuple[str, str]]:
    """Return kind and severity of all events."""
    return {(each.kind, each.severity) for each in account(name).event_log.events}


def account(name: str) -> FileEvents:
    return read_file_events(CASES / name)


EXPECTED: Final[list[tuple[Callable[[str], object], str, object]]] = [
    (utc, "08_boot_time_utc_us.ulg", "2025-09-08 13:31:04"),
    (utc, "28_uxrce_timesync_unix.mcap", "2025-10-09 08:53:19"),  # 19.997 s, truncated
    (utc, "turn5/48_gps_utc_corrected_by_2s.ulg", "2025-10-09 08:53:30"),
    (count, "15_logging_dropout_5s.ulg", {VLP: 500}),
    (count, "16_home_position_50s_old.ulg", {VLP: 500, "home_position": 1}),
    (count, "31_fmu_in_topics.mcap", {
        VLP: 50, "offboard_control_mode": 50, "trajectory_setpoint": 50, "vehicle_visual_odometry": 50,
    }),
    (count, "04_replayed_zero_attitude.ulg", {"vehicle_attitude": 250, VLP: 250}),
    (due_times, "16_home_position_50s_old.ulg", (0.0, 9.98)),
    (due_times, "16b_home_position_108s_old.ulg", (0.0, 9.98)),
    (events, "15_logging_dropout_5s.ulg", {("dropout", "info")}),
    (events, "16_home_position_50s_old.ulg", set()),
    (events, "17_old_log_without_release.ulg", {("mode", "info")}),
    (events, "18_primary_ekf_is_1.ulg", {("other_ekf", "info")}),  # of EKF 0
]  # fmt: skip


@pytest.mark.parametrize(("value", "name", "expected"), EXPECTED)
def test_value_matches_independent_tools(
    value: Callable[[str], object], name: str, expected: object
) -> None:
    """The expected values come from pyulog, from rosbags, and from the raw records of the files."""
    assert value(name) == expected


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "clock"),
    [
        (
            "48_gps_utc_corrected_by_2s.ulg",
            "times: UTC, from the vehicle's messages; vehicle_gps_position corrected its UTC by -2.0 s in flight",
        ),
        (
            "55_gps_on_another_clock.ulg",
            "times: seconds since boot, because the timestamps of vehicle_gps_position, which has UTC, are not on",
        ),
    ],
)
def test_events_say_what_is_known_of_utc(name: str, clock: str, tmp_path: Path) -> None:
    """`nedbus events` names a correction of UTC, or why it is unknown, for a log and for its conversion."""
    convert_replay(f"ulog:{CASES / 'turn5' / name}", converted := tmp_path / "a.mcap")
    for path in (CASES / "turn5" / name, converted):
        result = run_command("events", str(path))
        assert result.exit_code == 0
        assert clock in result.err
        assert run_command("why", str(path)).exit_code == 0
        assert (nedbus.utc_of(path) is None) == name.startswith("55")


def test_log_without_release_is_converted_without_warning(tmp_path: Path) -> None:
    """A log without ver_sw_release is converted completely, without warnings."""
    log = CASES / "17_old_log_without_release.ulg"
    assert run_command("convert", str(log), str(tmp_path / "a.mcap")).exit_code == 0
    assert account("17_old_log_without_release.ulg").warnings == ()


def test_end_of_fake_position_fusion_is_the_cause() -> None:
    """Fake position fusion ends at 154.1 s and no other begins before 160.4 s, so xy is invalid from 154.3 s."""
    lines = run_command("events", str(CASES / "15b_ekf_aiding_lost.ulg")).out.splitlines()
    (invalid,) = (line for line in lines if "BAD    xy not valid" in line)
    assert invalid.startswith("   154.300")
    assert "no horizontal aiding: EKF stopped fusing fake position (200 ms before)" in invalid


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("07_encrypted.ulg", "an encrypted log"),
        ("24_ros2idl.mcap", "cdr with ros2idl"),
        ("24b_no_definition.mcap", "no definition of px4_msgs/msg/VehicleLocalPosition"),
    ],
)
def test_unreadable_file_raises_with_the_reason(name: str, reason: str) -> None:
    """The error for a file that cannot be read states the reason."""
    with pytest.raises(SourceError, match=reason):
        nedbus.read(CASES / name)


@pytest.mark.parametrize(
    "name",
    ["Bom", "BomCrlf", "DefaultValue", "FormFeed", "Latin1", "LineSep", "Nel", "StringConst"],
)
def test_msg_file_variants_are_read(name: str) -> None:
    """All .msg files that the library rosbags reads are accepted, as are files with a BOM, which it rejects."""
    source: Any = parse_source(f"px4-zenoh:?msg={CASES / '43_msg_files' / name}.msg").open_source(
        vehicle="1"
    )
    ((definition,),) = (each.values() for each in source._supplied.values())
    assert [*definition.types][:3] == ["timestamp", "angle", "mode"]
