"""MAVLink source: vehicles are simulated with pymavlink, one of them in a subprocess."""

from __future__ import annotations

import json
import math
import os
import random
import re
import socket
import threading
import tty
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from itertools import count, islice
from pathlib import Path
from typing import Any, Self

import pytest
from pymavlink.dialects.v20 import common as dialect

import nedbus
from nedbus.errors import ConfigError, SourceError
from nedbus.mavlink.vehicle import ORIGIN
from nedbus.sources import parse_source
from nedbus.sources.mavlink import source as mavlink_source
from nedbus.sources.mavlink.link import DuplicateIds, open_link
from nedbus.timings import Timings
from tests.flights.local_position import upgrade
from tests.flights.messages import VLP
from tests.flights.replays import open_replay
from tests.nedbus.sources.mavlink import mavlink_peer
from tests.peers.command_line import run_command
from tests.peers.http_client import HttpClient
from tests.peers.live_source import Listener, source_status
from tests.peers.ports import free_port
from tests.peers.processes import Process, Start
from tests.waits import DEADLINE, wait_for

from .mavlink_peer import NED

PEER = str(Path(__file__).with_name("mavlink_peer.py"))
ROW = {
    "x": 1.5, "y": -2.25, "z": -10.0, "vx": 0.5, "vy": -0.25, "vz": 0.125, "heading": -1.0, "eph": 0.5, "epv": 0.75,
    "ref_lat": 47.3977418, "ref_lon": 8.5455939, "ref_alt": 487.957, "dist_bottom": 10.5, "evh": 0.25, "evv": 0.125,
}  # fmt: skip
Fly = Callable[..., Process]
REQUESTS = (dialect.MAV_CMD_SET_MESSAGE_INTERVAL, dialect.MAV_CMD_REQUEST_MESSAGE)


@pytest.fixture
def port() -> int:
    """Return a free UDP port."""
    return free_port()


@pytest.fixture
def listener(port: int) -> Iterator[Listener]:
    """Receive on UDP, without a service."""
    with Listener(f"mavlink:udpin:127.0.0.1:{port}?rate=50&topics={VLP}") as listener:
        yield listener


@pytest.fixture
def fly(start: Start, port: int, tmp_path: Path) -> Fly:
    """Return a function that starts a simulated vehicle."""

    def fly(*arguments: object, rows: list[dict[str, float]] | None = None) -> Process:
        values = tmp_path / "values.json"
        values.write_text(json.dumps(rows or [ROW]))
        return start(
            PEER, "--to", f"127.0.0.1:{port}", "--values", str(values), *map(str, arguments)
        )

    return fly


class Autopilot:
    """UDP socket of a vehicle: sends messages, and collects the requests it receives."""

    def __init__(self, port: int, *, system: int = 9, component: int = 1) -> None:
        self.encoder = dialect.MAVLink(None, system, component)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.setblocking(False)

    def send(self, *messages: Any) -> None:
        for each in messages:
            data = each if isinstance(each, bytes) else each.pack(self.encoder)
            self.encoder.seq = (self.encoder.seq + 1) % 256
            self._socket.send(data)

    def requests(self) -> list[tuple[int, float]]:
        """Return the messages that were requested since the last call, each with its interval [us]."""
        found = []
        with suppress(BlockingIOError):
            while True:
                for each in dialect.MAVLink(None).parse_buffer(self._socket.recv(65535)) or []:
                    if each.get_type() == "COMMAND_LONG":
                        assert each.command in REQUESTS
                        found.append((int(each.param1), each.param2))
        return found

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()


def estimator_status(flags: int, *, eph: float = 1.0) -> Any:
    return dialect.MAVLink_estimator_status_message(0, flags, 0, 0, 0, 0, 0, 0, eph, 1.0)


def local_position(ms: int, *values: float) -> Any:
    return dialect.MAVLink_local_position_ned_message(ms, *(values or range(6)))


def estimates(number: int) -> list[dict[str, float]]:
    """Return the estimates of a simulated flight at 5 Hz."""
    run = open_replay("sim:?seed=3")
    chosen = islice(
        (each for each in run.messages if each.address.topic == VLP), 0, 20 * number, 20
    )
    flags = ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid", "dist_bottom_valid", "xy_global")
    return [
        {name: getattr(upgrade(each.fields), name) for name in (*ROW, *flags)} for each in chosen
    ]


@pytest.mark.slow
def test_validity_without_estimator_status_is_unknown(
    run_nedbus: Start, bus: nedbus.Bus, port: int, endpoint: str
) -> None:
    """Each command reports unknown validity for a vehicle without ESTIMATOR_STATUS, such as ArduPilot by default."""
    pages = HttpClient(free_port())
    run_nedbus(
        "serve",
        "--connect",
        endpoint,
        "--http",
        pages.where,
        "-s",
        f"mavlink:udpin:127.0.0.1:{port}",
    )
    expected = {
        "list": "validity unknown", "info": "validity unknown", "echo --once": "validity unknown",
        "hz --count 2": "validity unknown",
        "health --expect 9 --valid xy": "validity of xy is unknown: the vehicle does not send it",
    }  # fmt: skip
    done = threading.Event()

    def send() -> None:
        with Autopilot(port) as vehicle:
            for number in count():
                if done.wait(0.05):
                    return
                with suppress(ConnectionError):  # before the service listens
                    vehicle.send(
                        dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3),
                        local_position(1000 + 50 * number),
                    )

    with ThreadPoolExecutor(1) as pool:
        sending = pool.submit(send)
        try:
            wait_for(
                lambda: pages.values("nedbus_messages_published_total", topic=VLP), what="positions"
            )
            for command, text in expected.items():
                shown = run_command(*command.split(), "-c", endpoint)
                assert text in shown.out + shown.err, (command, shown)
                assert "invalid," not in shown.out, command
            assert pages.values("nedbus_stream_flag_ratio") == []
            [sample] = bus.latest()
            assert (sample.message.x, sample.message.position) == (0.0, None)
            assert {"xy_valid", "z_valid"} <= sample.missing, "unknown, not invalid"
        finally:
            done.set()
        sending.result(DEADLINE)


@pytest.mark.slow
def test_positions_of_flight_reach_readers(
    run_nedbus: Start, fly: Fly, bus: nedbus.Bus, port: int
) -> None:
    """All positions that were not dropped are published, at 10 % packet loss and with a reboot.

    The whole flight fits into the link's receive buffer, so a service that reads late loses no messages.
    """
    source = f"mavlink:udpin:127.0.0.1:{port}?rate=50&topics={VLP}"
    service = run_nedbus("serve", "--connect", *bus.routers, "-s", source)
    in_use = re.compile(rf":{port:04X} \S+ 07 ")
    wait_for(lambda: in_use.search(Path("/proc/net/udp").read_text()), what="the service to listen")
    with bus.subscribe(mode="every") as every:
        options = (
            "--system",
            7,
            "--drop",
            0.1,
            "--count",
            120,
            "--reboot-after",
            60,
            "--speed",
            10,
        )
        vehicle = fly(*options, rows=estimates(120))
        assert vehicle.wait() == 0, vehicle.err
        *lines, end = [json.loads(line) for line in vehicle.out.splitlines()]
        sent = [line for line in lines if "x" in line]
        assert 80 < len(sent) < 120
        for line in sent:
            sample = every.receive(DEADLINE)
            assert (sample.vehicle, sample.topic, sample.source) == ("7", VLP, "mavlink")
            assert sample.message.timestamp == line["time_boot_ms"] * 1000
            assert [getattr(sample.message, name) for name in NED] == [line[name] for name in NED]
            assert "heading" in sample.missing or abs(sample.message.heading) <= math.pi + 1e-6
    wait_for(lambda: source_status(bus).published == len(sent), what="the last one to be counted")
    now = source_status(bus)
    assert (*now.addresses, *now.stale) == (f"7/{VLP}",), "stale after 3 s"
    assert (now.rejected, now.reboots, now.retries) == (0, 1, 0)
    # Losses before the first packet, around the reboot and after the last position cannot be counted.
    assert 0 < now.lost <= end["packets_dropped"]
    assert "vehicle 7 rebooted" in service.err


def test_position_has_only_fields_that_mavlink_provides(listener: Listener, port: int) -> None:
    """The estimate has the values of MAVLink's messages in PX4's units, and no other fields."""
    names = (
        "origin",
        "estimator",
        "global_position",
        "altitude",
        "odometry",
        "attitude",
        "local_position",
    )
    with Autopilot(port) as vehicle:
        vehicle.send(*(getattr(mavlink_peer, name)(2000, ROW) for name in names))
        [received] = listener.receive()
    flags = (
        "xy_valid",
        "z_valid",
        "v_xy_valid",
        "v_z_valid",
        "xy_global",
        "z_global",
        "dist_bottom_valid",
    )
    expected = {
        "timestamp": 2_000_000,
        "ref_timestamp": 1_000_000,
        **ROW,
        **dict.fromkeys(flags, True),
    }
    assert received.fields == pytest.approx(expected, abs=1e-4)
    assert received.fields["ref_lat"] == 47.3977418
    assert (str(received.address), received.lost) == (f"9/{VLP}", 0)


def test_messages_are_converted_to_chosen_topics(port: int) -> None:
    """Only the chosen messages arrive, at their own addresses, complemented by fields of earlier messages."""
    topics = "SensorGps,BatteryStatus,VehicleStatus,HomePosition"
    gps = dialect.MAVLink_gps_raw_int_message(
        5_000_000, 3, 10, 20, 30, 65535, 150, 65535, 9000, 255
    )
    cells = [4000, 4100, *[65535] * 8]
    battery = dialect.MAVLink_battery_status_message(
        1, 0, 0, 32767, cells, -1, 100, -1, 55, charge_state=2
    )
    home = dialect.MAVLink_home_position_message(10, 20, 30, 1, 2, 3, [math.nan] * 4, 0, 0, 0)
    with (
        Listener(f"mavlink:udpin:127.0.0.1:{port}?topics={topics}") as listener,
        Autopilot(port) as vehicle,
    ):
        heartbeat = dialect.MAVLink_heartbeat_message(
            2, dialect.MAV_AUTOPILOT_PX4, 128, 0x40000, 4, 3
        )
        vehicle.send(battery, heartbeat)  # the time is not known yet
        vehicle.send(
            dialect.MAVLink_system_time_message(1_700_000_000_000_000, 6000), local_position(7000)
        )
        sensors = dialect.MAVLink_sys_status_message(1, 2, 3, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)
        vehicle.send(sensors, gps, battery, heartbeat, home)
        received = {each.address.stream: dict(each.fields) for each in listener.receive(4)}
    assert received == {
        "sensor_gps/0": {
            "timestamp": 5_000_000, "time_utc_usec": 1_699_999_999_000_000, "fix_type": 3,
            "latitude_deg": 1e-6, "longitude_deg": 2e-6, "altitude_msl_m": 0.03,
            "vdop": 1.5, "cog_rad": math.pi / 2,
        },
        "battery_status/1": {
            "timestamp": 7_000_000, "voltage_v": 8.1, "discharged_mah": 100, "remaining": 0.55, "warning": 1,
        },
        "vehicle_status": {
            "timestamp": 7_000_000, "arming_state": 2, "hil_state": 0, "failsafe": False,
            "system_type": 2, "system_id": 9, "component_id": 1,
            "onboard_control_sensors_present": 1, "onboard_control_sensors_enabled": 2,
            "onboard_control_sensors_health": 3,
        },
        "home_position": {
            "timestamp": 7_000_000, "lat": 1e-6, "lon": 2e-6, "alt": 0.03, "x": 1.0, "y": 2.0, "z": 3.0,
            "valid_hpos": True, "valid_alt": True,
        },
    }  # fmt: skip


def test_vehicles_on_one_port_are_separate(timings: Timings, listener: Listener, port: int) -> None:
    """Each system id on a port is a separate vehicle, and receives its requests at its own address."""
    timings.source_tick = 0.01
    expected = {
        **dict.fromkeys([32, 230], 20_000),
        **dict.fromkeys([33, 141, 331], 100_000),
        ORIGIN: 0,
    }
    with Autopilot(port, system=3) as one, Autopilot(port, system=250) as other:
        requested: dict[Autopilot, dict[int, float]] = {one: {}, other: {}}
        for step in count():
            for vehicle, found in requested.items():
                vehicle.send(local_position(100 * step))
                found.update(vehicle.requests())
            assert {each.address.vehicle for each in listener.receive(2)} == {"3", "250"}
            if all(found.keys() == expected.keys() for found in requested.values()):
                break
    assert list(requested.values()) == [pytest.approx(expected)] * 2


HIGH_LATENCY = dialect.MAVLink_high_latency2_message(
    5000, 2, 12, 0, 10, 20, 30, *[0] * 12, 0, 0, 50, *[0] * 5
)


@pytest.mark.slow
def test_nothing_is_sent_over_a_satellite_link(timings: Timings, port: int) -> None:
    """To a vehicle that sends only HIGH_LATENCY2 nothing is sent, with log=1 as well; its kind of link is a remark."""
    timings.source_tick = 0.01
    with (
        Listener(f"mavlink:udpin:127.0.0.1:{port}?log=1&state=0") as listener,
        Autopilot(port, system=3) as satellite, Autopilot(port) as other,
    ):  # fmt: skip
        found: list[object] = []

        def is_requested() -> bool:
            satellite.send(HIGH_LATENCY)
            other.send(dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3), local_position(1000))
            found.extend(other.requests())
            return len(found) > 3 and len(listener.rejections) > 0

        listener.step_until(is_requested, what="requests to the other vehicle, and a remark")
        with pytest.raises(BlockingIOError):
            satellite._socket.recv(1)
        topics = {each.address.topic for each in listener.messages if each.address.vehicle == "3"}
        assert topics == {"vehicle_global_position", "vehicle_status", "battery_status"}
        [remark] = listener.rejections
        assert (
            remark.count,
            "a satellite link, because only HIGH_LATENCY2 arrives" in remark.reason,
        ) == (0, True)


def test_fixed_address_gets_no_heartbeat_over_a_satellite_link(
    monkeypatch: pytest.MonkeyPatch, timings: Timings
) -> None:
    """Over `udpout`, heartbeats announce the service until only HIGH_LATENCY2 arrives; then nothing is sent."""
    monkeypatch.setattr(mavlink_source, "_STATUS_INTERVAL", 0.0)
    timings.source_tick = 0.01
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as satellite:
        satellite.bind(("127.0.0.1", 0))
        satellite.setblocking(False)
        with Listener(f"mavlink:udpout:127.0.0.1:{satellite.getsockname()[1]}") as listener:
            heard = [address for _, address in _received(listener, satellite)]
            satellite.sendto(HIGH_LATENCY.pack(dialect.MAVLink(None, 3, 1)), heard[0])
            listener.step_until(lambda: listener.rejections, what="the remark")
            with suppress(BlockingIOError):
                while True:
                    satellite.recv(65535)
            for _ in range(20):
                listener.step()
            with pytest.raises(BlockingIOError):
                satellite.recv(65535)


def _received(listener: Listener, peer: socket.socket) -> list[tuple[bytes, Any]]:
    """Step until a datagram arrives, and return it with its sender."""
    datagrams: list[tuple[bytes, Any]] = []

    def has_arrived() -> bool:
        with suppress(BlockingIOError):
            datagrams.append(peer.recvfrom(65535))
        return len(datagrams) > 0

    listener.step_until(has_arrived, what="a datagram")
    return datagrams


def test_receive_buffer_holds_a_burst(port: int) -> None:
    """400 messages that arrive before the service reads are all received, even with Linux's default buffer limit."""
    with (
        closing(open_link(f"udpin:127.0.0.1:{port}", baud=57600)) as link,
        Autopilot(port) as vehicle,
    ):
        vehicle.send(*map(local_position, range(400)))
        received: list[object] = []
        while items := [*link.read(0.0)]:
            received += items
    assert len(received) == 400


def test_random_datagrams_are_counted_as_rejected(listener: Listener, port: int) -> None:
    """Random datagrams are counted as rejected under their link, and do not affect a vehicle on the same link."""
    rng, starts = (
        random.Random(0),
        (b"", b"\xfd\xff\x00", b"\xfe\x09", b"\xfd\x1c\x00\x00\x00\x01\x01\x20\x00\x00"),
    )
    with Autopilot(port) as vehicle, Autopilot(port) as attacker:
        for ms in range(1000, 3000, 50):
            for each in range(50):  # the kernel drops what is not read in time
                attacker.send(starts[each % 4] + rng.randbytes(rng.randrange(1, 300)))
            vehicle.send(local_position(ms))
            assert listener.receive()[0].fields["timestamp"] == 1000 * ms
    assert listener.rejected >= 2000
    assert {each.where for each in listener.rejections} == {f"udpin:127.0.0.1:{port}"}


def test_late_and_foreign_messages_are_not_published(listener: Listener, port: int) -> None:
    """Late datagrams and ids of 0 are rejected; the position of a camera is ignored silently."""
    with (
        Autopilot(port) as vehicle, Autopilot(port, component=100) as camera, Autopilot(port, system=0) as unnamed,
        Autopilot(port, component=0) as unset,
    ):  # fmt: skip
        vehicle.send(
            estimator_status(127), local_position(2000, math.nan, *range(5)), local_position(1500)
        )
        camera.send(local_position(3000))
        unnamed.send(local_position(3000))
        unset.send(local_position(3000))
        vehicle.send(local_position(4000))
        first, second = listener.receive(2)
    assert (first.address.vehicle, first.fields["timestamp"], second.fields["timestamp"]) == (
        "9",
        2_000_000,
        4_000_000,
    )
    assert (first.fields["xy_valid"], first.fields["v_xy_valid"], second.fields["xy_valid"]) == (
        False,
        True,
        True,
    )
    [late] = [each for each in listener.rejections if each.address]
    ignored = [each for each in listener.rejections if each is not late]
    assert late.reason == "out of order (1500 ms since boot, after 2000 ms)"
    link = f"udpin:127.0.0.1:{port}"
    assert [each.where for each in ignored] == [
        f"{link} system 0 component 1",
        f"{link} system 9 component 0",
    ]
    assert all("id 0 is for broadcast only" in each.reason for each in ignored)


def test_duplicate_system_id_is_logged(
    listener: Listener, port: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Two senders with the same system id are logged once, with both addresses; two address changes are not logged."""
    with Autopilot(port) as one, Autopilot(port) as other, Autopilot(port) as third:
        for ms, sender in enumerate((one, one, other, other, third, third), start=1000):
            sender.send(local_position(ms))
            listener.receive()
        assert not caplog.records
        for ms in range(2000, 2020):
            (other if ms % 2 else third).send(local_position(ms))
            listener.receive()
        [record] = caplog.records
        ports = {each._socket.getsockname()[1] for each in (other, third)}
        assert {
            int(each) for each in re.findall(r"127\.0\.0\.1:(\d+) ?", record.getMessage())[1:]
        } == ports
        assert "both send as system 9, and their messages are mixed" in record.getMessage()


@pytest.mark.parametrize(("interval", "is_reported"), [(1.25, True), (1.3, False)])
def test_two_senders_alternate_within_seconds(interval: float, is_reported: bool) -> None:
    """Two senders change the address five times within 5 s; a sender that reconnects now and then is not reported."""
    senders = DuplicateIds()
    peers = [("10.0.0.1", 14550), ("10.0.0.2", 14550)] * 10
    reported = [senders.add(9, peer, interval * number) for number, peer in enumerate(peers)]
    text = "10.0.0.2:14550 and 10.0.0.1:14550 both send as system 9, and their messages are mixed"
    assert [each.partition(";")[0] for each in reported] == [
        "",
        "",
        "",
        "",
        text * is_reported,
        *[""] * 15,
    ]


def test_closed_tcp_link_raises_and_can_be_reopened() -> None:
    """A message split across TCP segments is reassembled; a closed link raises, and can be reopened."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = f"tcp:127.0.0.1:{server.getsockname()[1]}"
        for ms in (1000, 2000):
            with Listener(f"mavlink:{link}?vehicles=9:boat") as listener:
                connection, _ = server.accept()
                data = local_position(ms).pack(dialect.MAVLink(None, 9, 1))
                connection.sendall(b"noise" + data[:7])
                connection.sendall(data[7:])
                [received] = listener.receive()
                assert (received.address.vehicle, received.fields["timestamp"]) == (
                    "boat",
                    ms * 1000,
                )
                connection.settimeout(DEADLINE)
                # a heartbeat, or a request
                assert connection.recv(1)[0] == dialect.PROTOCOL_MARKER_V2
                connection.close()
                with pytest.raises(SourceError, match="the link broke"):
                    listener.receive()
    with pytest.raises(SourceError, match=r"cannot be opened \(connection refused\)"):
        Listener(f"mavlink:{link}")


def test_serial_port_is_read_until_it_disappears() -> None:
    """Messages of a telemetry radio on a serial port are received; a port that disappears raises."""
    radio, port = os.openpty()
    tty.setraw(port)
    with Listener(f"mavlink:serial:{os.ttyname(port)}?baud=115200") as listener:
        listener.step()  # sends a heartbeat
        assert os.read(radio, 1)[0] == dialect.PROTOCOL_MARKER_V2
        os.write(radio, local_position(1000).pack(dialect.MAVLink(None, 9, 1)))
        assert listener.receive()[0].fields["y"] == 1.0
        os.close(radio)
        os.close(port)
        with pytest.raises(SourceError, match="the link broke"):
            listener.receive()


def test_requests_fit_serial_port(timings: Timings) -> None:
    """On a serial port messages are requested at rates that fit its baud rate."""
    timings.source_tick = 0.01
    radio, port = os.openpty()
    tty.setraw(port)
    os.set_blocking(radio, False)
    requested: dict[int, float] = {}
    with Listener(f"mavlink:serial:{os.ttyname(port)}?topics={VLP}") as listener:
        os.write(radio, local_position(1000).pack(dialect.MAVLink(None, 9, 1)))
        parser = dialect.MAVLink(None)

        def is_requested() -> bool:
            with suppress(BlockingIOError):
                for each in parser.parse_buffer(os.read(radio, 65535)) or []:
                    if each.get_type() == "COMMAND_LONG":
                        requested[int(each.param1)] = each.param2
            return ORIGIN in requested

        listener.step_until(is_requested, what="all requests")
    os.close(radio)
    os.close(port)
    assert requested[32] == pytest.approx(1e6 / 30)
    assert requested[230] == pytest.approx(1e6 / 13.04, rel=1e-3)


def test_port_in_use_raises(listener: Listener, port: int) -> None:
    with pytest.raises(
        SourceError, match=r"\(address already in use\): close the other program or use another"
    ):
        Listener(f"mavlink:udpin:127.0.0.1:{port}")
    assert not listener.rejections


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("mavlink:", "write mavlink:LINK"),
        ("mavlink:14540", "write udpin:0.0.0.0:14540"),
        ("mavlink:udpin:0.0.0.0:99999", "write udpin:0.0.0.0:14540"),
        ("mavlink:udpin:0.0.0.0:14550?rate=0", "positions per second"),
        ("mavlink:udpin:0.0.0.0:14550?vehicles=1:a b", "SYSTEM_ID:VEHICLE"),
        ("mavlink:udpin:0.0.0.0:14550?vehicles=wing:1", "SYSTEM_ID:VEHICLE"),
        ("mavlink:udpin:0.0.0.0:14550?vehicles=1:wing,2:wing", "each vehicle once"),
        ("mavlink:udpin:0.0.0.0:14550?baud=57600", "baud= is the rate of a serial port; remove it"),
        ("px4-zenoh:?vehicles=px4_1:a,px4_1:b", "NAMESPACE:VEHICLE"),
        ("px4-zenoh:?domain=500", "a ROS domain, 0 to 232"),
        ("px4-zenoh:?layout=1.12", "whose layouts apply to keys without a type hash"),
        ("px4-zenoh:here", "'here' is not an endpoint"),
    ],
)
def test_invalid_source_raises(text: str, reason: str) -> None:
    """The error for an invalid source shows the expected form."""
    with pytest.raises(ConfigError, match=reason):
        parse_source(text).open_source(vehicle="1")
