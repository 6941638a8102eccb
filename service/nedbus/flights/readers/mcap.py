"""Reader of MCAP files recorded by nedbus, and of px4_msgs recorded by `ros2 bag record`."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Message, Schema, Statistics
from zstandard import ZstdDecompressor, ZstdError, frame_content_size

from nedbus import limits
from nedbus.errors import AddressError, DecodeError, SourceError
from nedbus.samples import SourceMessage
from nedbus_msgs import (
    ARDUPILOT,
    BY_TOPIC,
    OTHER_AUTOPILOT,
    Address,
    Definition,
    Encoded,
    FieldType,
    Layout,
    cdr_layout,
    decode_with,
    define_msg,
    fitting_layout,
    is_vehicle_input,
    read_msg,
    record_encoder,
    ros2_types,
    split_ros2_topic,
)

from .formats import recording_files
from .mcap_chunks import READ_ERRORS, ZSTD_MAGIC, ChunkFile, records_of
from .reader import FlightReader, ReadOptions, Record

_SCHEMA_BUDGET: Final = 2**25  # bytes of the schemas of a file
# for all definitions of a file: 32 per message, 1 per field, 1 per 256 characters
_DEFINITION_BUDGET: Final = 16_000
_INPUT: Final = "mcap-input"  # `sample.source` of messages to a vehicle
# of nedbus's recordings, for an instance
_OWN_TOPIC: Final = re.compile(r"/([^/]+)/([^/]+)/(\d{1,3})")
_VERSION: Final = re.compile(r"_v(\d{1,3})$")  # of a topic of PX4's translation node


class RecordedStream:
    """A channel: its ROS 2 topic, address, layout of the messages, and the fields that its source did not provide."""

    converted: Mapping[str, Any] = {}
    source: str | None = None  # of log messages of another autopilot than PX4
    head = b"\x00\x01"  # little-endian XCDR1

    def __init__(
        self,
        ros2_topic: str,
        address: Address,
        definition: Definition[Any],
        layout: Layout,
        missing: frozenset[str],
    ) -> None:
        self.ros2_topic = ros2_topic
        self.address = address
        self.definition = definition
        self.layout = layout
        self.lacking = missing  # by the metadata of the channel
        self.strict_bools = frozenset(
            name for name, kind in layout.types.items() if kind.base == "bool"
        )
        self.cdr = cdr_layout(layout)

    @cached_property
    def dtype(self) -> Any:
        """Argument for `numpy.dtype` that describes a payload; a bool is a uint8."""
        return {
            "names": [*self.cdr.offsets],
            "formats": [_column_type(kind) for kind in self.layout.types.values()],
            "offsets": [*self.cdr.offsets.values()],
            "itemsize": self.cdr.size,
        }

    def check(self, payload: bytes) -> str | None:
        """Return why a payload cannot be decoded, None if it can."""
        if self.cdr.check(payload) is None:
            return None
        fits = fitting_layout(self.definition, payload)
        try:
            decode_with(self.definition, payload, self.layout)
        except DecodeError as exc:
            if fits and fits is not self.layout:
                return f'{exc}, or read it with layout="{fits.name}"'
            return str(exc)
        return None

    def decode(self, payload: bytes) -> dict[str, Any]:
        """Decode a message; leave out the fields that its source did not provide."""
        fields = decode_with(self.definition, payload, self.layout)
        for name in self.lacking & self.definition.all_fields:
            fields.pop(name, None)
        return fields

    def timestamp(self, payload: bytes) -> tuple[int | None]:
        """Return the timestamp of a message [us]."""
        at = self.cdr.offsets.get("timestamp")
        if at is None:
            return (None,)
        return (int.from_bytes(payload[at : at + 8], "little"),)

    @cached_property
    def encode_valid(self) -> Callable[[bytes], Encoded | None]:
        """A function that validates and encodes a message that passes `check`; it returns None for an invalid one."""
        if self.lacking:
            return lambda _: None
        unpack = self.cdr.body.unpack_from
        return record_encoder(self.definition, self.layout.types, lambda record: unpack(record, 4))


class McapReader(FlightReader):
    """An MCAP file, or the folder of a bag, read one chunk at a time.

    `counts`: the number of messages per stream by the file's statistics.

    Raises SourceError if a file is not MCAP, cannot be opened, or has no readable message of a PX4 topic.
    """

    kind = "mcap"

    def __init__(self, path: Path, options: ReadOptions) -> None:
        super().__init__(path, options)
        paths, lacking = recording_files(path)
        self._lacking = [f"{name} of this bag is missing" for name in lacking]
        self._files: list[_RecordedFile] = []
        self._number = 0  # of messages so far
        self._is_one_boot = True
        try:
            for file_path in paths:
                file = _RecordedFile(file_path, self)
                self._files.append(file)
                self._resources.append(file.chunks)
            for file in self._files:
                file.open()
            self._require_messages()
        except BaseException:
            self.close()
            raise
        self.total = sum(file.chunks.size for file in self._files)
        self.damaged = self._is_damaged

    def _require_messages(self) -> None:
        """Raise SourceError unless the files have messages of the requested topics."""
        if not self.counts:
            problem = "this recording has no messages of PX4 topics"
            if self._is_damaged:
                problem = "no message can be read"
            reasons = self.warnings[:3] or ["no channel has a type of px4_msgs"]
            raise SourceError(str(self.path), f"{problem}; {'; '.join(reasons)}")
        if not self.definitions:
            topics = ", ".join(sorted({stream.address.topic for stream in self.counts}))
            problem = f"this recording has none of the requested topics; it has {topics}"
            raise SourceError(str(self.path), problem)

    @property
    def counts(self) -> dict[RecordedStream, int]:
        """The number of messages per stream."""
        counts: dict[RecordedStream, int] = {}
        for file in self._files:
            counts |= file.counts
        return counts

    @property
    def warnings(self) -> list[str]:
        """Damage found and channels skipped so far."""
        warnings = [*self._lacking]
        for file in self._files:
            where = f"{file.name}: " if len(self._files) > 1 else ""
            warnings += [f"{where}{text}" for text in file.chunks.warnings]
        return warnings

    @property
    def _is_damaged(self) -> bool:
        return bool(self._lacking) or any(file.chunks.damaged for file in self._files)

    def records(self) -> Iterator[Record]:
        """Yield the messages in file order."""
        before = 0
        for file in self._files:
            for record in file.records():
                self.position = before + file.chunks.position
                yield record
            before += file.chunks.size
            self.damaged = self._is_damaged

    def message_of(self, record: Record) -> SourceMessage:
        """Return a record as a message; those to a vehicle, and texts not of PX4, have their own source."""
        message = super().message_of(record)
        self._number += 1
        if message.error is not None:
            message.error += f" (message {self._number} of the recording)"
        if is_vehicle_input(record.stream.ros2_topic):  # type: ignore[attr-defined] # its streams are RecordedStream
            message.source = _INPUT
        elif record.stream.source is not None:  # type: ignore[attr-defined]
            message.source = record.stream.source  # type: ignore[attr-defined]
        return message

    def layouts(self, definition: Definition[Any]) -> set[str]:
        """Return the names of the layouts of a definition."""
        return {stream.layout.name for stream in self.counts if stream.definition is definition}

    def add(self, stream: RecordedStream) -> None:
        """Add a stream to the definitions if it is selected."""
        if self.reads(stream.address.topic):
            self.definitions[stream.address] = stream.definition

    def add_boot_time(self, boot_utc: int) -> None:
        """Set the Unix time of the boot; 0 if the channels disagree."""
        if self.boot_utc not in (0, boot_utc):
            self._is_one_boot = False
        self.boot_utc = boot_utc if self._is_one_boot else 0


class _Described(NamedTuple):
    """What a schema describes."""

    definition: Definition[Any]
    layout: Layout


class _RecordedFile:
    """One file of a recording: its schemas, channels and messages."""

    def __init__(self, path: Path, reader: McapReader) -> None:
        self.name = path.name
        self._reader = reader
        self.chunks = ChunkFile(path)
        self.counts: Mapping[RecordedStream, int] = {}
        self._schemas: dict[int, Schema] = {}
        self._described: dict[int, _Described] = {}  # by schema
        self._schema_budget = _SCHEMA_BUDGET
        self._definition_budget = _DEFINITION_BUDGET
        self._streams: dict[int, RecordedStream | None] = {}  # by channel
        self._versions: dict[Address, int] = {}  # of the channel that is read
        self._all_known = False
        self._is_open = False

    def open(self) -> None:
        """Register the channels of the summary, or of the whole file if it has none."""
        totals: dict[int, int] = {}
        for kind in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
            for record in records_of(self.chunks.summary, kind):
                if isinstance(record, Statistics):
                    totals = record.channel_message_counts
                # A summary may repeat channels but not schemas, which are then in the chunks.
                elif (
                    not isinstance(record, Channel)
                    or not record.schema_id
                    or record.schema_id in self._schemas
                ):
                    self._register(record)
        self._all_known = bool(totals) and totals.keys() <= self._streams.keys()
        if self._all_known:
            counts: dict[RecordedStream, int] = {}
            for number, total in totals.items():
                stream = self._streams[number]
                if stream is not None:
                    counts[stream] = total
            self.counts = counts
        else:
            self.counts = Counter(stream for stream, _, _ in self._messages())
        self._is_open = True
        for stream in self.counts:
            self._reader.add(stream)

    def records(self) -> Iterator[Record]:
        """Yield the messages of the selected topics."""
        make = tuple.__new__  # half the time of the constructor
        chosen = self._reader.definitions
        for stream, payload, logged in self._messages():
            if stream.address in chosen:
                yield make(Record, (stream, _unpack(payload), logged // 1000, None))

    def _messages(self) -> Iterator[tuple[RecordedStream, bytes, int]]:
        """Yield stream, payload and log time [ns] of all messages, at least of the selected ones."""
        for block in self.chunks.blocks(self._selected_channels()):
            try:
                for record in records_of(block):
                    if not isinstance(record, Message):
                        self._register(record)
                        continue
                    if record.channel_id not in self._streams:
                        self._lose_channel(record.channel_id)
                    stream = self._streams[record.channel_id]
                    if stream is not None:
                        yield stream, record.data, record.log_time
            except READ_ERRORS:
                self.chunks.warn("skipped the rest of a chunk after an invalid record", lost=True)

    def _selected_channels(self) -> list[int] | None:
        """Return the channels to read, None for all, because the summary does not list them."""
        if not self._all_known:
            return None
        chosen = self._reader.definitions
        numbers = []
        for number, stream in self._streams.items():
            if stream is not None and stream.address in chosen:
                numbers.append(number)
        return numbers

    def _lose_channel(self, number: int) -> None:
        self._streams[number] = None
        text = f"skipped the messages of channel {number}, whose channel record is lost"
        self.chunks.warn(text, lost=True)

    def _register(self, record: McapRecord) -> None:
        """Register a schema or channel; ignore later records with the same id."""
        if isinstance(record, Schema) and record.id not in self._schemas:
            self._register_schema(record)
        elif isinstance(record, Channel) and record.id not in self._streams:
            self._register_channel(record)

    def _register_schema(self, schema: Schema) -> None:
        self._schema_budget -= len(schema.name) + len(schema.data)
        if self._schema_budget >= 0:
            self._schemas[schema.id] = schema
            return
        text = f"skipped channels: the schemas in this file exceed {_SCHEMA_BUDGET} bytes"
        self.chunks.warn(text, lost=True)

    def _register_channel(self, channel: Channel) -> None:
        stream = self._describe(self._schemas.get(channel.schema_id), channel)
        if stream is not None and not self._choose_version(channel.id, stream):
            stream = None
        self._streams[channel.id] = stream
        if stream is not None and self._is_open:
            self._reader.add(stream)

    def _choose_version(self, channel: int, stream: RecordedStream) -> bool:
        """Return whether a channel has the newest version of its messages; drop the channels of older versions."""
        version = _version_of(stream.ros2_topic)
        newest = self._versions.get(stream.address)
        if newest is None or newest == version:
            self._versions[stream.address] = version
            return True
        others = {
            number: other
            for number, other in self._streams.items()
            if other is not None and other.address == stream.address
        }
        if version < newest:
            first = next(iter(others.values()))
            self._warn_of_version(stream.ros2_topic, first.ros2_topic)
            return False
        self._versions[stream.address] = version
        for number, other in others.items():
            self._streams[number] = None
            self._warn_of_version(other.ros2_topic, stream.ros2_topic)
        return True

    def _warn_of_version(self, older: str, newer: str) -> None:
        self.chunks.warn(f"skipped {older}: {newer} has the same messages in a newer version")

    def _describe(self, schema: Schema | None, channel: Channel) -> RecordedStream | None:
        if schema is None or not schema.name.startswith(("px4_msgs/", "px4_msgs_old/")):
            return None
        try:
            _check_encoding(schema, channel)
            described = self._described_by(schema, channel.topic)
            own = _address_of(channel, self._reader.options.default_vehicle)
            definition = described.definition
            expected = BY_TOPIC.get(own.topic, definition)
            if expected is not definition:
                raise ValueError(
                    f"its messages are {definition.name}, but {own.topic} has {expected.name}"
                )
        except AddressError:
            text = f"skipped {channel.topic} (its name does not end with a topic of PX4)"
            self.chunks.warn(text, lost=True)
            return None
        except ValueError as exc:
            self.chunks.warn(f"skipped {channel.topic} ({exc})", lost=True)
            return None
        vehicle = own.vehicle
        if self._reader.reads(own.topic):
            vehicle = self._reader.vehicle_of(own.vehicle)
        address = Address(vehicle, own.topic, own.instance)
        metadata = channel.metadata
        self._read_times(vehicle, metadata)
        missing = frozenset(metadata.get("missing", "").split()).intersection(definition.names)
        stream = RecordedStream(channel.topic, address, definition, described.layout, missing)
        if metadata.get("source") in (ARDUPILOT, OTHER_AUTOPILOT):
            stream.source = metadata["source"]
        return stream

    def _read_times(self, vehicle: str, metadata: Mapping[str, str]) -> None:
        """Read when a vehicle booted, and when its recording began."""
        boot = metadata.get("boot_time_utc_us", "")[:20]
        if boot.isdecimal():
            self._reader.add_boot_time(int(boot))
        start = metadata.get("start_time_us", "")[:20]
        if start.isdecimal():
            self._reader.starts[vehicle] = int(start)

    def _described_by(self, schema: Schema, topic: str) -> _Described:
        """Return the definition and layout of a schema; raise ValueError if they do not match the message."""
        described = self._described.get(schema.id)
        if described is not None:
            return described
        if self._definition_budget < 0:
            raise ValueError(
                "the definitions in this file exceed the limit, which is the size of 250 PX4 topics"
            )
        self._definition_budget -= len(schema.data) // 256
        text = schema.data.decode(errors="replace")
        types = {field.name: field.type for field in read_msg(text)}
        self._definition_budget -= 32 + len(types)
        definition = self._define(schema, text, topic)
        layout = Layout("of the file", "", types=types)
        release = self._reader.options.layout
        if release:
            layout = definition.layout_of_release(release) or layout
        known = _same_layout(definition, layout)
        layout = known or self._check_layout(layout, definition, topic)
        described = _Described(definition, layout)
        self._described[schema.id] = described
        return described

    def _define(self, schema: Schema, text: str, topic: str) -> Definition[Any]:
        known = ros2_types().get(schema.name)
        if known is not None:
            return known
        name = schema.name.rpartition("/")[2]
        try:
            return define_msg(name, text)
        except ValueError as exc:
            definition = define_msg(name, text.replace("@range", "range"))
            self.chunks.warn(f"ignored the ranges in the definition of {topic} ({exc})")
            return definition

    def _check_layout(self, own: Layout, known: Definition[Any], topic: str) -> Layout:
        """Return a layout that is in no PX4 release; warn about unknown fields, which are left out."""
        wrong = set(known.always - own.types.keys())
        for name, kind in own.types.items():
            if kind not in known.known_types.get(name, {kind}):
                wrong.add(name)
        if wrong:
            names = ", ".join(sorted(wrong))
            raise ValueError(f"its definition of {names} matches no PX4 release")
        unknown = own.types.keys() - known.known_types.keys()
        if unknown:
            names = ", ".join(sorted(unknown))
            self.chunks.warn(f"left out {names} of {topic}, unknown to nedbus in {known.name}")
        return own


def _column_type(kind: FieldType) -> Any:
    """Return NumPy's type of a field; a bool is a uint8."""
    if kind.is_text:
        return f"S{kind.size}"
    form = f"<{kind.form.replace('?', 'B')}"
    return form[-1], kind.length or ()


def _version_of(ros2_topic: str) -> int:
    """Return the version of the messages of a topic, 0 without one."""
    version = _VERSION.search(ros2_topic)
    return 0 if version is None else int(version[1])


def _check_encoding(schema: Schema, channel: Channel) -> None:
    """Raise ValueError unless the messages are CDR with a definition."""
    encodings = (channel.message_encoding, schema.encoding)
    if schema.encoding and encodings != ("cdr", "ros2msg"):
        problem = f"its encoding is {encodings[0]} with {encodings[1]}, not cdr with ros2msg"
        raise ValueError(f"{problem}; record it where px4_msgs is installed")
    if not schema.data:
        raise ValueError(
            f"the file has no definition of {schema.name}; record it where px4_msgs is installed"
        )


def _same_layout(definition: Definition[Any], layout: Layout) -> Layout | None:
    """Return the layout of a PX4 release with the same fields in the same order."""
    fields = [*layout.types.items()]
    for known in definition.layouts.values():
        if [*known.types.items()] == fields:
            return known
    return None


def _address_of(channel: Channel, default_vehicle: str) -> Address:
    """Return the address of a channel by its metadata, or by its topic; raise AddressError for an invalid one."""
    metadata = channel.metadata
    if {"vehicle", "topic"} <= metadata.keys():
        number = metadata.get("instance")
        instance = None if number is None else int(number)
        return Address(metadata["vehicle"], metadata["topic"], instance)
    own = _OWN_TOPIC.fullmatch(channel.topic)
    if own is not None:  # a copy of nedbus's recording, without metadata
        return Address(own[1], own[2], int(own[3]))
    namespace, topic, instance = split_ros2_topic(channel.topic)
    return Address(namespace.replace("/", "-") or default_vehicle, topic, instance)


def _unpack(payload: bytes) -> bytes:
    """Decompress a message compressed by rosbag2; if that fails, return it unchanged, and the decoder rejects it."""
    with suppress(ZstdError):
        if (
            payload.startswith(ZSTD_MAGIC)
            and frame_content_size(payload) <= limits.COMPRESSED_MESSAGE
        ):
            return ZstdDecompressor().decompress(payload, max_output_size=limits.COMPRESSED_MESSAGE)
    return payload
