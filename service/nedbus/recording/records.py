"""The records of an MCAP file: of a chunk unpacked into bounded memory and checked by its CRC, then one by one."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from typing import Any, Final
from zlib import crc32

from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Schema, Statistics
from zstandard import ZstdDecompressor, ZstdError, frame_content_size

READ_ERRORS: Final = (McapError, ValueError, struct.error, ZstdError, MemoryError, OverflowError, RuntimeError)
"""What the mcap package and the decompressors raise for a damaged file."""

RECORD_HEAD: Final = struct.Struct("<BQ")
"""The opcode and the length of a record."""

CHUNK_HEAD: Final = struct.Struct("<QQQII")
"""Of a chunk: its times, size and CRC of its records, and the length of the compression's name."""

_DESCRIPTIONS: Final[dict[int, Any]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.STATISTICS: Statistics,
}
_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")  # channel, sequence, times
_SMALL: Final = 2**26  # bytes that any chunk may unpack to: ROS 2 writes 768 kB, nedbus 8 MiB, or one message more
_LARGE: Final = 2**30  # bytes that a chunk may unpack to
_RATIO: Final = 100  # to which a chunk that is not small may be compressed


def unpack_chunk(body: bytes) -> bytes:
    """Return the records of a chunk; raise one of READ_ERRORS if it is damaged, or would fill the memory."""
    chunk = Chunk.read(ReadDataStream(BytesIO(body)))
    size, packed = chunk.uncompressed_size, chunk.data
    if size > max(_SMALL, min(_LARGE, _RATIO * len(packed))):
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


def chunk_length(body: bytes) -> int | None:
    """Return the length of a chunk's record as the chunk's own fields have it."""
    if len(body) < CHUNK_HEAD.size:
        return None
    *_, name_length = CHUNK_HEAD.unpack_from(body)
    before: int = CHUNK_HEAD.size + name_length + 8
    if name_length > 8 or len(body) < before:
        return None
    return before + int.from_bytes(body[before - 8 : before], "little")


def records_of(part: bytes) -> Iterator[McapRecord]:
    """Yield the records of a part of a file that describe or hold messages; raise one of READ_ERRORS at damage."""
    offset = 0
    while offset < len(part):
        opcode, length = RECORD_HEAD.unpack_from(part, offset)
        start = offset + RECORD_HEAD.size
        offset = start + length
        if opcode == 0 or offset > len(part):  # no record has opcode 0
            raise ValueError(opcode)
        if opcode == Opcode.MESSAGE:
            channel, sequence, logged, published = _MESSAGE_HEAD.unpack_from(part, start)
            yield Message(channel, logged, part[start + _MESSAGE_HEAD.size : offset], published, sequence)
        elif opcode in _DESCRIPTIONS:
            yield _DESCRIPTIONS[opcode].read(ReadDataStream(BytesIO(part[start:offset])))
