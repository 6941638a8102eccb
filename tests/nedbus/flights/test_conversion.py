"""Conversion of flights to MCAP by `nedbus.convert`; test_recorder has the tests of the command and of the files."""

from __future__ import annotations

from pathlib import Path

import pytest

import nedbus
from nedbus.errors import AddressError, ConfigError, OutputError
from tests.flights.ulogs import write_log

TIMES = [20_000 * number for number in range(1, 3001)]  # us


@pytest.mark.slow
def test_conversion_reports_what_it_did(tmp_path: Path) -> None:
    """It writes all messages under the given vehicle, reports progress up to the total, and names absent topics."""
    log, output = write_log(tmp_path / "flight.ulg", TIMES), tmp_path / "flight.mcap"
    progress = list[tuple[int, int]]()
    done = nedbus.convert(
        log,
        output,
        topics=["vehicle_local_position", "SensorGps"],
        vehicle=7,
        on_progress=lambda read, total: progress.append((read, total)),
    )
    with nedbus.open(log) as flight, nedbus.open(output) as recording:
        before = [sample.message for sample in flight()]
        after = list(recording())
    assert [sample.message for sample in after] == before
    assert {sample.vehicle for sample in after} == {"7"}
    assert done.summary == f"{len(before)} messages"
    assert not done.damaged
    assert done.warnings == (f"{log}: this file has no messages of SensorGps",)
    assert all(0 < read <= total for read, total in progress)


@pytest.mark.slow
def test_conversion_of_invalid_arguments_leaves_no_file(tmp_path: Path) -> None:
    """An unknown topic, an invalid vehicle, another suffix or an existing file is refused."""
    log, output = write_log(tmp_path / "flight.ulg", TIMES), tmp_path / "flight.mcap"
    with pytest.raises(AddressError, match="topic"):
        nedbus.convert(log, output, topics="not a topic")
    with pytest.raises(AddressError, match="vehicle"):
        nedbus.convert(log, output, vehicle="a/b")
    with pytest.raises(ConfigError, match="one id would join several files"):
        nedbus.convert([log, log], output, vehicle=7)
    with pytest.raises(ConfigError, match="must end with"):
        nedbus.convert(log, tmp_path / "flight.csv")
    assert list(tmp_path.iterdir()) == [log]
    output.write_text("mine")
    with pytest.raises(OutputError, match="exists"):
        nedbus.convert(log, output)
    assert output.read_text() == "mine"
