"""Reader of MCAP files recorded by nedbus, and of px4_msgs recorded by `ros2 bag record`."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Message, Schema, Statistics
from zstandard import ZstdDecompressor, ZstdError, frame_content_size

from nedbus.errors import AddressError, DecodeError, SourceError
from nedbus.samples import SourceMessage
from nedbus_msgs import (
    ARDUPILOT,
    BY_TOPIC,
    OTHER_AUTOPILOT,
    Address,
    Definition,
    Encoded,
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

_MAX_PAYLOAD: Final = 2**16  # decompressed size of a message compressed by rosbag2
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
        types = [
            f"S{kind.size}"
            if kind.is_text
            else (f"<{kind.form.replace('?', 'B')}"[-1], kind.length or ())
            for kind in self.layout.types.values()
        ]
        names, offsets = [*self.cdr.offsets], [*self.cdr.offsets.values()]
        return {"names": names, "formats": types, "offsets": offsets, "itemsize": self.cdr.size}

    def check(self, payload: bytes) -> str | None:
        """Return why a payload cannot be decoded, None if it can."""
        if self.cdr.check(payload) is None:
            return None
        fits = fitting_layout(self.definition, payload)
        try:
            decode_with(self.definition, payload, self.layout)
        except DecodeError as exc:
            return (
                f'{exc}, or read it with layout="{fits.name}"'
                if fits and fits is not self.layout
                else str(exc)
            )
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
        return (None if at is None else int.from_bytes(payload[at : at + 8], "little"),)

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
            for each in paths:
                self._files.append(_RecordedFile(each, self))
                self._resources.append(self._files[-1].chunks)
            for file in self._files:
                file.open()
            if not self.counts:
                reasons = [*self.warnings[:3]] or ["no channel has a type of px4_msgs"]
                problem = (
                    "no message can be read"
                    if self._is_damaged
                    else "this recording has no messages of PX4 topics"
                )
                raise SourceError(str(path), f"{problem}; {'; '.join(reasons)}")
            if not self.definitions:
                found = ", ".join(sorted({stream.address.topic for stream in self.counts}))
                raise SourceError(
                    str(path), f"this recording has none of the requested topics; it has {found}"
                )
        except BaseException:
            self.close()
            raise
        self.total = sum(file.chunks.size for file in self._files)
        self.damaged = self._is_damaged

    @property
    def counts(self) -> dict[RecordedStream, int]:
        """The number of messages per stream."""
        return {stream: count for file in self._files for stream, count in file.counts.items()}

    @property
    def warnings(self) -> list[str]:
        """Damage found and channels skipped so far."""
        where = {file: f"{file.name}: " if len(self._files) > 1 else "" for file in self._files}
        return [
            *self._lacking,
            *(f"{where[file]}{text}" for file in self._files for text in file.chunks.warnings),
        ]

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
        self._is_one_boot &= self.boot_utc in (0, boot_utc)
        self.boot_utc = boot_utc if self._is_one_boot else 0


class _RecordedFile:
    def __init__(self, path: Path, reader: McapReader) -> None:
        self.name, self._reader = path.name, reader
        self.chunks = ChunkFile(path)
        self.counts: Mapping[RecordedStream, int] = {}
        self._schemas: dict[int, Schema] = {}
        self._layouts: dict[int, tuple[Definition[Any], Layout]] = {}  # by schema
        self._schema_budget, self._definition_budget = _SCHEMA_BUDGET, _DEFINITION_BUDGET
        self._streams: dict[int, RecordedStream | None] = {}  # by channel
        self._versions: dict[Address, int] = {}  # of the channel that is read
        self._all_known = self._is_open = False

    def open(self) -> None:
        """Register the channels of the summary, or of the whole file if it has none."""
        totals: dict[int, int] = {}
        for kind in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
            for record in records_of(self.chunks.summary, kind):
                # A summary may repeat channels but not schemas, which are then in the chunks.
                if (
                    not isinstance(record, Channel)
                    or record.schema_id in self._schemas
                    or not record.schema_id
                ):
                    self._register(record)
                if isinstance(record, Statistics):
                    totals = record.channel_message_counts
        self._all_known = bool(totals) and totals.keys() <= self._streams.keys()
        if self._all_known:
            self.counts = {
                stream: total
                for number, total in totals.items()
                if (stream := self._streams[number])
            }
        else:
            self.counts = Counter(stream for stream, _, _ in self._messages())
        self._is_open = True
        for stream in self.counts:
            self._reader.add(stream)

    def records(self) -> Iterator[Record]:
        """Yield the messages of the selected topics."""
        make, chosen = tuple.__new__, self._reader.definitions
        for stream, payload, logged in self._messages():
            if stream.address in chosen:
                yield make(Record, (stream, _unpack(payload), logged // 1000, None))

    def _messages(self) -> Iterator[tuple[RecordedStream, bytes, int]]:
        only = None
        if self._all_known:
            chosen = self._reader.definitions
            only = [
                number
                for number, stream in self._streams.items()
                if stream and stream.address in chosen
            ]
        for block in self.chunks.blocks(only):
            try:
                for record in records_of(block):
                    if not isinstance(record, Message):
                        self._register(record)
                        continue
                    if (number := record.channel_id) not in self._streams:
                        self._streams[number] = None
                        lost = f"skipped the messages of channel {number}, whose channel record is lost"
                        self.chunks.warn(lost, lost=True)
                    if stream := self._streams[number]:
                        yield stream, record.data, record.log_time
            except READ_ERRORS:
                self.chunks.warn("skipped the rest of a chunk after an invalid record", lost=True)

    def _register(self, record: McapRecord) -> None:
        """Register a schema or channel; ignore later records with the same id."""
        if isinstance(record, Schema) and record.id not in self._schemas:
            self._schema_budget -= len(record.name) + len(record.data)
            if self._schema_budget < 0:
                self.chunks.warn(
                    f"skipped channels: the schemas in this file exceed {_SCHEMA_BUDGET} bytes",
                    lost=True,
                )
            else:
                self._schemas[record.id] = record
        elif isinstance(record, Channel) and record.id not in self._streams:
            self._streams[record.id] = stream = self._describe(
                self._schemas.get(record.schema_id), record
            )
            if stream is not None and self._is_newest(record.id, stream) and self._is_open:
                self._reader.add(stream)

    def _is_newest(self, channel: int, stream: RecordedStream) -> bool:
        """Return whether a channel has the newest version of its messages; drop the channels of older versions."""
        found = _VERSION.search(stream.ros2_topic)
        version, known = int(found[1]) if found else 0, self._versions.get(stream.address, -1)
        self._versions[stream.address] = max(version, known)
        if known in (-1, version):
            return True
        same = {
            number: each
            for number, each in self._streams.items()
            if each and each.address == stream.address
        }
        is_newest = version > known
        older = [number for number in same if number != channel] if is_newest else [channel]
        for number in older:
            topic = same[number].ros2_topic
            self._streams[number] = None
            name = next(each.ros2_topic for each in same.values() if (each is stream) == is_newest)
            self.chunks.warn(f"skipped {topic}: {name} has the same messages in a newer version")
        return is_newest

    def _describe(self, schema: Schema | None, channel: Channel) -> RecordedStream | None:
        if schema is None or not schema.name.startswith(("px4_msgs/", "px4_msgs_old/")):
            return None
        try:
            if schema.encoding and (channel.message_encoding, schema.encoding) != (
                "cdr",
                "ros2msg",
            ):
                encodings = (
                    f"{channel.message_encoding} with {schema.encoding}, not cdr with ros2msg"
                )
                raise ValueError(
                    f"its encoding is {encodings}; record it where px4_msgs is installed"
                )
            if not schema.data:
                raise ValueError(
                    f"the file has no definition of {schema.name}; record it where px4_msgs is installed"
                )
            definition, layout = self._layout(schema, channel.topic)
            own = _address_of(channel, self._reader.options.default_vehicle)
            if (expected := BY_TOPIC.get(own.topic, definition)) is not definition:
                raise ValueError(
                    f"its messages are {definition.name}, but {own.topic} has {expected.name}"
                )
        except AddressError:
            self.chunks.warn(
                f"skipped {channel.topic} (its name does not end with a topic of PX4)", lost=True
            )
            return None
        except ValueError as exc:
            self.chunks.warn(f"skipped {channel.topic} ({exc})", lost=True)
            return None
        vehicle = (
            self._reader.vehicle_of(own.vehicle) if self._reader.reads(own.topic) else own.vehicle
        )
        address, metadata = Address(vehicle, own.topic, own.instance), channel.metadata
        if (boot := metadata.get("boot_time_utc_us", "")[:20]).isdecimal():
            self._reader.add_boot_time(int(boot))
        if (start := metadata.get("start_time_us", "")[:20]).isdecimal():
            self._reader.starts[vehicle] = int(start)
        missing = frozenset(metadata.get("missing", "").split()).intersection(definition.names)
        stream = RecordedStream(channel.topic, address, definition, layout, missing)
        if metadata.get("source") in (ARDUPILOT, OTHER_AUTOPILOT):
            stream.source = metadata["source"]
        return stream

    def _layout(self, schema: Schema, topic: str) -> tuple[Definition[Any], Layout]:
        """Return the definition and layout of a schema; raise ValueError if they do not match the message."""
        if schema.id not in self._layouts:
            if self._definition_budget < 0:
                raise ValueError(
                    "the definitions in this file exceed the limit, which is the size of 250 PX4 topics"
                )
            self._definition_budget -= len(schema.data) // 256
            text = schema.data.decode(errors="replace")
            own = Layout(
                "of the file", "", types={field.name: field.type for field in read_msg(text)}
            )
            self._definition_budget -= 32 + len(own.types)
            name = schema.name.rpartition("/")[2]
            try:
                definition = ros2_types().get(schema.name) or define_msg(name, text)
            except ValueError as exc:
                definition = define_msg(name, text.replace("@range", "range"))
                self.chunks.warn(f"ignored the ranges in the definition of {topic} ({exc})")
            if (release := self._reader.options.layout) and (
                forced := definition.layout_of_release(release)
            ):
                own = forced
            same = (
                each
                for each in definition.layouts.values()
                if [*each.types.items()] == [*own.types.items()]
            )
            self._layouts[schema.id] = (
                definition,
                next(same, None) or self._check_layout(own, definition, topic),
            )
        return self._layouts[schema.id]

    def _check_layout(self, own: Layout, known: Definition[Any], topic: str) -> Layout:
        """Return a layout that is in no PX4 release; warn about unknown fields, which are left out."""
        wrong = [
            name
            for name, kind in own.types.items()
            if kind not in known.known_types.get(name, {kind})
        ]
        if lacking := sorted({*wrong, *(known.always - own.types.keys())}):
            raise ValueError(f"its definition of {', '.join(lacking)} matches no PX4 release")
        if unknown := sorted(own.types.keys() - known.known_types.keys()):
            self.chunks.warn(
                f"left out {', '.join(unknown)} of {topic}, unknown to nedbus in {known.name}"
            )
        return own


def _address_of(channel: Channel, default_vehicle: str) -> Address:
    """Return the address of a channel by its metadata, or by its topic; raise AddressError for an invalid one."""
    metadata, number = channel.metadata, channel.metadata.get("instance")
    if {"vehicle", "topic"} <= metadata.keys():
        return Address(
            metadata["vehicle"], metadata["topic"], None if number is None else int(number)
        )
    if own := _OWN_TOPIC.fullmatch(channel.topic):  # a copy of nedbus's recording, without metadata
        return Address(own[1], own[2], int(own[3]))
    namespace, topic, instance = split_ros2_topic(channel.topic)
    return Address(namespace.replace("/", "-") or default_vehicle, topic, instance)


def _unpack(payload: bytes) -> bytes:
    """Decompress a message compressed by rosbag2; if that fails, return it unchanged, and the decoder rejects it."""
    with suppress(ZstdError):
        if payload.startswith(ZSTD_MAGIC) and frame_content_size(payload) <= _MAX_PAYLOAD:
            return ZstdDecompressor().decompress(payload, max_output_size=_MAX_PAYLOAD)
    return payload
