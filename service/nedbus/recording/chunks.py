"""Read the records of an MCAP file chunk by chunk; leave out and report damaged parts.

The summary, which has a CRC of its own, lists the chunks; without one the records are followed one by one.
Chunks are unpacked into bounded memory: the readers of the `mcap` package have no limit, and stop at the first damage.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator
from datetime import UTC, datetime
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any, Final
from zlib import crc32

from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Schema, Statistics
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdDecompressor, ZstdError, frame_content_size

from nedbus.errors import SourceError

from .flight_files import open_flight

READ_ERRORS: Final = (McapError, ValueError, struct.error, ZstdError, MemoryError, OverflowError, RuntimeError)
"""The errors of the mcap package and the decompressors for a damaged file."""

_RECORD_HEAD: Final = struct.Struct("<BQ")  # opcode, length
_CHUNK_HEAD: Final = struct.Struct("<QQQII")  # times, size and CRC of its records, length of its compression's name
_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")  # channel, sequence, times
_FOOTER: Final = struct.Struct("<BQQQI8s")  # opcode, length, begin of the summary and of its offsets, CRC, magic
_LENGTHS: Final[dict[int, int]] = {Opcode.DATA_END: 4, Opcode.FOOTER: 20}
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
_EPOCH: Final = 10**17  # ns: a later time is a date, an earlier one counts from a vehicle's start

_Place = tuple[int, int, int]  # a record: its opcode, its offset, and the offset of the next one


class ChunkFile:
    """An MCAP file that is open for reading.

    `summary`: the schemas, channels, chunk indexes and statistics of the summary; empty without one, or if damaged.
    `warnings`: the damage found so far; `damaged`: True if it cost messages.

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
        self._chunks: list[ChunkIndex] = []
        self.summary: list[McapRecord] = []
        try:
            self._read_summary()
        except READ_ERRORS:
            self.warn("its index is damaged: it is read without")

    def parts(self, only: Collection[int] | None = None) -> Iterator[bytes]:
        """Yield the records of each chunk that is whole, in the order of the file.

        With `only`, chunks in which none of these channels occurs may be left out.
        """
        for opcode, offset, end in self._indexed(only) if self._chunks else self._follow():
            record = self._read(offset, end - offset)
            try:
                yield _unpack_chunk(record) if opcode == Opcode.CHUNK else record
            except READ_ERRORS:
                self.warn(f"the chunk {_describe(record, offset)} is damaged: its messages are left out", lost=True)

    def warn(self, warning: str, *, lost: bool = False) -> None:
        """Report something once; `lost` if it cost messages."""
        self.damaged |= lost
        if len(self.warnings) <= _MAX_WARNINGS and warning not in self.warnings:
            self.warnings.append(warning if len(self.warnings) < _MAX_WARNINGS else "there is more damage")

    def _read(self, start: int, size: int) -> bytes:
        self._file.seek(start)
        return self._file.read(size)

    def _read_summary(self) -> None:
        """Read the summary if there is one; raise one of READ_ERRORS if it is damaged."""
        end = self._size - _FOOTER.size
        if end < len(MCAP0_MAGIC):
            return
        opcode, length, start, _, checksum, magic = _FOOTER.unpack(self._read(end, _FOOTER.size))
        if (opcode, length, magic) != (Opcode.FOOTER, _LENGTHS[Opcode.FOOTER], MCAP0_MAGIC) or not start:
            return
        if not len(MCAP0_MAGIC) <= start <= end:
            raise ValueError(start)
        crc_offset = self._size - len(MCAP0_MAGIC) - 4
        if checksum and crc32(self._read(start, crc_offset - start)) != checksum:
            raise ValueError(checksum)
        records = list(records_of(self._read(start, end - start)))
        chunks = [record for record in records if isinstance(record, ChunkIndex)]
        chunks.sort(key=lambda chunk: chunk.chunk_start_offset)
        places = [(chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length) for chunk in chunks]
        edges = [(0, len(MCAP0_MAGIC)), *places, (start, start)]
        if any(end > begin for (_, end), (begin, _) in pairwise(edges)):
            raise ValueError(places)
        self._chunks, self.summary = chunks, records

    def _indexed(self, only: Collection[int] | None) -> Iterator[_Place]:
        """Yield the chunks that the summary lists."""
        for chunk in self._chunks:
            channels = chunk.message_index_offsets.keys()  # a chunk that lists none may have any
            if only is None or not channels or not channels.isdisjoint(only):
                yield Opcode.CHUNK, chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length

    def _follow(self) -> Iterator[_Place]:
        """Yield each chunk, and each schema, channel and message outside of chunks, from one record to the next."""
        offset, after_chunk = len(MCAP0_MAGIC), False
        while True:
            begin = self._read(offset, _RECORD_HEAD.size + 64)
            opcode, length = _RECORD_HEAD.unpack_from(begin) if len(begin) >= _RECORD_HEAD.size else (0, 0)
            end = offset + _RECORD_HEAD.size + length
            own_length = _own_length(opcode, begin[_RECORD_HEAD.size :])
            if opcode == 0 or end > self._size or own_length not in (None, length):
                self.warn(f"cut or damaged: all from byte {offset} of {self._size} on is left out", lost=True)
                return
            if opcode in _LENGTHS:
                return
            if opcode == Opcode.MESSAGE_INDEX and not after_chunk:
                self.warn(f"damaged: the chunk before byte {offset} is left out", lost=True)
            after_chunk = opcode == Opcode.CHUNK or (after_chunk and opcode == Opcode.MESSAGE_INDEX)
            if opcode in {Opcode.CHUNK, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}:
                yield opcode, offset, end
            offset = end


def _own_length(opcode: int, body: bytes) -> int | None:
    """Return the length of a record by its own first fields, None for a kind without such fields."""
    if opcode == Opcode.MESSAGE_INDEX:
        return 6 + int.from_bytes(body[2:6], "little")
    if opcode == Opcode.CHUNK:
        before = _CHUNK_HEAD.size + int.from_bytes(body[_CHUNK_HEAD.size - 4 : _CHUNK_HEAD.size], "little")
        return before + 8 + int.from_bytes(body[before : before + 8], "little")
    return _LENGTHS.get(opcode)


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
    body = ReadDataStream(BytesIO(record[_RECORD_HEAD.size :]))
    chunk = Chunk.read(body)
    if _RECORD_HEAD.unpack_from(record) != (Opcode.CHUNK, body.count):  # zeros would be an empty chunk
        raise ValueError(len(record))
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


def _describe(chunk: bytes, offset: int) -> str:
    """Return the place of a chunk in its file, and the times of its messages."""
    if len(chunk) < _RECORD_HEAD.size + _CHUNK_HEAD.size:
        return f"at byte {offset}"
    start, end, *_ = _CHUNK_HEAD.unpack_from(chunk, _RECORD_HEAD.size)
    if start < _EPOCH:
        return f"at byte {offset} ({start / 1e9:.1f} to {end / 1e9:.1f} s)"
    first, last = (datetime.fromtimestamp(time / 1e9, UTC) for time in (start, end))
    return f"at byte {offset} ({first:%Y-%m-%d %H:%M:%S} to {last:%H:%M:%S} UTC)"
