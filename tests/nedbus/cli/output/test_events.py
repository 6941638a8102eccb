"""Lines of events and verdicts."""

from __future__ import annotations

import pytest

from nedbus.cli.output.events import describe_stories, to_line
from nedbus.health import Event, Times
from nedbus.vehicle_events import verdict_of
from tests.flights.messages import VLP

CAUSE = Event("1", "gps_fix_lost", "begin", "watch", "GPS fix lost", 10.0)


@pytest.mark.parametrize(
    ("time", "severity", "evidence"),
    [
        (12.0, "bad", "  <- GPS fix lost (2.0 s before)"),
        (9.5, "bad", "  <- GPS fix lost (500 ms after)"),
        (12.0, "info", ""),
    ],
)
def test_line_of_an_event_has_the_distance_of_its_evidence(
    time: float, severity: str, evidence: str
) -> None:
    """Evidence of another topic may be a little later than a fault; a mere notice needs none."""
    event = Event("1", "xy_invalid", "begin", severity, "xy not valid", time, evidence=(CAUSE,))  # type: ignore[arg-type] # from a parameter
    assert to_line(event, Times()).endswith(f"xy not valid{evidence}")


def test_paragraph_of_a_fault_has_only_the_headings_it_needs() -> None:
    """A fault without events before, during or after it has its period and the missing topics."""
    flags = ("xy_valid",)
    begin = Event("1", "xy_invalid", "begin", "bad", "xy not valid", 12.0, names=flags)
    end = Event("1", "xy_invalid", "end", "info", "xy valid again", 15.0, names=flags)
    verdict = verdict_of("1", [begin, end], topics=[VLP], times=Times(), end=20.0)
    [paragraph] = describe_stories(verdict, "advice")
    first, *lines = paragraph.splitlines()
    assert first.startswith("1: xy not valid from ")
    assert [line.split()[0] for line in lines] == ["ended", "no", "missing"]
    assert lines[-1].endswith("; advice")
