"""Saving a ULog stream: the file is a valid log at any moment."""

from __future__ import annotations

from pathlib import Path

import pytest
from pyulog import ULog

from nedbus.errors import OutputError
from nedbus.sources.mavlink.log_file import LogFile
from tests.service.ulog.test_parser import small_log

BEGIN = 1500
"""Bytes that hold the definitions and some messages of the small log."""


def test_file_has_whole_records_after_each_write(tmp_path: Path) -> None:
    """However the stream is cut, pyulog reads the file without damage after every write, as after kill -9."""
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


def test_gap_is_marked_as_dropout(tmp_path: Path) -> None:
    """A gap discards the record that it cut, and is a dropout of its duration."""
    log, file = small_log(), LogFile(tmp_path, "1")
    file.write(log[: len(log) - 100])
    file.mark_gap(0.25)
    file.close()
    saved = ULog(str(file.path))
    assert [each.duration for each in saved.dropouts] == [250]
    assert not saved.file_corruption


def test_streams_of_one_second_have_files_of_their_own(tmp_path: Path) -> None:
    """A file is never overwritten; a folder that cannot be made is an error that names it."""
    files = [LogFile(tmp_path / "logs", "1") for _ in range(3)]
    for each in files:
        each.close()
    assert len({each.path for each in files}) == 3
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        LogFile(tmp_path / "file" / "logs", "1")
