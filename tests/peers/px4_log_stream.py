"""A fake PX4 that streams its ULog over MAVLink from a recording: telemetry, commands, stop-and-wait, timeouts.

The recordings are of a real PX4 (SITL, main of 2026-05-14): gzip of records `<QBH`: time [ns], direction (0: from the
vehicle, 1: to it) and length, followed by a datagram with one MAVLink 2 frame.
The fake behaves like the recorded vehicle; the bytes of the ULog are the recorded ones, except the time in the header
of a second stream.
"""

from __future__ import annotations

import gzip
import math
import random
import select
import socket
import struct
import threading
import time
from bisect import bisect
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, Self

from pymavlink.dialects.v20 import common as dialect
from pymavlink.generator.mavcrc import x25crc

from tests.flights.ulogs import LOGS

STREAMS: Final = LOGS.parent / "px4" / "ulog_stream"
"""Recordings of streams, and the ULog files of the same flights."""
SHORT: Final = Path(__file__).parents[1] / "data" / "log_stream.bin.gz"
"""The header of `ulog_stream_flight1` without parameters and counters, and the 2 s after it.

The header is short, because on a very busy machine a long one is refused, as on a slow link.
"""

START, STOP = dialect.MAV_CMD_LOGGING_START, dialect.MAV_CMD_LOGGING_STOP
HEARTBEAT: Final = 0
_DATA, _ACKED = dialect.MAVLINK_MSG_ID_LOGGING_DATA, dialect.MAVLINK_MSG_ID_LOGGING_DATA_ACKED
# sequence, target ids, length, first_message_offset; then the data
_FIELDS: Final = struct.Struct("<HBBBB")
_REPEAT: Final = 0.05  # s; retransmission interval without an acknowledgement
# bytes; first_message_offset of a message in which no record begins
_DATA_SIZE, _NO_RECORD = 249, 255
_OTHER_LINK: Final = (0, 0)  # ids of a client on another link
_MAX_LATE: Final = 5  # frames
_SENDS: Final = 50  # transmissions of one message after which the stream ends
_BLOCKED: Final = 2.5  # s that the logger blocks after a START during STOP
_ROUND_TRIP: Final = 0.004  # s, in the recordings
_MAX_QUEUED: Final = 2**16  # bytes in the receive buffer of the client, at full speed
_HEARTBEAT_INTERVAL: Final = 1.0  # s while the recording is held
_BATCH: Final = 64  # frames sent between two reads of the socket
_TAIL: Final = 0.18  # s; duration of a STOP whose client acknowledges on another link
_MAX_IDLE: Final = 0.01  # s

Event = Literal["reboot", "vanish", "return", "foreign_stop"]


class Message(NamedTuple):
    """LOGGING_DATA or LOGGING_DATA_ACKED; `offset`: first_message_offset."""

    acked: bool
    sequence: int
    offset: int
    data: bytes


class Entry(NamedTuple):
    """A telemetry frame, or a stream message after the header, with its time in the recording [s]."""

    time: float
    content: bytes | Message


@dataclass
class Recording:
    """All messages of the vehicle except replies to the recorded client.

    `start`, `header_end`: times in the recording [s]. `tail`: the messages after STOP.
    `clock`: time of the recording [s] and of the vehicle [ns], from answers to TIMESYNC.
    `definitions`: records of topics that appeared in flight, with the index of the entry that completes each.
    """

    system: int
    entries: list[Entry] = field(default_factory=list)
    header: list[Message] = field(default_factory=list)
    tail: list[Message] = field(default_factory=list)
    clock: list[tuple[float, int]] = field(default_factory=list)
    definitions: list[tuple[int, bytes]] = field(default_factory=list)
    start: float = 0.0
    header_end: float = 0.0


def datagrams(path: Path) -> Iterator[tuple[float, bool, bytes]]:
    """Yield the time of each datagram [s], whether the vehicle sent it, and its bytes."""
    data, offset, header = gzip.decompress(path.read_bytes()), 0, struct.Struct("<QBH")
    while offset < len(data):
        time_ns, direction, length = header.unpack_from(data, offset)
        offset += header.size + length
        yield time_ns / 1e9, direction == 0, data[offset - length : offset]


def unpack(frame: bytes) -> tuple[int, bytes]:
    """Return the id of a MAVLink 2 message and its payload."""
    return int.from_bytes(frame[7:10], "little"), frame[10 : 10 + frame[1]]


def stream_message(frame: bytes) -> Message | None:
    """Return the stream message in a frame; None for other frames."""
    number, payload = unpack(frame)
    if number not in (_DATA, _ACKED):
        return None
    sequence, _, _, length, offset = _FIELDS.unpack_from(payload.ljust(_FIELDS.size, b"\0"))
    return Message(
        number == _ACKED, sequence, offset, payload[_FIELDS.size :][:length].ljust(length, b"\0")
    )


def read_recording(path: Path) -> Recording:
    """Read the first stream of a recording, and its telemetry."""
    recording: Recording | None = None
    first, is_stopping, data, last = 0.0, False, bytearray(), None
    for when, from_vehicle, frame in datagrams(path):
        number, payload = unpack(frame)
        if not from_vehicle:
            continue
        if recording is None:
            recording, first = Recording(frame[5]), when
        now = when - first
        if message := stream_message(frame):
            known = recording.tail if is_stopping else recording.header
            if is_stopping or not (recording.header_end or not message.acked):
                if not known or known[-1].sequence != message.sequence:
                    known.append(message)
                recording.start = recording.start or now
                continue
            recording.header_end = recording.header_end or now
            recording.entries.append(Entry(now, message))
            if last is not None and message.sequence != (last + 1) % 2**16:
                data.clear()
            data += (
                message.data if data or message.offset == 255 else message.data[message.offset :]
            )
            last = message.sequence
            for kind, body in split_records(data):
                if kind == "A":
                    record = struct.pack("<HB", len(body), ord(kind)) + body
                    recording.definitions.append((len(recording.entries), record))
        elif number == dialect.MAVLINK_MSG_ID_COMMAND_ACK and payload[:2] in (
            b"\xce\x09",
            b"\xcf\x09",
        ):
            is_stopping = is_stopping or payload[:2] == b"\xcf\x09"
        elif number == dialect.MAVLINK_MSG_ID_TIMESYNC and (
            answer := int.from_bytes(payload[:8], "little")
        ):
            recording.clock.append((now, answer))
        else:
            recording.entries.append(Entry(now, frame))
    assert recording
    return recording


def split_records(data: bytearray) -> Iterator[tuple[str, bytes]]:
    """Remove complete ULog records from the start of `data`; yield their types and bodies."""
    while len(data) >= 3 and len(data) >= (end := 3 + int.from_bytes(data[:2], "little")):
        yield chr(data[2]), bytes(data[3:end])
        del data[:end]


@dataclass
class _Stream:
    """An active stream. `pending`: messages to send by stop-and-wait before all others.

    `is_on_link`: the client is on this link. `expected`: next sequence number of the recording, None before the first
    record. `acknowledged`: arrival time of the acknowledgement of the first pending message.
    """

    ids: tuple[int, int]
    is_on_link: bool = True
    port: int = 0
    sequence: int = 0
    expected: int | None = None
    pending: deque[Message] = field(default_factory=deque)
    sends: int = 0
    sent: float = 0.0
    acknowledged: float | None = None

    def append(self, message: Message) -> None:
        """Queue a message for stop-and-wait."""
        self.pending.append(message._replace(sequence=self.sequence % 2**16))
        self.sequence += 1


class _Request(NamedTuple):
    """A command queued for the logger; `during_stop`: received before STOP was accepted; `port`: of its link."""

    command: int
    ids: tuple[int, int]
    during_stop: bool = False
    port: int = -1


class Px4LogStream:
    """A vehicle that sends to a UDP port of this host from a thread, inside a `with` block.

    `speed`: factor of real time; None: as fast as the client reads, while `is_ready` returns True.
    `loss`, `burst`: fraction of datagrams to the client that are dropped, and the number dropped in a row.
    `reorder`: fraction of datagrams that arrive up to five datagrams late.
    `round_trip`: minimum time from a message to its acknowledgement [s]; default in real time: as recorded.
    Answers to TIMESYNC take the part of it that exceeds the recorded one, which is the processing time of PX4.
    `refusal`: MAV_RESULT of every START. `answers`: whether a logger runs, and sends COMMAND_ACK.
    `unsent`: number of STARTs that are accepted without sending data.
    `owner`: ids of the client that initially owns the stream; `is_owner_on_link`: it is on this link.
    `events`: by time in the recording [s]. `on_send`: called with each frame.
    `on_message`: called with each message of the client.
    `waits`: hold the recording before its START until the client sends one.
    `second_port`: of a client on a second link, which has the telemetry, too. Like PX4, the vehicle sends the stream to
    the client whose START was accepted first, until a STOP arrives on the link of that client.

    `commands`: received MAV_CMDs. `dropped`: lost LOGGING_DATA, counted when a later one arrives.
    `late`: number of reordered LOGGING_DATA.
    `streams`: number of started streams. `finished`: set when the recording has been sent.
    """

    def __init__(
        self,
        recording: Recording,
        port: int,
        *,
        speed: float | None = 1.0,
        is_ready: Callable[[], bool] = lambda: True,
        loss: float = 0.0,
        burst: int = 1,
        reorder: float = 0.0,
        seed: int = 0,
        round_trip: float | None = None,
        refusal: int | None = None,
        answers: bool = True,
        unsent: int = 0,
        owner: tuple[int, int] | None = None,
        is_owner_on_link: bool = False,
        events: Mapping[float, Event] | None = None,
        waits: bool = True,
        second_port: int | None = None,
        deadline: float = 100.0,
        on_send: Callable[[bytes], object] = lambda _: None,
        on_message: Callable[[Any], object] = lambda _: None,
    ) -> None:
        self.commands: list[int] = []
        self.dropped = self.late = self.streams = 0
        self.finished = threading.Event()
        self.recording, self._port, self._speed, self._is_ready = recording, port, speed, is_ready
        self._loss, self._burst, self._reorder, self._random = (
            loss / burst,
            burst,
            reorder,
            random.Random(seed),
        )
        self._round_trip = round_trip if round_trip is not None else _ROUND_TRIP if speed else 0.0
        self._refusal, self._answers, self._unsent, self._waits = refusal, answers, unsent, waits
        self._events, self._on_send = deque(sorted((events or {}).items())), on_send
        self._on_message = on_message
        self._triggered: deque[Event] = deque()
        self._ports = [port] if second_port is None else [port, second_port]
        # port and ids of the client that has the stream
        self._streamer: tuple[int, tuple[int, int]] | None = None
        self._mav = dialect.MAVLink(None, recording.system, dialect.MAV_COMP_ID_AUTOPILOT1)
        self._mav.robust_parsing = True
        self._crc_extra: dict[int, int] = {}
        # to TIMESYNC: when, its time, the port
        self._answers_due: deque[tuple[float, int, int]] = deque()
        # late frames: the number of the frame that they follow
        self._held: list[tuple[int, bytes, int]] = []
        self._frames = self._drops_left = self._data_sent = self._newest = 0
        # LOGGING_DATA that were dropped since the last one that arrived
        self._unnoticed: list[int] = []
        self._is_gone = False
        self._busy_until = self._next_heartbeat = 0.0
        self._is_full, self._next_look = False, 0
        self._heartbeat = next(
            each for _, each in recording.entries if isinstance(each, bytes) and is_heartbeat(each)
        )
        self._rewind()
        self._stream: _Stream | None = (
            _Stream(owner, is_owner_on_link, sequence=5000) if owner else None
        )
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._end = time.monotonic() + deadline
        self._closing = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="px4-log-stream")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()
        self._socket.close()
        if self._failure:
            raise self._failure

    @property
    def is_armed(self) -> bool:
        """Whether the last HEARTBEAT had the armed flag."""
        return bool(unpack(self._heartbeat)[1][6] & dialect.MAV_MODE_FLAG_SAFETY_ARMED)

    def change_owner(self, ids: tuple[int, int]) -> None:
        """Address the stream to another client from now on."""
        assert self._stream
        self._stream.ids = ids

    def trigger(self, event: Event) -> None:
        """Cause an event now."""
        self._triggered.append(event)

    def _rewind(self) -> None:
        """Restart the recording and the vehicle's clock."""
        self._index, self._clock, self._checked = 0, 0.0, time.monotonic()
        self._stream = None
        self._stop_from: _Request | None = None  # the STOP that is under way
        self._streamer = None
        self._queue: deque[_Request] = deque()
        self._is_held = self._waits

    def _run(self) -> None:
        try:
            while not self._closing.is_set() and time.monotonic() < self._end:
                self._receive()
                while self._answers_due and self._answers_due[0][0] <= time.monotonic():
                    _, sent, port = self._answers_due.popleft()
                    self._send(dialect.MAVLink_timesync_message(self._boot_ns(), sent), port=port)
                while self._triggered:
                    self._apply(self._triggered.popleft())
                while self._events and self._events[0][0] <= self._clock:
                    self._apply(self._events.popleft()[1])
                self._run_logger(time.monotonic())
                self._play(time.monotonic())
        except BaseException as exc:  # noqa: BLE001 - raised again in the thread of the test
            self._failure = exc

    def _apply(self, event: Event) -> None:
        match event:
            case "reboot":
                self._rewind()
            case "foreign_stop":
                self._queue.append(_Request(STOP, _OTHER_LINK))
            case _:
                self._is_gone = event == "vanish"

    def _receive(self) -> None:
        """Handle the client's messages; wait briefly if nothing is due."""
        select.select([self._socket], [], [], self._idle_time())
        with suppress(BlockingIOError):
            while True:
                data, (_, port) = self._socket.recvfrom(2048)
                for message in self._mav.parse_buffer(data) or []:
                    if not self._is_gone:
                        self._on_message(message)
                        self._handle(message, time.monotonic(), port)

    def _idle_time(self) -> float:
        entries = self.recording.entries
        if (self._stream and self._stream.pending) or self._answers_due or not self._has_room():
            return 0.0005
        if self._is_held or self._index == len(entries):
            return _MAX_IDLE
        return (
            min(_MAX_IDLE, max(0.0, entries[self._index].time - self._clock))
            if self._speed
            else 0.0
        )

    def _handle(self, message: Any, now: float, port: int) -> None:
        ids, stream = (message.get_srcSystem(), message.get_srcComponent()), self._stream
        match message.get_type():
            case "COMMAND_LONG":
                self.commands.append(message.command)
                if message.command in (START, STOP) and self._answers:
                    self._queue.append(
                        _Request(message.command, ids, self._stop_from is not None, port)
                    )
                self._is_held = self._is_held and message.command != START
            case "LOGGING_ACK" if stream and stream.sends and stream.acknowledged is None:
                if message.sequence == stream.pending[0].sequence:
                    stream.acknowledged = max(
                        now, stream.sent - _REPEAT * (stream.sends - 1) + self._round_trip
                    )
            case "TIMESYNC" if message.tc1 == 0:
                self._answers_due.append(
                    (now + max(0.0, self._round_trip - _ROUND_TRIP), message.ts1, port)
                )

    def _boot_ns(self) -> int:
        """Return the time of the vehicle, interpolated from its recorded replies to TIMESYNC."""
        clock = self.recording.clock
        index = min(max(bisect(clock, (self._clock, 0)), 1), len(clock) - 1)
        (before, first), (after, second) = clock[index - 1 : index + 1]
        return first + round((self._clock - before) / (after - before) * (second - first))

    def _run_logger(self, now: float) -> None:
        """Send pending messages; execute commands only if none is pending, like PX4's logger."""
        if (stream := self._stream) and stream.pending:
            self._send_pending(stream, now)
        elif now >= self._busy_until:
            if self._stop_from:
                self._answer(self._stop_from, dialect.MAV_RESULT_ACCEPTED)
                if self._streamer and self._streamer[0] == self._stop_from.port:
                    self._streamer = None
                self._stream = self._stop_from = None
            elif self._queue:
                self._execute(self._queue.popleft(), now)

    def _send_pending(self, stream: _Stream, now: float) -> None:
        if stream.acknowledged is not None and now >= stream.acknowledged:
            stream.pending.popleft()
            stream.sends, stream.acknowledged = 0, None
            self.dropped, self._unnoticed = self.dropped + len(self._unnoticed), []
            if not stream.pending:
                self._clock = max(self._clock, self.recording.header_end)
                return
        if stream.sends and now < stream.sent + _REPEAT:
            return
        if stream.sends == _SENDS:
            self._stream = None
            return
        self._send_message(stream, stream.pending[0])
        stream.sends, stream.sent = stream.sends + 1, now

    def _execute(self, request: _Request, now: float) -> None:
        if request.command == STOP:
            if self._stream is None:
                self._answer(request, dialect.MAV_RESULT_ACCEPTED)
                return
            self._answer(request, dialect.MAV_RESULT_IN_PROGRESS)
            self._stop_from = request
            if self._stream.is_on_link:
                self._append_tail(self._stream)
            else:
                self._busy_until = now + _TAIL
        elif self._refusal is not None:
            self._answer(request, self._refusal)
        elif self._stream:
            self._answer(request, dialect.MAV_RESULT_TEMPORARILY_REJECTED)
        else:
            self._answer(request, dialect.MAV_RESULT_ACCEPTED)
            # the first message of this stream is never delivered
            if request.during_stop or self._unsent:
                self._unsent, self._busy_until = max(0, self._unsent - 1), now + _BLOCKED
            else:
                self._stream = self._begin(request)

    def _begin(self, request: _Request) -> _Stream:
        """Return a stream with the header and the definitions of topics that appeared since."""
        if self._streamer is None or len(self._ports) == 1:
            self._streamer = request.port, request.ids
        recording, stream = self.recording, _Stream(self._streamer[1], port=self._streamer[0])
        self._unnoticed = []
        for each in recording.header:
            stream.append(each)
        for index, record in recording.definitions:
            if index <= self._index:
                stream.append(Message(True, 0, 0, record))
        if self._clock <= recording.header_end:
            stream.expected = recording.header[-1].sequence + 1
        first = stream.pending[0]
        boot_us = int.from_bytes(first.data[8:16], "little") + self.streams
        stream.pending[0] = first._replace(
            data=first.data[:8] + boot_us.to_bytes(8, "little") + first.data[16:]
        )
        self.streams += 1
        self._clock = max(self._clock, recording.start)
        return stream

    def _append_tail(self, stream: _Stream) -> None:
        """Queue the rest of the current record, then PX4's messages after STOP."""
        tail = self.recording.tail
        messages = [
            each for _, each in self.recording.entries[self._index :] if isinstance(each, Message)
        ]
        if messages and tail:
            tail = [tail[0]._replace(offset=0, data=tail[0].data[tail[0].offset :]), *tail[1:]]
        for each in messages if stream.expected is not None else []:
            if end := min(each.offset, len(each.data)):
                stream.append(Message(True, 0, _NO_RECORD, each.data[:end]))
            if each.offset != _NO_RECORD:
                break
        for each in tail:
            stream.append(each)

    def _play(self, now: float) -> None:
        """Send the due part of the recording; pause while messages are pending or the client is slow."""
        elapsed, self._checked = now - self._checked, now
        limit = self.recording.start if self._is_held else math.inf
        if self._stream and self._stream.pending:
            limit = max(self._clock, self.recording.header_end)
        until = min(limit, self._clock + elapsed * self._speed if self._speed else math.inf)
        entries = self.recording.entries[self._index : self._index + _BATCH]
        for when, content in entries:
            is_blocked = isinstance(content, Message) and self._stream and self._stream.pending
            if when > until or is_blocked or not self._has_room():
                break
            self._index, self._clock = self._index + 1, max(self._clock, when)
            if isinstance(content, Message):
                self._send_entry(content)
            else:
                self._transmit(content)
        else:
            if len(entries) < _BATCH and not self.finished.is_set():
                self._release(everything=True)
                self.finished.set()
            when = math.inf
        if self._speed and when > until:
            self._clock = max(self._clock, until)
        if now >= self._next_heartbeat:
            self._transmit(self._heartbeat)

    def _send_entry(self, message: Message) -> None:
        """Send a message of the recording if a stream is active, beginning with its first complete record."""
        stream = self._stream
        if (
            stream is None
            or self._stop_from
            or (stream.expected is None and message.offset == _NO_RECORD)
        ):
            return
        if stream.expected is None:
            message = message._replace(offset=0, data=message.data[message.offset :])
        else:
            # lost before it was recorded
            stream.sequence += (message.sequence - stream.expected) % 2**16
        stream.expected = message.sequence + 1
        if not stream.is_on_link:
            stream.sequence += 1
        elif message.acked:
            stream.append(message)
        else:
            self._send_message(stream, message._replace(sequence=stream.sequence % 2**16))
            stream.sequence += 1

    def _send_message(self, stream: _Stream, message: Message) -> None:
        kind = (
            dialect.MAVLink_logging_data_acked_message
            if message.acked
            else dialect.MAVLink_logging_data_message
        )
        data = message.data.ljust(_DATA_SIZE, b"\0")
        self._data_sent += not message.acked
        number = 0 if message.acked else self._data_sent
        self._send(
            kind(*stream.ids, message.sequence, len(message.data), message.offset, [*data]),
            number,
            stream.port,
        )

    def _answer(self, request: _Request, result: int) -> None:
        if request.ids != _OTHER_LINK:
            ack = dialect.MAVLink_command_ack_message(request.command, result, 0, 0, *request.ids)
            self._send(ack, port=request.port)

    def _send(self, message: Any, number: int = 0, port: int = 0) -> None:
        self._transmit(message.pack(self._mav), number, port)

    def _transmit(self, frame: bytes, number: int = 0, port: int = 0) -> None:
        """Send, drop or delay a frame; `number`: index of a LOGGING_DATA message, from 1; 0 for other frames.

        `port`: of the link; 0 for all links. A delayed frame arrives on the first link.
        """
        self._release()
        self._frames += 1
        if is_heartbeat(frame):
            self._heartbeat, self._next_heartbeat = frame, time.monotonic() + _HEARTBEAT_INTERVAL
        frame = self._renumber(frame)
        if self._random.random() < self._loss:
            self._drops_left = self._burst
        if self._is_gone or self._drops_left:
            self._drops_left = max(0, self._drops_left - 1)
            self._unnoticed += [number] if number else []
        elif self._random.random() < self._reorder:
            self._held.append((self._frames + self._random.randint(1, _MAX_LATE), frame, number))
        else:
            self._arrive(number)
            self._on_send(frame)
            for each in [port] if port else self._ports:
                self._socket.sendto(frame, ("127.0.0.1", each))

    def _release(self, *, everything: bool = False) -> None:
        """Send the delayed frames that are due."""
        for each in self._held[:]:
            due, frame, number = each
            if everything or due <= self._frames:
                self._held.remove(each)
                self.late += 0 < number < self._newest
                self._arrive(number)
                self._socket.sendto(frame, ("127.0.0.1", self._port))

    def _arrive(self, number: int) -> None:
        """Count the dropped LOGGING_DATA before one that arrives."""
        dropped = sum(each < number for each in self._unnoticed)
        self.dropped, self._unnoticed = self.dropped + dropped, self._unnoticed[dropped:]
        self._newest = max(self._newest, number)

    def _renumber(self, frame: bytes) -> bytes:
        """Return a frame with the next MAVLink sequence number of this link."""
        number, _ = unpack(frame)
        if number not in self._crc_extra:  # some messages are not in this dialect
            self._crc_extra[number] = next(
                each for each in range(256) if _crc(frame[:-2], each) == frame[-2:]
            )
        frame = frame[:4] + bytes([self._frames % 256]) + frame[5:-2]
        return frame + _crc(frame, self._crc_extra[number])

    def _has_room(self) -> bool:
        """Return whether the client's receive buffer has room, checked every 16 frames."""
        if self._is_full or self._frames >= self._next_look:
            self._next_look = self._frames + 16
            self._is_full = not self._is_ready() or queued_bytes(self._port) > _MAX_QUEUED
        return not self._is_full


def is_heartbeat(frame: bytes) -> bool:
    """Return whether this is a HEARTBEAT."""
    number, _ = unpack(frame)
    return number == HEARTBEAT


def queued_bytes(port: int) -> int:
    """Return the number of unread bytes in the receive buffers of a UDP port."""
    rows = [line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
    return sum(
        int(row[4].split(":")[1], 16) for row in rows if int(row[1].split(":")[1], 16) == port
    )


def _crc(frame: bytes, extra: int) -> bytes:
    return struct.pack("<H", x25crc(frame[1:] + bytes([extra])).crc)
