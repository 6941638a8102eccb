"""Events, health and verdict of a service on the link of a real PX4 in flight, from recordings (../shared/data/px4)."""

from __future__ import annotations

from collections import Counter
from typing import Final

import pytest

from tests.flights.recorded_link import Service
from tests.flights.ulogs import LOGS

PX4: Final = LOGS.parent / "px4"

pytestmark = [
    pytest.mark.logs,
    pytest.mark.slow,
    pytest.mark.skipif(not (PX4 / "gps_off_in_flight.bin.gz").exists(), reason=f"no recordings of a PX4 in {PX4}"),
]


@pytest.mark.parametrize("name", ["foreign_stop_in_flight", "link_cut_20s_in_flight", "baro_failure_mavlink"])
def test_changes_between_streamed_and_converted_messages_are_no_resets(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Reset counters that converted messages lack cause neither reset events nor counted resets; the log has none."""
    service = Service(PX4 / f"{name}.bin.gz", monkeypatch).run()
    assert service.events("reset", "origin_set", "origin_moved") == []
    assert {sum(health.resets.values()) for health in service.healths.values()} == {0}


def test_drop_of_the_rate_is_not_a_series_of_gaps(monkeypatch: pytest.MonkeyPatch) -> None:
    """When attitudes drop from 50 to 8 Hz for the rest of the flight, gaps end after some messages."""
    service = Service(PX4 / "foreign_stop_in_flight.bin.gz", monkeypatch).run()
    gaps = {str(address): health.gaps for address, health in service.healths.items()}
    assert gaps["4/vehicle_attitude"] < 20
    assert max(gaps.values()) < 20


def test_topics_on_a_slow_link_are_not_stale_at_their_usual_rate(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """On a link of 57,600 baud a topic is logged at most twice as stale: until its rate is known, and as flapping."""
    Service(PX4 / "slow_link_header_stalls.bin.gz", monkeypatch).run()
    stale = Counter(text.split()[1] for text in caplog.messages if " is stale: " in text)
    assert stale["4/battery_status/0"] == 2
    assert max(stale.values()) == 2
