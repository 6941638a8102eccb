"""Files just beyond the limits of definitions: all code that reads them stays within fixed resources."""

from __future__ import annotations

import signal
import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

import pytest
from mcap.writer import Writer

import nedbus
from tests.flights.replays import open_replay
from tests.flights.ulogs import UlogWriter
from tests.nedbus.ulog import test_parser as log_limits
from tests.peers.processes import Start
from tests.waits import Stopwatch, wait_for

_SECONDS: Final = 30  # CPU time limit for all readers, on any machine; they need 1 to 2 s
_MEMORY: Final = 100_000  # KiB
_STOP: Final = 3.0  # s that the service sleeps while it stops; less than 1 s

# All readers of files in one process; only nedbus's own errors are allowed, which the command line shows as one line.
_READ: Final = """
import resource, sys
from pathlib import Path
import nedbus, nedbus.cli.app, nedbus.flights, nedbus.sources, nedbus.web.playback
from nedbus.tables import plot
from nedbus.sources.options import RecordedOptions
path = Path(sys.argv[1])
for module in ("nedbus.flights.readers.mcap", "nedbus.flights.writer"):
    __import__(module)

def convert():
    with nedbus.flights.open_messages([path], nedbus.flights.ReadOptions(topics=None)) as flight:
        nedbus.flights.convert_flight(flight, path.with_name("converted.mcap"), on_progress=lambda *_: None)

def play():
    recording = nedbus.web.playback.Recording(path)
    while not recording.is_read:
        pass

uses = [
    lambda: nedbus.read(path, ["*"]), lambda: nedbus.align(path, on=10.0), lambda: nedbus.utc_of(path),
    lambda: nedbus.flights.read_file_events(path), convert, play,
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


def _mcap(texts: Iterable[str], path: Path) -> bytes:
    """Return a recording with a message of each schema."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for number, text in enumerate(texts):
            schema = writer.register_schema(
                f"px4_msgs/msg/Other{number}x", "ros2msg", text.encode()
            )
            channel = writer.register_channel(f"/fmu/out/other{number}x", "cdr", schema)
            writer.add_message(channel, 0, b"\0\1\0\0" + bytes(8), 0)
        writer.finish()
    return path.read_bytes()


STAMP: Final = "uint64 timestamp\n"
PART: Final = "\n===\nMSG: px4_msgs/"
CUBE: Final = f"{STAMP}A[20] a{PART}A\nB[20] b{PART}B\n"
LIMITS: Final[dict[str, tuple[Callable[[], Iterable[str]], str]]] = {
    "fields": (lambda: [STAMP + "".join(f"uint8 f{number}\n" for number in range(1000))], "more than 1000 fields"),
    "nested fields": (lambda: [f"{CUBE}C[20] c{PART}C\nuint8 d\n"], "more than 1000 fields"),
    "empty arrays": (lambda: [CUBE + "".join(f"C[0] c{i}\n" for i in range(20)) + f"{PART}C\nbool d"], "is not a type"),
    "levels": (lambda: [f"{CUBE}C c{PART}C\nD d{PART}D\nuint8 e\n"], "'D' is not a type"),
    "name": (lambda: [f"{STAMP}A[20] {'a' * 256}{PART}A\nuint8 b\n"], "expected a field"),
    "messages": (lambda: [f"{STAMP}uint8 f{number}" for number in range(500)], "the definitions in this file exceed"),
    "large messages": (
        lambda: [STAMP + "".join(f"uint8 f{i}_{n}\n" for i in range(250)) for n in range(70)],
        "the definitions in this file exceed the limit, which is the size of 250 PX4 topics",
    ),
    "comment": (lambda: [f"{STAMP}uint8 a # @range{' ' * 2000}0, 1"], "ignored the ranges"),
}  # fmt: skip
"""Definitions that exceed one limit, and its reason; other readers may have none, so they exceed it only slightly."""


@pytest.mark.parametrize("kind", LIMITS)
def test_recording_beyond_a_limit_has_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """A recording whose definitions exceed a limit reports it; here the limit for all definitions is an eighth."""
    monkeypatch.setattr("nedbus.flights.readers.mcap._DEFINITION_BUDGET", 2000)
    make, reason = LIMITS[kind]
    path = tmp_path / "limits.mcap"
    _mcap(make(), path)
    try:
        run = open_replay(f"mcap:{path}?topics=*")
        reasons = [*run.messages] and " ".join(run.warnings)
    except nedbus.SourceError as exc:
        reasons = str(exc)
    assert reason in reasons


@pytest.mark.long
@pytest.mark.parametrize("kind", log_limits.LIMITS)
def test_log_beyond_a_limit_is_read_within_limits(start: Start, tmp_path: Path, kind: str) -> None:
    """All code that reads logs stays within limits of time and memory, whatever the formats describe."""
    (tmp_path / "limits.ulg").write_bytes(log_limits.LIMITS[kind][0]())
    _check(start, tmp_path / "limits.ulg")


@pytest.mark.long
@pytest.mark.parametrize("kind", LIMITS)
def test_recording_beyond_a_limit_is_read_within_limits(
    start: Start, tmp_path: Path, kind: str
) -> None:
    """All code that reads recordings stays within limits of time and memory, whatever the schemas describe."""
    _mcap(LIMITS[kind][0](), tmp_path / "limits.mcap")
    _check(start, tmp_path / "limits.mcap")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["nested fields", "topics", "subscriptions"])
def test_service_ends_after_log_beyond_a_limit(
    run_nedbus: Start, endpoint: str, tmp_path: Path, kind: str
) -> None:
    """A service publishes the decodable messages of a log beyond a limit, and exits with 1."""
    (tmp_path / "limits.ulg").write_bytes(log_limits.LIMITS[kind][0]())
    service = run_nedbus(
        "serve", "-s", f"ulog:{tmp_path}/limits.ulg?topics=*", "-c", endpoint, "--until-done"
    )
    assert service.wait() == 1
    assert "more than" in service.err
    assert (" 0 published" in service.err) == (kind == "nested fields")


def _check(start: Start, path: Path) -> None:
    process = start("-c", _READ, str(path))
    assert process.wait(100.0) == 0, process.err
    *_, growth = process.out.split()
    assert int(growth) < _MEMORY, process.out


@pytest.mark.slow
@pytest.mark.parametrize("options", ["", "&speed=max&loop=1"])
def test_service_with_many_topics_stops(
    run_nedbus: Start, endpoint: str, tmp_path: Path, options: str
) -> None:
    """Ctrl-C stops a service whose log rotates through 450 topics, without waiting for a timeout."""
    log = UlogWriter()
    fields = "".join(f"float value_{number};" for number in range(15))
    for number in range(450):
        log.put("F", f"other{number}:uint64_t timestamp;{fields}".encode())
        log.put("A", struct.pack("<BH", 0, number) + f"other{number}".encode())
    for number in range(10_000):
        log.put("D", struct.pack("<HQ60x", number % 450, 1_000_000 + 100 * number))
    path = log.write(tmp_path / "many.ulg")
    service = run_nedbus(
        "serve", "-s", f"ulog:{path}?topics=*{options}", "-c", endpoint, coverage=False
    )
    wait_for(lambda: "MB" in service.err, what="the start of the replay")
    with Stopwatch(service.popen.pid) as watch:
        service.signal(signal.SIGINT)
        assert service.wait() == 130, service.err
    assert watch.seconds < _STOP
    assert "exiting anyway" not in service.err
