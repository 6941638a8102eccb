"""Read MCAP files: those of nedbus, and px4_msgs that ROS 2's own `ros2 bag record` wrote."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from mcap.exceptions import McapError
from mcap.reader import McapReader, NonSeekingReader, make_reader
from mcap.records import Channel, Schema
from zstandard import ZstdError

from nedbus.errors import AddressError, SourceError
from nedbus_msgs import ROS2_TYPES, Address, find_layout, split_ros2_topic

_MAX_RECORD: Final = 2**30  # bytes; a longer record is damage
_READ_ERRORS: Final = (McapError, EOFError, ValueError, struct.error, ZstdError)  # of a damaged file


@dataclass(frozen=True, slots=True)
class RecordedStream:
    """One channel: its address, the layout of its messages, and the fields that its source did not provide."""

    address: Address
    layout: str
    missing: frozenset[str]


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """One message of a file: its CDR payload, and when it was published and recorded [ns]."""

    stream: RecordedStream
    payload: bytes
    published: int
    logged: int


class RecordingReader:
    """An MCAP file that is open for reading; a context manager. Messages are read one chunk at a time.

    `vehicle` is that of channels that name none. `warnings` is complete when `messages` has ended.

    Raises SourceError for a file that is not MCAP or cannot be opened.
    """

    def __init__(self, path: str | Path, *, vehicle: str) -> None:
        self.path = Path(path).expanduser()
        self.warnings: list[str] = []
        self._vehicle = vehicle
        self._complete = True
        self._streams: dict[int, RecordedStream | None] = {}
        self._by_topic: dict[str, RecordedStream] = {}  # of the channel
        try:
            self._file = self.path.open("rb")
        except OSError as exc:
            raise SourceError(str(path), (exc.strerror or str(exc)).lower()) from exc
        try:
            self._counts = self._read_counts()
        except SourceError:
            self._file.close()
            raise

    @property
    def counts(self) -> dict[RecordedStream, int]:
        """The number of messages of each stream."""
        return self._counts

    def messages(self, only: Address | None = None) -> Iterator[RecordedMessage]:
        """Yield all messages of local position topics, or of one address, in the order of the file."""
        topics = None if only is None else [name for name, stream in self._by_topic.items() if stream.address == only]
        try:
            for schema, channel, message in self._reader().iter_messages(topics=topics, log_time_order=False):
                stream = self._stream(schema, channel)
                if stream is not None and only in (None, stream.address):
                    yield RecordedMessage(stream, message.data, message.publish_time, message.log_time)
        except _READ_ERRORS:
            self._warn("cut: it ends inside a record; everything before that is read")

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _reader(self) -> McapReader:
        """Return a reader that uses the index of chunks, or reads sequentially where there is none."""
        self._file.seek(0)
        return (
            make_reader(self._file) if self._complete else NonSeekingReader(self._file, record_size_limit=_MAX_RECORD)
        )

    def _read_counts(self) -> dict[RecordedStream, int]:
        """Return the counts of the file's summary; without one, after a power cut, count the messages."""
        try:
            summary = self._reader().get_summary()
        except _READ_ERRORS:
            summary, self._complete = None, False
        counts: dict[RecordedStream, int] = {}
        if summary is None or summary.statistics is None:
            for recorded in self.messages():
                counts[recorded.stream] = counts.get(recorded.stream, 0) + 1
            if not counts and self.warnings:
                raise SourceError(str(self.path), "not a readable MCAP file")
            return counts
        for number, channel in summary.channels.items():
            stream = self._stream(summary.schemas.get(channel.schema_id), channel)
            if stream is not None:
                count = summary.statistics.channel_message_counts.get(number, 0)
                counts[stream] = counts.get(stream, 0) + count
        return counts

    def _stream(self, schema: Schema | None, channel: Channel) -> RecordedStream | None:
        if channel.id not in self._streams:
            stream = self._streams[channel.id] = self._describe(schema, channel)
            if stream is not None:
                self._by_topic[channel.topic] = stream
        return self._streams[channel.id]

    def _describe(self, schema: Schema | None, channel: Channel) -> RecordedStream | None:
        if schema is None or schema.name not in ROS2_TYPES:
            return None
        if channel.message_encoding != "cdr" or schema.encoding != "ros2msg":
            self._warn(
                f"{channel.topic} is left out: {channel.message_encoding} with {schema.encoding}, not cdr, ros2msg"
            )
            return None
        layout = find_layout(_field_names(schema.data))
        if layout is None:
            self._warn(f"{channel.topic} is left out: no known layout has these fields")
            return None
        try:
            address = self._address(channel)
        except (AddressError, ValueError) as exc:
            self._warn(f"{channel.topic} is left out: {exc}")
            return None
        return RecordedStream(address, layout.name, frozenset(channel.metadata.get("missing", "").split()))

    def _address(self, channel: Channel) -> Address:
        metadata = channel.metadata
        if {"vehicle", "topic"} <= metadata.keys():
            instance = metadata.get("instance")
            return Address(metadata["vehicle"], metadata["topic"], None if instance is None else int(instance))
        namespace, topic, instance_number = split_ros2_topic(channel.topic)
        return Address(namespace.replace("/", "-") or self._vehicle, topic, instance_number)

    def _warn(self, warning: str) -> None:
        if warning not in self.warnings:
            self.warnings.append(warning)


def _field_names(definition: bytes) -> list[str]:
    """Return the field names of a .msg definition, without constants."""
    own = definition.decode(errors="replace").split("\n===")[0]
    rows = (line.partition("#")[0].split() for line in own.splitlines())
    return [row[1] for row in rows if len(row) == 2 and "=" not in row[1]]
