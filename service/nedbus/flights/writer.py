"""Writer of MCAP files with CDR messages and their ROS 2 definitions, for Foxglove, PlotJuggler and any MCAP reader.

A file is valid from the start and after every flush: a footer follows the last chunk, and the next chunk overwrites
it. A power cut costs only the messages since the last flush, never the file.
"""

import errno
import logging
import os
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager
from itertools import repeat
from operator import attrgetter
from pathlib import Path
from typing import IO, Any, Final, NamedTuple, cast

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC, Writer

from nedbus import limits
from nedbus.atomic_write import sync_folder
from nedbus.errors import OutputError
from nedbus.log_event import about
from nedbus_msgs import Address, Definition, Layout, Message, Provenance, definition_text, ros2_type
from nedbus_msgs.arrays import MessageArray, arrays_of
from nedbus_msgs.messages import LogMessage

_log = logging.getLogger(__name__)

_CHUNK: Final = 2**23  # bytes; flushing every second makes smaller chunks
_LATEST: Final = 2**64 - 1  # ns that MCAP can hold; a damaged log may have larger timestamps
_END: Final = (
    struct.pack("<BQI", Opcode.DATA_END, 4, 0)
    + struct.pack("<BQQQI", Opcode.FOOTER, 20, 0, 0, 0)
    + MCAP0_MAGIC
)

_ROS2: Final = "offered_qos_profiles"  # metadata that ROS 2 tools expect in a bag
_LOG_TYPE: Final = "rcl_interfaces/msg/Log"
_LOG_DEFINITION: Final = f"""builtin_interfaces/Time stamp
uint8 level
string name
string msg
string file
string function
uint32 line
{"=" * 80}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
# FATAL, ERROR, WARN, INFO, DEBUG, by PX4's severity
_LOG_LEVELS: Final = (50, 50, 50, 40, 30, 20, 20, 10)


class _Logged(NamedTuple):
    """A message to write; `logged`: its log time [ns]."""

    message: Message
    address: Address
    provenance: Provenance
    logged: int


class _Encoded(NamedTuple):
    """A message as a file contains it: log time [ns], channel, payload, publish time [ns] and sequence number."""

    logged: int
    channel: int
    payload: bytes
    published: int
    number: int


class _Times(NamedTuple):
    """Log time [ns], publish time [ns] and sequence number of a message."""

    logged: int
    published: int
    number: int = 0


class _Channel(NamedTuple):
    """The id of a channel, and the layout of its messages."""

    number: int
    layout: Layout


class _Payloads(NamedTuple):
    """The payloads of messages in one layout, one after the other, and the size of each."""

    size: int
    data: bytes

    def at(self, index: int) -> bytes:
        return self.data[index * self.size : (index + 1) * self.size]


_Stream = tuple[Address, Provenance]


class RecordingWriter(AbstractContextManager["RecordingWriter"]):
    """Write messages to a new MCAP file; a context manager that finishes the file on exit.

    Each combination of address, definition and provenance has its own channel. Its layout is the current one; if no
    PX4 release has all its fields, the layout with exactly the fields that the source provides is preferred.
    PX4's log messages are duplicated as ROS 2's Log on `/<vehicle>/log`, for Foxglove's Log panel.
    `chunk_size`: bytes per chunk before compression; a flipped bit costs one chunk. `boot_utc`: Unix time of the
    vehicle's boot [us], for `utc_of` if the messages do not provide it. `starts`: when the recording of each vehicle
    began, on the clock of its timestamps [us]; older messages are from before.

    `omitted`: messages left out beyond 1,000 channels of their vehicle, or beyond those of a file.

    Raises OutputError if the file exists, is deleted while open, or cannot be written; flushed messages stay readable.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        chunk_size: int = _CHUNK,
        boot_utc: int = 0,
        starts: Mapping[str, int] | None = None,
    ) -> None:
        self.path = Path(path)
        self._boot_utc = boot_utc
        self._starts = starts or {}
        self.messages = 0
        self.omitted = 0
        with _writing(self.path):
            self._file = _AppendFile(self.path)
        # Large chunks: the writer keeps an index per chunk and channel in memory.
        self._writer = Writer(cast("IO[bytes]", self._file), chunk_size=chunk_size)
        self._writer.start(profile="ros2", library="nedbus")
        try:
            self.flush()
            with _writing(self.path):
                sync_folder(self.path)
        except OutputError:
            self._file.raw.close()
            self.path.unlink(missing_ok=True)
            raise
        self._schemas: dict[tuple[str, str], int] = {}  # by type and text
        self._channels: dict[Definition[Any], dict[_Stream, _Channel]] = {}
        self._numbers: Counter[str] = Counter()  # of channels, by vehicle
        self._log_channels = dict[str, int]()  # by vehicle; RecordingReader ignores these

    def write(
        self,
        messages: MessageArray,
        definition: Definition[Any],
        streams: Iterable[_Stream],
        *,
        logged: Iterable[int],
        published: Iterable[int],
        sequence: Iterable[int] = repeat(0),
    ) -> None:
        """Write messages of one type, each with its stream, log and publish time [ns], and sequence number."""
        times = map(_Times, logged, published, sequence)
        self._add(self._encode(messages, definition, streams, times))

    def write_messages(self, messages: Iterable[tuple[Message, Address, Provenance, int]]) -> None:
        """Write messages of any types, each with address, provenance and log time [ns], sorted by log time.

        The publish time of a message is its timestamp.
        """
        by_definition: dict[Definition[Any], list[_Logged]] = {}
        for given in messages:
            logged = _Logged(*given)
            by_definition.setdefault(logged.message.DEFINITION, []).append(logged)
        encoded: list[_Encoded] = []
        for definition, own in by_definition.items():
            array = arrays_of(definition).of([logged.message for logged in own])
            streams = ((logged.address, logged.provenance) for logged in own)
            encoded += self._encode(array, definition, streams, map(_times_of, own))
        self._add(sorted(encoded, key=attrgetter("logged")))  # a replay reads the file sequentially

    def _encode(
        self,
        messages: MessageArray,
        definition: Definition[Any],
        streams: Iterable[_Stream],
        times: Iterable[_Times],
    ) -> Iterator[_Encoded]:
        codec = arrays_of(definition)
        payloads: dict[Layout, _Payloads] = {}
        channels = self._channels.setdefault(definition, {})
        for index, stream, time in zip(range(len(messages)), streams, times, strict=False):
            channel = channels.get(stream) or self._new_channel(definition, *stream)
            if channel is None:
                self.omitted += 1
                continue
            layout = channel.layout
            if layout not in payloads:
                records = codec.encode_cdr(messages, layout)
                payloads[layout] = _Payloads(records.itemsize, records.tobytes())
            payload = payloads[layout].at(index)
            number = max(0, time.number) % 2**32
            yield _Encoded(time.logged, channel.number, payload, time.published, number)
            self.messages += 1
            if definition is LogMessage.DEFINITION:
                text: Any = codec.to_message(messages[index])
                yield self._encode_log(stream[0].vehicle, text, time)

    def _encode_log(self, vehicle: str, message: LogMessage, time: _Times) -> _Encoded:
        """Return a log message for the log channel of its vehicle."""
        if vehicle not in self._log_channels:
            channel = self._register(f"/{vehicle}/log", _LOG_TYPE, _LOG_DEFINITION, {})
            self._log_channels[vehicle] = channel
        payload = _log_payload(vehicle, message, time.logged)
        return _Encoded(time.logged, self._log_channels[vehicle], payload, time.published, 0)

    def _add(self, encoded: Iterable[_Encoded]) -> None:
        with _writing(self.path):
            for logged, channel, payload, published, number in encoded:
                self._writer.add_message(channel, logged, payload, published, number)

    def flush(self) -> None:
        """Sync all messages written so far to disk."""
        with _writing(self.path):
            self._writer.flush()
            self._file.sync()

    def close(self) -> None:
        """Finish the file; a second call does nothing."""
        if self._file.raw.closed:
            return
        with closing(self._file.raw), _writing(self.path):
            self._writer.finish()
            self._file.sync(end=b"")

    def __exit__(self, *exc: object) -> None:
        if isinstance(exc[1], OutputError):
            self._file.raw.close()  # finishing the file would fail again
        else:
            self.close()

    def _new_channel(
        self, definition: Definition[Any], address: Address, provenance: Provenance
    ) -> _Channel | None:
        """Return a new channel, None beyond the limit of a vehicle or of the file."""
        vehicle = address.vehicle
        is_vehicle_full = self._numbers[vehicle] >= limits.CHANNELS_OF_VEHICLE
        if is_vehicle_full or self._numbers.total() >= limits.CHANNELS:
            if not self.omitted:
                self._warn_of_omission(address)
            return None
        self._numbers[vehicle] += 1
        layout = definition.recorded_layout(definition.all_fields - provenance.missing)
        number = self._register(
            f"/{address}",
            ros2_type(definition),
            definition_text(definition, layout),
            self._metadata(address, provenance),
        )
        channel = _Channel(number, layout)
        self._channels[definition][address, provenance] = channel
        return channel

    def _warn_of_omission(self, address: Address) -> None:
        text = "%s: not recording some messages of vehicle %s, which has more than %d topics and provenances"
        extra = about("incomplete", address)
        _log.warning(text, self.path, address.vehicle, limits.CHANNELS_OF_VEHICLE, extra=extra)

    def _metadata(self, address: Address, provenance: Provenance) -> dict[str, str]:
        """Return what a channel says about its messages."""
        instance = ""
        if address.instance is not None:
            instance = str(address.instance)
        metadata = {
            "vehicle": address.vehicle,
            "topic": address.topic,
            "instance": instance,
            "source": provenance.source or "",
            "boot_time_utc_us": str(self._boot_utc or ""),
            "start_time_us": str(self._starts.get(address.vehicle, "")),
            "missing": " ".join(sorted(provenance.missing)),
        }
        return {name: value for name, value in metadata.items() if value}

    def _register(
        self,
        topic: str,
        name: str,
        text: str,
        metadata: dict[str, str],
    ) -> int:
        schema = self._schemas.get((name, text))
        if schema is None:
            schema = self._writer.register_schema(name, "ros2msg", text.encode())
            self._schemas[name, text] = schema
        return self._writer.register_channel(topic, "cdr", schema, {_ROS2: "", **metadata})


def _times_of(logged: _Logged) -> _Times:
    published = logged.message.timestamp * 1000
    return _Times(logged.logged, min(published, _LATEST))


def _log_payload(vehicle: str, message: LogMessage, time_ns: int) -> bytes:
    """Encode a vehicle's log message as the CDR payload of _LOG_TYPE."""
    seconds = min(time_ns // 10**9, 2**31 - 1)
    body = struct.pack("<iIB", seconds, time_ns % 10**9, _LOG_LEVELS[message.severity])
    for part in (vehicle, message.text, "", ""):
        data = part.encode() + b"\0"
        body += bytes(-len(body) % 4) + struct.pack("<I", len(data)) + data
    return b"\0\1\0\0" + body + bytes(-len(body) % 4 + 4)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as exc:
        raise OutputError(path, exc) from exc


class _AppendFile:
    """An append-only file for the MCAP writer; after each `sync` it ends with a valid footer."""

    def __init__(self, path: Path) -> None:
        self.raw = path.open("xb", buffering=0)
        self._pending = bytearray()
        self._offset = 0

    def write(self, data: bytes) -> int:
        self._pending += data
        if len(self._pending) > limits.PENDING_BYTES:
            self.sync()
        return len(data)

    def tell(self) -> int:
        return self._offset + len(self._pending)

    def flush(self) -> None:
        """Do nothing; `sync` writes to disk."""

    def sync(self, end: bytes = _END) -> None:
        """Write the pending data and a footer to disk; restore the previous footer if that fails."""
        pending = bytes(self._pending)
        self._pending.clear()
        try:
            self._write_at_offset(pending + end)
            self.raw.truncate(self._offset + len(pending) + len(end))
        except OSError:
            self.raw.truncate(self._offset)
            self._write_at_offset(_END)
            raise
        os.fsync(self.raw.fileno())
        self._offset += len(pending)
        if not os.fstat(self.raw.fileno()).st_nlink:
            raise OSError(errno.ESTALE, "the file was deleted while it was being written")

    def _write_at_offset(self, data: bytes) -> None:
        rest = memoryview(data)
        offset = self._offset
        while rest:
            written = os.pwrite(self.raw.fileno(), rest, offset)
            offset += written
            rest = rest[written:]
