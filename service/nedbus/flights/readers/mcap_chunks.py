"""MCAP file reader that reads chunk by chunk, and skips and reports damaged parts.

The summary, which has its own CRC, lists the chunks; without it, and in files of a library whose indexes may lack
messages, the records are scanned one by one. Decompression
uses bounded memory. The readers of the `mcap` package have no limit and stop at the first damage.
"""

from __future__ import annotations

import os
import struct
from array import array
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, BinaryIO, Final, NamedTuple
from zlib import crc32

from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    Header,
    McapRecord,
    Message,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdDecompressor, ZstdError, frame_content_size

from nedbus import limits
from nedbus.errors import SourceError
from nedbus.timeline import utc_text

from .formats import open_file

READ_ERRORS: Final = (
    McapError,
    ValueError,
    struct.error,
    ZstdError,
    MemoryError,
    OverflowError,
    RuntimeError,
)
"""Errors that the mcap package and the decompressors raise for a damaged file."""

ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"
_RECORD_HEAD: Final = struct.Struct("<BQ")  # opcode, length
# bytes that may follow a record's known fields: too few for another record
_SURPLUS: Final = range(_RECORD_HEAD.size)
# start, end, uncompressed size, CRC, length of the compression name
_CHUNK_HEAD: Final = struct.Struct("<QQQII")
_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")  # channel, sequence, times
# opcode, length, start of summary and summary offsets, CRC, magic
_FOOTER: Final = struct.Struct("<BQQQI8s")
# of a recording without an index: a DataEnd record, the footer and the magic
_END_BYTES: Final = 13 + _FOOTER.size
# pymcap-cli 0.34.0 `recover`: a chunk keeps the part of its indexes that was left, which lacks the messages of other
# channels; the statistics lack them as well
_PARTIAL_INDEXES: Final = "pymcap-cli"
_HEADER_BYTES: Final = 1000  # a longer header is not one of that library
_LENGTHS: Final[dict[int, int]] = {Opcode.DATA_END: 4, Opcode.FOOTER: 20}
_DESCRIPTIONS: Final[dict[int, Any]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.STATISTICS: Statistics,
}


class _IndexedChunk(NamedTuple):
    """Place of a chunk in the file, and its channels."""

    start: int
    end: int
    channels: Collection[int]


class _Place(NamedTuple):
    """A record in the file."""

    opcode: int
    begin: int
    end: int


def _place_of(index: ChunkIndex) -> _IndexedChunk:
    start = index.chunk_start_offset
    return _IndexedChunk(start, start + index.chunk_length, array("H", index.message_index_offsets))


class ChunkFile:
    """An MCAP file open for reading.

    `summary`: records with schemas, channels and statistics; empty if it is absent or damaged.
    `warnings`: the damage found so far; `damaged`: True if any of it cost messages.
    `size`: bytes of the file; `position`: bytes read so far.

    Raises SourceError if the file is not MCAP or cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.warnings: list[str] = []
        self.damaged = False
        self.position = 0
        self._file = open_file(path)
        if self._read(0, len(ZSTD_MAGIC)) == ZSTD_MAGIC:
            self._file = self._decompress(self._file)
        self.close = self._file.close
        self.size = os.fstat(self._file.fileno()).st_size
        if self._read(0, len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            self.close()
            raise SourceError(str(path), "; ".join(["not a readable MCAP file", *self.warnings]))
        self._chunks: list[_IndexedChunk] = []
        self._end = 0  # of the data, before the summary
        self.summary = b""
        if not self._library().startswith(_PARTIAL_INDEXES):
            try:
                self._read_summary()
            except READ_ERRORS:
                self.warn("the index is damaged; reading without it")

    def blocks(self, only: Collection[int] | None = None) -> Iterator[bytes]:
        """Yield each intact chunk, decompressed, and each record outside chunks, in file order.

        `only`: channels of interest; chunks without any of them may be skipped.
        """
        unpacked = 0
        limit = max(limits.BLOCK_BYTES, limits.COMPRESSION * self.size)
        places = self._listed(only) if self._chunks else self._scan(len(MCAP0_MAGIC), self.size)
        for place in places:
            self.position = place.end
            size = place.end - place.begin
            if size > limits.BLOCK_BYTES:
                text = (
                    f"skipped {size} bytes from byte {place.begin},"
                    f" above the limit of {limits.BLOCK_BYTES} for a chunk"
                )
                self.warn(text, lost=True)
                continue
            record = self._read(place.begin, size)
            if place.opcode != Opcode.CHUNK:
                yield record
                continue
            unpacked += _claimed_size(record)
            if unpacked > limit:
                text = (
                    f"skipped the chunks from byte {place.begin}:"
                    f" all chunks together claim more than {limit} bytes"
                )
                self.warn(text, lost=True)
                return
            try:
                yield _unpack_chunk(record)
            except READ_ERRORS:
                where = _describe(record, place.begin)
                self.warn(f"the chunk {where} is damaged; its messages are skipped", lost=True)

    def _listed(self, only: Collection[int] | None) -> Iterator[_Place]:
        """Yield opcode, begin and end of the chunks in the index, and of what lies between and behind them."""
        begin = len(MCAP0_MAGIC)
        for start, end, channels in self._chunks:
            yield from self._scan(begin, start, is_listed=True)
            begin = end
            # A chunk that lists no channels may contain any.
            if only is None or not channels or not set(channels).isdisjoint(only):
                yield _Place(Opcode.CHUNK, start, end)
        yield from self._scan(begin, self._end, is_listed=True)

    def warn(self, warning: str, *, lost: bool = False) -> None:
        """Add a warning unless it is a duplicate; `lost`: the damage cost messages."""
        if lost:
            self.damaged = True
        text = warning[: limits.WARNING_TEXT]
        if text in self.warnings or len(self.warnings) > limits.FILE_WARNINGS:
            return
        if len(self.warnings) == limits.FILE_WARNINGS:
            text = "further damage is not listed"
        self.warnings.append(text)

    def _decompress(self, packed: BinaryIO) -> BinaryIO:
        """Return a temporary file with the decompressed contents, up to the first damage."""
        packed.seek(0)
        with packed, ExitStack() as on_error:
            unpacked = on_error.enter_context(TemporaryFile())
            limit = max(limits.BLOCK_BYTES, limits.COMPRESSION * os.fstat(packed.fileno()).st_size)
            try:
                for part in ZstdDecompressor().read_to_iter(packed):
                    unpacked.write(part)
                    if unpacked.tell() > limit:
                        raise ZstdError(f"more than {limit} bytes")
            except ZstdError as exc:
                self.warn(f"the compressed file is damaged ({exc})", lost=True)
            unpacked.flush()  # the size of the file counts what is written
            on_error.pop_all()
        return unpacked

    def _read(self, start: int, size: int) -> bytes:
        self._file.seek(start)
        return self._file.read(size)

    def _library(self) -> str:
        """Return the name of the library that wrote the file; "" if its header is damaged or too long."""
        begin = len(MCAP0_MAGIC)
        header = self._read(begin, _HEADER_BYTES)
        if header[:1] != bytes([Opcode.HEADER]):
            return ""
        try:
            return str(Header.read(ReadDataStream(BytesIO(header[_RECORD_HEAD.size :]))).library)
        except READ_ERRORS:
            return ""

    def _read_summary(self) -> None:
        """Read the summary if there is one; raise one of READ_ERRORS if it is damaged."""
        end = self.size - _FOOTER.size
        if end < len(MCAP0_MAGIC):
            return
        opcode, length, start, _, checksum, magic = _FOOTER.unpack(self._read(end, _FOOTER.size))
        is_footer = opcode == Opcode.FOOTER and length == _LENGTHS[Opcode.FOOTER]
        if not is_footer or magic != MCAP0_MAGIC or not start:
            return
        if not len(MCAP0_MAGIC) <= start <= end:
            raise ValueError(start)
        if end - start > limits.BLOCK_BYTES:
            self.warn(f"the index is larger than {limits.BLOCK_BYTES} bytes; reading without it")
            return
        summary = self._read(start, end - start)
        footer = self._read(end, _FOOTER.size - len(MCAP0_MAGIC) - 4)
        if checksum and crc32(footer, crc32(summary)) != checksum:
            raise ValueError(checksum)
        chunks = []
        for record in records_of(summary):
            # Only the place is kept: an index also lists the messages of each channel.
            if isinstance(record, ChunkIndex):
                chunks.append(_place_of(record))
        chunks.sort()
        previous = len(MCAP0_MAGIC)
        for chunk in chunks:
            if chunk.start < previous:
                raise ValueError(chunk.start)
            previous = chunk.end
        if start < previous:
            raise ValueError(start)
        self._chunks = chunks
        self._end = start
        self.summary = summary

    def _scan(self, offset: int, stop: int, *, is_listed: bool = False) -> Iterator[_Place]:
        """Scan a range; yield opcode, begin and end of chunks, and of schemas, channels and messages between them.

        `is_listed`: the range is between chunks of the index, where damage usually costs only copies of the index.
        """
        after_chunk = is_listed and offset > len(MCAP0_MAGIC)
        while not is_listed or offset < stop:
            record = self._head_at(offset)
            if record is None or record.end > stop:
                if not is_listed and not self._is_recorded_on(offset):
                    text = f"skipped truncated or damaged data from byte {offset} of {self.size} to the end"
                    self.warn(text, lost=True)
                return
            opcode = record.opcode
            if opcode in _LENGTHS:
                return
            # The message index after a chunk has no CRC: one flipped bit turns its opcode into that of a message.
            if after_chunk and opcode == Opcode.MESSAGE and record.may_be_index:
                opcode = Opcode.MESSAGE_INDEX
            if opcode == Opcode.MESSAGE_INDEX:
                if not after_chunk:
                    self.warn(f"skipped a damaged chunk before byte {offset}", lost=True)
            else:
                after_chunk = opcode == Opcode.CHUNK
            if opcode in {Opcode.CHUNK, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}:
                yield _Place(opcode, offset, record.end)
            offset = record.end

    def _is_recorded_on(self, offset: int) -> bool:
        """Return whether a recorder has replaced the end of the file, at this byte, since it was opened."""
        has_grown = os.fstat(self._file.fileno()).st_size > self.size
        return has_grown and self.size - offset == _END_BYTES

    def _head_at(self, offset: int) -> _Head | None:
        """Return the head of the record at this byte; None if it is damaged."""
        data = self._read(offset, _RECORD_HEAD.size + 64)
        if len(data) < _RECORD_HEAD.size:
            return None
        opcode, length = _RECORD_HEAD.unpack_from(data)
        body = data[_RECORD_HEAD.size :]
        surplus = length - _expected_length(opcode, body, length)
        if opcode == 0 or surplus not in _SURPLUS:
            return None
        return _Head(
            opcode,
            end=offset + _RECORD_HEAD.size + length,
            may_be_index=length == _expected_length(Opcode.MESSAGE_INDEX, body, length),
        )


class _Head(NamedTuple):
    """The head of a record; `may_be_index`: its length is that of a message index."""

    opcode: int
    end: int
    may_be_index: bool


def _expected_length(opcode: int, body: bytes, length: int) -> int:
    """Return the record length implied by the lengths of its fields; `length` for record types without such fields."""
    if opcode == Opcode.MESSAGE_INDEX:
        return 6 + int.from_bytes(body[2:6], "little")
    if opcode == Opcode.CHUNK:
        name_length = body[_CHUNK_HEAD.size - 4 : _CHUNK_HEAD.size]
        before = _CHUNK_HEAD.size + int.from_bytes(name_length, "little")
        return before + 8 + int.from_bytes(body[before : before + 8], "little")
    return _LENGTHS.get(opcode, length)


def records_of(block: bytes, *opcodes: int) -> Iterator[McapRecord]:
    """Yield the schemas, channels, messages, chunk indexes and statistics in a block, or only these kinds of record.

    Raises one of READ_ERRORS if the block is damaged.
    """
    offset = 0
    while offset < len(block):
        opcode, length = _RECORD_HEAD.unpack_from(block, offset)
        start = offset + _RECORD_HEAD.size
        offset = start + length
        if opcode == 0 or offset > len(block):  # no record has opcode 0
            raise ValueError(opcode)
        if opcodes and opcode not in opcodes:
            continue
        if opcode == Opcode.MESSAGE:
            channel, sequence, logged, published = _MESSAGE_HEAD.unpack_from(block, start)
            payload = block[start + _MESSAGE_HEAD.size : offset]
            yield Message(channel, logged, payload, published, sequence)
        elif opcode in _DESCRIPTIONS:
            if length > limits.DESCRIPTION_BYTES:
                raise ValueError(length)
            yield _DESCRIPTIONS[opcode].read(ReadDataStream(BytesIO(block[start:offset])))


def _claimed_size(chunk: bytes) -> int:
    """Return the uncompressed size that the head of a chunk claims; 0 if it is truncated, or too large to unpack."""
    if len(chunk) < _RECORD_HEAD.size + _CHUNK_HEAD.size:
        return 0
    size: int = _CHUNK_HEAD.unpack_from(chunk, _RECORD_HEAD.size)[2]
    return size if size <= limits.BLOCK_BYTES else 0


def _unpack_chunk(record: bytes) -> bytes:
    """Decompress the records of a chunk; raise one of READ_ERRORS if it is damaged or too large."""
    body = ReadDataStream(BytesIO(record[_RECORD_HEAD.size :]))
    chunk = Chunk.read(body)
    opcode, length = _RECORD_HEAD.unpack_from(record)
    # zeros would parse as an empty chunk
    if opcode != Opcode.CHUNK or length - body.count not in _SURPLUS:
        raise ValueError(len(record))
    size = chunk.uncompressed_size
    packed = chunk.data
    if size > limits.BLOCK_BYTES:
        raise ValueError(size)
    records: bytes = packed
    if chunk.compression == "zstd":
        if frame_content_size(packed) not in {-1, size}:
            raise ValueError(size)
        records = ZstdDecompressor().decompress(packed, max_output_size=size)
    elif chunk.compression == "lz4":
        records = LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    has_checksum = bool(chunk.uncompressed_crc)
    if len(records) != size or (has_checksum and crc32(records) != chunk.uncompressed_crc):
        raise ValueError(size)
    return records


def _describe(chunk: bytes, offset: int) -> str:
    if len(chunk) < _RECORD_HEAD.size + _CHUNK_HEAD.size:
        return f"at byte {offset}"
    start, end, *_ = _CHUNK_HEAD.unpack_from(chunk, _RECORD_HEAD.size)
    return f"at byte {offset} ({utc_text([start / 1e9, end / 1e9])})"
