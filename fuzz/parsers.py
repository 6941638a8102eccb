"""One fuzz target per parser: each accepts any bytes, and lets only undocumented errors escape."""

from __future__ import annotations

import os
import re
import struct
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError
from pymavlink.dialects.v20 import common as dialect
from pymavlink.generator.mavcrc import x25crc

from nedbus import ulog
from nedbus.errors import SourceError
from nedbus.flights.columns import Columns
from nedbus.flights.readers import ReadOptions, Run
from nedbus.flights.readers.mcap import McapReader, RecordedStream
from nedbus.mavlink.fields import CONVERSIONS
from nedbus.mavlink.vehicle import Vehicle
from nedbus.sources import SourceMessage
from nedbus.sources.mavlink.link import Packet
from nedbus.sources.mavlink.log_stream import LogStream
from nedbus.sources.mavlink.reader import COMPONENT, SYSTEM, LinkReader, LogReceiver
from nedbus.sources.mavlink.receive_queue import Received
from nedbus.sources.options import MavlinkOptions
from nedbus_msgs import (
    BY_TOPIC,
    MESSAGES,
    TOPICS,
    Address,
    DecodeError,
    Definition,
    EncodeError,
    MsgError,
    bases_of_msg,
    codec_of,
    decode_with,
    define_msg,
    encode_with,
    hash_of_msg,
    read_msg,
    upgrade_with,
)
from nedbus_msgs.arrays import arrays_of

MAVLINK_KINDS: Final = (
    dialect.MAVLINK_MSG_ID_HEARTBEAT, dialect.MAVLINK_MSG_ID_LOGGING_DATA, dialect.MAVLINK_MSG_ID_LOGGING_DATA_ACKED,
    dialect.MAVLINK_MSG_ID_COMMAND_ACK, dialect.MAVLINK_MSG_ID_TIMESYNC, dialect.MAVLINK_MSG_ID_STATUSTEXT,
    dialect.MAVLINK_MSG_ID_SYSTEM_TIME, dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS, dialect.MAVLINK_MSG_ID_ALTITUDE,
    dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
    *(getattr(dialect, f"MAVLINK_MSG_ID_{name}") for name in CONVERSIONS if name != "HEARTBEAT"),
)  # fmt: skip
"""Ids of the messages that `frames` makes."""
MAVLINK_IDS: Final = (SYSTEM, COMPONENT)
"""System and component id of the log stream's client."""
_MAX_PIECES: Final = 40  # chunks of a log: feeding single bytes would take too long
_RAW: Final = 255  # kind of an item: raw bytes without a frame
_REMOTE: Final = 64  # bit of the kind: from another system
_LOST: Final = 128  # bit of the kind: one message before this one was lost


def parse_ulog(data: bytes) -> int:
    """Parse a log in chunks and decode its messages and texts; the chunk size must not affect the records.

    The first two bytes are the mode of the parser and the chunk size. Returns the number of records.
    """
    verify, log = bool(data[:1] > b"\x7f"), data[2:]
    size = max(int.from_bytes(data[1:2], "big") ** 2, len(log) // _MAX_PIECES, 1)
    whole = _records(log, len(log) or 1, verify=verify)
    assert _plain(_records(log, size, verify=verify)) == _plain(whole), (
        "the records depend on the chunk size"
    )
    streams: dict[ulog.Subscription, ulog.LoggedStream] = {}
    texts = ulog.LogMessageBuilder()
    count = 0
    for count, record in enumerate(texts.merge(whole), 1):  # noqa: B007 - counts
        if isinstance(record, ulog.Data):
            with suppress(ValueError):  # of a format that cannot be a message
                stream = streams.get(record.subscription) or ulog.LoggedStream(
                    "1", record.subscription
                )
                streams[record.subscription] = stream
                _validate(stream.definition, stream.decode(record.payload))
    return count


def parse_mcap(data: bytes) -> int:
    """Read a recording as a replay does. Returns the number of messages."""
    descriptor = os.memfd_create("recording")
    count = 0
    try:
        os.write(descriptor, data)
        with (
            suppress(SourceError),
            McapReader(Path(f"/proc/self/fd/{descriptor}"), ReadOptions(topics=None)) as reader,
        ):
            for count, record in enumerate(reader.records(), 1):  # noqa: B007 - counts
                with suppress(DecodeError):
                    _validate(record.stream.definition, record.stream.decode(record.payload))
    finally:
        os.close(descriptor)
        define_msg.cache_clear()
    return count


def parse_msg(data: bytes) -> int:
    """Read a .msg file, and encode a message of it. Returns the number of its fields."""
    text = data.decode(errors="replace")
    for read in (bases_of_msg, lambda each: hash_of_msg("Fuzzed", each)):
        with suppress(MsgError):
            read(text)
    try:
        fields = read_msg(text)
        definition = define_msg("Fuzzed", text)
    except MsgError:
        return 0
    finally:
        define_msg.cache_clear()
    codec, absent = codec_of(definition), arrays_of(definition).absent(1)
    payload = arrays_of(definition).encode(absent)
    with suppress(DecodeError):  # a rule of the file, such as a range without zero
        assert codec.encode(codec.decode(payload)) == payload
    return len(fields)


def parse_cdr(data: bytes) -> int:
    """Decode CDR of the message and layout that the first two bytes select; a valid message survives a round trip.

    Returns the number of valid messages.
    """
    definition = _definition_of(data)
    layouts = [*definition.layouts.values()]
    layout = layouts[data[1] % len(layouts)] if len(data) > 1 else layouts[0]
    payload = data[2:]
    topic = next(iter(definition.topics))
    address = Address("1", topic, 0 if TOPICS[topic].instances else None)
    columns = Columns()
    stream = RecordedStream("", address, definition, layout, frozenset())
    columns.add(Run(stream, [payload], []))  # as `nedbus.read` does
    accepted, valid, _ = columns.decode(definition)
    try:
        fields = decode_with(definition, payload, layout)
        message = upgrade_with(definition, fields)
    except (DecodeError, ValidationError):
        assert not valid.any(), "the array accepts what the model rejects"
        return 0
    again = decode_with(definition, encode_with(definition, fields, layout), layout)
    assert repr(again) == repr(fields)  # not ==, because NaN differs from itself
    if valid.all():
        encode = codec_of(definition).encode
        assert encode(arrays_of(definition).to_message(accepted[0])) == encode(message), (
            "the array differs"
        )
    return 1


def parse_msgpack(data: bytes) -> int:
    """Decode a payload, of the message selected by the first byte, as model, row and array; a valid one round-trips.

    Returns the number of valid messages.
    """
    definition, payload = _definition_of(data), data[1:]
    codec = codec_of(definition)
    try:
        message = codec.decode(payload)
    except DecodeError:
        message = None
    try:
        row = codec.decode_row(payload)
    except DecodeError:
        row = None
    assert (message is None) == (row is None), "models and rows differ"
    if len(payload) == codec.size:
        _, valid = arrays_of(definition).decode(payload)
        assert message is not None or not valid[0], "the array accepts what the model rejects"
    if message is None:
        return 0
    with suppress(EncodeError):  # a number in a wider msgpack type may exceed its field
        again = codec.decode(codec.encode(message))
        assert codec.encode(again) == codec.encode(message)
    return 1


def parse_mavlink(data: bytes) -> int:
    """Receive frames from a link as the source does, with its log stream. Returns the number of messages.

    The input has the format of `frames`; a `LogReceiver` reads it in its thread.
    """
    options = MavlinkOptions(log="1", topics=("*",))
    link: Any = _Link(frames(data))
    reader = LinkReader(link, name="fuzz")
    receiver = LogReceiver(reader, options, link.answer)
    vehicles: dict[int, Vehicle] = {}
    logs: dict[int, LogStream] = {}
    count = 0
    with closing(receiver), suppress(_EndOfInput):
        while True:
            for item in receiver.read(1.0):
                if not isinstance(item, Received):
                    continue
                now, system = item.time, item.system
                vehicle = vehicles.setdefault(system, Vehicle(str(system), options.chosen_topics))
                vehicle.count_lost(item.lost, now, counted=item.chunk.lost if item.chunk else 0)
                found = [vehicle.handle(item.message, now)]
                if item.chunk is not None:
                    log = logs.setdefault(
                        system, LogStream(str(system), options, receiver.vehicles[system].client)
                    )
                    found += log.add(item.chunk, now)
                for output in found:
                    if isinstance(output, SourceMessage):
                        definition = output.definition or BY_TOPIC[output.address.topic]
                        _validate(definition, output.fields)
                        count += 1
    for system, log in logs.items():
        client, now = receiver.vehicles[system].client, time.monotonic()
        log.status(now)
        for step in range(0, 400, 7):
            client.tick(now + step)
    return count


PARSERS: Final[Mapping[str, Callable[[bytes], int]]] = {
    "ulog": parse_ulog,
    "mcap": parse_mcap,
    "msg": parse_msg,
    "cdr": parse_cdr,
    "msgpack": parse_msgpack,
    "mavlink": parse_mavlink,
}
"""Fuzz target of each parser; its result is greater than 0 if the input contained something valid."""


def frames(data: bytes) -> Iterator[bytes]:
    """Yield MAVLink 2 frames with valid checksums; each input item has a kind, a length and a payload.

    A kind is an index into MAVLINK_KINDS, plus bits for another system and for a preceding loss; 255 is raw bytes.
    """
    sequences, offset = [0, 0], 0
    while offset + 2 <= len(data):
        kind, length = data[offset : offset + 2]
        payload = data[offset + 2 : offset + 2 + length]
        offset += 2 + length
        if kind == _RAW:
            yield payload
            continue
        number = MAVLINK_KINDS[kind % _REMOTE % len(MAVLINK_KINDS)]
        other = bool(kind & _REMOTE)
        sequences[other] += 1 + bool(kind & _LOST)
        head = bytes([len(payload), 0, 0, sequences[other] % 256, 1 + other, 1]) + number.to_bytes(
            3, "little"
        )
        crc = x25crc(head + payload)
        crc.accumulate(bytes([dialect.mavlink_map[number].crc_extra]))
        yield bytes([dialect.PROTOCOL_MARKER_V2]) + head + payload + struct.pack("<H", crc.crc)


class _EndOfInput(Exception):  # noqa: N818 - not an error
    """End the thread of the receiver."""


class _Link:
    """A serial link that received these bytes."""

    stream = True
    peer = None
    dropped = 0

    def __init__(self, pieces: Iterator[bytes]) -> None:
        self._pieces = pieces
        self._answers: list[bytes] = []

    def answer(self, message: Any, _: object) -> None:
        """Answer TIMESYNC, because the ULog stream is requested only once the round trip is known."""
        if message.get_type() == "TIMESYNC":
            answer: Any = dialect.MAVLink_timesync_message(1, message.ts1)
            self._answers.append(answer.pack(dialect.MAVLink(None, 1, 1)))

    def read(self, _: float) -> Iterator[Packet]:
        """Yield all bytes at once."""
        for piece in self._pieces:
            yield Packet(piece, None, time.monotonic())
            while self._answers:
                yield Packet(self._answers.pop(0), None, time.monotonic())
        raise _EndOfInput

    def send(self, data: bytes, peer: object) -> None:
        """Send nothing."""


def _records(log: bytes, size: int, *, verify: bool) -> list[ulog.Record]:
    parser, records = ulog.UlogParser(verify=verify), list[ulog.Record]()
    try:
        for start in range(0, len(log), size):
            records += parser.feed(log[start : start + size])
        return records + parser.close()
    except ulog.UlogError:  # raised before the first record
        return []


def _plain(records: list[ulog.Record]) -> str:
    return re.sub(" at 0x[0-9a-f]+", "", repr(records))  # text, because NaN differs from itself


def _definition_of(data: bytes) -> Definition[Any]:
    return [*MESSAGES.values()][(data[0] if data else 0) % len(MESSAGES)]


def _validate(definition: Definition[Any], fields: Mapping[str, Any]) -> None:
    with suppress(ValidationError):
        upgrade_with(definition, fields)
