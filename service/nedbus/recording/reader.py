"""Read MCAP files: those of nedbus, and px4_msgs that ROS 2's own `ros2 bag record` wrote."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

from mcap.records import Channel, McapRecord, Message, Schema, Statistics

from nedbus.errors import AddressError, SourceError
from nedbus_msgs import BY_TOPIC, Address, Definition, Layout, define_msg, read_msg, ros2_types, split_ros2_topic

from .chunks import READ_ERRORS, ChunkFile, records_of


@dataclass(frozen=True, slots=True, eq=False)
class RecordedStream:
    """One channel: its address, the layout of its messages, and the fields that its source did not provide."""

    address: Address
    definition: Definition[Any]
    layout: Layout
    missing: frozenset[str]


class RecordedMessage(NamedTuple):
    """One message of a file: its CDR payload, and the time of its recording [ns]."""

    stream: RecordedStream
    payload: bytes
    logged: int


class RecordingReader:
    """An MCAP file that is open for reading; a context manager. Messages are read one chunk at a time.

    `vehicle` is that of channels that name none; `counts` has the number of messages of each stream.
    `warnings` name the damage that is left out, and are complete when `messages` or `check` has ended.

    Raises SourceError for a file that is not MCAP or cannot be opened.
    """

    def __init__(self, path: str | Path, *, vehicle: str) -> None:
        self.path = Path(path).expanduser()
        self._vehicle = vehicle
        self._file = ChunkFile(self.path)
        self.close = self._file.close
        self.warnings = self._file.warnings
        self._schemas: dict[int, Schema] = {}
        self._layouts: dict[int, tuple[Definition[Any], Layout]] = {}  # by schema
        self._streams: dict[int, RecordedStream | None] = {}  # by channel
        totals: dict[int, int] = {}
        for record in sorted(self._file.summary, key=lambda record: isinstance(record, Channel)):  # after their schemas
            self._learn(record)
            if isinstance(record, Statistics):
                totals = record.channel_message_counts
        self._all_known = bool(totals) and totals.keys() <= self._streams.keys()
        if self._all_known:
            self.counts = {stream: total for number, total in totals.items() if (stream := self._streams[number])}
        else:
            self.counts = self._count()

    @property
    def damaged(self) -> bool:
        """True if damage cost messages."""
        return self._file.damaged

    def check(self) -> None:
        """Read the file once, so that `warnings`, `damaged` and `counts` are those of the messages that can be read."""
        for _ in self._file.parts(self._channels()):
            pass
        if self.damaged:
            self.counts = self._count()

    def messages(self, only: Collection[Address] | None = None) -> Iterator[RecordedMessage]:
        """Yield all messages, or those of some addresses, in the order of the file."""
        for part in self._file.parts(self._channels(only)):
            try:
                for record in records_of(part):
                    if not isinstance(record, Message):
                        self._learn(record)
                    elif (stream := self._stream(record)) and (only is None or stream.address in only):
                        yield RecordedMessage(stream, record.data, record.log_time)
            except READ_ERRORS:
                self._file.warn("damaged: a chunk has an invalid record; the rest of that chunk is left out", lost=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _channels(self, only: Collection[Address] | None = None) -> list[int] | None:
        """Return the channels of some addresses, or all that can be read; None before all are known."""
        if not self._all_known:
            return None
        streams = self._streams.items()
        return [number for number, stream in streams if stream and (only is None or stream.address in only)]

    def _count(self) -> dict[RecordedStream, int]:
        """Count the messages that can be read; raise SourceError if damage leaves none."""
        counts = Counter(recorded.stream for recorded in self.messages())
        if not counts and self.damaged:
            self.close()
            raise SourceError(str(self.path), f"no message can be read: {'; '.join(self.warnings[:3])}")
        return counts

    def _learn(self, record: McapRecord) -> None:
        """Keep a schema or a channel, unless there is one of this number already."""
        if isinstance(record, Schema):
            self._schemas.setdefault(record.id, record)
        elif isinstance(record, Channel) and record.id not in self._streams:
            self._streams[record.id] = self._describe(self._schemas.get(record.schema_id), record)

    def _stream(self, message: Message) -> RecordedStream | None:
        if message.channel_id not in self._streams:
            self._streams[message.channel_id] = None
            self._file.warn(f"the messages of channel {message.channel_id} are left out: its name is lost", lost=True)
        return self._streams[message.channel_id]

    def _describe(self, schema: Schema | None, channel: Channel) -> RecordedStream | None:
        if schema is None or not schema.name.startswith(("px4_msgs/", "px4_msgs_old/")):
            return None
        if channel.message_encoding != "cdr" or schema.encoding != "ros2msg":
            self._file.warn(
                f"{channel.topic} is left out: {channel.message_encoding} with {schema.encoding}, not cdr, ros2msg"
            )
            return None
        try:
            definition, layout = self._layout(schema)
            address = self._address(channel)
            expected = BY_TOPIC.get(address.topic, definition)
            if expected is not definition:
                raise ValueError(f"messages of type {definition.name}, where {address.topic} has {expected.name}")
        except (AddressError, ValueError) as exc:
            self._file.warn(f"{channel.topic} is left out: {exc}")
            return None
        return RecordedStream(address, definition, layout, frozenset(channel.metadata.get("missing", "").split()))

    def _layout(self, schema: Schema) -> tuple[Definition[Any], Layout]:
        """Return the message and the layout that a schema describes; raise ValueError if there is none."""
        if schema.id not in self._layouts:
            known, text = ros2_types().get(schema.name), schema.data.decode(errors="replace")
            definition = known or define_msg(schema.name.rpartition("/")[2], text)
            layout = known.find_layout(field.name for field in read_msg(text)) if known else definition.current
            if layout is None:
                raise ValueError("no known layout has these fields")
            self._layouts[schema.id] = definition, layout
        return self._layouts[schema.id]

    def _address(self, channel: Channel) -> Address:
        metadata = channel.metadata
        if {"vehicle", "topic"} <= metadata.keys():
            instance = metadata.get("instance")
            return Address(metadata["vehicle"], metadata["topic"], None if instance is None else int(instance))
        namespace, topic, instance_number = split_ros2_topic(channel.topic)
        return Address(namespace.replace("/", "-") or self._vehicle, topic, instance_number)
