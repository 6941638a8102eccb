"""Saving a ULog stream: the file contains only complete records."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest
from pyulog import ULog

from nedbus.sources.mavlink.log_stream import LogFile
from tests.flights.ulogs import write_log
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
            while not process.stdout.readline().endswith("killed\n"):  # may follow an unfinished line
                pass
            (saved,) = (tmp_path / f"{number}").iterdir()
            content = saved.read_bytes()
            assert len(content) >= written > count * CHUNK_SIZE - CHUNK_SIZE - 2**12
            assert log.startswith(content)
            assert not ULog(str(saved)).file_corruption
        process.stdin.close()
