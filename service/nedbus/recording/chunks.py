"""The data of an MCAP file, chunk by chunk, each checked by its CRC; what is damaged is left out and reported.

The summary, which has a CRC of its own, says where the chunks are; without one the records are followed one by one.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final
from zlib import crc32

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema, Statistics
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from nedbus.errors import SourceError

from .formats import open_flight
from .records import CHUNK_HEAD, READ_ERRORS, RECORD_HEAD, chunk_length, records_of, unpack_chunk

_FOOTER: Final = struct.Struct("<QQI")
_ZSTD: Final = b"\x04\x00\x00\x00zstd"  # in every chunk of ours
_MAX_WARNINGS: Final = 100
_SEARCH: Final = 2**20  # bytes that are searched at a time
_EPOCH: Final = 10**17  # ns: a later time is a date, an earlier one counts from a vehicle's start


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a record is; `number` counts the chunks from 1, `times` are those of its messages [ns]."""

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
        self._size = os.fstat(self._file.fileno()).st_size
        if self._read(0, len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            self._file.close()
            raise SourceError(str(path), "not a readable MCAP file")
        self.summary = self._read_summary()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def parts(self, only: Collection[int] | None = None) -> Iterator[bytes]:
        """Yield the records of each chunk that is whole, in the order of the file.

        With `only`, chunks in which none of these channels occurs may be left out.
        """
        for place in self._places(only):
            try:
                part = self._read_part(place)
            except READ_ERRORS:
                count = self._count_messages(place.end, only)
                what = f"chunk {place.number} ({_show_times(*place.times)})" if place.number else "a record"
                lost = "its messages are" if count is None else f"its {count} messages are"
                self.warn(f"{what} at byte {place.offset} is damaged: {lost} left out", lost=count != 0)
            else:
                yield part

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
        tail = self._read(max(0, self._size - RECORD_HEAD.size - _FOOTER.size - 8), RECORD_HEAD.size + _FOOTER.size + 8)
        if len(tail) < RECORD_HEAD.size + _FOOTER.size + 8 or not tail.endswith(MCAP0_MAGIC):
            return None
        opcode, length = RECORD_HEAD.unpack_from(tail)
        start, _, checksum = _FOOTER.unpack_from(tail, RECORD_HEAD.size)
        if (opcode, length) != (Opcode.FOOTER, _FOOTER.size) or not 8 <= start < self._size:
            return None
        covered = self._read(start, self._size - start - 4 - 8)
        try:
            if checksum and crc32(covered) != checksum:
                raise ValueError(checksum)
            return _parse_summary(covered[: 4 - RECORD_HEAD.size - _FOOTER.size], start)
        except READ_ERRORS:
            self.warn("its index is damaged: it is read without")
            return None

    def _places(self, only: Collection[int] | None) -> Iterator[_Place]:
        if self.summary is None or not self.summary.chunk_indexes:
            yield from self._follow()
            return
        for number, index in enumerate(self.summary.chunk_indexes, 1):
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
                start_time, end_time, *_ = CHUNK_HEAD.unpack(self._read(offset + RECORD_HEAD.size, CHUNK_HEAD.size))
                yield _Place(opcode, offset, end, number, (start_time, end_time))
            elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}:
                yield _Place(opcode, offset, end)
            offset = end

    def _read_head(self, offset: int) -> tuple[int, int]:
        """Return the opcode of a record, 0 at the end of the file, and where the record ends."""
        head = self._read(offset, RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            return 0, offset
        opcode, length = RECORD_HEAD.unpack(head)
        return opcode, offset + RECORD_HEAD.size + length

    def _is_plausible(self, opcode: int, offset: int, end: int) -> bool:
        """Return whether a record's length fits the file and what the record says of itself."""
        length = end - offset - RECORD_HEAD.size
        if opcode == 0 or end > self._size:
            return False
        if opcode == Opcode.DATA_END:
            return length == 4
        if opcode == Opcode.FOOTER:
            return length == _FOOTER.size and end + len(MCAP0_MAGIC) == self._size
        body = self._read(offset + RECORD_HEAD.size, min(length, 64))
        if opcode == Opcode.MESSAGE_INDEX:
            return length >= 6 and struct.unpack_from("<I", body, 2) == (length - 6,)
        if opcode == Opcode.CHUNK:
            return chunk_length(body) == length
        return True

    def _find_chunk(self, start: int) -> int | None:
        """Return where the next chunk of ours begins."""
        before = RECORD_HEAD.size + CHUNK_HEAD.size - 4  # bytes of a chunk before the name of its compression
        while block := self._read(start, _SEARCH):
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

    def _read_part(self, place: _Place) -> bytes:
        record = self._read(place.offset, place.end - place.offset)
        if place.opcode != Opcode.CHUNK:
            return record
        body = record[RECORD_HEAD.size :]
        if RECORD_HEAD.unpack_from(record) != (Opcode.CHUNK, len(body)) or chunk_length(body) != len(body):
            raise ValueError(place)
        return unpack_chunk(body)

    def _count_messages(self, end: int, only: Collection[int] | None) -> int | None:
        """Return how many messages the indexes behind a chunk list, None where there are none."""
        count, listed = 0, False
        opcode, after = self._read_head(end)
        while opcode == Opcode.MESSAGE_INDEX and self._is_plausible(opcode, end, after):
            [channel] = struct.unpack("<H", self._read(end + RECORD_HEAD.size, 2))
            listed = True
            if only is None or channel in only:
                count += (after - end - RECORD_HEAD.size - 6) // 16
            end = after
            opcode, after = self._read_head(end)
        return count if listed else None


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
    offset = len(MCAP0_MAGIC)
    for index in summary.chunk_indexes:
        if index.chunk_start_offset < offset:
            raise ValueError(index)
        offset = index.chunk_start_offset + index.chunk_length
    if offset > start:
        raise ValueError(offset)
    return summary


def _show_times(start: int, end: int) -> str:
    if start < _EPOCH:
        return f"{start / 1e9:.1f} to {end / 1e9:.1f} s"
    first, last = (datetime.fromtimestamp(time / 1e9, UTC) for time in (start, end))
    return f"{first:%Y-%m-%d %H:%M:%S} to {last:%H:%M:%S} UTC"
