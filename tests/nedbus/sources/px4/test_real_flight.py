"""Recordings of a real PX4 (../shared/data/px4), played into a service at full speed and compared with its log."""

from __future__ import annotations

import bisect
import gzip
import json
import socket
import struct
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Final, Self, cast

import pytest
import pyulog
import zenoh
from pymavlink.dialects.v20 import common as dialect

import nedbus
from nedbus.doctor import examine
from nedbus.mavlink.requests import request_rates
from nedbus.mavlink.vehicle import Vehicle
from nedbus.settings import load_settings
from nedbus.sources import SourceMessage
from nedbus.transport import Attachment, Session
from nedbus_msgs import ANY, TOPICS, Address, VehicleLocalPosition, get_topic, split_ros2_topic
from tests.flights.local_position import decode_cdr, encode_cdr, upgrade
from tests.flights.messages import VLP
from tests.flights.replays import open_replay
from tests.flights.ulogs import LOGS
from tests.nedbus.sources.mavlink.test_source import port
from tests.peers.live_source import Listener, source_status
from tests.peers.ports import free_endpoint
from tests.peers.processes import Start
from tests.peers.zenohd import start_zenohd
from tests.waits import DEADLINE, changing_timings, repeating, wait_for

from .test_source import is_read

__all__ = ["port"]  # a fixture

PX4: Final = LOGS.parent / "px4"
LOG: Final = PX4 / "gps_loss.ulg"
FLIGHT: Final = PX4 / "gps_loss_zenoh.jsonl.gz"
TWELVE: Final = PX4 / "twelve_messages"
DEFAULT_PUBCSV: Final = PX4 / "default_pubcsv_zenoh.jsonl.gz"
MSG: Final = Path(__file__).parents[3] / "data" / "msg"
"""PX4's definitions of messages that are not built in."""
ALIKE: Final = PX4 / "two_alike_zenoh.jsonl.gz"
MAVLINK: Final = PX4 / "gps_loss_mavlink.bin.gz"
WINDOW: Final = 100  # messages in flight at once
FLAGS = ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid")

pytestmark = [
    pytest.mark.logs,
    pytest.mark.timeout(300),
    pytest.mark.skipif(not LOG.exists(), reason=f"no recordings of a PX4: {PX4} does not exist"),
]


@dataclass(frozen=True, slots=True)
class Sent:
    """One line of a recording: a message, or a liveliness token that appears or disappears, and its PX4."""

    px4: int
    key: str
    kind: str
    express: bool = False
    attachment: bytes = b""
    payload: bytes = b""
    time: float = 0.0

    @property
    def address(self) -> Address:
        """The address under which the service publishes the message."""
        _, topic, instance = split_ros2_topic("/".join(self.key.split("/")[1:-2]))
        return Address("1", topic, instance)

    @property
    def cdr(self) -> bytes:
        """The message with normalised padding."""
        return encode_cdr(decode_cdr(self.payload, layout="1.16"), layout="1.16")


def read_recording(path: Path) -> Iterator[Sent]:
    """Yield the entries in order; a message belongs to the PX4 whose sequence it continues."""
    sessions: list[str] = []
    last: dict[tuple[int, str], int] = {}
    with gzip.open(path, "rt") as lines:
        for time_ns, what, key, *rest in map(json.loads, lines):
            if what == "token":
                session = key.split("/")[2]
                if session not in sessions:
                    sessions.append(session)
                yield Sent(sessions.index(session), key, rest[0].removeprefix("SampleKind."))
            else:
                _, kind, _, express, congestion, attachment, payload, _ = rest
                assert kind == "SampleKind.PUT"
                assert congestion in ("CongestionControl.DROP", "CongestionControl.BLOCK")
                sequence = Attachment.parse(bytes.fromhex(attachment)).sequence
                distances = [
                    abs(sequence - 1 - last.get((px4, key), 0)) for px4 in range(len(sessions))
                ]
                px4 = distances.index(min(distances))
                last[px4, key] = sequence
                raw = bytes.fromhex(attachment), bytes.fromhex(payload)
                yield Sent(px4, key, "PUT", express, *raw, time_ns / 1e9)


class Px4:
    """The session of one PX4, with a sending queue that never drops."""

    def __init__(self, endpoint: str) -> None:
        settings = {
            "scouting/multicast/enabled": False,
            "mode": "client",
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": round(1000 * DEADLINE),
            "listen/endpoints": [],
            # us: wait, like zenoh-pico
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 10_000_000,
        }
        config = zenoh.Config()
        for name, value in settings.items():
            config.insert_json5(name, json.dumps(value))
        self.session: Session = zenoh.open(config)
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._tokens: dict[str, zenoh.LivelinessToken] = {}

    def send(self, sent: Sent) -> None:
        """Publish a recorded message of this PX4, or declare or undeclare its token."""
        if sent.payload:
            if sent.key not in self._publishers:
                drop = zenoh.CongestionControl.DROP
                publisher = self.session.declare_publisher(
                    sent.key, congestion_control=drop, express=sent.express
                )
                self._publishers[sent.key] = publisher
                wait_for(lambda: is_read(publisher), what="the service to subscribe")
            self._publishers[sent.key].put(sent.payload, attachment=sent.attachment)
        elif sent.kind == "PUT":
            self._tokens[sent.key] = self.session.liveliness().declare_token(sent.key)
        elif sent.key in self._tokens:
            self._tokens.pop(sent.key).undeclare()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()


def play(bus: nedbus.Bus, px4s: Sequence[Px4], lines: Iterable[Sent], played: int) -> int:
    """Send the messages of each PX4 as fast as the service reads them; return the number played so far."""
    for sent in lines:
        px4s[sent.px4].send(sent)
        played += bool(sent.payload)
        if sent.payload and played % WINDOW == 0:
            wait_until_counted(bus, played)
    wait_until_counted(bus, played)
    return played


def wait_until_counted(bus: nedbus.Bus, count: int) -> None:
    """Wait until the service has published or rejected `count` messages; it counts each one after sending it."""

    def is_counted() -> bool:
        now = source_status(bus)
        return now.published + now.rejected == count

    wait_for(is_counted, what=f"{count} messages")


def log_rows() -> dict[tuple[Address, int], bytes]:
    """Return the messages of the vehicle's own log, by address and time."""
    rows = {}
    for message in open_replay(f"ulog:{LOG}").messages:
        fields = upgrade(message.fields).__dict__
        rows[message.address, fields["timestamp"]] = encode_cdr(fields, layout="1.16")
    return rows


@pytest.fixture
def source() -> str:
    """Return the source of the service."""
    return "px4-zenoh:"


@pytest.fixture(params=["embedded", pytest.param("zenohd", marks=pytest.mark.slow)])
def where(
    request: pytest.FixtureRequest, run_nedbus: Start, start: Start, tmp_path: Path, source: str
) -> str:
    """Start a service that receives from PX4s, as the router or as a client of zenohd; return the endpoint."""
    endpoint = free_endpoint()
    if request.param == "embedded":
        service = run_nedbus("serve", "--listen", endpoint, "-s", source)
    else:
        file = tmp_path / "zenohd.json5"
        # zenohd drops messages that wait for more than 1 ms; a slow machine needs longer.
        queue = "queue: { congestion_control: { drop: { wait_before_drop: 10000000 } } }"
        file.write_text(
            f'{{ listen: {{ endpoints: ["{endpoint}"] }}, scouting: {{ multicast: {{ enabled: false }} }},'
            f" transport: {{ link: {{ tx: {{ {queue} }} }} }} }}"
        )
        start_zenohd(start, "-c", str(file))
        service = run_nedbus("serve", "--connect", endpoint, "-s", source)
    wait_for(lambda: "listening" in service.err, what="the service")
    return endpoint


@pytest.mark.long
def test_positions_of_flight_equal_log(where: str) -> None:
    """All 26,514 messages of a flight with a GPS outage arrive, and equal those of PX4's own log bit by bit."""
    logged = log_rows()
    equal: Counter[str] = Counter()
    total = 0
    with (
        nedbus.connect(where, timeout=DEADLINE) as bus,
        bus.subscribe(ANY, mode="every") as every,
        Px4(where) as px4,
    ):
        window: dict[Address, list[bytes]] = {}

        def receive() -> None:
            for _ in range(sum(map(len, window.values()))):
                sample = every.receive(DEADLINE)
                received = encode_cdr(sample.message.__dict__, layout="1.16")
                assert (received, sample.source) == (window[sample.address].pop(0), "px4-zenoh")
                row = logged.get((sample.address, sample.message.timestamp))
                assert row in (None, received)
                equal[str(sample.address)] += row is not None
            window.clear()

        for sent in read_recording(FLIGHT):
            if total % WINDOW == 0 or sent.kind == "DELETE":
                receive()
            px4.send(sent)
            if sent.payload:
                window.setdefault(sent.address, []).append(sent.cdr)
                total += 1
        wait_until_counted(bus, total)
        now = source_status(bus)
        assert (now.published, now.rejected, now.lost, now.reboots) == (total, 0, 0, 0)
        assert (total, every.counts.lost) == (26_514, 0)
    assert equal == {
        "1/estimator_local_position/0": 5318,
        "1/estimator_local_position/1": 5318,
        "1/vehicle_local_position": 5202,
        "1/vehicle_local_position_groundtruth": 10_649,
    }


def read_log(path: Path) -> dict[tuple[str, int, int], dict[str, object]]:
    """Return the messages of a log as pyulog reads them, by topic, instance and time; arrays are tuples."""
    rows: dict[tuple[str, int, int], dict[str, object]] = {}
    for data in pyulog.ULog(str(path)).data_list:
        columns: dict[str, list[object]] = {}
        arrays: dict[str, list[list[object]]] = {}
        for name, column in (
            (name.replace(".", "_"), column) for name, column in data.data.items()
        ):
            base, _, index = name.partition("[")
            if "_padding" in base:
                continue
            if index:
                arrays.setdefault(base, []).append(column.tolist())
            else:
                columns[name] = column.tolist()
        columns |= {name: list(zip(*parts, strict=True)) for name, parts in arrays.items()}
        for row in zip(*columns.values(), strict=True):
            fields = dict(zip(columns, row, strict=True))
            rows[data.name, data.multi_id, cast("int", fields["timestamp"])] = fields
    return rows


def is_equal(value: object, logged: object) -> bool:
    """Return whether a value equals the logged one bit by bit: -0.0 is not 0.0, NaN is NaN, and 1 means true."""
    if isinstance(value, tuple) and isinstance(logged, tuple):
        return len(value) == len(logged) and all(map(is_equal, value, logged))
    return repr(value) == repr(logged) if isinstance(value, float) else value == logged


@pytest.mark.long
@pytest.mark.parametrize("source", [f"px4-zenoh:?msg={MSG}"])
def test_all_topics_of_flight_equal_log(where: str) -> None:
    """All 69,605 messages of 21 topics are published and read; the 46,457 that are in the log equal it in all fields.

    The recording lacks 11 messages that PX4 counted. The five types that are not built in are supplied, one of them
    with nested messages. A reader gets the definitions with the first messages, and loses no message.
    """
    logged = read_log(TWELVE.with_suffix(".ulg"))
    equal: Counter[bool] = Counter()
    total = received = 0
    last: dict[Address, str] = {}
    with (
        nedbus.connect(where, timeout=DEADLINE) as bus,
        bus.subscribe(ANY, mode="every") as every,
        Px4(where) as px4,
    ):

        def read_all() -> None:
            nonlocal received
            while received < total:
                sample = every.receive(DEADLINE)
                fields = sample.message.__dict__
                before, last[sample.address] = last.get(sample.address), repr(fields)
                if before == repr(fields) and not get_topic(sample.topic).rate:
                    continue  # topics without a rate are republished if the service stalls for 3 s
                received += 1
                row = logged.get((sample.topic, sample.address.instance or 0, fields["timestamp"]))
                if row is not None:
                    assert [
                        name for name, value in row.items() if not is_equal(fields[name], value)
                    ] == []
                    equal[sample.topic in TOPICS] += 1

        for sent in read_recording(TWELVE.with_name(f"{TWELVE.name}_zenoh.jsonl.gz")):
            px4.send(sent)
            total += bool(sent.payload)
            if total % WINDOW == 0:
                read_all()
        read_all()
        wait_for(lambda: source_status(bus).published >= total, what="the last one to be counted")
        now = source_status(bus)
        assert (total, now.rejected, now.lost, now.reboots) == (69_605, 0, 11, 0)
        assert (now.not_carried, now.silent) == ((), ())
        assert every.counts == nedbus.Counts(received=every.counts.received)
    assert (equal[True], equal[False]) == (45_702, 755)


@pytest.mark.long
def test_silent_topics_are_reported_with_default_pub_csv(where: str) -> None:
    """Topics that stop or never arrive with PX4's default pub.csv are silent, and the doctor suggests a remedy.

    All reliable topics in the recording stop after 3.4 s; the others continue up to 7.7 s. The recording is played at
    half speed.
    """
    ended = [
        "battery_status/0",
        "estimator_status_flags/0",
        "failsafe_flags",
        "vehicle_land_detected",
        "vehicle_status",
    ]
    silent = {f"1/{stream}" for stream in (*ended, "timesync_status")}
    with nedbus.connect(where, timeout=DEADLINE) as bus, Px4(where) as px4:
        begin, start = 0.0, time.monotonic()
        for sent in read_recording(DEFAULT_PUBCSV):
            if sent.kind == "DELETE":
                break
            begin = begin or sent.time
            time.sleep(max(0.0, start + 2 * (sent.time - begin) - time.monotonic()))
            px4.send(sent)
            last = sent
        with repeating(lambda: px4.send(last)):
            wait_for(lambda: set(source_status(bus).silent) == silent, what="silent topics")
            with changing_timings() as timings:
                timings.listen = 0.1
                findings = examine(
                    load_settings(None, connect=(where,)), version=nedbus.__version__
                )
            unsupported = source_status(bus).not_carried
    assert list(unsupported) == sorted(unsupported)
    assert {"SensorCombined", "VehicleControlMode", "VehicleCommandAck", "AirspeedValidated"} < set(
        unsupported
    )
    [loss] = [each for each in findings if "silent while other topics arrive" in each.seen]
    assert (loss.state, "rel=" in loss.advice) == ("warning", True)
    [other] = [each for each in findings if "SensorCombined" in each.seen]
    assert (other.state, "msg=" in other.advice) == ("ok", True)


@pytest.mark.long
def test_two_px4s_with_same_gid_are_not_mixed(where: str) -> None:
    """The first of two PX4s with equal keys and gids is published until the second appears; then both are rejected.

    A key that the second one only announces is also rejected. Nothing counts as lost or as a reboot.
    """
    lines = list(read_recording(ALIKE))
    second = next(number for number, sent in enumerate(lines) if sent.px4 == 1)
    its_first = next(number for number, sent in enumerate(lines) if sent.px4 == 1 and sent.payload)
    # Messages of two sessions have no common order: those of the first one may have arrived later.
    overlapping = lines[second : its_first + 1]
    alone = [sent for sent in lines[:second] if sent.payload]
    played = 0
    with (
        nedbus.connect(where, timeout=DEADLINE) as bus,
        bus.subscribe(ANY, mode="every") as every,
        Px4(where) as first,
        Px4(where) as other,
    ):
        later = [sent for sent in lines[its_first + 1 :] if sent.kind == "PUT"]
        of_both = (
            [sent for sent in overlapping if bool(sent.px4) == is_second]
            for is_second in (True, False)
        )
        for part in (lines[:second], *of_both, later):
            played = play(bus, (first, other), part, played)
        received = [
            encode_cdr(every.receive(DEADLINE).message.__dict__, layout="1.16") for _ in alone
        ]
        assert sorted(received) == sorted(sent.cdr for sent in alone)
        now = source_status(bus)
        assert (now.published, now.rejected) == (len(alone), played - len(alone))
        assert (now.lost, now.reboots, every.counts.lost) == (0, 0, 0)
        assert len(now.warnings) == 4
        assert all("have the same gid" in warning for warning in now.warnings)


@pytest.mark.long
def test_restarted_px4_counts_as_one_reboot(where: str) -> None:
    """A PX4 that is restarted counts as one reboot, however many topics it has, and nothing is lost."""
    lines = list(islice(read_recording(FLIGHT), 1100))
    messages = [sent for sent in lines if sent.payload]
    assert len({sent.address for sent in messages}) == 4
    with nedbus.connect(where, timeout=DEADLINE) as bus:
        for played in (0, len(messages)):
            with Px4(where) as px4:
                play(bus, [px4], lines, played)
        now = source_status(bus)
        assert (now.published, now.rejected, now.lost, now.reboots) == (2 * len(messages), 0, 0, 1)


def read_datagrams(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield the time of each datagram [ns], and its bytes."""
    data, offset = gzip.decompress(path.read_bytes()), 0
    header = struct.Struct("<QH")
    while offset < len(data):
        time_ns, length = header.unpack_from(data, offset)
        offset += header.size + length
        yield time_ns, data[offset - length : offset]


def is_position(datagram: bytes) -> bool:
    """Return whether LOCAL_POSITION_NED is in a datagram of MAVLink 2."""
    offset = 0
    while offset < len(datagram):
        length, flags = datagram[offset + 1], datagram[offset + 2]
        if datagram[offset + 7 : offset + 10] == b"\x20\x00\x00":
            return True
        offset += 12 + length + 13 * (flags & 1)
    return False


def count_outdated_flags(name: str, rate: float) -> int:
    """Return the number of positions in a real flight that are converted with a flag that differs from the log.

    ESTIMATOR_STATUS is simulated at this rate [Hz], with the flags logged at its time.
    """
    logged = {}
    for message in open_replay(f"ulog:{PX4 / name}.ulg").messages:
        if message.address.topic == VLP:
            estimate = upgrade(message.fields)
            logged[estimate.timestamp] = estimate
    times = sorted(logged)

    def truth(microseconds: float) -> VehicleLocalPosition:
        return logged[times[bisect.bisect(times, microseconds) - 1]]

    vehicle, parser = Vehicle("1"), dialect.MAVLink(None)
    late = turn = 0
    for _, datagram in read_datagrams(PX4 / f"{name}_mavlink.bin.gz"):
        for position in parser.parse_buffer(datagram) or []:
            if position.get_type() != "LOCAL_POSITION_NED":
                continue
            now = position.time_boot_ms / 1000
            if int(now * rate) > turn:
                turn = int(now * rate)
                then = truth(1e6 * turn / rate)
                bits = (
                    2 * then.v_xy_valid
                    | 4 * then.v_z_valid
                    | 24 * then.xy_valid
                    | 32 * then.z_valid
                )
                vehicle.handle(
                    dialect.MAVLink_estimator_status_message(0, bits, *[0.0] * 6, 1.0, 1.0), now
                )
            converted = vehicle.handle(position, now)
            assert isinstance(converted, SourceMessage)
            fields = converted.fields
            late += any(
                fields.get(flag, False) != getattr(truth(1000 * position.time_boot_ms), flag)
                for flag in FLAGS
            )
    return late


@pytest.mark.long
@pytest.mark.parametrize("name", ["gps_loss", "twelve_messages"])
def test_requested_status_rate_reduces_outdated_flags(name: str) -> None:
    """At the rate requested for 57,600 baud, at most a third as many positions have outdated flags as at 2 Hz."""
    requested, slow = (
        count_outdated_flags(name, rate) for rate in (request_rates(30.0, 57600, [VLP])[230], 2.0)
    )
    assert 0 < 3 * requested <= slow


@pytest.mark.slow
def test_converted_positions_equal_log(port: int) -> None:
    """Position and velocity equal the log bit by bit, and so do the flags, except changes since the last status.

    ESTIMATOR_STATUS arrives once a second, so a flag lags by up to a second: here at the first status (after 1.15 s),
    and when GPS is first used (3.15 s), lost (28.15 s) and regained (30.15 s).
    """
    names = ("timestamp", "x", "y", "z", "vx", "vy", "vz")
    logged = {}
    for message in open_replay(f"ulog:{LOG}").messages:
        if message.address.topic == VLP:
            fields = upgrade(message.fields).__dict__
            logged[fields["timestamp"]] = fields
    differing: Counter[tuple[str, int]] = Counter()
    compared = 0
    link = f"mavlink:udpin:127.0.0.1:{port}?topics={VLP}"
    with Listener(link) as listener, socket.socket(type=socket.SOCK_DGRAM) as px4:
        for _, datagram in read_datagrams(MAVLINK):
            px4.sendto(datagram, ("127.0.0.1", port))
            if not is_position(datagram):
                continue
            [received] = listener.receive()
            assert (received.lost, received.rebooted, listener.rejections) == (0, False, [])
            fields = upgrade(received.fields).__dict__
            row = logged.get(fields["timestamp"])
            if row is None:
                continue  # the last position, sent after the log was closed
            compared += 1
            assert [fields[name] for name in names] == [row[name] for name in names]
            for flag in FLAGS:
                differing[flag, (fields["timestamp"] + 850_000) // 1_000_000] += (
                    fields[flag] != row[flag]
                )
    assert compared == 1275
    vertical, horizontal = {1: 11}, {3: 11, 28: 8, 30: 4}
    for flag in FLAGS:
        found = {
            second: count for (name, second), count in differing.items() if name == flag and count
        }
        assert found == (horizontal if "xy" in flag else vertical)
