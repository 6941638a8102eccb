"""The observation of a network: bounded, whatever peers publish."""

from __future__ import annotations

import pytest

import nedbus
from nedbus import limits
from nedbus.doctor.observation import Observation
from nedbus.timings import Timings
from nedbus.transport import Session
from tests.flights.local_position import encode
from tests.flights.messages import VLP, message
from tests.waits import repeating, wait_for


def test_names_of_peers_are_bounded(
    bus: nedbus.Bus, zenoh_session: Session, timings: Timings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the vehicles and prefixes that a peer publishes, the doctor keeps `limits.EXAMINED_NAMES`, and no long key."""
    timings.min_listen, timings.listen = 0.2, 0.2
    payload = encode(message(1))
    long_prefix = "x" * limits.PEER_TEXT
    keys = [f"nedbus/{number}/{VLP}" for number in range(6)]
    keys += [f"other{number}/1/{VLP}" for number in range(6)]

    def publish() -> None:
        for key in (*keys, f"{long_prefix}/1/{VLP}"):
            zenoh_session.put(key, payload, encoding="application/msgpack")

    def observe(names: int) -> Observation:
        monkeypatch.setattr(limits, "EXAMINED_NAMES", names)
        seen = Observation("nedbus", nedbus.__version__, None)
        seen.observe(bus, bus._session)
        return seen

    with repeating(publish):
        wait_for(lambda: len(observe(1000).elsewhere) == 6, what="all short keys")
        wait_for(lambda: len(observe(2).elsewhere) == 2, what="two keys")
        seen = observe(2)
    assert len(seen.delays) <= 2
    assert len(seen.ages) <= 2
    assert not any(long_prefix in key for key in seen.elsewhere)
