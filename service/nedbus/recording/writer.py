"""Write MCAP files that Foxglove, PlotJuggler and any MCAP reader open: CDR messages with their definition.

A file is complete from the beginning and after every flush: its end is written behind the last chunk, and overwritten
by the next one. So a power cut costs the messages since the last flush, and never the file.
"""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from itertools import repeat
from operator import itemgetter
from pathlib import Path
from typing import IO, Any, Final, Self, cast

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC, Writer

from nedbus.errors import OutputError
from nedbus_msgs import Address, Definition, Layout, Message, Provenance, definition_text, ros2_type
from nedbus_msgs.arrays import MessageArray, arrays_of

_CHUNK: Final = 2**23  # bytes; a flush every second makes smaller ones
_MAX_PENDING_BYTES: Final = 2**24  # that wait for a flush
_MAX_TIME: Final = 2**64 - 1  # ns: a damaged log may have any timestamp
_END: Final = (
    struct.pack("<BQI", Opcode.DATA_END, 4, 0) + struct.pack("<BQQQI", Opcode.FOOTER, 20, 0, 0, 0) + MCAP0_MAGIC
)

_Encoded = tuple[int, int, bytes, int, int]  # time of recording [ns], channel, payload, time of publication, number


class RecordingWriter:
    """Write messages to a new MCAP file; a context manager that finishes it.

    There is one channel for each address and provenance, in the current layout of its message, or in that of PX4 which
    has just the fields that its source provides, where no layout of PX4 has all.
    Damage of one bit costs a chunk, of up to `chunk_size` bytes before compression.

    Raises OutputError when the file exists already, was deleted meanwhile, or cannot be written; messages that were
    flushed can still be read.
    """

    def __init__(self, path: str | Path, *, chunk_size: int = _CHUNK) -> None:
        self.path = Path(path)
        self.messages = 0
        with _writing(self.path):
            self._file = _AppendFile(self.path)
        # Chunks as large as a flush allows: the writer keeps an index of each, with a line for every channel.
        self._writer = Writer(cast("IO[bytes]", self._file), chunk_size=chunk_size)
        self._writer.start(profile="ros2", library="nedbus")
        try:
            self.flush()
        except OutputError:
            self._file.close()
            self.path.unlink(missing_ok=True)
            raise
        self._schemas: dict[tuple[str, str], int] = {}  # by message and layout
        self._channels: dict[tuple[Address, Provenance], tuple[int, Layout]] = {}

    def write(
        self,
        messages: MessageArray,
        definition: Definition[Any],
        streams: Iterable[tuple[Address, Provenance]],
        *,
        logged: Iterable[int],
        published: Iterable[int],
        sequence: Iterable[int] = repeat(0),
    ) -> None:
        """Write messages of one kind, each with its address and provenance, when it was recorded and published [ns]."""
        self._add(self._encode(messages, definition, streams, zip(logged, published, sequence, strict=False)))

    def write_messages(self, messages: Iterable[tuple[Message, Address, Provenance, int]]) -> None:
        """Write messages of any kinds, each with address, provenance and when it was recorded [ns], in that order.

        A message was published at its own timestamp.
        """
        by_kind: dict[Definition[Any], list[tuple[Message, Address, Provenance, int]]] = {}
        for each in messages:
            by_kind.setdefault(each[0].DEFINITION, []).append(each)
        encoded: list[_Encoded] = []
        for definition, own in by_kind.items():
            array = arrays_of(definition).of([message for message, *_ in own])
            streams = ((address, provenance) for _, address, provenance, _ in own)
            times = ((logged, min(message.timestamp * 1000, _MAX_TIME), 0) for message, *_, logged in own)
            encoded += self._encode(array, definition, streams, times)
        self._add(sorted(encoded, key=itemgetter(0)))  # a replay reads the file from begin to end

    def _encode(
        self,
        messages: MessageArray,
        definition: Definition[Any],
        streams: Iterable[tuple[Address, Provenance]],
        times: Iterable[tuple[int, int, int]],
    ) -> Iterator[_Encoded]:
        encoded: dict[Layout, tuple[int, bytes]] = {}  # size of a payload, and all payloads
        for index, stream, (logged, published, number) in zip(range(len(messages)), streams, times, strict=False):
            channel, layout = self._channels.get(stream) or self._open_channel(definition, *stream)
            if layout not in encoded:
                payloads = arrays_of(definition).encode_cdr(messages, layout)
                encoded[layout] = payloads.itemsize, payloads.tobytes()
            size, data = encoded[layout]
            yield logged, channel, data[index * size : (index + 1) * size], published, max(0, number) % 2**32

    def _add(self, encoded: Iterable[_Encoded]) -> None:
        with _writing(self.path):
            for logged, channel, data, published, number in encoded:
                self._writer.add_message(channel, logged, data, published, number)
                self.messages += 1

    def flush(self) -> None:
        """Sync everything to the disk, so that a power cut loses none of it."""
        with _writing(self.path):
            self._writer.flush()
            self._file.sync()

    def close(self) -> None:
        """Finish the file; a second call does nothing."""
        if self._file.closed:
            return
        with closing(self._file), _writing(self.path):
            self._writer.finish()
            self._file.sync(end=b"")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        if isinstance(exc[1], OutputError):
            self._file.close()  # finishing it would fail again
        else:
            self.close()

    def _open_channel(
        self, definition: Definition[Any], address: Address, provenance: Provenance
    ) -> tuple[int, Layout]:
        layout = definition.recorded_layout(definition.all_fields - provenance.missing)
        schema = self._schemas.get((definition.name, layout.name))
        if schema is None:
            text = definition_text(definition, layout).encode()
            schema = self._writer.register_schema(ros2_type(definition), "ros2msg", text)
            self._schemas[definition.name, layout.name] = schema
        # ROS 2 tools recognise their bags by the first key.
        metadata = {"offered_qos_profiles": "", "vehicle": address.vehicle, "topic": address.topic}
        if address.instance is not None:
            metadata["instance"] = str(address.instance)
        if provenance.source is not None:
            metadata["source"] = provenance.source
        if provenance.missing:
            metadata["missing"] = " ".join(sorted(provenance.missing))
        channel = self._writer.register_channel(f"/{address}", "cdr", schema, metadata)
        self._channels[address, provenance] = channel, layout
        return channel, layout


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Raise OutputError for an OSError in the block."""
    try:
        yield
    except OSError as exc:
        raise OutputError(path, exc) from exc


class _AppendFile:
    """A file for the MCAP writer that has a valid end after each `sync`."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("xb", buffering=0)
        self._pending = bytearray()
        self._offset = 0
        self.closed = False

    def write(self, data: bytes) -> int:
        self._pending += data
        if len(self._pending) > _MAX_PENDING_BYTES:
            self.sync()
        return len(data)

    def tell(self) -> int:
        return self._offset + len(self._pending)

    def flush(self) -> None:
        """Do nothing: `sync` writes to the disk."""

    def sync(self, end: bytes = _END) -> None:
        """Write the pending data and an end behind it to the disk; restore the previous end if that fails."""
        pending = bytes(self._pending)
        self._pending.clear()
        try:
            self._write_at_offset(pending + end)
            self._file.truncate(self._offset + len(pending) + len(end))
        except OSError:
            self._file.truncate(self._offset)
            self._write_at_offset(_END)
            raise
        os.fsync(self._file.fileno())
        self._offset += len(pending)
        if not os.fstat(self._file.fileno()).st_nlink:
            raise OSError(errno.ESTALE, "it was deleted while it was written")

    def _write_at_offset(self, data: bytes) -> None:
        rest = memoryview(data)
        while rest:
            rest = rest[os.pwrite(self._file.fileno(), rest, self._offset + len(data) - len(rest)) :]

    def close(self) -> None:
        self.closed = True
        self._file.close()
