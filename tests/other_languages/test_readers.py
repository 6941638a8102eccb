"""Independent readers of recordings and saved logs return every value that was written."""

from __future__ import annotations

import math
import random
import struct
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest
from pyulog import ULog
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from docs.generator.vectors import definition_of, from_json
from nedbus.flights import RecordingWriter
from nedbus.mavlink.log_reassembly import Chunk
from nedbus.sources.mavlink.log_client import LogStatus, LogStreamClient
from nedbus.sources.mavlink.log_stream import LogStream
from nedbus.sources.options import MavlinkOptions
from nedbus_msgs import TOPICS, Address, Provenance
from tests.flights.ulogs import UlogWriter

from .programs import run_program
from .test_vectors import FILE

MCAP_READERS: Final = {
    "@mcap/core": (
        "read_mcap.mjs",
        [
            "@mcap/core@2.2.2",
            "@foxglove/rosmsg@5.0.5",
            "@foxglove/rosmsg2-serialization@3.1.0",
            "fzstd",
        ],
    ),
    "mcap-ros2-support": ("read_mcap.py", ["mcap-ros2-support==0.6.0"]),
    "mcap in Rust": ("read_mcap.rs", ['mcap = "0.26"']),
    "mcap in Go": ("read_mcap.go", ["github.com/foxglove/mcap/go/mcap"]),
}
ULOG_READERS: Final = {
    "@foxglove/ulog": ("read_ulog.mjs", ["@foxglove/ulog@2.3.2"]),
    "yule_log": ("read_ulog.rs", ['yule_log = "0.4"']),
    "px4-ulog": ("read_ulog_columns.rs", ['px4-ulog = "0.6"']),
}
TYPES: Final = {
    "int8_t": "b", "uint8_t": "B", "int16_t": "h", "uint16_t": "H", "int32_t": "i", "uint32_t": "I", "int64_t": "q",
    "uint64_t": "Q", "float": "f", "double": "d", "bool": "?",
}  # fmt: skip
"""Basic types of ULog, and their codes."""
EXTREMES: Final = {
    "f": (math.nan, math.inf, -math.inf, -0.0),
    "d": (math.nan, -0.0, 1e300),
    "?": (True, False),
}
# by stream and field; the elements of arrays one after the other
Texts = Mapping[tuple[str, str], list[str]]
Values = Mapping[tuple[str, str], list[Any]]

# packages may be downloaded, compiled
pytestmark = [pytest.mark.long, pytest.mark.process, pytest.mark.timeout(900)]


def parse(output: str) -> Texts:
    """Return the values in the output of a reader."""
    found = defaultdict[tuple[str, str], list[str]](list)
    # of readers that print each element of arrays
    columns = defaultdict[tuple[str, str], dict[str, list[str]]](dict)
    for line in output.splitlines():
        stream, field, values = line.split("\t")
        name, is_element, index = field.partition("[")
        if is_element:
            columns[stream, name][f"{index:>4}"] = values.split()
        elif not stream.endswith("/log") and not field.startswith("_padding"):
            found[stream, field] += values.split()
    for key, elements in columns.items():
        rows = zip(*(elements[index] for index in sorted(elements)), strict=True)
        found[key] += [value for row in rows for value in row]
    return found


def assert_equal(found: Texts, expected: Values) -> None:
    """Compare each value; -0 differs from 0, and all NaNs are equal."""
    assert found.keys() == expected.keys()
    for key, values in expected.items():
        texts = found[key]
        assert len(texts) == len(values), key
        kind = type(values[0])
        read = [
            {"true": True, "false": False}[each.lower()] if kind is bool else kind(each)
            for each in texts
        ]
        if key[1] == "text":  # mcap-ros2-support reads ROS 2's char as signed
            read = [each % 256 for each in read]
        assert repr(read) == repr(values), key


def flat(value: Any) -> list[Any]:
    """Return the values of a field as a list, a text as bytes."""
    return [*value] if isinstance(value, tuple | bytes) else [value]


def write_recording(path: Path) -> Values:
    """Write each test vector of a current layout as a message, and return the values."""
    expected, rows = defaultdict[tuple[str, str], list[Any]](list), []
    for number, case in enumerate(FILE["exact"]):
        definition = definition_of(case["message"], FILE["definitions"])
        if case["layout"] != definition.current.wire:
            continue
        topic = next(iter(definition.topics), "wire_types")
        message = definition.model(**from_json(case["values"], definition.types))
        instance = 0 if topic in TOPICS and TOPICS[topic].instances else None
        address, logged = Address("7", topic, instance), 10**9 + number
        rows.append((message, address, Provenance("vectors"), logged))
        expected[f"/{address}", "@times"] += [logged, min(message.timestamp * 1000, 2**64 - 1)]
        for name, kind in definition.types.items():
            value = getattr(message, name)
            value = value.encode().ljust(kind.size, b"\0") if kind.is_text else value
            expected[f"/{address}", name] += flat(value)
    with RecordingWriter(path) as writer:
        writer.write_messages(rows)
    return expected


def decode(output: str) -> Texts:
    """Return the values in the output of a reader that prints each definition and payload, decoded with rosbags."""
    store, lines = get_typestore(Stores.EMPTY), list[str]()
    for line in output.splitlines():
        topic, times, name, definition, payload = line.split("\t")
        if topic.endswith("/log"):
            continue
        if name not in store.types:
            store.register(get_types_from_msg(bytes.fromhex(definition).decode(), name))
        decoded: Any = store.deserialize_cdr(bytes.fromhex(payload), name)
        lines.append(f"{topic}\t@times\t{times}")
        for field in decoded.__dataclass_fields__:
            value = getattr(decoded, field)
            values = (
                value.tolist()
                if hasattr(value, "tolist")
                else value
                if isinstance(value, list)
                else [value]
            )
            lines.append(f"{topic}\t{field}\t{' '.join(map(str, values))}")
    return parse("\n".join(line for line in lines if "__msgtype__" not in line))


@pytest.mark.parametrize("reader", MCAP_READERS)
def test_every_value_of_a_recording_is_read(reader: str, tmp_path: Path) -> None:
    """A reader of MCAP returns each value, log time and publish time of a recording."""
    expected = write_recording(tmp_path / "a.mcap")
    source, packages = MCAP_READERS[reader]
    output = run_program(source, packages, [str(tmp_path / "a.mcap")], tmp_path)
    assert_equal(
        decode(output) if reader in ("mcap in Rust", "mcap in Go") else parse(output), expected
    )


def save_stream(folder: Path) -> tuple[Path, Values]:
    """Return the file that `save=` writes of a stream with all types, arrays, a text and two instances; its values."""
    fields = {name.removesuffix("_t"): name for name in TYPES} | {
        f"{each}s": f"{each}[2]" for each in TYPES
    }
    fields = {"timestamp": "uint64_t", "text": "char[4]", **fields}
    definition = (
        "".join(f"{kind} {name};" for name, kind in fields.items()) + "uint8_t[5] _padding0;"
    )
    writer, values, rng = (
        UlogWriter(),
        defaultdict[tuple[str, str], list[Any]](list),
        random.Random(1),
    )
    writer.put("F", f"types:{definition}".encode())
    for instance in (0, 1):
        writer.put("A", struct.pack("<BH", instance, instance) + b"types")
    for time in range(50):
        payload = struct.pack("<H", time % 2)
        for name, kind in fields.items():
            base, _, length = kind.partition("[")
            if name == "timestamp":
                data, code = struct.pack("<Q", time), "<Q"
            elif base == "char":
                data, code = b"text", "<4B"
            else:
                count = int(length.rstrip("]") or 1)
                code = f"<{count}{TYPES[base]}"
                extremes = EXTREMES.get(TYPES[base], ())
                data = rng.randbytes(struct.calcsize(code))
                if extremes and (TYPES[base] == "?" or not time % 3):
                    data = struct.pack(code, *rng.choices(extremes, k=count))
            payload += data
            values[f"types/{time % 2}", name] += struct.unpack(code, data)
        writer.put("D", payload)
    client = cast(
        "LogStreamClient", SimpleNamespace(status=LogStatus("streaming"), header_seconds=1.0)
    )
    stream = LogStream("1", MavlinkOptions(log="1", save=str(folder / "saved")), client)
    for start in range(0, len(writer.data), 249):
        list(
            stream.add(
                Chunk("delivered", bytes(writer.data[start : start + 249]), begins=not start), 0.0
            )
        )
    stream.end()
    [path] = (folder / "saved").iterdir()
    return path, values


@pytest.mark.parametrize("reader", ULOG_READERS)
def test_every_value_of_a_saved_stream_is_read(reader: str, tmp_path: Path) -> None:
    """A reader of ULog returns each value of the log that `save=` writes."""
    path, expected = save_stream(tmp_path)
    source, packages = ULOG_READERS[reader]
    assert_equal(parse(run_program(source, packages, [str(path)], tmp_path)), expected)


def test_every_value_of_a_saved_stream_is_read_by_pyulog(tmp_path: Path) -> None:
    path, expected = save_stream(tmp_path)
    lines = [
        f"{each.name}/{each.multi_id}\t{name}\t"
        + " ".join(
            str(bool(value) if name.startswith("bool") else value) for value in values.tolist()
        )  # bools are int8
        for each in ULog(str(path)).data_list
        for name, values in each.data.items()
    ]
    assert_equal(parse("\n".join(lines)), expected)
