"""Reader of MCAP recordings by nedbus, and of px4_msgs recorded by `ros2 bag record`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

from mcap.records import Channel, McapRecord, Message, Schema, Statistics

from nedbus.errors import AddressError, SourceError
from nedbus_msgs import (
    BY_TOPIC,
    Address,
    Definition,
    Layout,
    define_msg,
    is_vehicle_input,
    read_msg,
    ros2_types,
    split_ros2_topic,
)

from .mcap_chunks import READ_ERRORS, ChunkFile, records_of

_MAX_DEFINITIONS: Final = 16_000  # fields, or the time of as many: 32 for a message, 1 for 256 characters


@dataclass(frozen=True, slots=True, eq=False)
class RecordedStream:
    """One channel: its address, the layout of its messages, and the fields its source did not provide.

    `is_input`: messages to the vehicle, `/fmu/in/...`.
    """

    address: Address
    definition: Definition[Any]
    layout: Layout
    missing: frozenset[str]
    is_input: bool = False


class RecordedMessage(NamedTuple):
    """One recorded message: its CDR payload and log time [ns]."""

    stream: RecordedStream
    payload: bytes
    logged: int


class RecordingReader:
    """An MCAP file open for reading, one chunk at a time; a context manager.

    `vehicle`: the vehicle of channels that name none; `counts`: the number of messages per stream.
    `warnings`: the damage found, complete after `messages` or `check` has finished.

    Raises SourceError if the file is not MCAP, cannot be opened, or has no readable message because of damage.
    """

    def __init__(self, path: str | Path, *, vehicle: str) -> None:
        self.path = Path(path).expanduser()
        self._vehicle = vehicle
        self._file = ChunkFile(self.path)
        self.close = self._file.close
        self.warnings = self._file.warnings
        self._schemas: dict[int, Schema] = {}
        self._layouts: dict[int, tuple[Definition[Any], Layout]] = {}  # by schema
        self._left = _MAX_DEFINITIONS
        self._streams: dict[int, RecordedStream | None] = {}  # by channel
        totals: dict[int, int] = {}
        for record in sorted(self._file.summary, key=lambda record: isinstance(record, Channel)):  # schemas first
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
        """Read the whole file to complete `warnings` and `damaged`, and to correct `counts` for damage."""
        for _ in self._file.parts(self._channels()):
            pass
        if self.damaged:
            self.counts = self._count()

    def messages(self, only: Collection[Address] | None = None) -> Iterator[RecordedMessage]:
        """Yield the messages in file order; `only`: those of these addresses."""
        for part in self._file.parts(self._channels(only)):
            try:
                for record in records_of(part):
                    if not isinstance(record, Message):
                        self._learn(record)
                    elif (stream := self._stream(record)) and (only is None or stream.address in only):
                        yield RecordedMessage(stream, record.data, record.log_time)
            except READ_ERRORS:
                self._file.warn("damaged: a chunk has an invalid record; skipped the rest of that chunk", lost=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _channels(self, only: Collection[Address] | None = None) -> list[int] | None:
        """Return the readable channels, of these addresses or all; None while not all channels are known."""
        if not self._all_known:
            return None
        streams = self._streams.items()
        return [number for number, stream in streams if stream and (only is None or stream.address in only)]

    def _count(self) -> dict[RecordedStream, int]:
        """Count the readable messages; raise SourceError if damage leaves none."""
        counts = Counter(recorded.stream for recorded in self.messages())
        if not counts and self.damaged:
            self.close()
            raise SourceError(str(self.path), f"no message can be read: {'; '.join(self.warnings[:3])}")
        return counts

    def _learn(self, record: McapRecord) -> None:
        """Register a schema or channel; the first with its id wins."""
        if isinstance(record, Schema):
            self._schemas.setdefault(record.id, record)
        elif isinstance(record, Channel) and record.id not in self._streams:
            self._streams[record.id] = self._describe(self._schemas.get(record.schema_id), record)

    def _stream(self, message: Message) -> RecordedStream | None:
        if message.channel_id not in self._streams:
            self._streams[message.channel_id] = None
            self._file.warn(
                f"skipped the messages of channel {message.channel_id}: its channel record is lost", lost=True
            )
        return self._streams[message.channel_id]

    def _describe(self, schema: Schema | None, channel: Channel) -> RecordedStream | None:
        if schema is None or not schema.name.startswith(("px4_msgs/", "px4_msgs_old/")):
            return None
        if channel.message_encoding != "cdr" or schema.encoding != "ros2msg":
            self._file.warn(
                f"skipped {channel.topic}: its encoding is {channel.message_encoding} with {schema.encoding}, not cdr"
                " with ros2msg"
            )
            return None
        try:
            definition, layout = self._layout(schema)
            address = self._address(channel)
            expected = BY_TOPIC.get(address.topic, definition)
            if expected is not definition:
                raise ValueError(f"its messages are {definition.name}, but {address.topic} has {expected.name}")
        except (AddressError, ValueError) as exc:
            self._file.warn(f"skipped {channel.topic}: {exc}")
            return None
        missing = frozenset(channel.metadata.get("missing", "").split())
        return RecordedStream(address, definition, layout, missing, is_vehicle_input(channel.topic))

    def _layout(self, schema: Schema) -> tuple[Definition[Any], Layout]:
        """Return the definition and layout of a schema; raise ValueError if no layout matches."""
        if schema.id not in self._layouts:
            if self._left < 0:
                raise ValueError("the definitions of this file are more than those of 250 topics of PX4")
            self._left -= len(schema.data) // 256
            known, text = ros2_types().get(schema.name), schema.data.decode(errors="replace")
            self._left -= 32 + len(read_msg(text))
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
