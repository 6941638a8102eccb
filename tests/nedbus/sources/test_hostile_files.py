"""Small files that describe gigabytes, or take hours to parse: rejected, or read within fixed resources."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

import pytest
from mcap.writer import Writer

from tests.flights.ulogs import UlogWriter
from tests.peers.processes import Start

_SECONDS: Final = 30  # CPU time limit for all readers, on any machine; they need 1 to 2 s
_MEMORY: Final = 100_000  # KiB

# All readers of files in one process; only nedbus's own errors are allowed, which the command line shows as one line.
_READ: Final = """
import resource, sys
from pathlib import Path
import nedbus, nedbus.cli.app, nedbus.sources, nedbus.web.playback
from nedbus.recording import plot
from nedbus.sources.options import RecordedOptions
path = Path(sys.argv[1])
for module in ("nedbus.sources.mcap", "nedbus.recording.mcap_writer"):
    __import__(module)

def convert():
    replay = nedbus.sources.parse_source(nedbus.sources.source_text_of_file(path, topics="*")).open_source(vehicle="1")
    target = path.with_name("converted.mcap")
    nedbus.sources.convert(replay.open(), target, source="ulog", on_progress=lambda _: None)

def play():
    recording = nedbus.web.playback.Recording(path)
    while not recording.is_read:
        pass

uses = [
    lambda: nedbus.read(path, ["*"]), lambda: nedbus.align(path, on=10.0), lambda: nedbus.utc_of(path),
    lambda: nedbus.sources.read_file_events(path), convert, play,
]
resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for use in uses:
    try:
        use()
        print("read")
    except nedbus.NedbusError as exc:
        print(exc)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
""".replace("SECONDS", str(_SECONDS))


def _ulog(formats: Iterable[str], subscriptions: Iterable[str], size: int = 8, repeat: int = 1) -> bytes:
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


def _mcap(texts: Iterable[str], path: Path) -> bytes:
    """Return a recording with a message of each schema."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for number, text in enumerate(texts):
            schema = writer.register_schema(f"px4_msgs/msg/Other{number}", "ros2msg", text.encode())
            channel = writer.register_channel(f"/fmu/out/other{number}", "cdr", schema)
            writer.add_message(channel, 0, b"\0\1\0\0" + bytes(8), 0)
        writer.finish()
    return path.read_bytes()


STAMP: Final = "uint64 timestamp\n"
PART: Final = "\n===\nMSG: px4_msgs/"
TOPICS: Final = [f"t{number}" for number in range(5000)]
ULOGS: Final[dict[str, Callable[[], bytes]]] = {
    "nested": lambda: _ulog(
        ["n:uint64_t timestamp;n0 a;", *(f"n{i}:n{i + 1}[300] a;" for i in range(6)), "n6:uint8_t a;"], ["n"]
    ),
    "wide": lambda: _ulog(["n:uint64_t timestamp;w[300] a;", "w:v[300] a;", "v:uint8_t[300] a;"], ["n"]),
    "recursive": lambda: _ulog(["n:uint64_t timestamp;n[300] a;"], ["n"]),
    "cycle": lambda: _ulog(["n:uint64_t timestamp;m a;", "m:n a;"], ["n"]),
    "known": lambda: _ulog(
        ["vehicle_local_position:uint64_t timestamp;n a;", "n:n[300] a;"], ["vehicle_local_position"]
    ),
    "name": lambda: _ulog(["n:uint64_t timestamp;m[999] " + "a" * 60_000 + ";", "m:uint8_t a;"], ["n"]),
    "topics": lambda: _ulog([f"{name}:uint64_t timestamp;" for name in TOPICS], TOPICS),
    "fields": lambda: _ulog(
        [f"t{i}:uint64_t timestamp;" + "".join(f"float f{k};" for k in range(255)) for i in range(200)],
        TOPICS[:200],
        1028,
    ),
    "rejected": lambda: _ulog(
        ["t0:uint64_t timestamp;" + "".join(f"float f{k};" for k in range(1500))], ["t0"], 8, 50_000
    ),
    "instances": lambda: _ulog(
        ["t0:uint64_t timestamp;uint8_t[8] _padding0;"], [f"t0:{i % 200}" for i in range(20_000)]
    ),
}
SCHEMAS: Final[dict[str, Callable[[], Iterable[str]]]] = {
    "fields": lambda: [STAMP + "".join(f"uint8 f{number}\n" for number in range(19_000))],
    "nested": lambda: [STAMP + f"A[999] a{PART}A\nB[999] b{PART}B\nC[999] c{PART}C\nuint8 d\n"],
    "empty arrays": lambda: [
        f"{STAMP}A[999] a{PART}A\nB[999] b{PART}B\n" + "".join(f"C[0] c{i}\n" for i in range(9000)) + f"{PART}C\nbool d"
    ],
    "recursive": lambda: [STAMP + f"A[999] a{PART}A\nB[999] b{PART}B\nA[999] a\n"],
    "name": lambda: [STAMP + "A[999] " + "a" * 200_000 + f"{PART}A\nuint8 b\n"],
    "messages": lambda: [f"{STAMP}uint8 f{number}" for number in range(5000)],
    "large messages": lambda: [STAMP + "".join(f"uint8 f{i}_{n}\n" for i in range(250)) for n in range(400)],
    "annotation": lambda: [STAMP + "uint8 a # @range" + " " * 100_000, STAMP + "uint8 a # @range " + "9" * 100_000],
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", ULOGS)
def test_hostile_log_is_read_within_limits(start: Start, tmp_path: Path, kind: str) -> None:
    """All code that reads logs stays within limits of time and memory, whatever the formats describe."""
    (tmp_path / "hostile.ulg").write_bytes(ULOGS[kind]())
    _check(start, tmp_path / "hostile.ulg")


@pytest.mark.slow
@pytest.mark.parametrize("kind", SCHEMAS)
def test_hostile_recording_is_read_within_limits(start: Start, tmp_path: Path, kind: str) -> None:
    """All code that reads recordings stays within limits of time and memory, whatever the schemas describe."""
    _mcap(SCHEMAS[kind](), tmp_path / "hostile.mcap")
    _check(start, tmp_path / "hostile.mcap")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["nested", "topics", "instances"])
def test_service_ends_after_hostile_log(run_nedbus: Start, endpoint: str, tmp_path: Path, kind: str) -> None:
    """A service publishes the decodable messages of a hostile log, and exits with 1."""
    (tmp_path / "hostile.ulg").write_bytes(ULOGS[kind]())
    service = run_nedbus("serve", "-s", f"ulog:{tmp_path}/hostile.ulg?topics=*", "-c", endpoint, "--until-done")
    assert service.wait() == 1
    assert "more than" in service.err
    assert (" 0 published" in service.err) == (kind == "nested")


def _check(start: Start, path: Path) -> None:
    process = start("-c", _READ, str(path))
    assert process.wait(100.0) == 0, process.err
    *_, growth = process.out.split()
    assert int(growth) < _MEMORY, process.out
