"""Reader of MCAP files recorded by nedbus, and of px4_msgs recorded by `ros2 bag record`."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Message, Schema, Statistics
from zstandard import ZstdDecompressor, ZstdError, frame_content_size

from nedbus.errors import AddressError, SourceError
from nedbus_msgs import BY_TOPIC, Address, Definition, Layout, define_msg, read_msg, ros2_types, split_ros2_topic

from .flight_files import recording_files
from .mcap_chunks import READ_ERRORS, ZSTD_MAGIC, ChunkFile, records_of

_MAX_PAYLOAD: Final = 2**16  # decompressed size of a message compressed by rosbag2
_SCHEMA_BUDGET: Final = 2**25  # bytes of the schemas of a file
_DEFINITION_BUDGET: Final = 16_000  # for all definitions of a file: 32 per message, 1 per field, 1 per 256 characters


@dataclass(frozen=True, slots=True, eq=False)
class RecordedStream:
    """A channel: its ROS 2 topic, address, layout of the messages, and the fields that its source did not provide."""

    ros2_topic: str
    address: Address
    definition: Definition[Any]
    layout: Layout
    missing: frozenset[str]


class RecordedMessage(NamedTuple):
    """One recorded message: its CDR payload and log time [ns]."""

    stream: RecordedStream
    payload: bytes
    logged: int

    @property
    def address(self) -> Address:
        """The address of its stream."""
        return self.stream.address


class RecordingReader(ExitStack):
    """An MCAP file, or the folder of a bag, open for reading one chunk at a time; a context manager.

    `vehicle`: the vehicle of channels without one; `counts`: the number of messages per stream.
    `warnings`: the damage found, complete after `messages` or `check` has finished.

    Raises SourceError if a file is not MCAP, cannot be opened, or has no readable message of a PX4 topic.
    """

    def __init__(self, path: str | Path, *, vehicle: str) -> None:
        super().__init__()
        paths, lacking = recording_files(Path(path).expanduser())
        self._lacking = [f"{name} of this bag is missing" for name in lacking]
        self._files: list[_RecordedFile] = []
        try:
            for each in paths:
                self._files.append(_RecordedFile(each, vehicle))
                self.callback(self._files[-1].chunks.close)
            if not self.counts:
                reasons = [*self.warnings[:3]] or ["no channel has a type of px4_msgs"]
                problem = "no message can be read" if self.damaged else "this recording has no messages of PX4 topics"
                raise SourceError(str(path), f"{problem}; {'; '.join(reasons)}")
        except BaseException:
            self.close()
            raise

    @property
    def counts(self) -> dict[RecordedStream, int]:
        """The number of messages per stream."""
        return {stream: count for file in self._files for stream, count in file.counts.items()}

    @property
    def warnings(self) -> list[str]:
        """Damage found and channels skipped so far."""
        where = {file: f"{file.name}: " if len(self._files) > 1 else "" for file in self._files}
        return [*self._lacking, *(f"{where[file]}{text}" for file in self._files for text in file.chunks.warnings)]

    @property
    def boot_utc(self) -> int:
        """Unix time of the boot [us], from the metadata of a converted log; 0 if unknown, or if the files disagree."""
        known = {boot for file in self._files for boot in file.boot_times}
        return int(known.pop()) if len(known) == 1 else 0

    @property
    def damaged(self) -> bool:
        """True if damage cost messages."""
        return bool(self._lacking) or any(file.chunks.damaged for file in self._files)

    def check(self) -> None:
        """Read everything to complete `warnings` and `damaged`, and to correct `counts` for damage."""
        for file in self._files:
            file.check()

    def messages(self, only: Collection[Address] | None = None) -> Iterator[RecordedMessage]:
        """Yield the messages of all or `only` these addresses, in file order."""
        for file in self._files:
            yield from file.messages(only)


class _RecordedFile:
    def __init__(self, path: Path, vehicle: str) -> None:
        self.name, self._vehicle = path.name, vehicle
        self.boot_times: set[str] = set()
        self.chunks = ChunkFile(path)
        self._schemas: dict[int, Schema] = {}
        self._layouts: dict[int, tuple[Definition[Any], Layout]] = {}  # by schema
        self._schema_budget, self._definition_budget = _SCHEMA_BUDGET, _DEFINITION_BUDGET
        self._streams: dict[int, RecordedStream | None] = {}  # by channel
        totals: dict[int, int] = {}
        self.counts: Mapping[RecordedStream, int]
        for kind in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
            for record in records_of(self.chunks.summary, kind):
                # A summary may repeat channels but not schemas, which are then in the chunks.
                if not isinstance(record, Channel) or record.schema_id in self._schemas or not record.schema_id:
                    self._register(record)
                if isinstance(record, Statistics):
                    totals = record.channel_message_counts
        self._all_known = bool(totals) and totals.keys() <= self._streams.keys()
        if self._all_known:
            self.counts = {stream: total for number, total in totals.items() if (stream := self._streams[number])}
        else:
            self.counts = Counter(each.stream for each in self.messages())

    def check(self) -> None:
        for _ in self.chunks.blocks(self._channels()):
            pass
        if self.chunks.damaged:
            self.counts = Counter(each.stream for each in self.messages())

    def messages(self, only: Collection[Address] | None = None) -> Iterator[RecordedMessage]:
        for block in self.chunks.blocks(self._channels(only)):
            try:
                for record in records_of(block):
                    if not isinstance(record, Message):
                        self._register(record)
                        continue
                    if (number := record.channel_id) not in self._streams:
                        self._streams[number] = None
                        lost = f"skipped the messages of channel {number}, whose channel record is lost"
                        self.chunks.warn(lost, lost=True)
                    if (stream := self._streams[number]) and (only is None or stream.address in only):
                        yield RecordedMessage(stream, _unpack(record.data), record.log_time)
            except READ_ERRORS:
                self.chunks.warn("skipped the rest of a chunk after an invalid record", lost=True)

    def _channels(self, only: Collection[Address] | None = None) -> list[int] | None:
        """Return the readable channels, by default of all addresses; None if the summary does not list all channels."""
        if not self._all_known:
            return None
        streams = self._streams.items()
        return [number for number, stream in streams if stream and (only is None or stream.address in only)]

    def _register(self, record: McapRecord) -> None:
        """Register a schema or channel; ignore later records with the same id."""
        if isinstance(record, Schema) and record.id not in self._schemas:
            self._schema_budget -= len(record.name) + len(record.data)
            if self._schema_budget < 0:
                self.chunks.warn(f"skipped channels: the schemas in this file exceed {_SCHEMA_BUDGET} bytes")
            else:
                self._schemas[record.id] = record
        elif isinstance(record, Channel) and record.id not in self._streams:
            self._streams[record.id] = self._describe(self._schemas.get(record.schema_id), record)

    def _describe(self, schema: Schema | None, channel: Channel) -> RecordedStream | None:
        if schema is None or not schema.name.startswith(("px4_msgs/", "px4_msgs_old/")):
            return None
        try:
            if schema.encoding and (channel.message_encoding, schema.encoding) != ("cdr", "ros2msg"):
                encodings = f"{channel.message_encoding} with {schema.encoding}, not cdr with ros2msg"
                raise ValueError(f"its encoding is {encodings}; record it where px4_msgs is installed")
            if not schema.data:
                raise ValueError(f"the file has no definition of {schema.name}; record it where px4_msgs is installed")
            definition, layout = self._layout(schema, channel.topic)
            metadata, number = channel.metadata, channel.metadata.get("instance")
            if {"vehicle", "topic"} <= metadata.keys():
                address = Address(metadata["vehicle"], metadata["topic"], None if number is None else int(number))
            else:
                namespace, topic, instance = split_ros2_topic(channel.topic)
                address = Address(namespace.replace("/", "-") or self._vehicle, topic, instance)
            expected = BY_TOPIC.get(address.topic, definition)
            if expected is not definition:
                raise ValueError(f"its messages are {definition.name}, but {address.topic} has {expected.name}")
        except (AddressError, ValueError) as exc:
            self.chunks.warn(f"skipped {channel.topic} ({exc})")
            return None
        if (boot := metadata.get("boot_time_utc_us", "")[:20]).isdecimal() and len(self.boot_times) < 2:
            self.boot_times.add(boot)
        missing = frozenset(metadata.get("missing", "").split()).intersection(definition.names)
        return RecordedStream(channel.topic, address, definition, layout, missing)

    def _layout(self, schema: Schema, topic: str) -> tuple[Definition[Any], Layout]:
        """Return the definition and layout of a schema; raise ValueError if they do not match the message."""
        if schema.id not in self._layouts:
            if self._definition_budget < 0:
                raise ValueError("the definitions in this file exceed the limit, which is the size of 250 PX4 topics")
            self._definition_budget -= len(schema.data) // 256
            text = schema.data.decode(errors="replace")
            own = Layout("of the file", "", types={field.name: field.type for field in read_msg(text)})
            self._definition_budget -= 32 + len(own.types)
            name = schema.name.rpartition("/")[2]
            try:
                definition = ros2_types().get(schema.name) or define_msg(name, text)
            except ValueError as exc:
                definition = define_msg(name, text.replace("@range", "range"))
                self.chunks.warn(f"ignored the ranges in the definition of {topic} ({exc})")
            same = (each for each in definition.layouts.values() if [*each.types.items()] == [*own.types.items()])
            self._layouts[schema.id] = definition, next(same, None) or self._check_layout(own, definition, topic)
        return self._layouts[schema.id]

    def _check_layout(self, own: Layout, known: Definition[Any], topic: str) -> Layout:
        """Return a layout that is in no PX4 release; warn about unknown fields, which are left out."""
        wrong = [name for name, kind in own.types.items() if kind not in known.known_types.get(name, {kind})]
        if lacking := sorted({*wrong, *(known.always - own.types.keys())}):
            raise ValueError(f"its definition of {', '.join(lacking)} matches no PX4 release")
        if unknown := sorted(own.types.keys() - known.known_types.keys()):
            self.chunks.warn(f"left out {', '.join(unknown)} of {topic}, unknown to nedbus in {known.name}")
        return own


def _unpack(payload: bytes) -> bytes:
    """Decompress a message compressed by rosbag2; if that fails, return it unchanged, and the decoder rejects it."""
    with suppress(ZstdError):
        if payload.startswith(ZSTD_MAGIC) and frame_content_size(payload) <= _MAX_PAYLOAD:
            return ZstdDecompressor().decompress(payload, max_output_size=_MAX_PAYLOAD)
    return payload
