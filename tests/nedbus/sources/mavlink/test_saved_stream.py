"""Files of a ULog stream: the log, which contains only complete records, and the state of the stream."""

from __future__ import annotations

import errno
import os
import random
import signal
import struct
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from hashlib import sha256
from pathlib import Path
from shutil import rmtree
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest
from pyulog import ULog

from nedbus import limits
from nedbus.mavlink.log_reassembly import Chunk
from nedbus.sources import Rejection, SourceMessage
from nedbus.sources.mavlink.log_client import LogStatus, LogStreamClient
from nedbus.sources.mavlink.log_stream import LogFile, LogStream
from nedbus.sources.mavlink.saved_stream import StreamFile, read_stream, state_path
from nedbus.sources.options import MavlinkOptions
from tests.flights.ulogs import UlogWriter, write_log, write_raw_log
from tests.nedbus.ulog.test_parser import small_log
from tests.peers.processes import Start, without_coverage

BEGIN: Final = 1500
"""Length of a first write that contains the definitions and some messages of the small log."""
KILLS: Final = 50
CHUNK_SIZE: Final = 249
"""Data bytes per LOGGING_DATA."""
SAVE: Final = f"""
import os, sys, time
from pathlib import Path
from nedbus.sources.mavlink.log_stream import LogFile
log = Path(sys.argv[1]).read_bytes()
for folder in sys.stdin:
    if not (pid := os.fork()):
        print(os.getpid(), flush=True)
        file = LogFile(Path(folder.strip()), "1")
        for start in range(0, len(log), {CHUNK_SIZE}):
            file.write(log[start : start + {CHUNK_SIZE}])
            print(file.path.stat().st_size, flush=True)
        time.sleep(3600)
    os.waitpid(pid, 0)
    print("killed", flush=True)
"""
FILL: Final = f"""
import resource, sys
from pathlib import Path
from nedbus.sources.mavlink.log_stream import LogFile
sys.dont_write_bytecode = True  # the limit would truncate it
log, file = Path(sys.argv[1]).read_bytes(), LogFile(Path(sys.argv[2]), "1")
file.write(log[:{BEGIN}])
size = file.path.stat().st_size + 5  # as on a full disk, the first write of what follows is a short one
resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
try:
    file.write(log[{BEGIN}:])
except OSError as exc:
    print(exc.strerror)
file.close()
"""


def test_file_is_valid_after_each_write(tmp_path: Path) -> None:
    """After each write the file contains only complete records, however the stream is split."""
    log, file = small_log(), LogFile(tmp_path, "1")
    file.write(log[:BEGIN])
    counts = []
    for start in range(BEGIN, len(log), 97):
        file.write(log[start : start + 97])
        saved = ULog(str(file.path))
        assert not saved.file_corruption
        counts.append(len(saved.data_list[0].data["timestamp"]))
    file.close()
    assert counts == sorted(counts)
    assert counts[-1] == 20
    assert file.path.read_bytes() == log


def test_gap_is_saved_as_dropout(tmp_path: Path) -> None:
    """The record that a gap interrupts is discarded, and the gap is saved as a dropout with its duration."""
    log, file = small_log(), LogFile(tmp_path, "1")
    file.write(log[: len(log) - 100])
    file.mark_gap(0.25)
    file.close()
    saved = ULog(str(file.path))
    assert [each.duration for each in saved.dropouts] == [250]
    assert not saved.file_corruption


@pytest.mark.slow
def test_full_disk_leaves_complete_records(start: Start, tmp_path: Path) -> None:
    """A write of which only a part fits on the disk raises, and its part is removed."""
    log, expected = small_log(), LogFile(tmp_path / "expected", "1")
    expected.write(log[:BEGIN])
    expected.close()
    (tmp_path / "log.ulg").write_bytes(log)
    process = start("-c", FILL, str(tmp_path / "log.ulg"), str(tmp_path / "saved"), coverage=False)
    assert process.wait() == 0, process.err
    assert process.out == "File too large\n"
    (saved,) = (tmp_path / "saved").iterdir()
    assert saved.read_bytes() == expected.path.read_bytes()
    assert not ULog(str(saved)).file_corruption


def test_streams_in_the_same_second_get_separate_files(tmp_path: Path) -> None:
    """Streams that begin in the same second get separate files; a folder that cannot be created raises."""
    files = [LogFile(tmp_path / "logs", "1") for _ in range(3)]
    for each in files:
        each.close()
    assert len({each.path for each in files}) == 3
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        LogFile(tmp_path / "file" / "logs", "1")


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.timeout(300)
def test_killed_process_leaves_valid_log(tmp_path: Path) -> None:
    """After SIGKILL at any of 50 random moments the file contains only complete records of the log."""
    path = write_log(tmp_path / "flight.ulg", range(0, 20_000_000, 10_000))
    log, chance = path.read_bytes(), random.Random(1)
    command = [sys.executable, "-c", SAVE, os.fspath(path)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=without_coverage()
    ) as process:
        assert process.stdin
        assert process.stdout
        for number in range(KILLS):
            print(tmp_path / f"{number}", file=process.stdin, flush=True)
            pid, count = int(process.stdout.readline()), chance.randrange(1, len(log) // CHUNK_SIZE)
            written = [int(process.stdout.readline()) for _ in range(count)][-1]
            os.kill(pid, signal.SIGKILL)
            # may follow an unfinished line
            while not process.stdout.readline().endswith("killed\n"):
                pass
            (saved,) = (tmp_path / f"{number}").iterdir()
            content = saved.read_bytes()
            assert len(content) >= written > count * CHUNK_SIZE - CHUNK_SIZE - 2**12
            assert log.startswith(content)
            assert not ULog(str(saved)).file_corruption
        process.stdin.close()


class TestState:
    """The state file, from which a restarted process continues a stream."""

    DEFINITIONS: Final = b"ULog" + bytes(100)

    def save(self, tmp_path: Path, system: int = 7) -> Path:
        """Save a stream whose last message arrived at host time 1000 s and vehicle time 50 s, with sequence 65,000."""
        path = state_path(MavlinkOptions(state=str(tmp_path)), "udpin:0.0.0.0:14540", system)
        assert path
        file = StreamFile(path, system)
        file.write(self.DEFINITIONS)
        file.update(65_000, 50_000_000, 1000.0)
        assert file.is_current
        file.close()
        return path

    def test_definitions_and_progress_are_read_back(self, tmp_path: Path) -> None:
        """The file has the definitions, later ones, too, and the last progress; `remove` deletes it."""
        path = self.save(tmp_path)
        assert read_stream(path, 7) == (self.DEFINITIONS, 1000.0, 50_000_000, 65_000)
        file = StreamFile(path, 7)
        file.write(self.DEFINITIONS)
        file.update(1, 2, 3.0)
        file.append(b"more")
        assert read_stream(path, 7) == (self.DEFINITIONS + b"more", 3.0, 2, 1)
        file.close(remove=True)
        assert [*tmp_path.iterdir()] == []

    @pytest.mark.parametrize(("elapsed", "vehicle", "is_same"), [
        (1.0, 51.0, True), (1.0, 51.9, True), (1.0, 1.0, False), (1.0, 54.0, False),
        (100.0, 148.1, True), (100.0, 100.0, False), (3600.0, 3650.0 * 0.99, True),
    ])  # fmt: skip
    def test_boot_is_identified_by_the_clocks_of_vehicle_and_host(
        self, tmp_path: Path, elapsed: float, vehicle: float, is_same: bool
    ) -> None:
        """The vehicle's clock has advanced like the host's, within 2 s and the drift of a clock; else it rebooted."""
        saved = read_stream(self.save(tmp_path), 7)
        with (
            nullcontext()
            if is_same
            else pytest.raises(ValueError, match="the vehicle has rebooted")
        ):
            saved.check_boot(round(vehicle * 1e6), 1000.0 + elapsed)

    @pytest.mark.parametrize(("change", "reason"), [
        (lambda data: data[:20], "was not written by this release"),
        (lambda data: b"", "was not written by this release"),
        (lambda data: b"nedbusS9" + data[8:], "was not written by this release"),
        (lambda data: data[:-1], "is damaged"),
        (lambda data: data[:-1] + b"x", "is damaged"),
        (lambda data: data + b"x", "is damaged"),
        (lambda data: data[:8] + bytes([data[8] ^ 1]) + data[9:], "this host has rebooted"),
        (lambda data: data[:24] + b"\x09" + data[25:], "is of system 9"),
    ])  # fmt: skip
    def test_unusable_file_raises_with_reason(
        self, tmp_path: Path, change: Callable[[bytes], bytes], reason: str
    ) -> None:
        """A file that is damaged, of another version, host boot or vehicle is not used."""
        path = self.save(tmp_path)
        path.write_bytes(change(path.read_bytes()))
        with pytest.raises(ValueError, match=reason):
            read_stream(path, 7)

    def test_missing_file_and_disabled_state_raise(self, tmp_path: Path) -> None:
        """Without a file the reason names the folder; `state=0` writes none."""
        with pytest.raises(ValueError, match=f"not in {tmp_path}"):
            read_stream(tmp_path / "a", 7)
        path = state_path(MavlinkOptions(state="0"), "link", 7)
        with pytest.raises(ValueError, match="state=0"):
            read_stream(path, 7)
        file = StreamFile(path, 7)
        file.write(b"definitions")
        file.update(1, 1, 1.0)
        assert not file.is_current

    def test_folder_follows_systemd_and_xdg(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """By default the file is in systemd's StateDirectory, else in the XDG state folder; one for each link."""
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "xdg"))
        options = MavlinkOptions()
        one, two = (
            state_path(options, link, 1) for link in ("udpin:0.0.0.0:14540", "udpin:0.0.0.0:14541")
        )
        assert one
        assert one != two
        assert one.parent == tmp_path / "xdg" / "nedbus" / "ulog-streams"
        monkeypatch.setenv("STATE_DIRECTORY", f"{tmp_path}/systemd:/other")
        assert (
            state_path(options, "", 1)
            == tmp_path / "systemd" / "ulog-streams" / f"{sha256(b'').hexdigest()[:16]}-1"
        )

    def test_folder_that_cannot_be_written_is_logged_once(
        self,
        tmp_path: Path,
        caplog: pytest.LogCaptureFixture,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        """Without a writable folder, or with very long definitions, the stream cannot be continued later."""
        (tmp_path / "file").write_text("")
        file = StreamFile(tmp_path / "file" / "state", 7)
        for _ in range(3):
            file.write(b"definitions")
            file.update(1, 1, 1.0)
        assert not file.is_current
        assert len(caplog.messages) == 1
        assert "cannot be continued: set state=" in caplog.text
        file = StreamFile(tmp_path / "state", 7)
        monkeypatch.setattr(limits, "LOG_STREAM_PENDING", 1000)
        file.write(bytes(1001))
        assert not file.is_current
        file.write(bytes(1000))
        assert file.is_current
        file.close()


def stream_with_files(folder: Path) -> tuple[LogStream, bytes, bytes]:
    """Return a stream that saves to a folder, its header, and a data record."""
    path = write_raw_log(
        folder / "a.ulg", {"noise": ("uint64_t timestamp;uint8_t[87] data;", "Q87x")}, []
    )
    client = cast(
        "LogStreamClient", SimpleNamespace(status=LogStatus("streaming"), header_seconds=1.0)
    )
    options = MavlinkOptions(log="1", save=str(folder / "saved"))
    return (
        LogStream("1", options, client),
        path.read_bytes(),
        struct.pack("<HBHQ87x", 97, ord("D"), 0, 1),
    )


class TestFilesOfStream:
    """Files that a stream creates with `save=`."""

    def test_header_without_messages_creates_no_file(self, tmp_path: Path) -> None:
        """A header that stalls, or is repeated, leaves no file."""
        stream, header, _ = stream_with_files(tmp_path)
        for now in range(100):
            assert not [*stream.add(Chunk("delivered", header, begins=True), 10.0 * now)]
        stream.end()
        assert not (tmp_path / "saved").exists()
        assert stream.status(1e6).unsaved == 0

    def test_one_file_in_five_seconds(self, tmp_path: Path) -> None:
        """Of streams that follow each other within 5 s one is saved; the bytes of the others are counted."""
        stream, header, record = stream_with_files(tmp_path)
        for number in range(100):
            now = 100.0 + number / 10
            for chunk in (Chunk("delivered", header, begins=True), Chunk("delivered", record)):
                assert all(isinstance(each, SourceMessage) for each in stream.add(chunk, now))
        stream.end()
        assert len([*(tmp_path / "saved").iterdir()]) == 2
        assert stream.status(1e6).unsaved == 98 * (len(header) + len(record))

    def test_second_stream_within_five_seconds_is_saved_completely(self, tmp_path: Path) -> None:
        """A stream that begins within 5 s after a file is kept in memory until then, with its gaps."""
        stream, header, record = stream_with_files(tmp_path)
        found = 0
        for now, chunk in (
            (100.0, Chunk("delivered", header, begins=True)), (100.1, Chunk("delivered", record)),
            (101.0, Chunk("delivered", header, begins=True)), (101.1, Chunk("delivered", record)),
            (102.1, Chunk("delivered", record, lost=3)), (106.0, Chunk("delivered", record)),
        ):  # fmt: skip
            found += len([*stream.add(chunk, now)])
        stream.end()
        assert found == 4
        saved = [
            ULog(str(each))
            for each in sorted((tmp_path / "saved").iterdir(), key=lambda each: each.stat().st_size)
        ]
        assert [len(each.data_list[0].data["timestamp"]) for each in saved] == [1, 3]
        assert [[each.duration for each in log.dropouts] for log in saved] == [[], [1000]]
        assert stream.status(1e6).unsaved == 0

    def test_all_bytes_that_a_full_disk_refuses_are_counted(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """If the disk is full when the stream before the first message is written, all parts of it count."""
        stream, header, record = stream_with_files(tmp_path)
        parts = [header[start : start + 7] for start in range(0, len(header), 7)]
        monkeypatch.setattr("nedbus.sources.mavlink.log_stream.LogFile.write", _refuse)
        for index, part in enumerate(parts):
            assert not [*stream.add(Chunk("delivered", part, begins=not index), 100.0)]
        assert len([*stream.add(Chunk("delivered", record), 100.1)]) == 1
        assert stream.status(100.1).unsaved == len(header) + len(record)

    def test_deleted_folder_is_logged_once_and_counted(
        self, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        """Data for a file that was deleted in flight is counted, and its loss is logged once."""
        stream, header, record = stream_with_files(tmp_path)
        for chunk in (Chunk("delivered", header, begins=True), Chunk("delivered", record)):
            assert stream.status(100.0).unsaved == 0
            assert len([*stream.add(chunk, 100.0)]) <= 1
        rmtree(tmp_path / "saved")
        caplog.clear()
        for now in range(101, 111):
            status = stream.status(float(now))
            assert len([*stream.add(Chunk("delivered", record), float(now))]) == 1
        assert (status.unsaved, status.saved) == (9 * len(record), "")
        assert [each for each in caplog.messages if "stopped saving" in each] == caplog.messages
        assert len(caplog.messages) == 1
        assert "was deleted" in caplog.text


@pytest.mark.slow
def test_topics_of_repeated_headers_are_not_kept(tmp_path: Path) -> None:
    """The addresses of a stream are bounded by its subscriptions; a new header discards those of the last one."""
    stream, *_ = stream_with_files(tmp_path)
    stream = LogStream("1", MavlinkOptions(topics=("*",)), stream._client)
    for number in range(20):
        writer = UlogWriter()
        for index in range(50):
            name = f"topic_{number}_{index}"
            writer.put("F", f"{name}:uint64_t timestamp;".encode())
            writer.put("A", struct.pack("<BH", 0, index) + name.encode())
            writer.put("D", struct.pack("<HQ", index, number))
        assert (
            len([*stream.add(Chunk("delivered", bytes(writer.data), begins=True), float(number))])
            == 50
        )
    assert len(stream._streamed) == 50


def test_changed_definitions_of_continued_stream_are_rejected(tmp_path: Path) -> None:
    """A continued stream with a message of another length is rejected; an unknown id is counted, and reported once."""
    reasons: list[str] = []
    client: Any = SimpleNamespace(
        status=LogStatus("streaming"), header_seconds=None, reject=reasons.append
    )
    _, header, record = stream_with_files(tmp_path)
    stream = LogStream("1", MavlinkOptions(log="1"), client)
    unknown = struct.pack("<HBHQ", 10, ord("D"), 9, 1)
    found = [*stream.add(Chunk("delivered", header, begins=True), 1.0)]
    for chunk in (
        Chunk("delivered", unknown, lost=5),
        Chunk("delivered", unknown),
        Chunk("delivered", record),
    ):
        found += stream.add(chunk, 2.0)
    assert [each.reason for each in found if isinstance(each, Rejection)] == [
        "messages of topics whose definitions were lost are counted as undecodable until the next stream"
    ]
    assert (len(found), stream.status(3.0).undecodable, reasons) == (2, 2, [])
    found = [*stream.add(Chunk("delivered", struct.pack("<HBHQ", 10, ord("D"), 0, 1)), 4.0)]
    assert reasons == ["its definitions changed while no process received it"]


def _refuse(_: object, data: bytes) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
