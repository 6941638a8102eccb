"""Readers of a TCP link: reassembly of partial reads, memory, and the limit of messages that wait for the source."""

from __future__ import annotations

import socket
import tracemalloc
from collections.abc import Iterator
from contextlib import closing, suppress
from functools import partial
from typing import Any, Self

import pytest
from pymavlink.dialects.v20 import common as dialect

from nedbus import limits
from nedbus.mavlink.parser import new_parser, parse
from nedbus.sources import Rejection
from nedbus.sources.mavlink import reader
from nedbus.sources.mavlink.link import PeerChoice, open_link
from nedbus.sources.mavlink.reader import LinkReader
from nedbus.sources.mavlink.receive_queue import Received
from nedbus.sources.options import MavlinkOptions
from nedbus.timings import Timings
from tests.flights.recorded_link import Receiver
from tests.peers.live_source import Listener
from tests.peers.ports import free_port
from tests.waits import DEADLINE, wait_for

WAITING = 1000  # messages


class Autopilot:
    """TCP server of a vehicle: accepts one connection, sends messages, answers TIMESYNC, and counts STARTs."""

    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.link = f"tcp:127.0.0.1:{self._server.getsockname()[1]}"
        self._mav, self._parser = dialect.MAVLink(None, 9, 1), dialect.MAVLink(None)
        self._connection: socket.socket | None = None
        self._starts = self.answers = 0

    def pack(self, *messages: Any) -> list[bytes]:
        """Return the messages as bytes, with consecutive sequence numbers."""
        packed = []
        for each in messages:
            packed.append(each.pack(self._mav))
            self._mav.seq = (self._mav.seq + 1) % 256
        return packed

    def send(self, *parts: bytes) -> None:
        if self._connection is None:
            self._connection, _ = self._server.accept()
        self._connection.settimeout(DEADLINE)
        self._connection.sendall(b"".join(parts))

    @property
    def starts(self) -> int:
        """Number of requests for the ULog stream so far."""
        assert self._connection is not None
        self._connection.setblocking(False)
        try:
            data = self._connection.recv(65535)
        except BlockingIOError:
            return self._starts
        for each in self._parser.parse_buffer(data) or []:
            is_command = each.get_type() == "COMMAND_LONG"
            self._starts += is_command and each.command == dialect.MAV_CMD_LOGGING_START
            if each.get_type() == "TIMESYNC":
                self.send(*self.pack(dialect.MAVLink_timesync_message(1, each.ts1)))
                self.answers += 1
        return self._starts

    def close(self) -> None:
        self._server.close()
        if self._connection is not None:
            self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@pytest.fixture
def autopilot() -> Iterator[Autopilot]:
    with Autopilot() as autopilot:
        yield autopilot


def heartbeat() -> Any:
    return dialect.MAVLink_heartbeat_message(2, dialect.MAV_AUTOPILOT_PX4, 0, 0, 4, 3)


def position(ms: int) -> Any:
    return dialect.MAVLink_local_position_ned_message(ms, *range(6))


@pytest.mark.slow
def test_reads_that_end_within_a_message_lose_nothing(autopilot: Autopilot) -> None:
    """If no read of a stream ends with a message, all messages arrive, and the parsed ones are freed."""
    file_part = dialect.MAVLink_file_transfer_protocol_message(0, 245, 191, [1] * 251)
    data = b"".join(autopilot.pack(heartbeat(), *[file_part] * 1535))
    size = 4 * len(data) // 1536 + 1  # no divisor of the length
    received: list[object] = []
    with closing(open_link(autopilot.link, baud=57600)) as link:
        link_reader = LinkReader(link, name="tcp")
        tracemalloc.start()
        try:
            for begin in range(0, len(data), size):
                autopilot.send(data[begin : begin + size])
                received += (
                    each.sequence if isinstance(each, Received) else each
                    for each in link_reader.read(DEADLINE)
                )
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
    assert received == [*range(256)] * 6
    assert peak < len(data) / 2


@pytest.mark.slow
def test_source_that_was_blocked_continues_with_the_newest_messages(
    monkeypatch: pytest.MonkeyPatch, autopilot: Autopilot
) -> None:
    """While the source does not read, the oldest messages are dropped beyond a limit, and counted as lost."""
    monkeypatch.setattr(limits, "MAVLINK_WAITING", WAITING)
    with Listener(f"mavlink:{autopilot.link}?log=1&topics=vehicle_local_position") as listener:
        autopilot.send(
            *autopilot.pack(
                *(position(1000 + number) for number in range(WAITING + 99)), heartbeat()
            )
        )
        wait_for(lambda: autopilot.starts, what="START, the answer to the heartbeat")
        dropped = 100 + autopilot.answers  # they wait, too
        first, *rest = listener.receive(WAITING + 99 - dropped)
        assert (first.fields["timestamp"], first.lost) == (1000 * (1000 + dropped), dropped)
        assert rest[-1].fields["timestamp"] == 1000 * (1000 + WAITING + 98)
        assert sum(each.lost for each in rest) == 0


def test_messages_that_are_not_used_are_not_decoded() -> None:
    """Of a message that no topic needs only the header is read, after the check of its CRC; its sequence counts."""
    encoder = dialect.MAVLink(None, 9, 1)
    pressure = dialect.MAVLink_scaled_pressure_message(1, 1.0, 1.0, 1)
    for version in (pressure.pack(encoder), pressure.pack(encoder, force_mavlink1=True)):
        _, received = parse(new_parser(), heartbeat().pack(encoder) + version, "link", None, 1.0)
        assert isinstance(received, Received)
        assert (received.system, received.message.get_type()) == (9, "UNKNOWN_29")
        damaged = bytes([*version[:-3], version[-3] ^ 1, *version[-2:]])
        [rejection] = parse(new_parser(), damaged, "link", None, 1.0)
        assert isinstance(rejection, Rejection)


def test_vehicles_of_a_link_are_limited(autopilot: Autopilot) -> None:
    """The first 100 system ids on a link are vehicles; messages of others are rejected with one reason."""
    with Listener(f"mavlink:{autopilot.link}") as listener:
        for system in range(1, 104):
            autopilot.send(position(1000).pack(dialect.MAVLink(None, system, 1)))
        received = listener.receive(100)
        listener.step_until(lambda: listener.rejected == 3, what="rejections")
    assert [int(each.address.vehicle) for each in received] == [*range(1, 101)]
    assert {each.where.rpartition(" ")[2] for each in listener.rejections} == {"vehicles"}


def receive(
    receiver: Receiver, system: int, now: float, *, peer: object = "peer"
) -> Received | Rejection:
    """Pass a HEARTBEAT of a vehicle to a receiver without a thread."""
    [received] = parse(
        new_parser(), heartbeat().pack(dialect.MAVLink(None, system, 1)), "link", peer, now
    )
    assert isinstance(received, Received)
    return receiver.process(received)


def test_vehicle_that_is_silent_longest_is_removed_for_another_one() -> None:
    """100 heartbeats of a stranger lock out no vehicle: after some seconds, the one silent longest is removed."""
    receiver = Receiver(MavlinkOptions())
    for system in range(1, 101):
        receive(receiver, system, system / 100)
    assert isinstance(receive(receiver, 101, 2.0), Rejection), "none is silent"
    receive(receiver, 1, 6.0)
    assert isinstance(receive(receiver, 101, 6.1), Received)
    assert receiver.vehicles.keys() == {1, *range(3, 102)}, "2 was silent longest"


def test_removed_vehicle_has_no_state(
    monkeypatch: pytest.MonkeyPatch, timings: Timings, autopilot: Autopilot
) -> None:
    """A vehicle that was removed and returns is a new one, on both threads: its stream is requested again."""
    monkeypatch.setattr(limits, "MAVLINK_VEHICLES", 1)
    monkeypatch.setattr(reader, "_MIN_SILENCE", 0.0)
    timings.log_answer = DEADLINE  # no retransmission of START
    with Listener(f"mavlink:{autopilot.link}?log=1&state=0") as listener:
        for attempt in (1, 2):
            autopilot.send(*autopilot.pack(heartbeat(), position(1000 * attempt)))
            wait_for(partial(has_started, autopilot, attempt), what="START")
            autopilot.send(position(1000 * attempt).pack(dialect.MAVLink(None, 8, 1)))
            listener.step_until(
                partial(has_received, listener, "8"), what="a position of the other vehicle"
            )
            listener.messages.clear()


def has_started(autopilot: Autopilot, starts: int) -> bool:
    return autopilot.starts == starts


def has_received(listener: Listener, vehicle: str) -> bool:
    return vehicle in {each.address.vehicle for each in listener.messages}


def test_peer_that_delivers_data_keeps_the_requests() -> None:
    """A datagram with a vehicle's own id from elsewhere does not redirect what is sent to the vehicle."""
    choice = PeerChoice("vehicle", 0.0)
    for step in range(100):
        choice.add("vehicle", step / 10)
        choice.add("stranger", step / 10 + 0.01)
        assert choice.peer == "vehicle"
    assert choice.second == "stranger"


def test_peer_is_replaced_when_it_is_silent_or_outnumbered() -> None:
    """A vehicle with a new address is answered there after 3 s, or after 20 messages in a row."""
    moved = PeerChoice("old", 0.0)
    moved.add("new", 2.9)
    assert (moved.peer, moved.second) == ("old", None)
    moved.add("new", 3.1)
    assert (moved.peer, moved.second) == ("new", None)
    outnumbered = PeerChoice("stranger", 0.0)
    for _ in range(20):
        assert outnumbered.peer == "stranger"
        outnumbered.add("vehicle", 0.1)
    assert outnumbered.peer == "vehicle"


@pytest.mark.slow
def test_stranger_with_the_id_of_a_vehicle_changes_nothing_but_a_remark() -> None:
    """Requests go on to the vehicle, the stranger's heartbeat does not arm it, and `info` names the second address."""
    port = free_port()
    with (
        Listener(f"mavlink:udpin:127.0.0.1:{port}?log=1&state=0") as listener,
        UdpAutopilot(port) as vehicle, UdpAutopilot(port) as stranger,
    ):  # fmt: skip
        armed = dialect.MAVLink_heartbeat_message(2, dialect.MAV_AUTOPILOT_PX4, 128, 0, 4, 3)

        def is_remarked() -> bool:
            vehicle.send(heartbeat(), position(1000))
            stranger.send(armed)
            return bool(listener.rejections)

        listener.step_until(is_remarked, what="a remark")
        assert stranger.received() == []
        assert vehicle.received()
    [remark] = listener.rejections
    assert remark.count == 0
    assert remark.where.endswith("system 9, second address")
    assert (
        f"also arrives from 127.0.0.1:{stranger.port}; requests go to 127.0.0.1:{vehicle.port} only"
        in remark.reason
    )


class UdpAutopilot:
    """UDP socket of system 9, which keeps the types of what it receives."""

    def __init__(self, port: int) -> None:
        self._mav, self._socket = dialect.MAVLink(None, 9, 1), socket.socket(type=socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.setblocking(False)
        self.port = self._socket.getsockname()[1]

    def send(self, *messages: Any) -> None:
        for message in messages:
            self._socket.send(message.pack(self._mav))

    def received(self) -> list[str]:
        types = []
        with suppress(BlockingIOError):
            while True:
                parsed = dialect.MAVLink(None).parse_buffer(self._socket.recv(65535))
                types += [message.get_type() for message in parsed or ()]
        return types

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()


@pytest.mark.slow
def test_late_messages_do_not_hide_a_reboot(timings: Timings, autopilot: Autopilot) -> None:
    """After messages that arrived late, the vehicle has rebooted if its times are a second below the newest one.

    They are possible: up to 2 s more than the time since its last message. After a reboot, its ULog stream is requested
    again.
    """
    timings.log_answer = DEADLINE  # no retransmission of START
    attitude, height = dialect.MAVLink_attitude_message, dialect.MAVLink_global_position_int_message

    def messages(ms: int) -> list[Any]:
        return [position(ms), attitude(ms, *[0] * 6), height(ms, *[0] * 8)]

    with Listener(f"mavlink:{autopilot.link}?log=1"):
        autopilot.send(*autopilot.pack(heartbeat(), *messages(5000), position(4200)))
        wait_for(lambda: autopilot.starts == 1, what="the first START")
        autopilot.send(*autopilot.pack(*messages(1500), heartbeat()))
        wait_for(lambda: autopilot.starts == 2, what="START after the reboot")


def data_frames() -> Iterator[bytes]:
    """Yield frames of ULog data: full, short, and with zeros at the end, which MAVLink 2 does not transmit."""
    mav = dialect.MAVLink(None, 9, 1)
    for data in (bytes(range(249)), b"abc" + bytes(246), bytes(249)):
        for kind in (
            dialect.MAVLink_logging_data_message,
            dialect.MAVLink_logging_data_acked_message,
        ):
            for target, sequence, length, offset in ((245, 65_535, 249, 255), (0, 0, 3, 0)):
                yield bytes(kind(target, target, sequence, length, offset, data).pack(mav))


def test_data_of_the_ulog_stream_is_decoded_as_by_pymavlink() -> None:
    """Frames of ULog data have the same fields as pymavlink decodes, in a datagram of one frame and of several."""
    names = ("target_system", "target_component", "sequence", "length", "first_message_offset")
    frames = list(data_frames())
    reference = dialect.MAVLink(None)
    for datagrams in (frames, [b"".join(frames)]):
        found = [
            each for data in datagrams for each in parse(new_parser(), data, "link", None, 0.0)
        ]
        assert len(found) == len(frames)
        for received, frame in zip(found, frames, strict=True):
            assert isinstance(received, Received)
            expected: Any = reference.parse_char(frame)
            assert [getattr(received.message, name) for name in names] == [
                getattr(expected, name) for name in names
            ]
            data = received.message.data.ljust(249, b"\0")
            assert (received.message.get_type(), received.message.get_msgId()) == (
                expected.get_type(),
                expected.get_msgId(),
            )
            assert (list(data), received.system) == (list(expected.data), 9)


def test_damaged_data_of_the_ulog_stream_is_rejected() -> None:
    """A frame of ULog data with a flipped bit in data or checksum is rejected, and the next frame is read."""
    frames = list(data_frames())
    for index in range(10, len(frames[0])):
        damaged = bytearray(frames[0])
        damaged[index] ^= 1
        found = list(parse(new_parser(), bytes(damaged), "link", None, 0.0))
        assert not any(isinstance(each, Received) for each in found), index
    parser = new_parser()
    mixed = [
        *parse(parser, bytes(damaged), "link", None, 0.0),
        *parse(parser, frames[1], "link", None, 0.0),
    ]
    assert [isinstance(each, Received) for each in mixed] == [False, True]
