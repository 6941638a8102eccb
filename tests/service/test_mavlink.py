"""Vehicles that speak MAVLink, each a process of its own: pymavlink encodes the estimates of a real flight."""

from __future__ import annotations

import json
import math
import os
import random
import socket
import sys
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from pymavlink.dialects.v20 import common as dialect

import nedbus
from nedbus.errors import ConfigError
from nedbus.sources import parse_source
from nedbus.sources.mavlink_vehicle import ORIGIN, STREAMS, OutOfOrderError, Vehicle, request_rates
from nedbus_msgs import upgrade
from tests.conftest import DEADLINE, LOGS, Process, Start, free_port, wait_for
from tests.replays import open_replay

PEER = str(Path(__file__).with_name("mavlink_peer.py"))
VLP = "vehicle_local_position"
NED = ("x", "y", "z", "vx", "vy", "vz")
ROW = {
    "x": 1.5, "y": -2.25, "z": -10.0, "vx": 0.5, "vy": -0.25, "vz": 0.125, "heading": -1.0, "eph": 0.5, "epv": 0.75,
    "ref_lat": 47.3977418, "ref_lon": 8.5455939, "ref_alt": 487.957, "dist_bottom": 10.5, "evh": 0.25, "evv": 0.125,
}  # fmt: skip

Fly = Callable[..., Process]


@pytest.fixture
def port() -> int:
    """Return a free UDP port."""
    return free_port()


@pytest.fixture
def service(run_nedbus: Start, endpoint: str, port: int) -> Process:
    """Run a service that listens on UDP."""
    service = run_nedbus("serve", "--connect", endpoint, "-s", f"mavlink:udpin:127.0.0.1:{port}?rate=50")
    wait_for(lambda: is_in_use(port), what="the service to listen")
    return service


@pytest.fixture
def fly(start: Start, port: int, tmp_path: Path) -> Fly:
    """Start a vehicle."""

    def fly(*arguments: object, rows: list[dict[str, float]] | None = None) -> Process:
        values = tmp_path / "values.json"
        values.write_text(json.dumps(rows or [ROW]))
        return start(PEER, "--to", f"127.0.0.1:{port}", "--values", str(values), *map(str, arguments))

    return fly


@pytest.fixture
def every(bus: nedbus.Bus) -> Iterator[nedbus.Subscription]:
    """Receive every message that the service publishes."""
    with bus.subscribe(mode="every") as subscription:
        yield subscription


def is_in_use(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return True
    return False


def status(bus: nedbus.Bus) -> dict[str, Any]:
    """Return the status of the service's only source."""
    services = cast("list[dict[str, Any]]", bus.services())
    return services[0]["sources"][0] if services else {}


def are_rejected(bus: nedbus.Bus, count: float) -> bool:
    return bool(status(bus)["rejected"] >= count)


def printed(vehicle: Process) -> list[dict[str, Any]]:
    """Return the lines that a vehicle printed."""
    return [json.loads(line) for line in vehicle.out.splitlines()]


def estimates() -> list[dict[str, float]]:
    """Return the estimates of a real flight, or of a simulated one where the log is missing."""
    log = LOGS / "sitl_1.15_events.ulg"
    run = open_replay(f"ulog:{log}" if log.exists() else "sim:")
    chosen = islice((each for each in run.messages if each.address.topic == VLP), 300)
    messages = [upgrade(each.fields) for each in chosen]
    flags = ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid", "dist_bottom_valid", "xy_global")
    return [{name: getattr(message, name) for name in (*ROW, *flags)} for message in messages]


def test_loss_and_reboot_are_counted(service: Process, fly: Fly, bus: nedbus.Bus, every: nedbus.Subscription) -> None:
    """30 Hz of positions, 50 Hz of attitude, a tenth of all packets dropped, a reboot: all the rest is published."""
    vehicle = fly("--system", 7, "--drop", 0.1, "--count", 300, "--reboot-after", 150, "--speed", 10, rows=estimates())
    assert vehicle.wait() == 0, vehicle.err
    *lines, end = printed(vehicle)
    sent = [line for line in lines if "x" in line]
    assert 200 < len(sent) < 300
    for line in sent:
        sample = every.receive(DEADLINE)
        assert (sample.vehicle, sample.topic, sample.source) == ("7", VLP, "mavlink")
        assert sample.message.timestamp == line["time_boot_ms"] * 1000
        assert [getattr(sample.message, name) for name in NED] == [line[name] for name in NED]
        assert "heading" in sample.missing or abs(sample.message.heading) <= math.pi + 1e-6
    wait_for(lambda: status(bus)["published"] == len(sent), what="the last one to be counted")
    now = status(bus)
    assert (now["rejected"], now["reboots"], now["retries"]) == (0, 1, 0)
    # Losses before the first packet, around the reboot and after the last position cannot be counted.
    assert 0 < now["lost"] <= end["packets_dropped"]
    assert "7/vehicle_local_position: the vehicle rebooted" in service.err


@pytest.mark.usefixtures("service")
def test_fields_are_those_of_mavlink(fly: Fly, every: nedbus.Subscription) -> None:
    """The estimate has what MAVLink's messages have, in PX4's units; all other fields are marked as not provided."""
    fly("--speed", 10)
    expected = {**ROW, "xy_valid": True, "z_valid": True, "v_xy_valid": True, "v_z_valid": True, "xy_global": True}
    expected |= {"z_global": True, "dist_bottom_valid": True, "ref_timestamp": 1_000_000}
    sample = every.receive(DEADLINE)
    while not sample.message.xy_global or "evh" in sample.missing or "dist_bottom" in sample.missing:
        sample = every.receive(DEADLINE)
    for name, value in expected.items():
        assert getattr(sample.message, name) == pytest.approx(value, abs=1e-4 if name == "heading" else 1e-6), name
    assert sample.message.ref_lat == 47.3977418
    provided = sample.message.model_fields_set - sample.missing
    assert provided == {*expected, "timestamp"}
    assert not sample.message.dead_reckoning
    assert math.isnan(sample.message.delta_z)


@pytest.mark.usefixtures("service")
def test_vehicles_on_one_port(fly: Fly, bus: nedbus.Bus, every: nedbus.Subscription) -> None:
    """Each system id is a vehicle of its own, and gets the requests for its streams at its own address."""
    fleet = {system: fly("--system", system, "--speed", 5) for system in (3, 250)}
    expected = {*STREAMS, ORIGIN}

    def requested(vehicle: Process) -> dict[int, float]:
        return {line["message_id"]: line["interval_us"] for line in printed(vehicle) if "message_id" in line}

    wait_for(lambda: all(requested(vehicle).keys() == expected for vehicle in fleet.values()), what="all requests")
    assert all(requested(vehicle)[32] == 20_000 for vehicle in fleet.values())
    assert all(requested(vehicle)[230] == 500_000 for vehicle in fleet.values())  # the link is full without it
    seen = {every.receive(DEADLINE).vehicle for _ in range(200)}
    assert seen == {"3", "250"}
    assert sorted(bus.vehicles()) == ["250", "3"]


def test_stale_vehicle_recovers(service: Process, fly: Fly, bus: nedbus.Bus, every: nedbus.Subscription) -> None:
    """A vehicle that sends nothing for about 3 s is stale in the status and not listed; then it is published again."""
    fly("--system", 7, "--count", 30, "--speed", 10).wait()
    wait_for(lambda: status(bus)["published"] == 30, what="the flight")
    assert status(bus)["state"] == "running"
    wait_for(lambda: status(bus)["stale"] == [f"7/{VLP}"], what="the status to be stale")
    assert status(bus)["state"] == "waiting"
    assert bus.vehicles() == {}
    assert "is stale: nothing arrived for 3 s" in service.err
    fly("--system", 7, "--start-ms", 60_000, "--speed", 10)
    wait_for(lambda: status(bus)["stale"] == [], what="the vehicle to be back")
    assert list(bus.vehicles()) == ["7"]
    assert [every.receive(DEADLINE).message.timestamp for _ in range(31)][-1] == 60_000_000


@pytest.mark.usefixtures("service")
def test_time_goes_on_when_its_counter_wraps(fly: Fly, every: nedbus.Subscription, bus: nedbus.Bus) -> None:
    """time_boot_ms overflows after 49.7 days; the timestamp does not."""
    fly("--start-ms", 2**32 - 500, "--count", 40, "--speed", 10)
    times = [every.receive(DEADLINE).message.timestamp for _ in range(40)]
    assert times == sorted(times)
    assert times[0] == (2**32 - 500) * 1000
    assert times[-1] > 2**32 * 1000
    assert status(bus)["reboots"] == 0


def test_hostile_datagrams_are_counted(
    service: Process, port: int, fly: Fly, bus: nedbus.Bus, every: nedbus.Subscription
) -> None:
    """10,000 random datagrams: counted, logged once, nothing published, and a vehicle beside them is received."""
    rng = random.Random(0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as attacker:
        for each in range(1, 10_001):
            start = (b"", b"\xfd\xff\x00", b"\xfe\x09", b"\xfd\x1c\x00\x00\x00\x01\x01\x20\x00\x00")[each % 4]
            attacker.sendto(start + rng.randbytes(rng.randrange(1, 300)), ("127.0.0.1", port))
            if each % 100 == 0:  # the kernel drops what is not read in time
                wait_for(partial(are_rejected, bus, 0.9 * each), what=f"{each} rejections")
    assert status(bus)["published"] == 0
    assert sum(": rejected: " in line for line in service.err.splitlines()) == 1
    fly("--count", 10, "--speed", 10)
    assert len({every.receive(DEADLINE).message.timestamp for _ in range(10)}) == 10


def test_invalid_estimates_are_rejected(
    service: Process, port: int, bus: nedbus.Bus, every: nedbus.Subscription
) -> None:
    """Messages that violate the rules are reported, as from any source; a late datagram is not published."""
    encoder = dialect.MAVLink(None, 9, 1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:

        def send(message: Any) -> None:
            vehicle.sendto(message.pack(encoder), ("127.0.0.1", port))

        send(dialect.MAVLink_estimator_status_message(0, 127, 0, 0, 0, 0, 0, 0, -1.0, 1.0))
        send(dialect.MAVLink_local_position_ned_message(1000, *range(6)))
        send(dialect.MAVLink_estimator_status_message(0, 127, 0, 0, 0, 0, 0, 0, 1.0, 1.0))
        send(dialect.MAVLink_local_position_ned_message(2000, math.nan, *range(5)))
        send(dialect.MAVLink_local_position_ned_message(1500, *range(6)))
        encoder.srcComponent = 100  # a camera: its position is not the vehicle's
        send(dialect.MAVLink_local_position_ned_message(3000, *range(6)))
        encoder.srcSystem = 0
        send(dialect.MAVLink_local_position_ned_message(3000, *range(6)))
    sample = every.receive(DEADLINE)
    assert (sample.vehicle, sample.message.timestamp) == ("9", 2_000_000)
    assert not sample.message.xy_valid
    assert sample.message.v_xy_valid
    wait_for(lambda: status(bus)["rejected"] == 2, what="both")
    assert "eph: must not be negative" in service.err
    assert "out of order: time_boot_ms 1500 after 2000" in service.err


def test_denied_origin_is_told_once_and_not_before_there_can_be_one(service: Process, port: int) -> None:
    """PX4 denies GPS_GLOBAL_ORIGIN until it has a global position: that is no news; a denial afterwards is, once."""
    encoder, decoder = dialect.MAVLink(None, 9, 1), dialect.MAVLink(None)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.settimeout(0.2)

        def send(message: Any) -> None:
            vehicle.sendto(message.pack(encoder), ("127.0.0.1", port))

        def answer(flags: int, number: int) -> bool:
            """Send a status, deny what is requested, and return whether this was."""
            send(dialect.MAVLink_estimator_status_message(0, flags, 0, 0, 0, 0, 0, 0, 1.0, 1.0))
            send(dialect.MAVLink_local_position_ned_message(round(time.monotonic() * 1000), *range(6)))
            with suppress(TimeoutError):
                for request in decoder.parse_buffer(vehicle.recv(65535)) or []:
                    if request.get_type() == "COMMAND_LONG":
                        denied = dialect.MAV_RESULT_DENIED
                        send(dialect.MAVLink_command_ack_message(request.command, denied, 0, 0, 245, 191))
                        if request.param1 == number:
                            return True
            return False

        wait_for(lambda: answer(0b1111, ORIGIN), what="the request of an origin")
        wait_for(lambda: "9/vehicle_local_position: does not send ODOMETRY" in service.err, what="the other denials")
        assert "GPS_GLOBAL_ORIGIN" not in service.err
        for _ in range(2):
            wait_for(lambda: answer(0b11111, ORIGIN), what="the request of an origin")
    wait_for(lambda: "does not send GPS_GLOBAL_ORIGIN when it is requested" in service.err, what="the denial")
    assert service.err.count("GPS_GLOBAL_ORIGIN") == 1


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (0b1111111111, True),  # at rest, since 48f1687d3a
        (0b1101111111, True),  # in flight
        (0b1101100101, False),  # GPS lost
        (0b0010100101, False),  # the constant position mode, up to 1.15: no velocity, and no position
        (0b0010111101, False),  # the same, of a release that keeps a position all the same
    ],
)
def test_constant_position_mode_is_no_sign_of_rest(flags: int, expected: bool) -> None:
    """Its bit counts where no horizontal velocity is valid: it was the opposite of that until PX4's 48f1687d3a."""
    vehicle = Vehicle(30.0, 57600)
    vehicle.handle(dialect.MAVLink_estimator_status_message(0, flags, 0, 0, 0, 0, 0, 0, 1.0, 1.0), 100.0)
    fields = vehicle.handle(position(1), 100.0)
    assert fields is not None
    assert fields["xy_valid"] is expected


def test_broken_tcp_link_is_reopened(
    run_nedbus: Start, endpoint: str, bus: nedbus.Bus, every: nedbus.Subscription
) -> None:
    """A link that is closed is an error in the status, and retried; a message in pieces is reassembled."""
    encoder = dialect.MAVLink(None, 5, 1)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        run_nedbus("serve", "--connect", endpoint, "-s", f"mavlink:tcp:127.0.0.1:{port}?vehicles=5:boat")
        for ms in (1000, 2000):
            server.settimeout(DEADLINE)
            connection, _ = server.accept()
            data = dialect.MAVLink_local_position_ned_message(ms, *range(6)).pack(encoder)
            connection.sendall(b"noise" + data[:7])
            connection.sendall(data[7:])
            sample = every.receive(DEADLINE)
            assert (sample.vehicle, sample.message.timestamp) == ("boat", ms * 1000)
            connection.settimeout(DEADLINE)
            assert connection.recv(1)[0] == dialect.PROTOCOL_MARKER_V2  # a heartbeat, or a request
            connection.close()
            wait_for(lambda: status(bus)["state"] != "running", what="the error to be reported")
    wait_for(lambda: "cannot be opened (connection refused)" in str(status(bus)["error"]), what="the reason")


def test_serial_port(run_nedbus: Start, endpoint: str, bus: nedbus.Bus, every: nedbus.Subscription) -> None:
    """A telemetry radio on a serial port is received; a port that disappears is retried."""
    radio, port = os.openpty()
    tty.setraw(port)
    run_nedbus("serve", "--connect", endpoint, "-s", f"mavlink:serial:{os.ttyname(port)}?baud=115200")
    assert os.read(radio, 1)[0] == dialect.PROTOCOL_MARKER_V2
    os.write(radio, dialect.MAVLink_local_position_ned_message(1000, *range(6)).pack(dialect.MAVLink(None, 5, 1)))
    assert every.receive(DEADLINE).message.y == 1.0
    os.close(radio)
    os.close(port)
    wait_for(lambda: status(bus)["state"] == "retrying", what="the error to be reported")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("mavlink:", "write it as mavlink:LINK"),
        ("mavlink:14550", "write udpin:0.0.0.0:14550"),
        ("mavlink:udpin:0.0.0.0:99999", "write udpin:0.0.0.0:14550"),
        ("mavlink:udpin:0.0.0.0:14550?rate=0", "positions a second"),
        ("mavlink:udpin:0.0.0.0:14550?vehicles=1:a b", "SYSTEM_ID:VEHICLE"),
        ("mavlink:udpin:0.0.0.0:14550?vehicles=wing:1", "SYSTEM_ID:VEHICLE"),
        ("mavlink:udpin:0.0.0.0:14550?vehicles=1:wing,2:wing", "each vehicle once"),
        ("px4-zenoh:?vehicles=px4_1:a,px4_1:b", "NAMESPACE:VEHICLE"),
        ("px4-zenoh:?domain=500", "a ROS domain, 0 to 232"),
        ("px4-zenoh:?layout=1.12", "the layout of keys without a type hash"),
        ("px4-zenoh:here", "'here' is not an endpoint"),
    ],
)
def test_invalid_source_is_an_error(text: str, reason: str) -> None:
    """The error of an invalid source shows the right form."""
    with pytest.raises(ConfigError, match=reason):
        parse_source(text).open_source(vehicle="1")


def test_missing_extra_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without pymavlink the error names the extra to install."""
    monkeypatch.delitem(sys.modules, "nedbus.sources.mavlink", raising=False)
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20", None)
    with pytest.raises(ConfigError, match=r"^pymavlink: not installed: .*pip install .*\[mavlink\]'$"):
        parse_source("mavlink:udpin:0.0.0.0:14550").open_source(vehicle="1")


def test_port_in_use_is_an_error(run_nedbus: Start, endpoint: str, port: int) -> None:
    """A port that another program uses is reported as the source's error."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", port))
        service = run_nedbus("serve", "--connect", endpoint, "-s", f"mavlink:udpin:127.0.0.1:{port}")
        wait_for(lambda: "cannot be opened (address already in use)" in service.err, what="the error")


def position(ms: int) -> SimpleNamespace:
    values = dict.fromkeys(NED, 0.0)
    return SimpleNamespace(get_type=lambda: "LOCAL_POSITION_NED", time_boot_ms=ms, **values)


@pytest.mark.parametrize(
    ("rate", "baud", "status"),
    [(30.0, 57600, 13.04), (20.0, 57600, 20.0), (45.0, 57600, 2.0), (50.0, 115200, 50.0), (0.5, 57600, 2.0)],
)
def test_flags_are_requested_as_often_as_the_link_carries(rate: float, baud: int, status: float) -> None:
    """ESTIMATOR_STATUS comes with each position where there is room for it, else with what room there is."""
    rates = request_rates(rate, baud)
    assert rates.keys() == STREAMS.keys()
    assert (rates[32], rates[331]) == (rate, 10.0)
    assert rates[230] == pytest.approx(status, abs=0.01)
    if status > 2:
        assert sum(STREAMS[number] * hertz for number, hertz in rates.items()) <= 0.9 * baud / 10 + 0.01


def test_requests_are_repeated_five_times() -> None:
    """Each stream is requested up to five times, 1 s apart, then the next; the origin until it is known."""
    vehicle = Vehicle(30.0, 57600)
    requested: list[int] = []
    for tick in range(200):
        now = 100.0 + tick / 2
        vehicle.track_sequence(1, tick % 256, now)
        requested += [number for number, _ in vehicle.requests(now)]
    for number in STREAMS:
        assert requested.count(number) == 5
    assert requested.count(ORIGIN) > 10


def test_answer_ends_a_request() -> None:
    """After any answer the next stream is requested; once all are and the origin is known, nothing is requested."""
    vehicle = Vehicle(30.0, 57600)
    requested: list[tuple[int, float]] = []
    for tick in range(20):
        now = 100.0 + tick
        vehicle.track_sequence(1, tick, now)
        vehicle.handle(position(1000 * tick), now)
        for request in list(vehicle.requests(now)):
            requested.append(request)
            assert vehicle.acknowledge(now) == request[0]
        if tick == 10:
            origin = dialect.MAVLink_gps_global_origin_message(1, 2, 3, 4)
            assert vehicle.handle(origin, now) is None
    assert [number for number, _ in requested[:6]] == [*STREAMS, ORIGIN]
    assert requested[0] == (32, 30.0)
    assert len(requested) < 9
    assert vehicle.acknowledge(1000.0) is None


def test_reordered_and_duplicate_messages_are_not_lost() -> None:
    """Datagrams that arrive out of order, or twice, do not count as lost."""
    vehicle = Vehicle(30.0, 57600)
    for sequence in (10, 12, 11, 13, 13, 14, 100, 200, 0):
        vehicle.track_sequence(1, sequence, 100.0)
    assert vehicle.lost == 85 + 99 + 55


def test_positions_that_stop_are_requested_again() -> None:
    """The streams of a vehicle that sends messages, but no positions, are requested again."""
    vehicle = Vehicle(30.0, 57600)
    requested: list[int] = []
    for tick in range(400):
        now = 100.0 + tick / 10
        vehicle.track_sequence(1, tick % 256, now)
        if now < 110:
            vehicle.handle(position(tick * 100), now)
        for number, _ in list(vehicle.requests(now)):
            vehicle.acknowledge(now)
            if now >= 110:
                requested.append(number)
    assert requested.count(32) >= 3


def test_expired_values_are_not_provided() -> None:
    """A heading that is not repeated is not provided after 2 s; an origin stays until a reboot."""
    vehicle = Vehicle(30.0, 57600)
    vehicle.handle(dialect.MAVLink_global_position_int_message(0, 0, 0, 0, 0, 0, 0, 0, 9000), 100.0)
    vehicle.handle(dialect.MAVLink_gps_global_origin_message(473977418, 85455939, 488000), 100.0)
    first = vehicle.handle(position(1000), 101.0)
    later = vehicle.handle(position(4000), 104.0)
    assert first is not None
    assert later is not None
    assert first["heading"] == pytest.approx(math.pi / 2)
    assert "heading" not in later
    assert later["ref_lat"] == 47.3977418
    assert "ref_timestamp" not in later
    again = vehicle.handle(position(500), 105.0)
    assert again is not None
    assert "ref_lat" not in again
    assert vehicle.rebooted
    with pytest.raises(OutOfOrderError):
        vehicle.handle(position(499), 105.0)


def test_yaw_of_the_attitude_replaces_the_heading() -> None:
    """Without a global position PX4 sends no GLOBAL_POSITION_INT; the heading is then the yaw of its attitude."""
    vehicle = Vehicle(30.0, 57600)
    vehicle.handle(dialect.MAVLink_attitude_message(0, 0, 0, 1.25, 0, 0, 0), 100.0)
    vehicle.handle(dialect.MAVLink_global_position_int_message(0, 0, 0, 0, 0, 0, 0, 0, 65535), 100.0)
    fields = vehicle.handle(position(1), 100.0)
    assert fields is not None
    assert fields["heading"] == pytest.approx(1.25)
