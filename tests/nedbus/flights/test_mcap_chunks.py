"""MCAP files just beyond the limits of a chunk, a record and an index: reading them takes bounded memory."""

import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final
from zlib import crc32

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

import nedbus
from nedbus import limits
from nedbus.flights.readers.mcap_chunks import ChunkFile, records_of
from tests.flights.replays import open_recording
from tests.peers.processes import Start

_SECONDS: Final = 5  # they need 0.7 s
LIMIT: Final = 2**22  # bytes of a chunk or index, here; 64 MiB in fact
SHARE: Final = 8  # of 512 MiB: growth of a process per byte of the limit

# The first use of the libraries is not counted.
_READ: Final = """
import sys
from pathlib import Path
import nedbus
from pathlib import Path
from nedbus import limits
from nedbus.flights.readers import ReadOptions, mcap
limits.BLOCK_BYTES = mcap._SCHEMA_BUDGET = LIMIT
peak = lambda: int(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0])  # [KiB]
before = peak()
try:
    mcap.McapReader(Path(sys.argv[1]), ReadOptions(topics=None))
except nedbus.SourceError as exc:
    print(exc)
print(1024 * (peak() - before))
""".replace("LIMIT", str(LIMIT))


def encode(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())


def chunk(content: bytes, compression: str = "") -> bytes:
    """Return a chunk of records."""
    pack = {"": bytes, "zstd": zstandard.compress, "lz4": lz4.frame.compress}[compression]
    return encode(Chunk(compression, pack(content), 0, 0, crc32(content), len(content)))


def message(size: int) -> bytes:
    """Return a message record of incompressible data."""
    return encode(Message(1, 0, random.Random(1).randbytes(size - 31), 0, 0))


def channels(number: int) -> bytes:
    """Return channels of nearly the maximum size, with as many metadata as fit."""
    metadata = {f"{each:x}": "" for each in range(75_000)}
    return encode(*(Channel(each, f"/{each}", "cdr", metadata, 0) for each in range(number)))


def index(*records: McapRecord) -> bytes:
    """Return an index with these records, and the end of the data before it."""
    data_end, place = encode(DataEnd(0)), len(MCAP0_MAGIC)
    return data_end + encode(*records) + encode(Footer(place + len(data_end), 0, 0))


def metadata(size: int) -> Metadata:
    return Metadata(metadata={"a": "b" * size}, name="c")


FILES: Final[dict[str, tuple[Callable[[], bytes], str]]] = {
    "chunk": (lambda: chunk(message(LIMIT + 1)), "above the limit"),
    "expanding chunk": (lambda: chunk(bytes(LIMIT + 1), "zstd"), "is damaged"),
    "message": (lambda: message(LIMIT + 1), "above the limit"),
    "accepted chunk": (lambda: chunk(message(LIMIT - 100)), "channel record is lost"),
    "accepted lz4 chunk": (lambda: chunk(message(LIMIT - 2**16), "lz4"), "channel record is lost"),
    "accepted zstd chunk": (lambda: chunk(message(LIMIT - 2**16), "zstd"), "channel record is lost"),
    "accepted channels": (lambda: chunk(channels(4)), "no messages"),
    "large channel": (lambda: chunk(encode(Channel(1, "/a" * 2**19, "cdr", {}, 0))), "invalid record"),
    "index": (lambda: index(metadata(LIMIT)), "the index is larger than"),
    "index of chunks": (
        lambda: index(*(ChunkIndex(0, 8, "", 0, 0, 0, dict.fromkeys(range(60_000), 0), 0, 0) for _ in range(6))),
        "is damaged",
    ),
    "schemas": (
        lambda: b"".join(
            chunk(encode(Schema(id=number, data=b"a" * 2**19, encoding="ros2msg", name="px4_msgs/msg/A")))
            for number in range(1, 10)
        ),
        "the schemas in this file exceed",
    ),
}  # fmt: skip
"""Contents of a file at or just beyond a limit, and what is reported."""


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.parametrize("kind", FILES)
def test_file_at_a_limit_is_read_in_bounded_memory(start: Start, tmp_path: Path, kind: str) -> None:
    """Memory of at most eight times the limit of a chunk, 512 MiB, is used; what is skipped is reported."""
    make, reason = FILES[kind]
    path = tmp_path / "a.mcap"
    data = make()
    end = b"" if kind.startswith("index") else encode(DataEnd(0), Footer(0, 0, 0))
    path.write_bytes(MCAP0_MAGIC + data + end + MCAP0_MAGIC)
    process = start("-c", _READ, str(path), coverage=False)
    assert process.wait() == 0, process.err
    assert reason in process.out
    assert int(process.out.splitlines()[-1]) < SHARE * LIMIT, process.out


@pytest.mark.long
def test_index_with_many_schemas_is_read_in_linear_time(tmp_path: Path) -> None:
    """An index with 40,000 schemas and channels is read in seconds of CPU time, on any machine."""
    path = tmp_path / "a.mcap"
    schemas = [
        Schema(id=number, data=b"", encoding="", name="other") for number in range(1, 40_001)
    ]
    path.write_bytes(
        MCAP0_MAGIC
        + index(*schemas, *(Channel(each.id, "/a", "", {}, each.id) for each in schemas))
    )
    with path.open("ab") as file:
        file.write(MCAP0_MAGIC)
    begin = time.process_time()
    with pytest.raises(nedbus.SourceError, match="no messages"):
        open_recording(path)
    assert time.process_time() - begin < _SECONDS


def test_chunks_that_together_unpack_too_far_are_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The limit of the compression ratio counts all chunks of a file; chunks beyond it are reported as damage."""
    path = tmp_path / "repeated.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=2000, compression=CompressionType.ZSTD)
        writer.start()
        channel = writer.register_channel("topic", "", 0)
        for number in range(20):
            writer.add_message(channel, number, bytes(1500), number)
        writer.finish()

    def read() -> tuple[int, bool, list[str]]:
        file = ChunkFile(path)
        count = sum(1 for block in file.blocks() for _ in records_of(block, Opcode.MESSAGE))
        file.close()
        return count, file.damaged, file.warnings

    assert read() == (20, False, [])
    monkeypatch.setattr(limits, "BLOCK_BYTES", 16_000)
    monkeypatch.setattr(limits, "COMPRESSION", 1)
    count, damaged, warnings = read()
    assert 0 < count < 20
    assert damaged
    assert "together claim more than 16000 bytes" in warnings[0]


@pytest.mark.parametrize(
    ("library", "read_without_index"), [("pymcap-cli", True), ("libmcap 2.1.1", False)]
)
def test_indexes_that_may_be_partial_are_not_used(
    tmp_path: Path, library: str, read_without_index: bool
) -> None:
    """A chunk of which `pymcap-cli recover` kept one of two indexes is read for the topic that lacks one, too.

    Other libraries write all indexes of a chunk, so one whose indexes lack a channel has none of its messages.
    """
    path = tmp_path / "recovered.mcap"
    begin = MCAP0_MAGIC + encode(Header("ros2", library))
    messages = encode(
        *(Channel(number, f"/{number}", "cdr", {}, 0) for number in (1, 2)),
        *(Message(number, 0, b"", 0, 0) for number in (1, 2, 2)),
    )
    kept = encode(MessageIndex(1, [(0, 0)]))
    data = begin + chunk(messages) + kept + encode(DataEnd(0))
    indexed = ChunkIndex(
        chunk_length=len(chunk(messages)),
        chunk_start_offset=len(begin),
        compression="",
        compressed_size=len(messages),
        message_end_time=0,
        message_index_length=len(kept),
        message_index_offsets={1: len(begin) + len(chunk(messages))},
        message_start_time=0,
        uncompressed_size=len(messages),
    )
    totals = Statistics(
        attachment_count=0,
        channel_count=1,
        channel_message_counts={1: 1},
        chunk_count=1,
        message_count=1,
        message_end_time=0,
        message_start_time=0,
        metadata_count=0,
        schema_count=0,
    )
    summary = encode(indexed, totals)
    path.write_bytes(data + summary + encode(Footer(len(data), 0, 0)) + MCAP0_MAGIC)
    file = ChunkFile(path)
    read = [record for block in file.blocks({2}) for record in records_of(block, Opcode.MESSAGE)]
    file.close()
    assert len(read) == (3 if read_without_index else 0)
    assert bool(file.summary) != read_without_index
    assert file.warnings == []
