"""Atomically written files survive a power cut: data is synced first, then the containing folder."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from nedbus.atomic_write import atomic_write
from nedbus.flights import RecordingWriter
from tests.flights.messages import message
from tests.nedbus.flights.test_recorder import write

Synced = list[tuple[str, list[str]]]


@pytest.fixture
def synced(monkeypatch: pytest.MonkeyPatch) -> Synced:
    """Return the name of each synced file or folder, and the names in that folder, in the order of the calls."""
    calls: Synced = []
    fsync = os.fsync

    def record(descriptor: int) -> None:
        path = Path(f"/proc/self/fd/{descriptor}").readlink()
        calls.append(
            (path.name, sorted(each.name for each in path.iterdir()) if path.is_dir() else [])
        )
        fsync(descriptor)

    monkeypatch.setattr("os.fsync", record)
    return calls


@pytest.mark.parametrize("replace", [False, True])
def test_folder_is_synced_after_its_file_is_renamed(
    tmp_path: Path, synced: Synced, replace: bool
) -> None:
    with atomic_write(tmp_path / "a.crt", replace=replace) as part:
        part.write_text("a")
    assert [name for name, _ in synced] == [part.name, tmp_path.name]
    assert "a.crt" in synced[1][1]
    assert [each.name for each in tmp_path.iterdir()] == ["a.crt"]


def test_replaced_file_is_synced_with_its_folder(tmp_path: Path, synced: Synced) -> None:
    (tmp_path / "a.crt").write_text("old")
    with atomic_write(tmp_path / "a.crt", replace=True) as part:
        part.write_text("new")
    assert [name for name, _ in synced] == [part.name, tmp_path.name]
    assert (tmp_path / "a.crt").read_text() == "new"


def test_folder_of_a_new_recording_is_synced_before_the_first_message(
    tmp_path: Path, synced: Synced
) -> None:
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        assert synced == [("a.mcap", []), (tmp_path.name, ["a.mcap"])]
        write(writer, message(1))
    assert synced[2:] == [("a.mcap", [])]


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads every folder")
def test_folder_without_read_permission_is_not_synced(tmp_path: Path) -> None:
    tmp_path.chmod(0o300)
    try:
        with atomic_write(tmp_path / "a.crt") as part:
            part.write_text("a")
        assert (tmp_path / "a.crt").read_text() == "a"
    finally:
        tmp_path.chmod(0o700)
