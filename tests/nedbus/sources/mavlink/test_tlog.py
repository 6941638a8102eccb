"""Telemetry logs (.tlog) of QGroundControl and MAVProxy: converted like live messages, at the times in the file."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

import nedbus
from nedbus.errors import SourceError
from nedbus.flights.readers import tlog
from tests.flights.messages import VLP
from tests.flights.replays import open_replay
from tests.peers.command_line import run_command

CASES = Path(__file__).parents[5] / "shared/cases/turn6"
EPOCH = 1_760_000_000_000_000  # us; 2025-10-09 08:53:20 UTC
FLAGS = 0x3F  # ESTIMATOR_STATUS: all valid


def frames(system: int, count: int, *, signed: bool = False, version: int = 2) -> Iterable[bytes]:
    """Yield records of a vehicle that booted at EPOCH: attitude, status and position at 10 Hz."""
    sender = mavlink.MAVLink(None, system, 1)
    if signed:
        sender.signing.secret_key, sender.signing.sign_outgoing = bytes(32), True
    station = mavlink.MAVLink(None, 255, 190)
    beat: Any = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    for number in range(count):
        ms = 1000 + 100 * number
        messages: list[Any] = [
            mavlink.MAVLink_attitude_message(ms, 0, 0, 0.5, 0, 0, 0),
            mavlink.MAVLink_estimator_status_message(ms * 1000, FLAGS, 0, 0, 0, 0, 0, 0, 0.5, 0.5),
            mavlink.MAVLink_local_position_ned_message(ms, number, 2, -3, 1, 0, 0),
        ]
        for each in messages:
            sender.seq = (sender.seq + 1) % 256
            packed = each.pack(sender, force_mavlink1=version == 1)
            yield struct.pack(">Q", EPOCH + ms * 1000) + packed
        yield struct.pack(">Q", EPOCH + ms * 1000) + beat.pack(station)


@pytest.mark.parametrize("form", [{}, {"signed": True}, {"version": 1}])
def test_tlog_is_read_by_all_commands(tmp_path: Path, form: dict[str, Any]) -> None:
    """Arrays, replay, events and recording contain all positions of the vehicle, with the host's UTC."""
    path = tmp_path / "flight.tlog"
    path.write_bytes(b"".join(frames(7, 100, **form)))
    positions = nedbus.read(path)
    assert positions["x"].tolist() == list(range(100))
    assert positions["xy_valid"].all()
    assert math.isclose(positions["heading"][5], 0.5, rel_tol=1e-6)
    assert "delta_z" in nedbus.missing_of(positions)
    utc = nedbus.utc_of(path)
    assert utc is not None
    assert utc.offset_us == EPOCH
    run = open_replay(f"tlog:{path}?vehicle=a")
    replayed = [each for each in run.messages if each.address.topic == VLP]
    assert [(each.address.vehicle, each.fields["x"]) for each in replayed] == [
        ("a", x) for x in range(100)
    ]
    np.testing.assert_allclose(
        [each.at for each in replayed], [number / 10 for number in range(100)]
    )
    assert not run.warnings
    assert run_command("events", str(path)).exit_code == 0
    assert run_command("convert", str(path), str(tmp_path / "a.mcap")).exit_code == 0
    assert nedbus.read(tmp_path / "a.mcap")["x"].tolist() == list(range(100))
    assert nedbus.missing_of(nedbus.read(tmp_path / "a.mcap")) == nedbus.missing_of(positions)


@pytest.mark.parametrize("seconds", [20.0, 60.2, -5.0, -3600.0])
def test_step_of_the_hosts_clock_takes_no_time(tmp_path: Path, seconds: float) -> None:
    """The vehicle's clock determines how much time passed, not that of the ground station."""
    path = tmp_path / "flight.tlog"
    records = list(frames(7, 20))
    middle = len(records) // 2
    for index in range(middle, len(records)):
        (stamp,) = struct.unpack_from(">Q", records[index])
        records[index] = (
            struct.pack(">Q", stamp + round((seconds - 0.1) * 1e6)) + records[index][8:]
        )
    path.write_bytes(b"".join(records))
    due = [each.at for each in open_replay(f"tlog:{path}").messages if each.address.topic == VLP]
    np.testing.assert_allclose(np.diff(due), [0.1] * 19, atol=1e-6)


def test_autopilots_in_tlog_are_separate_vehicles(tmp_path: Path) -> None:
    """Each autopilot is a vehicle named by its system id; the ground station is not a vehicle."""
    path = tmp_path / "flight.tlog"
    pairs = zip(frames(1, 10), frames(2, 10), strict=True)
    path.write_bytes(b"".join(one + two for one, two in pairs))
    assert {address.vehicle for address in nedbus.addresses_of(path)} == {"1", "2"}
    assert len(nedbus.read(path, vehicle=2)) == 10
    assert run_command("why", "-v", "1", str(path)).exit_code == 0


def test_boot_time_of_tlog_ignores_old_samples(tmp_path: Path) -> None:
    """The time of the boot comes from the vehicle's newest time, not from the old sample of a lost GPS receiver."""
    sender = mavlink.MAVLink(None, 7, 1)
    messages: list[Any] = [
        mavlink.MAVLink_system_time_message(0, 60_000),
        mavlink.MAVLink_gps_raw_int_message(5_000_000, 1, 0, 0, 0, 0, 0, 0, 0, 9),
    ]
    path = tmp_path / "flight.tlog"
    path.write_bytes(
        b"".join(struct.pack(">Q", EPOCH + 60_000_000) + each.pack(sender) for each in messages)
    )
    utc = nedbus.utc_of(path)
    assert utc is not None
    assert utc.offset_us == EPOCH


def test_damaged_tlog_loses_only_the_damaged_messages(tmp_path: Path) -> None:
    """Bytes that are not MAVLink are skipped and reported; a truncated file is read up to the last whole frame."""
    path = tmp_path / "flight.tlog"
    records = list(frames(1, 50))
    damaged = bytearray(records[42])  # a position
    damaged[12] ^= 0xFF
    path.write_bytes(
        b"".join([*records[:42], damaged, *records[43:90], bytes(50), *records[90:]])[:-3]
    )
    positions = nedbus.read(path)
    assert positions["x"].tolist() == [x for x in range(50) if x != 10]
    run = open_replay(f"tlog:{path}")
    list(run.messages)
    assert run.damage is not None
    assert "B are not MAVLink" in run.damage


@pytest.mark.parametrize(
    ("cut", "zeros", "count", "warning"),
    [
        (3, 0, 49, "truncated (the file ends within a message)"),
        (30, 0, 49, "truncated (the file ends within a message)"),
        (0, 1, 50, "truncated (the last 1 B are zeros, as after a power cut)"),
        (0, 4096, 50, "truncated (the last 4096 B are zeros, as after a power cut)"),
        (5, 4096, 49, "truncated (the last"),
        (30, 4096, 49, "truncated (the last"),
        (38, 2**22, 49, "truncated (the last"),
    ],
)
def test_end_of_tlog_after_power_cut_is_a_warning(
    tmp_path: Path, cut: int, zeros: int, count: int, warning: str
) -> None:
    """An end within a message, in zeros, or both is a warning and no damage: all whole messages are read."""
    path = tmp_path / "flight.tlog"
    records = list(frames(1, 50))[:-1]  # the last one is a position
    data = b"".join(records)
    path.write_bytes(data[: len(data) - cut] + bytes(zeros))
    assert len(nedbus.read(path)) == count
    run = open_replay(f"tlog:{path}")
    list(run.messages)
    assert run.damage is None
    assert run.warnings[0].startswith(warning)
    converted = run_command("convert", str(path), str(tmp_path / "a.mcap"))
    assert converted.exit_code == 0
    assert "truncated" in converted.err


def test_zeros_at_the_end_of_tlog_are_not_searched(tmp_path: Path) -> None:
    """The number of reads of a file with zeros at its end is that of its blocks, not of its bytes."""
    path = tmp_path / "flight.tlog"
    size = 2**24
    path.write_bytes(b"".join(frames(1, 5)) + bytes(size))
    calls = 0
    search = tlog._next_candidate

    def count(data: bytes, at: int) -> int:
        nonlocal calls
        calls += 1
        return search(data, at)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tlog, "_next_candidate", count)
        nedbus.read(path)
        assert calls == 0
        path.write_bytes(b"".join(frames(1, 5)) + bytes(size) + b"".join(frames(1, 5)))
        nedbus.read(path)
    assert 0 < calls < 2 * size / 2**16


def test_damaged_messages_of_other_components_are_no_damage(tmp_path: Path) -> None:
    """Messages with a wrong checksum of a component that is ignored anyway, usual in logs of stations, are ignored."""
    path = tmp_path / "flight.tlog"
    camera = mavlink.MAVLink(None, 1, 100)
    damaged = bytearray(mavlink.MAVLink_attitude_message(1, 0, 0, 0.5, 0, 0, 0).pack(camera))
    damaged[-1] ^= 1
    record = struct.pack(">Q", EPOCH) + damaged
    path.write_bytes(b"".join(each + record for each in frames(1, 50)))
    assert len(nedbus.read(path)) == 50
    result = run_command("convert", str(path), str(tmp_path / "a.mcap"))
    assert (result.exit_code, "not MAVLink" in result.err) == (0, False)


def write_messages(path: Path, messages: Iterable[tuple[int, Any]]) -> None:
    """Write messages of vehicle 7, each with its time since boot [ms], to a file that begins at EPOCH."""
    sender = mavlink.MAVLink(None, 7, 1)
    with path.open("wb") as file:
        for ms, message in messages:
            file.write(struct.pack(">Q", EPOCH + 1000 * ms) + message.pack(sender))
            sender.seq = (sender.seq + 1) % 256


@pytest.mark.slow
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("is_wrapped", [False, True])
def test_flight_over_the_antimeridian_has_no_event(
    tmp_path: Path, direction: int, *, is_wrapped: bool
) -> None:
    """Eastward and westward, as PX4 up to 1.15 sends longitudes and as later releases do: no rejection, no event."""
    path, copied = tmp_path / "flight.tlog", tmp_path / "flight.mcap"
    latitude, origin = -170_000_000, direction * 1_799_990_000
    degree = math.cos(math.radians(17.0)) * 111_319.49  # m

    def fly() -> Iterable[tuple[int, Any]]:
        for number in range(200):
            ms, east = 1000 + 100 * number, direction * number
            estimated = origin + round(1e7 * east / degree)
            measured = round(1e7 * math.remainder(estimated / 1e7, 360.0))
            if is_wrapped:
                estimated = measured
            yield ms, mavlink.MAVLink_estimator_status_message(1000 * ms, FLAGS, *[0] * 6, 0.5, 0.5)
            yield (
                ms,
                mavlink.MAVLink_local_position_ned_message(ms, 0, east, -50, 0, 10 * direction, 0),
            )
            yield (
                ms,
                mavlink.MAVLink_global_position_int_message(
                    ms, latitude, estimated, 550_000, 50_000, 0, 0, 0, 0
                ),
            )
            accuracy = 0, 1000, 1500, 100
            fix = 3, latitude, measured, 550_000, 100, 100, 500, 9000, 12
            yield ms, mavlink.MAVLink_gps_raw_int_message(1000 * ms, *fix, *accuracy)
            if number % 10 == 0:
                yield ms, mavlink.MAVLink_heartbeat_message(2, 12, 128, 0, 4, 3)
                yield ms, mavlink.MAVLink_gps_global_origin_message(latitude, origin, 500_000, 1)
                home = latitude, estimated, 500_000, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0
                yield ms, mavlink.MAVLink_home_position_message(*home)

    write_messages(path, fly())
    assert run_command("convert", "--topics", "*", str(path), str(copied)).exit_code == 0
    for file in (path, copied):
        with nedbus.open(file) as flight:
            positions = [
                sample.message.global_position for sample in flight(nedbus.VehicleGlobalPosition)
            ]
            homes = [sample.message.global_position for sample in flight(nedbus.HomePosition)]
            assert flight.warnings == ()
        assert (len(positions), len(homes)) == (200, 20)
        last = positions[-1]
        assert last is not None
        assert last.longitude == pytest.approx(direction * -179.999131, abs=2e-6)
        assert None not in homes
        assert list(nedbus.events(file)) == []
        assert nedbus.why(file)["7"].text == "no faults in 20 s"


def test_gps_loss_that_repeats_the_time_of_the_last_fix_is_an_event(tmp_path: Path) -> None:
    """ArduPilot's GPS_RAW_INT keeps the time of the last fix while there is none: the loss is an event, no silence.

    The intervals are those of a log of ArduSub 4.1.1.
    """
    path = tmp_path / "flight.tlog"

    def fly() -> Iterable[tuple[int, Any]]:
        for ms in range(700_000, 730_000, 500):
            is_lost = 710_000 <= ms < 717_500
            fix_type = 0 if is_lost else 3
            fix_ms = 709_500 if is_lost else ms
            place = 483861418, -1246305732, 0, 2228, 65535, 65535, 65535, 21
            yield ms, mavlink.MAVLink_local_position_ned_message(ms, 0, 0, 1, 0, 0, 0)
            yield ms, mavlink.MAVLink_gps_raw_int_message(1000 * fix_ms, fix_type, *place)
            if ms % 1000 == 0:
                yield ms, mavlink.MAVLink_heartbeat_message(12, 3, 128, 0, 4, 3)

    write_messages(path, fly())
    with nedbus.open(path) as flight:
        assert len(list(flight("sensor_gps"))) == 60
        assert flight.warnings == ()
    assert [(event.text, event.boot) for event in nedbus.events(path)] == [
        ("GPS fix lost: 3D to none", 710.0),
        ("GPS fix regained: none to 3D after 7.5 s", 717.5),
    ]


def test_transition_of_a_vtol_over_mavlink_is_an_event(tmp_path: Path) -> None:
    """Transitions in EXTENDED_SYS_STATE are events as in a log, each within the interval of HEARTBEAT."""
    path = tmp_path / "flight.tlog"
    states = [mavlink.MAV_VTOL_STATE_MC] * 100 + [mavlink.MAV_VTOL_STATE_TRANSITION_TO_FW] * 50
    states += [mavlink.MAV_VTOL_STATE_FW] * 100 + [mavlink.MAV_VTOL_STATE_TRANSITION_TO_MC] * 50
    states += [mavlink.MAV_VTOL_STATE_MC] * 50

    def fly() -> Iterable[tuple[int, Any]]:
        for number, state in enumerate(states):
            ms = 1000 + 100 * number
            yield ms, mavlink.MAVLink_local_position_ned_message(ms, 0, 0, -50, 0, 0, 0)
            if number % 10 == 0:
                yield ms, mavlink.MAVLink_extended_sys_state_message(state, 2)
                yield ms, mavlink.MAVLink_heartbeat_message(22, 12, 128, 0, 4, 3)

    write_messages(path, fly())
    found = [(event.text, event.boot) for event in nedbus.events(path)]
    assert found == [
        ("VTOL transition to fixed wing", 11.0),
        ("VTOL transition ended after 5.0 s", 16.0),
        ("vehicle type changed from rotary wing to fixed wing", 16.0),
        ("VTOL transition to rotary wing", 26.0),
        ("vehicle type changed from fixed wing to rotary wing", 26.0),
        ("VTOL transition ended after 5.0 s", 31.0),
    ]


@pytest.mark.parametrize("content", [b"hello", bytes(5000), b"".join(frames(255, 0))])
def test_tlog_without_mavlink_raises(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "flight.tlog"
    path.write_bytes(content)
    for read in (nedbus.read, lambda path: open_replay(f"tlog:{path}")):
        with pytest.raises(SourceError, match=r"no autopilot messages|an empty file"):
            read(path)


@pytest.mark.skipif(not CASES.is_dir(), reason="no ../shared/cases")
@pytest.mark.parametrize(
    ("name", "count", "seconds"),
    [
        ("06_boot_ms_wrap.tlog", 400, 19.95),
        ("09_two_links_1.5s.tlog", 300, 14.95),
        ("duplicate.tlog", 5, 0.4),
    ],
)
def test_each_message_once_and_in_order(name: str, count: int, seconds: float) -> None:
    """After the wrap of `time_boot_ms`, over a second, slower link, and with a frame that is in the file twice."""
    stamps = nedbus.read(CASES / name)["timestamp"]
    assert stamps.size == count
    assert (np.diff(stamps) > 0).all()
    assert (stamps[-1] - stamps[0]) / 1e6 == pytest.approx(seconds)
    assert "reboot" not in run_command("events", str(CASES / name)).out


@pytest.mark.skipif(not CASES.is_dir(), reason="no ../shared/cases")
def test_copies_are_counted() -> None:
    """A frame that is in the file twice is one sample; a warning counts the copy."""
    with nedbus.open(CASES / "duplicate.tlog") as flight:
        assert len(list(flight("*"))) > 0
        assert "1 copy from a second link left out" in " ".join(flight.warnings)
