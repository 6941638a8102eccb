"""The event timeline of a page."""

from __future__ import annotations

import pytest

from nedbus.web.event_timeline import EventTimeline
from tests.nedbus.web.page import SimulatedFleet, sim

__all__ = ["sim"]  # a fixture


def test_cached_stories_and_verdicts_are_bounded(
    sim: SimulatedFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Moments and names that viewers request are cached up to a limit, although no event ends their validity."""
    monkeypatch.setattr("nedbus.limits.PAGE_STORIES", 10)
    timeline = EventTimeline(sim.event_log)
    sim.fly(5)
    sim.fly(5, xy_valid=False)
    sim.fly(20)
    end = sim.time
    for number in range(100):
        moment = end - 0.1 * number
        story, verdict = (
            timeline.story("wing", end, moment, ()),
            timeline.verdict("wing", end, moment),
        )
        assert timeline.verdict(f"unknown{number}", end).stories == ()
        assert story == timeline.story("wing", end, moment, ())
        assert verdict is timeline.verdict("wing", end, moment), "the latest one is cached"
    assert len(timeline._verdicts) == timeline._find_stories_cached.cache_info().currsize == 10
