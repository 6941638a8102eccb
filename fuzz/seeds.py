"""Seed corpora, made from the small real files of tests/data and from files and payloads that nedbus writes."""

from __future__ import annotations

import json
import lzma
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from mcap.writer import CompressionType, IndexType, Writer
from pymavlink.dialects.v20 import common as dialect
from tests.peers.px4_log_stream import SHORT, datagrams, stream_message, unpack

from nedbus.flights import RecordingWriter
from nedbus_msgs import (
    MESSAGES,
    Address,
    Definition,
    Provenance,
    codec_of,
    definition_text,
    encode_with,
    ros2_type,
)

from .parsers import MAVLINK_IDS, MAVLINK_KINDS

DATA: Final = Path(__file__).parents[1] / "tests" / "data"
_TOPICS: Final = (b"vehicle_local_position", b"vehicle_status", b"event", b"battery_status")
_RECORDED: Final = ("VehicleAttitude", "BatteryStatus", "LogMessage")
_MESSAGES: Final = 2  # per topic of a trimmed log
_TELEMETRY: Final = 60  # frames
_STREAM: Final = 8  # messages of the log stream in a seed of MAVLink
_PIECE: Final = 249  # bytes of a message of the log stream


def ulog_seeds() -> Iterator[bytes]:
    """Yield trimmed logs of real vehicles with each kind of record, for both modes of the parser."""
    for log in (
        _trim((DATA / "boot_time_utc_us.ulg").read_bytes()),
        _streamed_log(),
        _log_of_each_record(),
    ):
        for verify in (0, 255):
            for size in (4, 255):
                yield bytes([verify, size]) + log


def mcap_seeds() -> Iterator[bytes]:
    """Yield recordings without checksums, so that a changed byte reaches the parser, and real recordings."""
    for compression in CompressionType:
        for index in (IndexType.ALL, IndexType.NONE):
            yield _recording(compression, index)
    yield (DATA / "fmu_in_topics.mcap").read_bytes()  # of `ros2 bag record`
    with TemporaryDirectory() as folder:
        path = Path(folder, "seed.mcap")
        with RecordingWriter(path) as writer:
            chosen = [
                (definition, fields)
                for definition, fields in _golden()
                if definition.name in _RECORDED
            ]
            for number, (definition, fields) in enumerate(chosen, 1):
                message = definition.model.model_validate(fields)
                topic = next(iter(definition.topics.values()))
                address = Address("1", topic.name, 0 if topic.instances else None)
                writer.write_messages([(message, address, Provenance("fuzz"), number)])
        yield path.read_bytes()


def msg_seeds() -> Iterator[bytes]:
    """Yield PX4's .msg files, with nested messages, and the .msg files of the built-in messages."""
    parts = {path.stem: path.read_bytes() for path in sorted((DATA / "msg").glob("*.msg"))}
    yield from parts.values()
    nested = parts["PositionSetpoint"]
    yield (
        parts["PositionSetpointTriplet"]
        + b"\n"
        + b"=" * 80
        + b"\nMSG: px4_msgs/PositionSetpoint\n"
        + nested
    )
    yield b"uint64 timestamp\nfloat32[4] q # [-] @range -1,1 @invalid NaN\nchar[8] text\nuint8 A=1\nstring S = 'a'\n"
    for definition in MESSAGES.values():
        yield definition_text(definition, definition.current).encode()


def cdr_seeds() -> Iterator[bytes]:
    """Yield a payload of each message in each layout."""
    for number, (definition, fields) in enumerate(_golden()):
        for index, layout in enumerate(definition.layouts.values()):
            message = definition.model.model_validate(fields)
            values = definition.downgrade(message.__dict__, layout)
            yield bytes([number, index]) + encode_with(definition, values, layout)


def msgpack_seeds() -> Iterator[bytes]:
    """Yield the golden payload of each message, and payloads of the first message with unusual values."""
    for number, (definition, fields) in enumerate(_golden()):
        yield bytes([number]) + codec_of(definition).encode(definition.model.model_validate(fields))
    first = [*MESSAGES].index("VehicleLocalPosition")
    for entry in json.loads((DATA / "golden.json").read_text()).values():
        yield bytes([first]) + bytes.fromhex(entry["payload"])


def mavlink_seeds() -> Iterator[bytes]:
    """Yield telemetry of a real PX4, the beginning of its log stream, and a short log as a stream."""
    sent = [frame for _, is_sent, frame in datagrams(SHORT) if is_sent]
    telemetry = [unpack(frame) for frame in sent if stream_message(frame) is None]
    stream = [unpack(frame) for frame in sent if stream_message(frame) is not None]
    heartbeat = next(
        (number, payload)
        for number, payload in telemetry
        if number == dialect.MAVLINK_MSG_ID_HEARTBEAT
    )
    kinds = {number: payload for number, payload in telemetry if number in MAVLINK_KINDS}
    for number, payload in kinds.items():
        yield _framed([heartbeat, (number, payload), (number, payload)])
    used = [(number, payload) for number, payload in telemetry if number in MAVLINK_KINDS]
    yield _framed([heartbeat, *used][:_TELEMETRY])
    yield _framed([heartbeat, *stream[:_STREAM]])
    result = struct.pack("<HBBiBB", dialect.MAV_CMD_LOGGING_START, 0, 0, 0, *MAVLINK_IDS)
    answer = dialect.MAVLINK_MSG_ID_COMMAND_ACK, result
    for log in (_log_of_each_record(), _streamed_log()):
        yield _framed([heartbeat, answer, *_as_stream(log)])
    yield b"\xff\x05\xfd\x09\0\0\0" + _framed([heartbeat])


SEEDS: Final[Mapping[str, Callable[[], Iterable[bytes]]]] = {
    "ulog": ulog_seeds,
    "mcap": mcap_seeds,
    "msg": msg_seeds,
    "cdr": cdr_seeds,
    "msgpack": msgpack_seeds,
    "mavlink": mavlink_seeds,
}
"""Seeds of each parser in `parsers.PARSERS`."""


def _golden() -> Iterator[tuple[Definition[Any], dict[str, Any]]]:
    golden = json.loads((DATA / "golden_messages.json").read_text())
    for name, definition in MESSAGES.items():
        if name in golden:
            yield definition, golden[name]["fields"]
        else:
            yield definition, {"timestamp": 1}


def _trim(log: bytes) -> bytes:
    """Return a log with its texts, its first parameters, and a few messages of few topics."""
    trimmed, offset = bytearray(log[:16]), 16
    ids: dict[bytes, int] = {}
    kinds: dict[int, int] = {}
    while offset + 3 <= len(log):
        end = offset + 3 + int.from_bytes(log[offset : offset + 2], "little")
        kind, content, whole = log[offset + 2], log[offset + 3 : end], log[offset:end]
        kinds[kind] = kinds.get(kind, 0) + 1
        name = (
            content.partition(b":")[0]
            if kind == ord("F")
            else content[3:]
            if kind == ord("A")
            else b""
        )
        if kind == ord("D"):
            ids[content[:2]] = ids.get(content[:2], _MESSAGES) + 1
            is_kept = ids[content[:2]] <= _MESSAGES
        elif kind == ord("A"):
            ids[content[1:3]] = 0 if name in _TOPICS else _MESSAGES
            is_kept = name in _TOPICS
        else:
            is_kept = (
                name in _TOPICS
                if kind == ord("F")
                else kinds[kind] <= _MESSAGES and len(content) < 500
            )
        trimmed += whole if is_kept else b""
        offset = end
    return bytes(trimmed)


def _streamed_log() -> bytes:
    """Return the log of the recorded stream, trimmed."""
    messages = filter(
        None, (stream_message(frame) for _, is_sent, frame in datagrams(SHORT) if is_sent)
    )
    unique = {message.sequence: message.data for message in messages}
    return _trim(b"".join(unique.values()))


def _log_of_each_record() -> bytes:
    """Return a log with each kind of record, and an event whose text its metadata defines."""
    event = {"message": "{1}: {2:.1m/s}", "arguments": [{"type": "e"}, {"type": "float"}]}
    component = {
        "namespace": "px4",
        "enums": {"e": {"type": "uint8_t", "entries": {"1": {"description": "one"}}}},
        "event_groups": {"default": {"events": {"7": event}}},
    }
    packed = lzma.compress(json.dumps({"components": {"1": component}}).encode(), lzma.FORMAT_XZ)
    fields = "uint64_t timestamp;uint32_t id;uint16_t event_sequence;uint8_t[25] arguments;uint8_t log_levels;"
    arguments = struct.pack("<Bf20x", 1, 2.5)
    records = [
        (b"B", bytes(40)),
        (b"F", b"event:" + fields.encode()),
        (b"F", b"part:float x;char[8] text;uint8_t[3] _padding0;"),
        (b"F", b"whole:uint64_t timestamp;part[2] parts;bool flag;"),
        (b"I", _key("char[3] sys") + b"abc"),
        (b"M", b"\0" + _key(f"uint8_t[{len(packed)}] metadata_events") + packed),
        (b"P", _key("float A_B") + struct.pack("<f", 1.5)),
        (b"Q", b"\1" + _key("int32_t C_D") + struct.pack("<i", 7)),
        (b"A", b"\0\0\0event"),
        (b"A", b"\1\1\0whole"),
        (b"D", struct.pack("<HQIH25sB", 0, 1_000, 1 << 24 | 7, 1, arguments, 0x44)),
        (b"D", struct.pack("<HQf8s3xf8s3x?", 1, 2_000, 1.0, b"one", 2.0, b"two", True)),
        (b"L", b"6" + struct.pack("<Q", 3_000) + b"[commander] Takeoff detected\t"),
        (b"C", b"4" + struct.pack("<HQ", 2, 4_000) + b"battery low"),
        (b"S", bytes.fromhex("2f731320250cbb12")),
        (b"O", struct.pack("<H", 12)),
        (b"D", struct.pack("<HQf8s3xf8s3x?", 1, 5_000, 1.0, b"one", 2.0, b"two", False)),
        (b"R", struct.pack("<H", 1)),
    ]
    head = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 500)
    return head + b"".join(
        struct.pack("<H", len(content)) + kind + content for kind, content in records
    )


def _key(text: str) -> bytes:
    return bytes([len(text)]) + text.encode()


def _recording(compression: CompressionType, index: IndexType) -> bytes:
    file = BytesIO()
    writer = Writer(
        file,
        chunk_size=600,
        compression=compression,
        index_types=index,
        enable_crcs=False,
        enable_data_crcs=False,
    )
    writer.start(profile="ros2", library="fuzz")
    for number, (definition, fields) in enumerate(_golden()):
        if definition.name in _RECORDED:
            layout = definition.current
            values = definition.downgrade(definition.model.model_validate(fields).__dict__, layout)
            text = re.sub(" *#.*", "", definition_text(definition, layout))
            schema = writer.register_schema(ros2_type(definition), "ros2msg", text.encode())
            topic = next(iter(definition.topics.values()))
            metadata = {
                "vehicle": "1",
                "topic": topic.name,
                "missing": "x y",
                **({"instance": "0"} if topic.instances else {}),
            }
            channel = writer.register_channel(f"/fmu/out/{number}", "cdr", schema, metadata)
            writer.add_message(channel, number, encode_with(definition, values, layout), number, 1)
    schema = writer.register_schema(
        "px4_msgs/msg/Other", "ros2msg", b"uint64 timestamp\nfloat32[2] a\nchar[4] text\n"
    )
    channel = writer.register_channel("/vehicle_7/fmu/out/other_v1", "cdr", schema)
    writer.add_message(channel, 9, b"\0\1\0\0" + struct.pack("<Qff4s", 9, 1.0, 2.0, b"abc"), 9)
    writer.finish()
    return file.getvalue()


def _as_stream(log: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the messages of a log stream: first those with acknowledgement."""
    starts, offset = [0, 16], 16
    while offset < len(log):
        offset += 3 + int.from_bytes(log[offset : offset + 2], "little")
        starts.append(offset)
    for number, start in enumerate(range(0, len(log), _PIECE)):
        piece = log[start : start + _PIECE]
        offsets = (begin - start for begin in starts if start <= begin < start + len(piece))
        first = next(offsets, 255)
        payload = struct.pack("<HBBBB", number, *MAVLINK_IDS, len(piece), first) + piece
        is_acked = start < len(log) / 2
        ids = dialect.MAVLINK_MSG_ID_LOGGING_DATA_ACKED, dialect.MAVLINK_MSG_ID_LOGGING_DATA
        yield ids[not is_acked], payload


def _framed(messages: Iterable[tuple[int, bytes]]) -> bytes:
    """Return the input of `parsers.frames` for these messages, given by id and payload."""
    return b"".join(
        bytes([MAVLINK_KINDS.index(number), len(data)]) + data for number, data in messages
    )
