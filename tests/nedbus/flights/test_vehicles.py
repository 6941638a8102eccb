"""The vehicles of a flight of several files: names, files, UTC."""

from __future__ import annotations

from pathlib import Path

import pytest

import nedbus
from nedbus.errors import SourceError
from nedbus.flights import path_of, require_utc, utc_offset_of, vehicles_of
from tests.flights.ulogs import write_log
from tests.nedbus.flights.test_several_files import EPOCH, write_flight


def test_vehicles_of_several_files_have_names_files_and_utc(tmp_path: Path) -> None:
    """Vehicles with one name are named after their files; each has its file and the UTC of its own boot."""
    paths = [
        write_flight(tmp_path / "a.ulg", boot=0, start=60),
        write_flight(tmp_path / "b.ulg", boot=30, start=60),
    ]
    with nedbus.open(paths) as flight:
        assert vehicles_of(flight) == ["a", "b"]
        assert [path_of(flight, name) for name in ("a", "b")] == paths
        offsets = [require_utc(flight, name).offset_us for name in ("a", "b")]
    assert offsets == [EPOCH, EPOCH + 30_000_000]


def test_vehicle_without_utc_has_no_offset(tmp_path: Path) -> None:
    """A vehicle whose messages provide no UTC has no offset; requiring one raises an error that names its file."""
    path = write_log(tmp_path / "flight.ulg", [1_000_000, 2_000_000])
    with nedbus.open(path) as flight:
        assert vehicles_of(flight) == ["1"]
        assert utc_offset_of(flight, "1") is None
        with pytest.raises(SourceError, match=r"flight\.ulg.*no message contains UTC"):
            require_utc(flight, "1")
