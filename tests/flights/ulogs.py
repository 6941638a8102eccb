"""Write small ULog files in PX4's documented format, to test without real logs."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path

from nedbus.flights import FileEvents, read_file_events
from nedbus.ulog import LOG_MESSAGE, Data, LogMessageBuilder, UlogParser
from nedbus_msgs import VehicleLocalPosition
from tests.flights.local_position import FIELD_TYPES, LAYOUTS, downgrade

LOGS = Path(__file__).parents[3] / "shared" / "data" / "ulog"
"""Real flight logs, for tests marked `logs`."""
_NAMES = {
    "uint64": "uint64_t",
    "uint8": "uint8_t",
    "bool": "bool",
    "float32": "float",
    "float64": "double",
}
_CODES = {"uint64_t": "Q", "uint8_t": "B", "bool": "?", "float": "f", "double": "d"}


def _type(name: str, field_types: Mapping[str, str]) -> str:
    return field_types.get(name, "float32").removesuffix("[2]")


@cache
def cached_events(log: Path) -> FileEvents:
    """Return the events of a real log, cached per worker: reading a large one takes more than a second."""
    return read_file_events(log)


def log_messages_in(
    log: Path | bytes, texts: LogMessageBuilder | None = None
) -> list[tuple[int, int, str]]:
    """Return timestamp, severity and text of each log message in a log."""
    parser = UlogParser(verify=True)
    records = [*parser.feed(log if isinstance(log, bytes) else log.read_bytes()), *parser.close()]
    messages = (texts or LogMessageBuilder()).merge(records)
    found = (
        each for each in messages if isinstance(each, Data) and each.subscription is LOG_MESSAGE
    )
    return [tuple(LOG_MESSAGE.layout.decode(each.payload).values()) for each in found]


class UlogWriter:
    """Writer of one log; fields are sorted by size, as in PX4."""

    def __init__(self, *, layout: str = "1.16", system_id: int | None = 1) -> None:
        fields = LAYOUTS[layout].fields
        self._fields = sorted(
            fields, key=lambda name: -struct.calcsize(_CODES[_NAMES[_type(name, FIELD_TYPES)]])
        )
        self._layout = layout
        self._ids: dict[tuple[str, int], int] = {}
        self.data = bytearray(b"\x55\x4c\x6f\x67\x01\x12\x35\x01" + struct.pack("<Q", 0))
        self.put("B", bytes(40))
        if system_id is not None:
            key = b"int32_t MAV_SYS_ID"
            self.put("P", bytes([len(key)]) + key + struct.pack("<i", system_id))
        self._defined: set[str] = set()

    def define(self, topics: Iterable[str], *, without: Sequence[str] = ()) -> None:
        """Write the format of these topics, omitting the fields in `without`."""
        self._fields = [name for name in self._fields if name not in without]
        for topic in topics:
            text = (
                "".join(f"{self._field_type(name)} {name};" for name in self._fields)
                + "uint8_t[3] _padding0;"
            )
            self.put("F", f"{topic}:{text}".encode())
            self._defined.add(topic)

    def add(
        self, topic: str, message: VehicleLocalPosition, *, instance: int = 0, **raw: object
    ) -> None:
        """Write one message; `raw` overrides fields, even with invalid values."""
        if (topic, instance) not in self._ids:
            self._ids[topic, instance] = len(self._ids)
            self.put("A", struct.pack("<BH", instance, self._ids[topic, instance]) + topic.encode())
        values = downgrade(message, self._layout) | raw
        body = b"".join(self._pack(name, values[name]) for name in self._fields)
        self.put("D", struct.pack("<H", self._ids[topic, instance]) + body)

    def write(self, path: Path) -> Path:
        """Write the file."""
        path.write_bytes(self.data)
        return path

    def _field_type(self, name: str) -> str:
        array = "[2]" if FIELD_TYPES.get(name) == "float32[2]" else ""
        return _NAMES[_type(name, FIELD_TYPES)] + array

    def _pack(self, name: str, value: object) -> bytes:
        code = _CODES[_NAMES[_type(name, FIELD_TYPES)]]
        if isinstance(value, tuple):
            return struct.pack(f"<2{code}", *value)
        return struct.pack(f"<{'B' if code == '?' else code}", value)

    def put(self, kind: str, body: bytes) -> None:
        """Write one ULog message of this type."""
        self.data += struct.pack("<HB", len(body), ord(kind)) + body


def write_log(
    path: Path,
    timestamps: Sequence[int],
    *,
    topic: str = "vehicle_local_position",
    **fields: object,
) -> Path:
    """Write a log of one topic with messages at these times [us]; x is their index."""
    writer = UlogWriter()
    writer.define([topic])
    for number, timestamp in enumerate(timestamps):
        message = VehicleLocalPosition.model_validate(
            {"timestamp": timestamp, "x": float(number), **fields}
        )
        writer.add(topic, message)
    return writer.write(path)


def write_raw_log(
    path: Path,
    topics: Mapping[str, tuple[str, str]],
    messages: Iterable[tuple[str, Sequence[object]]],
) -> Path:
    """Write a log with any topics; `topics`: ULog field list and struct format of each."""
    writer, names = UlogWriter(), list(topics)
    for number, (topic, (fields, _)) in enumerate(topics.items()):
        writer.put("F", f"{topic}:{fields}".encode())
        writer.put("A", struct.pack("<BH", 0, number) + topic.encode())
    for topic, values in messages:
        writer.put("D", struct.pack(f"<H{topics[topic][1]}", names.index(topic), *values))
    return writer.write(path)
