"""Messages of MCAP files: recordings of ours, and what ROS 2's own `ros2 bag record` wrote of px4_msgs."""

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

from nedbus_msgs import ROS2_TYPES, Address, find_layout

from .errors import AddressError, SourceError
from .rmw_zenoh import split_topic

_LIMIT: Final = 2**30  # bytes of a record that are believed
_BROKEN: Final = (McapError, EOFError, ValueError, struct.error, ZstdError)  # what a reader raises for a broken file


@dataclass(frozen=True, slots=True)
class Stream:
    """One channel of a file: its address, the layout of its messages, and the fields that are not really there."""

    address: Address
    layout: str
    missing: frozenset[str]


@dataclass(frozen=True, slots=True)
class Played:
    """One message of a file, as it stands there: CDR, and when it was published and recorded [ns]."""

    stream: Stream
    payload: bytes
    published: int
    logged: int


class Playback:
    """An MCAP file that is open for reading; a context manager. Messages are read one chunk at a time.

    `warnings` says what is not readable; it is complete after a run of `messages`.

    Raises SourceError for a file that is no MCAP or cannot be opened.
    """

    def __init__(self, path: str | Path, *, vehicle: str) -> None:
        self.path = Path(path).expanduser()
        self.warnings: list[str] = []
        self._vehicle = vehicle
        self._complete = True
        self._streams: dict[int, Stream | None] = {}
        self._named: dict[str, Stream] = {}  # by the topic of its channel
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
    def counts(self) -> dict[Stream, int]:
        """How many messages there are of each stream."""
        return self._counts

    def messages(self, only: Address | None = None) -> Iterator[Played]:
        """Yield all messages of local position topics, or of one address, in the order of the file."""
        topics = None if only is None else [name for name, stream in self._named.items() if stream.address == only]
        try:
            for schema, channel, message in self._reader().iter_messages(topics=topics, log_time_order=False):
                stream = self._stream(schema, channel)
                if stream is not None and only in (None, stream.address):
                    yield Played(stream, message.data, message.publish_time, message.log_time)
        except _BROKEN:
            self._warn("cut: it ends in the middle of something; all before that is read")

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
        """Return a reader that finds the chunks by their index, or one after the other where there is none."""
        self._file.seek(0)
        return make_reader(self._file) if self._complete else NonSeekingReader(self._file, record_size_limit=_LIMIT)

    def _read_counts(self) -> dict[Stream, int]:
        """Take the counts from the file's summary, or count, where a power cut left none."""
        try:
            summary = self._reader().get_summary()
        except _BROKEN:
            summary, self._complete = None, False
        counts: dict[Stream, int] = {}
        if summary is None or summary.statistics is None:
            for played in self.messages():
                counts[played.stream] = counts.get(played.stream, 0) + 1
            if not counts and self.warnings:
                raise SourceError(str(self.path), "this is no MCAP file that can be read")
            return counts
        for number, channel in summary.channels.items():
            stream = self._stream(summary.schemas.get(channel.schema_id), channel)
            if stream is not None:
                count = summary.statistics.channel_message_counts.get(number, 0)
                counts[stream] = counts.get(stream, 0) + count
        return counts

    def _stream(self, schema: Schema | None, channel: Channel) -> Stream | None:
        if channel.id not in self._streams:
            stream = self._streams[channel.id] = self._learn(schema, channel)
            if stream is not None:
                self._named[channel.topic] = stream
        return self._streams[channel.id]

    def _learn(self, schema: Schema | None, channel: Channel) -> Stream | None:
        if schema is None or schema.name not in ROS2_TYPES:
            return None
        if channel.message_encoding != "cdr" or schema.encoding != "ros2msg":
            self._warn(
                f"{channel.topic} is left out: {channel.message_encoding} with {schema.encoding}, not cdr, ros2msg"
            )
            return None
        layout = find_layout(_field_names(schema.data))
        if layout is None:
            self._warn(f"{channel.topic} is left out: no layout that is known here has these fields")
            return None
        try:
            address = self._address(channel)
        except (AddressError, ValueError) as exc:
            self._warn(f"{channel.topic} is left out: {exc}")
            return None
        return Stream(address, layout.name, frozenset(channel.metadata.get("missing", "").split()))

    def _address(self, channel: Channel) -> Address:
        facts = channel.metadata
        if {"vehicle", "topic"} <= facts.keys():
            instance = facts.get("instance")
            return Address(facts["vehicle"], facts["topic"], None if instance is None else int(instance))
        namespace, topic, number = split_topic(channel.topic)
        return Address(namespace.replace("/", "-") or self._vehicle, topic, number)

    def _warn(self, warning: str) -> None:
        if warning not in self.warnings:
            self.warnings.append(warning)


def _field_names(definition: bytes) -> list[str]:
    """Return the names of the fields of a .msg file, constants left out."""
    own = definition.decode(errors="replace").split("\n===")[0]
    rows = (line.partition("#")[0].split() for line in own.splitlines())
    return [row[1] for row in rows if len(row) == 2 and "=" not in row[1]]
