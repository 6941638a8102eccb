"""MCAP file reader that reads chunk by chunk, and skips and reports damaged parts.

The summary, which has its own CRC, lists the chunks; without it the records are scanned one by one. Decompression
uses bounded memory. The readers of the `mcap` package have no limit and stop at the first damage.
"""

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
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Schema, Statistics
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdDecompressor, ZstdError, frame_content_size

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
_LENGTHS: Final[dict[int, int]] = {Opcode.DATA_END: 4, Opcode.FOOTER: 20}
_DESCRIPTIONS: Final[dict[int, Any]] = {
    Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.CHUNK_INDEX: ChunkIndex, Opcode.STATISTICS: Statistics,
}  # fmt: skip
# bytes of a chunk, also uncompressed, and of a summary; ROS 2 and nedbus write up to 8 MiB
_MAX_BLOCK: Final = 2**26
# bytes of a record in _DESCRIPTIONS; statistics of all possible channels have 655 kB
_MAX_DESCRIPTION: Final = 2**20
# compression ratio of files above _MAX_BLOCK, and of all chunks of a file together
_MAX_RATIO: Final = 100
_MAX_WARNINGS: Final = 100
_MAX_WARNING: Final = 1000  # characters


class _IndexedChunk(NamedTuple):
    """Place of a chunk in the file, and its channels."""

    start: int
    end: int
    channels: Collection[int]


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
        self.damaged, self.position = False, 0
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
        try:
            self._read_summary()
        except READ_ERRORS:
            self.warn("the index is damaged; reading without it")

    def blocks(self, only: Collection[int] | None = None) -> Iterator[bytes]:
        """Yield each intact chunk, decompressed, and each record outside chunks, in file order.

        `only`: channels of interest; chunks without any of them may be skipped.
        """
        unpacked, limit = 0, max(_MAX_BLOCK, _MAX_RATIO * self.size)
        for opcode, offset, end in (
            self._listed(only) if self._chunks else self._scan(len(MCAP0_MAGIC), self.size)
        ):
            self.position = end
            if end - offset > _MAX_BLOCK:
                text = f"skipped {end - offset} bytes from byte {offset}, above the limit of {_MAX_BLOCK} for a chunk"
                self.warn(text, lost=True)
                continue
            record = self._read(offset, end - offset)
            if opcode == Opcode.CHUNK:
                unpacked += _claimed_size(record)
                if unpacked > limit:
                    text = f"skipped the chunks from byte {offset}: all chunks together claim more than {limit} bytes"
                    self.warn(text, lost=True)
                    return
            try:
                yield _unpack_chunk(record) if opcode == Opcode.CHUNK else record
            except READ_ERRORS:
                self.warn(
                    f"the chunk {_describe(record, offset)} is damaged; its messages are skipped",
                    lost=True,
                )

    def _listed(self, only: Collection[int] | None) -> Iterator[tuple[int, int, int]]:
        """Yield opcode, begin and end of the chunks in the index, and of what lies between and behind them."""
        begin = len(MCAP0_MAGIC)
        for start, end, channels in self._chunks:
            yield from self._scan(begin, start, is_listed=True)
            begin = end
            # A chunk that lists no channels may contain any.
            if only is None or not channels or not set(channels).isdisjoint(only):
                yield Opcode.CHUNK, start, end
        yield from self._scan(begin, self._end, is_listed=True)

    def warn(self, warning: str, *, lost: bool = False) -> None:
        """Add a warning unless it is a duplicate; `lost`: the damage cost messages."""
        self.damaged |= lost
        warning = warning[:_MAX_WARNING]
        if len(self.warnings) <= _MAX_WARNINGS and warning not in self.warnings:
            self.warnings.append(
                warning if len(self.warnings) < _MAX_WARNINGS else "further damage is not listed"
            )

    def _decompress(self, packed: BinaryIO) -> BinaryIO:
        """Return a temporary file with the decompressed contents, up to the first damage."""
        packed.seek(0)
        with packed, ExitStack() as on_error:
            unpacked = on_error.enter_context(TemporaryFile())
            limit = max(_MAX_BLOCK, _MAX_RATIO * os.fstat(packed.fileno()).st_size)
            try:
                for part in ZstdDecompressor().read_to_iter(packed):
                    unpacked.write(part)
                    if unpacked.tell() > limit:
                        raise ZstdError(f"more than {limit} bytes")
            except ZstdError as exc:
                self.warn(f"the compressed file is damaged ({exc})", lost=True)
            on_error.pop_all()
        return unpacked

    def _read(self, start: int, size: int) -> bytes:
        self._file.seek(start)
        return self._file.read(size)

    def _read_summary(self) -> None:
        """Read the summary if there is one; raise one of READ_ERRORS if it is damaged."""
        end = self.size - _FOOTER.size
        if end < len(MCAP0_MAGIC):
            return
        opcode, length, start, _, checksum, magic = _FOOTER.unpack(self._read(end, _FOOTER.size))
        if (opcode, length, magic) != (
            Opcode.FOOTER,
            _LENGTHS[Opcode.FOOTER],
            MCAP0_MAGIC,
        ) or not start:
            return
        if not len(MCAP0_MAGIC) <= start <= end:
            raise ValueError(start)
        if end - start > _MAX_BLOCK:
            self.warn(f"the index is larger than {_MAX_BLOCK} bytes; reading without it")
            return
        summary = self._read(start, end - start)
        footer = self._read(end, _FOOTER.size - len(MCAP0_MAGIC) - 4)
        if checksum and crc32(footer, crc32(summary)) != checksum:
            raise ValueError(checksum)
        chunks = sorted(
            _place_of(each) for each in records_of(summary) if isinstance(each, ChunkIndex)
        )
        previous = len(MCAP0_MAGIC)
        for begin, stop, _ in (*chunks, (start, start, ())):
            if begin < previous:
                raise ValueError(begin)
            previous = stop
        self._chunks = chunks
        self._end = start
        self.summary = summary

    def _scan(
        self, offset: int, stop: int, *, is_listed: bool = False
    ) -> Iterator[tuple[int, int, int]]:
        """Scan a range; yield opcode, begin and end of chunks, and of schemas, channels and messages between them.

        `is_listed`: the range is between chunks of the index, where damage usually costs only copies of the index.
        """
        after_chunk = is_listed and offset > len(MCAP0_MAGIC)
        while not is_listed or offset < stop:
            begin = self._read(offset, _RECORD_HEAD.size + 64)
            opcode, length = (
                _RECORD_HEAD.unpack_from(begin) if len(begin) >= _RECORD_HEAD.size else (0, 0)
            )
            end = offset + _RECORD_HEAD.size + length
            surplus = length - _expected_length(opcode, begin[_RECORD_HEAD.size :], length)
            if opcode == 0 or end > stop or surplus not in _SURPLUS:
                if is_listed:
                    return
                self.warn(
                    f"skipped truncated or damaged data from byte {offset} of {self.size} to the end",
                    lost=True,
                )
                return
            if opcode in _LENGTHS:
                return
            # The message index after a chunk has no CRC: one flipped bit turns its opcode into that of a message.
            is_index = length == _expected_length(
                Opcode.MESSAGE_INDEX, begin[_RECORD_HEAD.size :], length
            )
            if after_chunk and opcode == Opcode.MESSAGE and is_index:
                opcode = Opcode.MESSAGE_INDEX
            if opcode == Opcode.MESSAGE_INDEX and not after_chunk:
                self.warn(f"skipped a damaged chunk before byte {offset}", lost=True)
            after_chunk = opcode == Opcode.CHUNK or (after_chunk and opcode == Opcode.MESSAGE_INDEX)
            if opcode in {Opcode.CHUNK, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}:
                yield opcode, offset, end
            offset = end


def _expected_length(opcode: int, body: bytes, length: int) -> int:
    """Return the record length implied by the lengths of its fields; `length` for record types without such fields."""
    if opcode == Opcode.MESSAGE_INDEX:
        return 6 + int.from_bytes(body[2:6], "little")
    if opcode == Opcode.CHUNK:
        before = _CHUNK_HEAD.size + int.from_bytes(
            body[_CHUNK_HEAD.size - 4 : _CHUNK_HEAD.size], "little"
        )
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
            yield Message(
                channel, logged, block[start + _MESSAGE_HEAD.size : offset], published, sequence
            )
        elif opcode in _DESCRIPTIONS:
            if length > _MAX_DESCRIPTION:
                raise ValueError(length)
            yield _DESCRIPTIONS[opcode].read(ReadDataStream(BytesIO(block[start:offset])))


def _claimed_size(chunk: bytes) -> int:
    """Return the uncompressed size that the head of a chunk claims; 0 if it is truncated, or too large to unpack."""
    if len(chunk) < _RECORD_HEAD.size + _CHUNK_HEAD.size:
        return 0
    size: int = _CHUNK_HEAD.unpack_from(chunk, _RECORD_HEAD.size)[2]
    return size if size <= _MAX_BLOCK else 0


def _unpack_chunk(record: bytes) -> bytes:
    """Decompress the records of a chunk; raise one of READ_ERRORS if it is damaged or too large."""
    body = ReadDataStream(BytesIO(record[_RECORD_HEAD.size :]))
    chunk = Chunk.read(body)
    opcode, length = _RECORD_HEAD.unpack_from(record)
    # zeros would parse as an empty chunk
    if opcode != Opcode.CHUNK or length - body.count not in _SURPLUS:
        raise ValueError(len(record))
    size, packed = chunk.uncompressed_size, chunk.data
    if size > _MAX_BLOCK:
        raise ValueError(size)
    records: bytes = packed
    if chunk.compression == "zstd":
        if frame_content_size(packed) not in {-1, size}:
            raise ValueError(size)
        records = ZstdDecompressor().decompress(packed, max_output_size=size)
    elif chunk.compression == "lz4":
        records = LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    if len(records) != size or (
        chunk.uncompressed_crc and crc32(records) != chunk.uncompressed_crc
    ):
        raise ValueError(size)
    return records


def _describe(chunk: bytes, offset: int) -> str:
    if len(chunk) < _RECORD_HEAD.size + _CHUNK_HEAD.size:
        return f"at byte {offset}"
    start, end, *_ = _CHUNK_HEAD.unpack_from(chunk, _RECORD_HEAD.size)
    return f"at byte {offset} ({utc_text([start / 1e9, end / 1e9])})"
