"""Senders on a link: HEARTBEAT decides which of them are autopilots, not the component id alone."""

from __future__ import annotations

import csv
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as dialect

import nedbus
from nedbus.flights import read_file_events
from nedbus.mavlink.parser import Received, new_parser, parse
from tests.nedbus.sources.mavlink.test_source import Autopilot
from tests.peers.command_line import run_command
from tests.peers.live_source import Listener
from tests.peers.ports import free_port

PX4, ARDUPILOT, INVALID = (
    dialect.MAV_AUTOPILOT_PX4,
    dialect.MAV_AUTOPILOT_ARDUPILOTMEGA,
    dialect.MAV_AUTOPILOT_INVALID,
)
QUADROTOR, SUBMARINE, UNKNOWN = dialect.MAV_TYPE_QUADROTOR, dialect.MAV_TYPE_SUBMARINE, 250
STATION, COMPANION, GIMBAL = (
    dialect.MAV_TYPE_GCS,
    dialect.MAV_TYPE_ONBOARD_CONTROLLER,
    dialect.MAV_TYPE_GIMBAL,
)
EPOCH = 1_760_000_000_000_000  # us
OTHERS = [
    (STATION, INVALID),
    (STATION, 0),
    (COMPANION, INVALID),
    (GIMBAL, INVALID),
    (QUADROTOR, INVALID),
    (UNKNOWN, 0),
]


def heartbeat(kind: int = QUADROTOR, autopilot: int = PX4, *, armed: bool = False) -> Any:
    mode = dialect.MAV_MODE_FLAG_SAFETY_ARMED * armed
    return dialect.MAVLink_heartbeat_message(kind, autopilot, mode, 0, dialect.MAV_STATE_ACTIVE, 3)


def position(ms: int) -> Any:
    return dialect.MAVLink_local_position_ned_message(ms, *range(6))


def received(*messages: tuple[int, int, Any]) -> list[str]:
    """Return the types of the messages that are used; each message has a system and a component id."""
    parser, found = new_parser(), []
    for system, component, message in messages:
        data = message.pack(dialect.MAVLink(None, system, component))
        found += [
            each.message.get_type()
            for each in parse(parser, data, "link", None, 0)
            if isinstance(each, Received)
        ]
    return found


def write_tlog(path: Path, messages: Iterable[tuple[float, int, Any]]) -> None:
    """Write messages of component 1, each with its time [s] and system id."""
    encoders = {system: dialect.MAVLink(None, system, 1) for system in range(1, 256)}
    with path.open("wb") as file:
        for seconds, system, message in messages:
            file.write(
                struct.pack(">Q", EPOCH + round(1e6 * seconds)) + message.pack(encoders[system])
            )


@pytest.mark.parametrize(("kind", "autopilot"), OTHERS)
@pytest.mark.parametrize("is_first", [True, False])
def test_heartbeats_of_others_with_ids_of_the_autopilot_are_ignored(
    tmp_path: Path, kind: int, autopilot: int, *, is_first: bool
) -> None:
    """A heartbeat of another program with the ids of an autopilot changes nothing: the vehicle is armed once."""
    path, other = tmp_path / "flight.tlog", heartbeat(kind, autopilot)
    messages: list[tuple[float, int, Any]] = [(0.5, 1, other)] * is_first
    for number in range(100):
        if number % 10 == 0:
            messages.append((1 + number / 10, 1, heartbeat(armed=number >= 50)))
        messages.append((1 + number / 10, 1, position(1000 + 100 * number)))
        if number % 10 == 5:
            messages.append((1 + number / 10, 1, other))
    write_tlog(path, messages)
    assert len(nedbus.read(path)) == 100
    states = nedbus.read(path, "vehicle_status")["arming_state"].tolist()
    disarmed, armed = (
        nedbus.VehicleStatus.ARMING_STATE_DISARMED,
        nedbus.VehicleStatus.ARMING_STATE_ARMED,
    )
    assert states == [disarmed] * 4 + [armed] * 5, "the time is not known at the first HEARTBEAT"


@pytest.mark.parametrize(("kind", "autopilot"), OTHERS)
def test_sender_that_is_no_autopilot_is_ignored(kind: int, autopilot: int) -> None:
    """Of a sender with component 1 and another's heartbeat nothing is used, also what it sent before."""
    before = dialect.MAVLink_timesync_message(0, 1)
    vision = dialect.MAVLink_odometry_message(
        0, 1, 1, 0, 0, 0, [1, 0, 0, 0], *[0] * 6, [0] * 21, [0] * 21
    )
    assert (
        received(
            (42, 1, before), (42, 1, heartbeat(kind, autopilot)), (42, 1, before), (42, 1, vision)
        )
        == []
    )


@pytest.mark.parametrize(
    "kind", [QUADROTOR, SUBMARINE, dialect.MAV_TYPE_GENERIC, dialect.MAV_TYPE_VTOL_TILTROTOR]
)
@pytest.mark.parametrize("autopilot", [PX4, ARDUPILOT, dialect.MAV_AUTOPILOT_GENERIC])
def test_autopilots_are_used(kind: int, autopilot: int) -> None:
    """Vehicles of all kinds and autopilots are used; component ids other than 1 are not."""
    assert received((9, 1, heartbeat(kind, autopilot)), (9, 100, heartbeat(kind, autopilot))) == [
        "HEARTBEAT"
    ]


def test_autopilot_is_used_before_its_first_heartbeat() -> None:
    """A sender of flight data is presumed to be an autopilot until its heartbeat arrives."""
    pressure = dialect.MAVLink_scaled_pressure_message(1, 1.0, 1.0, 1)
    assert received((9, 1, pressure), (9, 1, position(1)), (9, 1, pressure)) == [
        "LOCAL_POSITION_NED",
        "UNKNOWN_29",
    ]


@pytest.mark.slow
def test_router_with_component_1_is_not_requested() -> None:
    """A router that sends a companion's heartbeat with component 1 is no vehicle, and receives no request."""
    port = free_port()
    with (
        Listener(f"mavlink:udpin:127.0.0.1:{port}?log=1") as listener,
        Autopilot(port, system=42) as router, Autopilot(port) as vehicle,
    ):  # fmt: skip
        asked: list[tuple[int, float]] = []

        def is_asked() -> bool:
            router.send(dialect.MAVLink_timesync_message(0, 1), heartbeat(COMPANION, INVALID))
            vehicle.send(heartbeat(SUBMARINE, ARDUPILOT), position(1000))
            asked.extend(vehicle.requests())
            return len(asked) > 3

        listener.step_until(is_asked, what="requests to the vehicle")
        assert router.requests() == []
        assert {each.address.vehicle for each in listener.receive()} == {"9"}


def test_damaged_messages_of_ignored_senders_are_no_damage() -> None:
    """The sender of a message is looked at before its checksum, in both versions of the protocol."""
    for is_old in (True, False):
        for component, is_damage in ((1, True), (100, False)):
            encoder = dialect.MAVLink(None, 9, component)
            frame = bytearray(position(1).pack(encoder, force_mavlink1=is_old))
            frame[-1] ^= 1
            assert len([*parse(new_parser(), bytes(frame), "link", None, 0)]) == is_damage


@pytest.mark.parametrize(("component", "is_damage"), [(1, True), (100, False)])
def test_damaged_signed_messages_of_ignored_senders_are_no_damage(
    component: int, is_damage: bool
) -> None:
    """The sender of a damaged message with a signature is known, too."""
    encoder = dialect.MAVLink(None, 9, component)
    encoder.signing.secret_key = bytes(32)
    encoder.signing.sign_outgoing = True
    frame = bytearray(position(1).pack(encoder))
    frame[12] ^= 1  # of the payload
    assert len([*parse(new_parser(), bytes(frame), "link", None, 0)]) == is_damage


@pytest.mark.parametrize(
    ("autopilot", "author"),
    [(PX4, "PX4"), (ARDUPILOT, "ArduPilot"), (dialect.MAV_AUTOPILOT_PPZ, "autopilot"), (0, "PX4")],
)
def test_texts_name_the_autopilot_of_the_heartbeat(
    tmp_path: Path, autopilot: int, author: str
) -> None:
    """A text is quoted after its author, which HEARTBEAT names; also in an MCAP file of the log."""
    path, copied = tmp_path / "flight.tlog", tmp_path / "flight.mcap"
    messages: list[tuple[float, int, Any]] = []
    for number in range(100):
        seconds = 1 + number / 10
        if number % 10 == 0:
            messages.append((seconds, 1, heartbeat(SUBMARINE, autopilot)))
        messages.append((seconds, 1, position(1000 + 100 * number)))
        if number == 50:
            messages.append((seconds, 1, dialect.MAVLink_statustext_message(2, b"Leak Detected")))
    write_tlog(path, messages)
    assert run_command("convert", "--topics", "*", str(path), str(copied)).exit_code == 0
    for file in (path, copied):
        texts = [
            event.words for event in read_file_events(file).event_log.events if event.kind == "text"
        ]
        assert texts == [f'{author}: "Leak Detected"'], file
        shown = run_command("events", str(file)).out
        assert f'{author}: "Leak Detected"' in shown
        rows = list(csv.DictReader(run_command("events", str(file), "--csv").out.splitlines()))
        assert {(row["kind"] == "text", row["author"]) for row in rows} <= {
            (True, author),
            (False, ""),
        }
