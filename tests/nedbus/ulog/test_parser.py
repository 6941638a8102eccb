"""Incremental ULog parser: compared with pyulog on real logs, with chunks of any size, damage and hostile formats."""

from __future__ import annotations

import random
import re
import struct
import tracemalloc
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st
from pyulog import ULog

from nedbus.ulog import (
    Damage,
    Data,
    Dropout,
    LoggedText,
    Record,
    Subscription,
    UlogError,
    UlogParser,
)
from nedbus_msgs import VehicleLocalPosition
from tests.flights.messages import VLP
from tests.flights.ulogs import LOGS, UlogWriter

REAL = [*LOGS.glob("*.ulg"), *(LOGS.parent / "px4").rglob("*.ulg")]


def parse(data: bytes, *, chunk: int | None = None, verify: bool = True) -> list[Record]:
    """Return all records of a log that is fed in chunks."""
    parser, records = UlogParser(verify=verify), list[Record]()
    for start in range(0, len(data), chunk or len(data) or 1):
        records += parser.feed(data[start : start + (chunk or len(data))])
    return records + parser.close()


def small_log(messages: int = 20) -> bytes:
    """Return a log of one topic with a sync message after every fifth message."""
    writer = UlogWriter()
    writer.define([VLP])
    for number in range(messages):
        writer.add(VLP, VehicleLocalPosition(timestamp=1000 * number, x=float(number)))
        if number % 5 == 4:
            writer.put("S", bytes.fromhex("2f731320250cbb12"))
    return bytes(writer.data)


def text_of(records: list[Record]) -> str:
    """Return records as text, in which NaN equals itself."""
    return re.sub(" at 0x[0-9a-f]+", "", repr(records))


def data_of(records: list[Record]) -> list[bytes]:
    return [each.payload for each in records if isinstance(each, Data)]


@pytest.mark.logs
@pytest.mark.slow
@pytest.mark.parametrize("path", REAL, ids=lambda path: path.stem)
def test_real_log_equals_pyulog(path: Path) -> None:
    """Every field of every message, and every logged string, equals what pyulog reads, bit by bit."""
    log, payloads = ULog(str(path)), defaultdict[Subscription, list[bytes]](list)
    records = parse(path.read_bytes(), chunk=65_536)
    for record in records:
        if isinstance(record, Data):
            payloads[record.subscription].append(record.payload)
    theirs = {(each.name, each.multi_id, each.msg_id): each.data for each in log.data_list}
    assert {(each.name, each.multi_id, each.message_id) for each in payloads} == theirs.keys()
    for subscription, own in payloads.items():
        columns = theirs[subscription.name, subscription.multi_id, subscription.message_id]
        rows = np.frombuffer(b"".join(own), np.dtype(subscription.layout.dtype))
        flat = {
            name.replace("[", "_").replace("]", "").replace(".", "_"): column
            for name, column in columns.items()
        }
        compared = 0
        for name in rows.dtype.names or ():
            is_text = rows[name].dtype.kind == "S"  # pyulog returns a column per character
            values = (
                np.ascontiguousarray(rows[name]).view(np.uint8) if is_text else rows[name]
            ).reshape(len(rows), -1)
            is_array = is_text or rows[name].ndim > 1
            names = [f"{name}_{index}" for index in range(values.shape[1])] if is_array else [name]
            for column, value in zip(names, values.T, strict=True):
                assert flat[column].tobytes() == np.ascontiguousarray(value).tobytes(), (
                    subscription.name,
                    column,
                )
                compared += 1
        assert compared == len([each for each in flat if "_padding" not in each])
    texts = [
        (each.timestamp, each.text)
        for each in records
        if isinstance(each, LoggedText) and each.tag is None
    ]
    assert texts == [(each.timestamp, each.message) for each in log.logged_messages]
    assert sum(isinstance(each, Dropout) for each in records) == len(log.dropouts)


@given(st.lists(st.integers(1, 400), min_size=1, max_size=30), st.booleans())
def test_records_do_not_depend_on_chunk_size(sizes: list[int], verify: bool) -> None:
    log, parser, records, start = small_log(), UlogParser(verify=verify), list[Record](), 0
    while start < len(log):
        size = sizes[start % len(sizes)]
        records += parser.feed(log[start : start + size])
        start += size
    assert text_of(records + parser.close()) == text_of(parse(log, verify=verify))
    assert len(data_of(records)) >= 19


def test_log_can_be_fed_byte_by_byte() -> None:
    log = small_log()
    assert text_of(parse(log, chunk=1)) == text_of(parse(log))


@pytest.mark.parametrize("verify", [False, True])
@pytest.mark.parametrize("size", [1, 16, 64])
def test_record_of_invalid_type_split_across_chunks_is_skipped(size: int, verify: bool) -> None:
    """The rest of a record whose type is not a letter is skipped when it arrives, not parsed as records."""
    log = small_log()
    log += b"\x40\0\x01" + small_log()[-0x40:] + small_log()[-200:]
    assert text_of(parse(log, chunk=size, verify=verify)) == text_of(parse(log, verify=verify))


@given(st.randoms(use_true_random=False), st.sampled_from(("flip", "cut", "insert")))
def test_damage_does_not_alter_messages(rng: random.Random, kind: str) -> None:
    """Missing and inserted bytes lose messages, but alter none; a flipped bit alters at most its own message."""
    log = small_log(60)
    whole = data_of(parse(log))
    start = rng.randrange(200, len(log) - 50)
    size = rng.randrange(1, 300)
    assume(kind != "cut" or size != 11)  # the size of a sync message, which the next test covers
    if kind == "flip":
        damaged = bytearray(log)
        damaged[start] ^= 1 << rng.randrange(8)
    else:
        cut = start + size if kind == "cut" else start
        damaged = bytearray(
            log[:start] + (b"" if kind == "cut" else rng.randbytes(size)) + log[cut:]
        )
    try:
        found = data_of(parse(bytes(damaged)))
    except UlogError:
        return  # a flag that a parser must reject
    wrong = [each for each in found if each not in whole]
    assert len(wrong) <= (1 if kind == "flip" else 0)
    if start > 2000:  # after the definitions
        assert len(found) >= len(whole) - 15 - size // 200


@pytest.mark.parametrize("chunk", [100, 1_000_000])
def test_sync_inside_message_is_detected_as_damage(chunk: int) -> None:
    """If the bytes missing from a message are as long as the sync message after it, the sync is not read as data."""
    log = small_log(10)
    sync = log.index(bytes.fromhex("2f731320250cbb12")) - 3
    whole = data_of(parse(log))
    found = data_of(parse(log[: sync - 100] + log[sync - 89 :], chunk=chunk))
    assert [each for each in found if each not in whole] == []
    assert len(found) == 9


def log_of(
    formats: Iterable[str], subscriptions: Iterable[str], size: int = 8, repeat: int = 1
) -> bytes:
    """Return a log with these formats, and a message of this size per subscription; `NAME:1` is an instance."""
    writer = UlogWriter()
    for each in formats:
        writer.put("F", each.encode())
    for number, name in enumerate(subscriptions):
        topic, _, instance = name.partition(":")
        for _ in range(repeat):
            writer.put("A", struct.pack("<BH", int(instance or 0), number) + topic.encode())
        writer.put("D", struct.pack("<HQ", number, 1).ljust(size + 2, b"\0"))
    return bytes(writer.data)


STAMP: Final = "uint64_t timestamp;"
CUBE: Final = ["a:b[20] b;", "b:c[20] c;", "c:uint8_t d;"]
FIELDS: Final = "".join(f"float f{number};" for number in range(255))
NAMES: Final = [f"t{number}" for number in range(600)]
LIMITS: Final[dict[str, tuple[Callable[[], bytes], str]]] = {
    "nested fields": (lambda: log_of([f"n:{STAMP}a[20] a;", *CUBE], ["n"]), "it has more than 1000 fields"),
    "nested fields of a known topic": (
        lambda: log_of([f"vehicle_local_position:{STAMP}a[20] a;", *CUBE], ["vehicle_local_position"]),
        "it has more than 1000 fields or 65533 bytes",
    ),
    "levels": (
        lambda: log_of([f"n:{STAMP}a a;", "a:b b;", "b:c c;", "c:d d;", "d:uint8_t e;"], ["n"]),
        "it nests messages more than 3 levels deep",
    ),
    "fields": (
        lambda: log_of([f"n:{STAMP}" + "".join(f"float f{k};" for k in range(1000))], ["n"], repeat=20),
        "it has more than 1000 fields",
    ),
    "bytes": (lambda: log_of([f"n:{STAMP}uint8_t[65526] a;"], ["n"]), "it has more than 1000 fields or 65533 bytes"),
    "name": (lambda: log_of([f"n:{STAMP}m[20] {'a' * 256};", "m:uint8_t a;"], ["n"]), "the format of n is missing"),
    "topics": (
        lambda: log_of([f"{name}:{STAMP}" for name in NAMES], NAMES), "the log has more than 500 messages"
    ),
    "fields of all topics": (
        lambda: log_of([f"{name}:{STAMP}{FIELDS}" for name in NAMES[:40]], NAMES[:40], 1028),
        "the messages of the log have more than 8192 fields",
    ),
    "subscriptions": (
        lambda: log_of([f"t0:{STAMP}uint8_t[8] _padding0;"], [f"t0:{number % 200}" for number in range(1100)]),
        "the log has more than 1000 subscriptions",
    ),
    "characters": (
        lambda: log_of([f"{name}:{STAMP}{FIELDS}" for name in NAMES[:420]], ["t0"], 1028),
        "the format definitions have more than 1048576 characters",
    ),
}  # fmt: skip
"""Logs that exceed one limit, and its reason; other readers may have none, so the logs exceed it only slightly."""


@pytest.mark.parametrize("kind", LIMITS)
def test_log_beyond_a_limit_has_reason(kind: str) -> None:
    """A log whose definitions exceed a limit reports it; the definitions within the limits are used."""
    make, reason = LIMITS[kind]
    records = parse(make(), verify=False)
    assert any(reason in each.reason for each in records if isinstance(each, Damage))
    expected = {"topics": 500, "fields of all topics": 32, "subscriptions": 1000, "characters": 1}
    assert len(data_of(records)) == expected.get(kind, 0)


def test_data_that_is_not_readable_raises_once() -> None:
    """After the error, the parser discards all data: its memory stays constant."""
    log = small_log(0)
    log = log[:27] + b"\2" + log[28:]  # an unknown incompatible flag
    parser = UlogParser(verify=False)
    assert parser.feed(log[:30]) == []
    with pytest.raises(UlogError, match="unknown incompatible flags 0x2"):
        parser.feed(log[30:])
    assert held_memory(parser, small_log(1000), 249) < 2**12
    assert parser.feed(small_log()) == parser.close() == []


def held_memory(parser: UlogParser, data: bytes, chunk: int) -> int:
    """Return the largest memory [bytes] held between the chunks of a log, without the records."""
    tracemalloc.start()
    try:
        start, most = tracemalloc.get_traced_memory()[0], 0
        for at in range(0, len(data), chunk):
            parser.feed(data[at : at + chunk])
            most = max(most, tracemalloc.get_traced_memory()[0] - start)
    finally:
        tracemalloc.stop()
    return most


@pytest.mark.parametrize(
    ("verify", "limit"),
    [(True, 257 * 2**10), (False, 65 * 2**10)],
    ids=["with verification", "without"],
)
@pytest.mark.parametrize("size", [60_000, 65_535])
def test_held_data_is_bounded(verify: bool, limit: int, size: int) -> None:
    """Neither damage followed by long records of unknown types nor a partial record grows the buffer."""
    writer = UlogWriter()
    parser = UlogParser(verify=verify)
    parser.feed(bytes(writer.data))
    writer.data.clear()
    if verify:
        writer.data += b"\0" * 3 + b"\1" * 131_000
        writer.put("P", b"\x09float A_B" + bytes(4))
    for _ in range(10 if verify else 1):
        writer.put("Z", bytes(size))
    held = held_memory(parser, bytes(writer.data[:-1]), 2**12)
    assert limit // 4 < held < limit


@pytest.mark.slow
def test_subscriptions_hold_constant_memory() -> None:
    """Neither subscriptions that end, nor those to unknown topics, grow a table."""
    writer = UlogWriter()
    writer.put("F", b"a:uint64_t timestamp;")
    parser = UlogParser(verify=False)
    parser.feed(bytes(writer.data))
    writer.data.clear()
    for number in range(3000):
        writer.put("A", struct.pack("<BH", 0, number) + b"a")
        writer.put("A", struct.pack("<BH", number % 256, number + 1) + b"unknown%d" % number)
        writer.put("R", struct.pack("<H", number))
    assert held_memory(parser, bytes(writer.data), 249) < 2**14


def test_topic_that_is_subscribed_again_continues() -> None:
    """A subscription after an unsubscription continues the first one that has ended, with any message id."""
    writer = UlogWriter()
    writer.put("F", b"a:uint64_t timestamp;uint8_t[4] _padding0;")
    writer.put("F", b"b:uint64_t timestamp;")
    steps = (
        ("A", 1, b"a"), ("A", 2, b"b"), ("A", 3, b"a"),  # a topic is subscribed twice
        ("D", 1, b""), ("D", 3, b""), ("A", 1, b"a"), ("D", 1, b""),
        ("R", 1, b""), ("R", 9, b""), ("D", 1, b""), ("D", 2, b""),
        ("A", 1, b"a"), ("D", 1, b"\0\0\0\0"), ("R", 1, b""), ("R", 3, b""),
        ("A", 2, b"a"), ("R", 2, b""),  # the id belongs to b
        ("A", 2, b"a"), ("D", 2, b""), ("A", 3, b"b"), ("D", 3, b""),
    )  # fmt: skip
    for number, (kind, message_id, rest) in enumerate(steps):
        content = {"A": b"\0", "D": b"", "R": b""}[kind] + struct.pack("<H", message_id)
        writer.put(kind, content + (struct.pack("<Q", number) if kind == "D" else b"") + rest)
    parser = UlogParser(verify=False)
    records = parser.feed(bytes(writer.data))
    subscriptions = [each for each in records if isinstance(each, Subscription)]
    assert [(each.message_id, each.name) for each in subscriptions] == [
        (1, "a"),
        (2, "b"),
        (3, "a"),
    ]
    found = [
        (subscriptions.index(each.subscription), each.payload[0]) for each in records if isinstance(each, Data)
    ]  # fmt: skip
    assert found == [(0, 3), (2, 4), (0, 6), (1, 10), (0, 12), (0, 18), (1, 20)]
    assert [each.reason for each in records if isinstance(each, Damage)] == [
        "a is ignored, because its message id belongs to b"
    ]
    assert parser.undecodable == 1


def test_number_of_subscriptions_is_limited() -> None:
    """Beyond 1000, only subscriptions that continue an earlier one are accepted."""
    writer = UlogWriter()
    writer.put("F", b"a:uint64_t timestamp;")
    for number in range(1003):
        writer.put("A", struct.pack("<BH", number % 256, number) + b"a")
        writer.put("R", struct.pack("<H", number))
    for number in range(1003):
        writer.put("A", struct.pack("<BH", number % 256, number) + b"a")
    records = parse(bytes(writer.data), verify=False)
    assert sum(isinstance(each, Subscription) for each in records) == 1000
    assert len({each.reason for each in records if isinstance(each, Damage)}) == 1


@pytest.mark.parametrize(
    ("kind", "content"),
    [
        ("Z", b"from the future"), ("z", b""), ("7", b"from the future"), ("_", b"private"),
        ("S", bytes.fromhex("2f731320250cbb12") + b"more"), ("O", struct.pack("<H", 10) + b"more"),
        ("I", b"\x0dfloat16_t abcxx"), ("M", b"\0\x0down_struct abc123"), ("P", b"\x0bint32_t abc1234more"),
    ],
)  # fmt: skip
def test_unknown_record_types_are_skipped(kind: str, content: bytes) -> None:
    """Record types, value types and trailing fields that a later version may add are not damage."""
    writer = UlogWriter()
    writer.define([VLP])
    for number in range(5):
        writer.add(VLP, VehicleLocalPosition(timestamp=number, x=1.0))
        writer.put(kind, content)
    records = parse(bytes(writer.data))
    assert len(data_of(records)) == 5
    assert not any(isinstance(each, Damage) for each in records)
