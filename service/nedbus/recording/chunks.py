"""The records of an MCAP file, chunk by chunk, each checked by its CRC; what is damaged is left out and reported.

The summary, which has a CRC of its own, says where the chunks are; without one the records are followed one by one.
Chunks are unpacked into bounded memory: the `mcap` package's own readers would fill it, and stop at the first damage.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import Any, Final, NamedTuple
from zlib import crc32

from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Schema, Statistics
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdDecompressor, ZstdError, frame_content_size

from nedbus.errors import SourceError

from .flight_files import open_flight

READ_ERRORS: Final = (McapError, ValueError, struct.error, ZstdError, MemoryError, OverflowError, RuntimeError)
"""The errors of the mcap package and the decompressors for a damaged file."""

_RECORD_HEAD: Final = struct.Struct("<BQ")  # opcode, length
_CHUNK_HEAD: Final = struct.Struct("<QQQII")  # times, size and CRC of its records, length of its compression's name
_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")  # channel, sequence, times
_FOOTER: Final = struct.Struct("<QQI")
_DESCRIPTIONS: Final[dict[int, Any]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.STATISTICS: Statistics,
}
_MAX_SMALL_CHUNK: Final = 2**26  # bytes that any chunk may unpack to: ROS 2 writes 768 kB, nedbus 8 MiB and a message
_MAX_CHUNK: Final = 2**30  # bytes that a chunk may unpack to
_MAX_RATIO: Final = 100  # to which a chunk that is not small may be compressed
_MAX_WARNINGS: Final = 100
_ZSTD: Final = b"\x04\x00\x00\x00zstd"  # in every chunk of ours
_SEARCH_BYTES: Final = 2**20  # that are searched at a time
_EPOCH: Final = 10**17  # ns: a later time is a date, an earlier one counts from a vehicle's start


class _Place(NamedTuple):
    """The place of a record; `number` counts the chunks from 1, `times` are those of its messages [ns]."""

    opcode: int
    offset: int
    end: int
    number: int = 0
    times: tuple[int, int] = (0, 0)


class ChunkFile:
    """An MCAP file that is open for reading.

    `summary` is None where there is none, or where it is damaged.
    `warnings` say what is damaged; `damaged` is whether that cost messages, as far as the file was read.

    Raises SourceError for a file that is not MCAP or cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.warnings: list[str] = []
        self.damaged = False
        self._file = open_flight(path)
        self.close = self._file.close
        self._size = os.fstat(self._file.fileno()).st_size
        if self._read(0, len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            self.close()
            raise SourceError(str(path), "not a readable MCAP file")
        self.summary = self._read_summary()

    def parts(self, only: Collection[int] | None = None) -> Iterator[bytes]:
        """Yield the records of each chunk that is whole, in the order of the file.

        With `only`, chunks in which none of these channels occurs may be left out.
        """
        for place in self._indexed(only) if self.summary and self.summary.chunk_indexes else self._follow():
            record = self._read(place.offset, place.end - place.offset)
            try:
                yield _unpack_chunk(record) if place.opcode == Opcode.CHUNK else record
            except READ_ERRORS:
                count = self._count_messages(place.end, only)
                what = f"chunk {place.number} ({_show_times(*place.times)})" if place.number else "a record"
                lost = "its messages are" if count is None else f"its {count} messages are"
                self.warn(f"{what} at byte {place.offset} is damaged: {lost} left out", lost=count != 0)

    def warn(self, warning: str, *, lost: bool = False) -> None:
        """Report something once; `lost` if it cost messages."""
        self.damaged |= lost
        if len(self.warnings) <= _MAX_WARNINGS and warning not in self.warnings:
            self.warnings.append(warning if len(self.warnings) < _MAX_WARNINGS else "there is more damage")

    def _read(self, start: int, size: int) -> bytes:
        self._file.seek(start)
        return self._file.read(size)

    def _read_summary(self) -> Summary | None:
        """Return the summary if it is whole."""
        end = self._size - _RECORD_HEAD.size - _FOOTER.size - len(MCAP0_MAGIC)
        opcode, after = self._read_head(end) if end > 0 else (0, 0)
        if opcode != Opcode.FOOTER or not self._is_plausible(opcode, end, after):
            return None
        start, _, checksum = _FOOTER.unpack(self._read(end + _RECORD_HEAD.size, _FOOTER.size))
        if not len(MCAP0_MAGIC) <= start <= end:
            return None
        try:
            if checksum and crc32(self._read(start, after - 4 - start)) != checksum:
                raise ValueError(checksum)
            return _parse_summary(self._read(start, end - start), start)
        except READ_ERRORS:
            self.warn("its index is damaged: it is read without")
            return None

    def _indexed(self, only: Collection[int] | None) -> Iterator[_Place]:
        """Yield the chunks that the summary lists."""
        for number, index in enumerate(self.summary.chunk_indexes if self.summary else (), 1):
            channels = index.message_index_offsets.keys()  # a chunk that lists none may have any
            if only is None or not channels or not channels.isdisjoint(only):
                start, times = index.chunk_start_offset, (index.message_start_time, index.message_end_time)
                yield _Place(Opcode.CHUNK, start, start + index.chunk_length, number, times)

    def _follow(self) -> Iterator[_Place]:
        """Yield each chunk, and each schema, channel and message outside of chunks, from one record to the next."""
        offset, number, after_chunk = len(MCAP0_MAGIC), 0, False
        while True:
            opcode, end = self._read_head(offset)
            if not self._is_plausible(opcode, offset, end):
                found = self._find_chunk(offset + 1)
                lost = f"bytes {offset} to {found}" if found else f"everything from byte {offset} of {self._size} on"
                self.warn(f"cut or damaged: {lost} is left out", lost=True)
                if found is None:
                    return
                offset = found
                continue
            if opcode in {Opcode.DATA_END, Opcode.FOOTER}:
                return
            if opcode == Opcode.MESSAGE_INDEX and not after_chunk:
                self.warn(f"damaged: the chunk before byte {offset} is left out", lost=True)
            after_chunk = opcode == Opcode.CHUNK or (after_chunk and opcode == Opcode.MESSAGE_INDEX)
            if opcode == Opcode.CHUNK:
                number += 1
                start_time, end_time, *_ = _CHUNK_HEAD.unpack(self._read(offset + _RECORD_HEAD.size, _CHUNK_HEAD.size))
                yield _Place(opcode, offset, end, number, (start_time, end_time))
            elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}:
                yield _Place(opcode, offset, end)
            offset = end

    def _read_head(self, offset: int) -> tuple[int, int]:
        """Return the opcode of a record, 0 at the end of the file, and where the record ends."""
        head = self._read(offset, _RECORD_HEAD.size)
        if len(head) < _RECORD_HEAD.size:
            return 0, offset
        opcode, length = _RECORD_HEAD.unpack(head)
        return opcode, offset + _RECORD_HEAD.size + length

    def _is_plausible(self, opcode: int, offset: int, end: int) -> bool:
        """Return whether a record's length fits the file and what the record says of itself."""
        length = end - offset - _RECORD_HEAD.size
        if opcode == 0 or end > self._size:
            return False
        if opcode == Opcode.DATA_END:
            return length == 4
        if opcode == Opcode.FOOTER:
            return length == _FOOTER.size and self._read(end, len(MCAP0_MAGIC) + 1) == MCAP0_MAGIC
        body = self._read(offset + _RECORD_HEAD.size, min(length, 64))
        if opcode == Opcode.MESSAGE_INDEX:
            return length >= 6 and struct.unpack_from("<I", body, 2) == (length - 6,)
        return opcode != Opcode.CHUNK or _chunk_length(body) == length

    def _find_chunk(self, start: int) -> int | None:
        """Return the offset of the next chunk of a recording of ours, None if there is none."""
        before = _RECORD_HEAD.size + _CHUNK_HEAD.size - 4  # bytes of a chunk before the name of its compression
        while block := self._read(start, _SEARCH_BYTES):
            found = block.find(_ZSTD)
            if found < 0:
                start += max(1, len(block) - len(_ZSTD) + 1)
                continue
            offset = start + found - before
            opcode, end = self._read_head(offset) if offset > 0 else (0, 0)
            if opcode == Opcode.CHUNK and self._is_plausible(opcode, offset, end):
                return offset
            start += found + 1
        return None

    def _count_messages(self, end: int, only: Collection[int] | None) -> int | None:
        """Return the number of messages that the indexes behind a chunk list, None where there are none."""
        count, listed = 0, False
        opcode, after = self._read_head(end)
        while opcode == Opcode.MESSAGE_INDEX and self._is_plausible(opcode, end, after):
            [channel] = struct.unpack("<H", self._read(end + _RECORD_HEAD.size, 2))
            listed = True
            if only is None or channel in only:
                count += (after - end - _RECORD_HEAD.size - 6) // 16
            end = after
            opcode, after = self._read_head(end)
        return count if listed else None


def records_of(part: bytes) -> Iterator[McapRecord]:
    """Yield the records of a part of a file that describe or hold messages; raise one of READ_ERRORS at damage."""
    offset = 0
    while offset < len(part):
        opcode, length = _RECORD_HEAD.unpack_from(part, offset)
        start = offset + _RECORD_HEAD.size
        offset = start + length
        if opcode == 0 or offset > len(part):  # no record has opcode 0
            raise ValueError(opcode)
        if opcode == Opcode.MESSAGE:
            channel, sequence, logged, published = _MESSAGE_HEAD.unpack_from(part, start)
            yield Message(channel, logged, part[start + _MESSAGE_HEAD.size : offset], published, sequence)
        elif opcode in _DESCRIPTIONS:
            yield _DESCRIPTIONS[opcode].read(ReadDataStream(BytesIO(part[start:offset])))


def _unpack_chunk(record: bytes) -> bytes:
    """Return the records of a chunk; raise one of READ_ERRORS if it is damaged, or would fill the memory."""
    body = record[_RECORD_HEAD.size :]
    if _RECORD_HEAD.unpack_from(record) != (Opcode.CHUNK, len(body)) or _chunk_length(body) != len(body):
        raise ValueError(len(body))
    chunk = Chunk.read(ReadDataStream(BytesIO(body)))
    size, packed = chunk.uncompressed_size, chunk.data
    if size > max(_MAX_SMALL_CHUNK, min(_MAX_CHUNK, _MAX_RATIO * len(packed))):
        raise ValueError(size)
    records: bytes = packed
    if chunk.compression == "zstd":
        if frame_content_size(packed) not in {-1, size}:
            raise ValueError(size)
        records = ZstdDecompressor().decompress(packed, max_output_size=size)
    elif chunk.compression == "lz4":
        records = LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    if len(records) != size or (chunk.uncompressed_crc and crc32(records) != chunk.uncompressed_crc):
        raise ValueError(size)
    return records


def _chunk_length(body: bytes) -> int | None:
    """Return the length of a chunk's record as the chunk's own fields have it."""
    if len(body) < _CHUNK_HEAD.size:
        return None
    *_, name_length = _CHUNK_HEAD.unpack_from(body)
    before: int = _CHUNK_HEAD.size + name_length + 8
    if name_length > 8 or len(body) < before:
        return None
    return before + int.from_bytes(body[before - 8 : before], "little")


def _parse_summary(data: bytes, start: int) -> Summary:
    """Return the summary that begins at `start`; raise ValueError if its chunks are not one after another before it."""
    summary = Summary()
    for record in records_of(data):
        if isinstance(record, Schema):
            summary.schemas[record.id] = record
        elif isinstance(record, Channel):
            summary.channels[record.id] = record
        elif isinstance(record, ChunkIndex):
            summary.chunk_indexes.append(record)
        elif isinstance(record, Statistics):
            summary.statistics = record
    summary.chunk_indexes.sort(key=lambda index: index.chunk_start_offset)
    starts = [index.chunk_start_offset for index in summary.chunk_indexes]
    ends = [index.chunk_start_offset + index.chunk_length for index in summary.chunk_indexes]
    if any(end > begin for begin, end in zip([*starts, start], [len(MCAP0_MAGIC), *ends], strict=True)):
        raise ValueError(start)
    return summary


def _show_times(start: int, end: int) -> str:
    if start < _EPOCH:
        return f"{start / 1e9:.1f} to {end / 1e9:.1f} s"
    first, last = (datetime.fromtimestamp(time / 1e9, UTC) for time in (start, end))
    return f"{first:%Y-%m-%d %H:%M:%S} to {last:%H:%M:%S} UTC"
