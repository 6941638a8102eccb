"""Damaged recordings and logs: damaged parts are skipped and reported, and all messages that are read are correct.

Chunks of a recording have CRCs, so each message that is read must equal the original bit by bit.
A log has no checksums, so a flipped bit in a value goes unnoticed: there, at most the damaged messages may differ, and
damage to the structure must be detected.

`DAMAGE_TRIES=10000 pytest tests/nedbus/sources/test_damage.py` makes more tries, including tries with the real logs
of ../shared.
"""

from __future__ import annotations

import logging
import os
import random
import re
import struct
import tracemalloc
from collections import Counter
from collections.abc import Iterable, Mapping
from io import BytesIO
from pathlib import Path
from zlib import crc32

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk, ChunkIndex, Footer
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

import nedbus
from nedbus import limits
from nedbus.errors import SourceError
from nedbus.flights import RecordingWriter
from nedbus.flights.readers.mcap import McapReader
from nedbus_msgs import DEFAULT, TOPICS, Address, Provenance
from nedbus_msgs.arrays import MessageArray, to_array
from tests.flights.local_position import (
    ROS2_TYPE,
    downgrade,
    encode_cdr,
    message_definition,
    upgrade,
)
from tests.flights.messages import VLP, message
from tests.flights.replays import convert_replay, open_recording, open_replay
from tests.flights.ulogs import LOGS, UlogWriter
from tests.peers.command_line import run_command
from tests.peers.ports import free_endpoint

_log = logging.getLogger(__name__)

TRIES = int(os.environ.get("DAMAGE_TRIES", "200"))
FEW = 60  # number of tries in the quick tier, which uses generated files only
each_tier = pytest.mark.parametrize("tries", [FEW, pytest.param(TRIES, marks=pytest.mark.long)])
MAX_LOG = 150_000  # bytes of a real log per try

Rows = Counter[tuple[str, bytes]]  # topic and values of messages


def damage(data: bytes, rng: random.Random) -> tuple[str, int, bytes]:
    """Flip a bit, cut off the end, or zero a range; return a description, the number of bytes hit, and the result."""
    kind, damaged = rng.choice(("bit", "bit", "cut", "zeros")), bytearray(data)
    offset = rng.randrange(len(data))
    if kind == "bit":
        damaged[offset] ^= 1 << rng.randrange(8)
        return f"bit at {offset}", 1, bytes(damaged)
    if kind == "cut":
        return f"cut at {offset}", 0, data[:offset]
    length = min(rng.choice((1, 4, 16, 64, 512, 4096)), len(data) - offset)
    damaged[offset : offset + length] = bytes(length)
    return f"{length} zeros at {offset}", length, bytes(damaged)


def write_recording(path: Path, *, finish: bool) -> Path:
    """Write a flight of two vehicles in a dozen chunks; without `finish`, as after a power cut."""
    messages = [
        (each.address, upgrade(each.fields))
        for each in open_replay("sim:?duration=2&topics=VehicleLocalPosition").messages
    ]
    writer = RecordingWriter(path)
    for start in range(0, len(messages), 40):
        part = messages[start : start + 40]
        streams = [
            (Address(vehicle, a.topic, a.instance), Provenance("sim"))
            for vehicle in "12"
            for a, _ in part
        ]
        both = to_array([each for _, each in part] * 2)
        times = [each * 1000 for each in both["timestamp"].tolist()]
        writer.write(both, DEFAULT, streams, logged=times, published=times)
        writer.flush()
    flushed = path.read_bytes()
    writer.close()
    if not finish:
        path.write_bytes(flushed)
    return path


def make_recordings(folder: Path) -> list[Path]:
    found = [
        write_recording(folder / "whole.mcap", finish=True),
        write_recording(folder / "cut.mcap", finish=False),
    ]
    for log in sorted(LOGS.glob("*.ulg")) if TRIES > 1000 else []:
        convert_replay(f"ulog:{log}", folder / f"{log.stem}.mcap")
        found.append(folder / f"{log.stem}.mcap")
    return found


def payloads_of(path: Path) -> tuple[Counter[tuple[Address, bytes]], McapReader]:
    with open_recording(path) as reader:
        messages = [(each.stream, each.payload) for each in reader.records()]
    return Counter(
        (each.address, data + repr(sorted(each.lacking)).encode()) for each, data in messages
    ), reader


@pytest.mark.slow
@pytest.mark.timeout(120 + 3 * TRIES)
@each_tier
def test_damaged_recording_yields_only_original_messages(tmp_path: Path, tries: int) -> None:
    """Each message that is read is an original one, none is repeated, and losses are reported."""
    rng = random.Random(12)
    originals = [
        (path.read_bytes(), payloads_of(path)[0], path.stem) for path in make_recordings(tmp_path)
    ]
    path = tmp_path / "damaged.mcap"
    outcomes: Counter[str] = Counter()
    for number in range(tries * 3 // 4):
        data, original, name = originals[number % 2] if number % 4 < 3 else rng.choice(originals)
        done, _, damaged = damage(data, rng)
        path.write_bytes(damaged)
        where = f"{name}, try {number}, {done}"
        try:
            read, reader = payloads_of(path)
            run = open_replay(f"mcap:{path}?speed=max")
            replayed = sum(1 for _ in run.messages)
        except SourceError:
            outcomes["rejected"] += 1
            continue
        lost = original - read
        assert not read - original, where
        assert reader.damaged or not lost, f"{where}: {sum(lost.values())} lost: {reader.warnings}"
        assert bool(run.damage) == reader.damaged, where
        assert replayed == sum(read.values()), where
        # Without the index it is unknown whether the unreadable part contained messages.
        assert lost or not reader.damaged or not reader._files[0].chunks.summary, (
            f"{where}: nothing lost: {reader.warnings}"
        )
        outcomes["lost" if lost else "whole"] += 1
        if number % 20 == 0:
            address = rng.choice([each for each, _ in original])
            expected = sum(count for (each, _), count in read.items() if each == address)
            if expected:
                array = nedbus.read(
                    path, address.topic, vehicle=address.vehicle, instance=address.instance
                )
                assert len(array) == expected, where
    assert outcomes["lost"] > outcomes["rejected"], outcomes
    assert outcomes["whole"], outcomes
    _log.info("%s", outcomes)


def write_log(path: Path) -> Path:
    """Write a log of two estimator instances and the selected estimate, all of one format."""
    writer = UlogWriter()
    writer.define([VLP, "estimator_local_position"])
    for number in range(60):
        for instance in (0, 1):
            one = message(number + 1, x=number / 7, y=float(instance))
            writer.add("estimator_local_position", one, instance=instance)
        writer.add(VLP, message(number + 1, x=number / 7, z=-5.0, z_valid=True))
    return writer.write(path)


def shorten(log: Path, path: Path) -> Path:
    """Write the first messages of a real log."""
    data = log.read_bytes()
    end = offset = 16
    while offset + 3 <= len(data) and (offset < MAX_LOG or data[offset + 2] != ord("D")):
        offset += 3 + int.from_bytes(data[offset : offset + 2], "little")
    for _ in range(1000):  # of the data section
        if offset + 3 > len(data):
            break
        offset += 3 + int.from_bytes(data[offset : offset + 2], "little")
        end = offset if offset <= len(data) else end
    path.write_bytes(data[:end])
    return path


def make_logs(folder: Path) -> list[Path]:
    logs = sorted([*LOGS.glob("*.ulg"), *(LOGS.parent / "px4").glob("*.ulg")])
    return [
        write_log(folder / "ours.ulg"),
        *(shorten(log, folder / f"{log.stem}.ulg") for log in logs),
    ]


def rows_of(path: Path) -> dict[Address, MessageArray]:
    """Return the messages of the topics that a replay reads by default.

    Without log_message, because one flipped bit of the metadata alters all events.
    """
    return {
        address: nedbus.read(
            path, address.topic, vehicle=address.vehicle, instance=address.instance
        )
        for address in nedbus.addresses_of(path)
        if address.topic in TOPICS and address.topic != "log_message"
    }


def count_rows(
    streams: dict[Address, MessageArray], missing: Mapping[str, set[str]]
) -> Counter[tuple[str, bytes]]:
    """Count the messages of each topic by the values of all logged fields; damage may change the vehicle's name."""
    found: Counter[tuple[str, bytes]] = Counter()
    for address, messages in streams.items():
        fields = [
            name
            for name in messages.dtype.names or ()
            if name not in missing.get(address.topic, ())
        ]
        columns = [
            np.ascontiguousarray(messages[name]).view(np.uint8).reshape(len(messages), -1)
            for name in fields
        ]
        found.update((address.topic, row.tobytes()) for row in np.hstack(columns))
    return found


def is_truncation(damaged: bytes, data: bytes) -> bool:
    """Return whether `damaged` is a proper prefix of `data`."""
    return len(damaged) < len(data) and data.startswith(damaged)


@pytest.mark.slow
@pytest.mark.timeout(120 + 3 * TRIES)
@each_tier
def test_damaged_log_loses_only_damaged_messages(tmp_path: Path, tries: int) -> None:
    """No more messages differ than were damaged, and losses from a damaged structure are reported."""
    rng = random.Random(13)
    logs = make_logs(tmp_path) if tries > FEW else [write_log(tmp_path / "ours.ulg")]
    originals = [(path.read_bytes(), rows_of(path), path.stem) for path in logs]
    path = tmp_path / "damaged.ulg"
    outcomes: Counter[str] = Counter()
    for number in range(max(FEW, tries // 4)):
        data, original, name = rng.choice(originals)
        done, count, damaged = damage(data, rng)
        path.write_bytes(damaged)
        where = f"{name}, try {number}, {done}"
        try:
            read, run = rows_of(path), open_replay(f"ulog:{path}")
            assert list(run.messages)
        except SourceError:
            outcomes["rejected"] += 1
            continue
        missing: dict[str, set[str]] = {}
        for address, messages in read.items():
            missing.setdefault(address.topic, set()).update(nedbus.missing_of(messages))
        before, after = count_rows(original, missing), count_rows(read, missing)
        damaged_messages = 1 + count // 50 if count else 0
        altered, lost = (after - before).total(), (before - after).total()
        assert altered <= damaged_messages, f"{where}: {altered} messages differ: {run.warnings}"
        # A log has no end mark: one truncated by a power loss is complete.
        assert run.damage or lost <= damaged_messages or is_truncation(damaged, data), (
            f"{where}: {lost} lost: {run.warnings}"
        )
        outcomes["reported" if run.damage else "lost" if lost else "whole"] += 1
    assert outcomes["whole"], outcomes
    assert outcomes["reported"], outcomes
    _log.info("%s", outcomes)


def damage_chunk(path: Path, number: int) -> int:
    """Flip a bit in the middle of a chunk of a recording; return the number of messages lost."""
    data = bytearray(path.read_bytes())
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    index = summary.chunk_indexes[number - 1]
    data[index.chunk_start_offset + index.chunk_length - 100] ^= 4
    path.write_bytes(data)
    with open_recording(path) as reader:
        total = sum(reader.counts.values())
        return total - sum(1 for _ in reader.records())


def rewrite_index(path: Path, field: str, value: int) -> None:
    """Change a field of the first two chunks in the index of a recording, and update its CRC."""
    data = path.read_bytes()
    start, _, _ = struct.unpack_from("<QQI", data, len(data) - 28)
    builder = RecordBuilder()
    left = 2
    for record in StreamReader(BytesIO(data[start:]), skip_magic=True).records:
        if isinstance(record, ChunkIndex) and left:
            setattr(record, field, value)
            left -= 1
        if not isinstance(record, Footer):
            record.write(builder)
    index = builder.end() + struct.pack("<BQQQ", 2, 20, start, 0)
    path.write_bytes(data[:start] + index + struct.pack("<I", crc32(index)) + data[-8:])


@pytest.mark.parametrize(
    ("field", "value"),
    [("chunk_start_offset", each) for each in (0, 100, 2**40, 2**62, 2**63, 2**64 - 1)]
    + [("chunk_length", each) for each in (10_000, 2**40, 2**62, 2**63, 2**64 - 1)],
)
def test_invalid_index_is_ignored(tmp_path: Path, field: str, value: int) -> None:
    """An index with overlapping chunks, or chunks outside the file, is not used, and no message is lost."""
    path = write_recording(tmp_path / "a.mcap", finish=True)
    original = payloads_of(path)[0]
    rewrite_index(path, field, value)
    read, reader = payloads_of(path)
    assert read == original
    assert reader.warnings == ["the index is damaged; reading without it"]


def add_chunk(path: Path, records: bytes, *, size: int, compression: str, in_index: bool) -> None:
    """Append a chunk with this declared size to a recording without an index, or use it as the index."""
    data = path.read_bytes()
    end = len(data) - 50
    packed = zstandard.compress(records) if compression == "zstd" else lz4.frame.compress(records)
    builder = RecordBuilder()
    Chunk(compression, packed, 1, 2, crc32(records), size).write(builder)
    if in_index:
        footer = struct.pack("<BQQQ", 2, 20, end + 13, 0)
        index = builder.end() + footer
        path.write_bytes(data[: end + 13] + index + struct.pack("<I", crc32(index)) + data[-8:])
    else:
        path.write_bytes(data[:end] + builder.end() + data[end:])


@pytest.mark.parametrize(
    ("size", "declared", "compression", "in_index"),
    [
        (2**21, declared, compression, False)
        for declared in (2**21, 2**16)
        for compression in ("zstd", "lz4")
    ]
    + [(2**21, 2**21, "zstd", True), (2**19, 2**19, "zstd", False)],
)
def test_oversized_chunk_is_skipped(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    size: int,
    declared: int,
    compression: str,
    *,
    in_index: bool,
) -> None:
    """A chunk that would decompress to twice the limit, here 1 MiB, is skipped, whatever its declared size.

    A smaller one is decompressed: zeros are not a record, so the rest of that chunk is skipped.
    """
    monkeypatch.setattr(limits, "BLOCK_BYTES", 2**20)
    path = write_recording(tmp_path / "a.mcap", finish=False)
    original = payloads_of(path)[0]
    add_chunk(path, bytes(size), size=declared, compression=compression, in_index=in_index)
    tracemalloc.start()
    try:
        read, reader = payloads_of(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert read == original
    assert peak < 2**20
    assert reader.damaged != in_index
    if size == 2**19:
        assert reader.warnings == ["skipped the rest of a chunk after an invalid record"]


def test_number_of_damage_warnings_is_limited(tmp_path: Path) -> None:
    """A file with a thousand damaged places causes a hundred warnings; a final one states that more were omitted."""
    path = write_recording(tmp_path / "a.mcap", finish=False)
    place = struct.pack("<BQ", Opcode.MESSAGE_INDEX, 6) + bytes(6)
    path.write_bytes(path.read_bytes()[:-50] + (place + struct.pack("<BQ", 0x80, 0)) * 1000)
    reader = payloads_of(path)[1]
    assert len(reader.warnings) == 101
    assert reader.warnings[-1] == "further damage is not listed"


CHUNK = r"the chunk at byte \d+ \(\d\.\d to \d\.\d s\) is damaged; its messages are skipped"


@pytest.mark.slow
def test_commands_read_undamaged_part_and_exit_1(tmp_path: Path) -> None:
    """With one flipped bit, convert, plot and serve --until-done use the readable part, and report the loss."""
    path = write_recording(tmp_path / "a.mcap", finish=True)
    with open_recording(path) as reader:
        total = sum(reader.counts.values())
    assert (lost := damage_chunk(path, 3)) == 80
    [warning] = open_replay(f"mcap:{path}").warnings
    assert re.fullmatch(CHUNK, warning)
    errors = []
    for arguments in (
        ["convert", str(path), "b.mcap"],
        ["plot", str(path), "-v", "1", "-o", "b.png"],
        ["serve", "--listen", free_endpoint(), "--until-done", "-s", f"mcap:{path}?speed=max"],
    ):
        ended = run_command(*arguments)
        assert ended.exit_code == 1, ended.err
        assert re.search(CHUNK, ended.err)
        errors.append(ended.err)
    assert f"{total - lost} messages" in errors[0]
    assert f"{total - lost} published" in errors[2]
    assert Path("b.png").stat().st_size > 10_000
    with open_recording("b.mcap") as reader:
        assert sum(reader.counts.values()) == total - lost


@pytest.mark.slow
def test_damaged_chunk_of_converted_flight_is_small(tmp_path: Path) -> None:
    """`convert` writes small chunks, so one damaged chunk loses less than a fifth of a flight of 30 s."""
    path = tmp_path / "a.mcap"
    convert_replay("sim:?duration=30", path)
    with open_recording(path) as reader:
        total = sum(reader.counts.values())
    assert 0 < damage_chunk(path, 3) < total / 5


def test_truncated_log_is_converted_with_warning(tmp_path: Path) -> None:
    """A log that ends inside a message, as after a power loss, is converted up to that point with exit code 0."""
    path = write_log(tmp_path / "a.ulg")
    path.write_bytes(path.read_bytes()[:-50])
    convert = run_command("convert", str(path), str(tmp_path / "a.mcap"))
    assert convert.exit_code == 0
    assert "179 messages" in convert.err
    assert "truncated (the file ends inside a message)" in convert.err


def write_payloads(path: Path, payloads: Iterable[bytes], *, layout: str = "1.16") -> Path:
    """Write a recording of one vehicle, like another program's, with any payloads at 1 kHz."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema(ROS2_TYPE, "ros2msg", message_definition(layout).encode())
        channel = writer.register_channel("/fmu/out/vehicle_local_position", "cdr", schema)
        for number, payload in enumerate(payloads):
            writer.add_message(channel, number * 10**6, payload, number * 10**6)
        writer.finish()
    return path


def payload(timestamp: int, *, layout: str = "1.16", **fields: object) -> bytes:
    return encode_cdr(downgrade(message(timestamp, **fields), layout), layout=layout)


BAD_BOOL = payload(7)[: 4 + 16] + b"\x02" + payload(7)[4 + 16 + 1 :]  # xy_valid
INVALID = {
    "bool of 2": BAD_BOOL,
    "big-endian": b"\x00\x00" + payload(7)[2:],
    "short": payload(7)[:-4],
    "long": payload(7) + bytes(100),
    "empty": b"",
}


@pytest.mark.parametrize("invalid", INVALID.values(), ids=INVALID)
def test_undecodable_message_is_skipped(
    tmp_path: Path, invalid: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    """An undecodable message is rejected with its position, and counted; the others are replayed and read."""
    path = write_payloads(tmp_path / "a.mcap", [payload(1), payload(2), invalid, payload(3)])
    run = open_replay(f"mcap:{path}")
    messages = list(run.messages)
    assert [each.error is None for each in messages] == [True, True, False, True]
    assert str(messages[2].error).endswith(" (message 3 of the recording)")
    assert run.damage is None
    assert convert_replay(f"mcap:{path}", tmp_path / "b.mcap") == "3 messages, 1 rejected"
    assert " (message 3 of the recording)" in caplog.text
    assert nedbus.read(path)["timestamp"].tolist() == [1, 2, 3]
    assert "1 of 4 messages" in caplog.text


def test_service_continues_after_undecodable_message(tmp_path: Path) -> None:
    """An undecodable message does not restart the replay: later messages are published once; the exit code is 0."""
    path = write_payloads(tmp_path / "a.mcap", [payload(1), BAD_BOOL, payload(2)])
    service = run_command(
        "serve", "--listen", free_endpoint(), "--until-done", "-s", f"mcap:{path}?speed=max"
    )
    assert service.exit_code == 0, service.err
    assert "xy_valid is 2, not a bool (0 or 1) (message 2 of the recording)" in service.err
    assert "done, 2 published, 1 rejected" in service.err


def test_payloads_of_wrong_size_are_rejected(tmp_path: Path) -> None:
    """55 payloads, all too long by the same amount, are 55 invalid messages, not 56 misaligned ones."""
    path = write_payloads(tmp_path / "a.mcap", [payload(each) + bytes(60) for each in range(55)])
    with pytest.raises(
        SourceError,
        match=r"no message of .* can be read: .* 280 bytes, expected 220 for layout 1.16",
    ):
        nedbus.read(path)
    with nedbus.open(path) as flight:
        samples = flight()
        assert not list(samples)
        assert samples.skipped.total() == 55


@pytest.mark.parametrize("layout", ["1.13", "V0", "1.16"])
def test_invalid_message_is_skipped(
    tmp_path: Path, layout: str, caplog: pytest.LogCaptureFixture
) -> None:
    """`read` skips one invalid message and counts it, in any layout."""
    bad = bytearray(payload(2, layout=layout, ref_lat=12.5))
    offset = bad.index(struct.pack("<d", 12.5))
    bad[offset : offset + 8] = struct.pack("<d", 91.0)
    payloads = payload(1, layout=layout), bytes(bad), payload(3, layout=layout)
    path = write_payloads(tmp_path / "a.mcap", payloads, layout=layout)
    assert nedbus.read(path)["timestamp"].tolist() == [1, 3]
    assert "skipped 1 of 3 messages of vehicle_local_position as invalid" in caplog.text
