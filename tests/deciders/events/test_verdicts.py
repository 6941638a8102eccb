"""Verdicts on a vehicle with hand-made messages."""

from __future__ import annotations

from nedbus.events import Times, Verdict, verdict_of

from .flight import ARMED, Flight

LIVE = Times(is_live=True)


def verdict(flight: Flight, *, times: Times | None = None, at: float | None = None) -> Verdict:
    """Return the verdict on the vehicle now; by default in seconds since boot."""
    followed = flight.account.vehicles["1"]
    events = sorted(flight.account.events_since(0)[0], key=lambda each: each.time)
    held = [each for each in followed.conditions.values() if each.severity != "info"]
    return verdict_of("1", events, held, topics=followed.topics, times=times or Times(), end=flight.now, at=at)


def lose_gps(flight: Flight) -> None:
    flight.gps()
    flight.fly(1)
    flight.gps(fix_type=0, satellites_used=0)
    flight.wait(1.0).send(dead_reckoning=True)
    flight.wait(2.0).send(dead_reckoning=True)
    flight.wait(2.0).send(dead_reckoning=True, xy_valid=False, v_xy_valid=False)
    flight.wait(0.5).status(ARMED)
    flight.wait(0.5).status(ARMED, failsafe=True)


def test_verdict_of_a_fault_that_lasts() -> None:
    """It names the fault, its begin, its duration and clock, the evidence in order of time, and what is missing."""
    flight = Flight()
    lose_gps(flight)
    found = verdict(flight)
    assert found.text == (
        "xy and vxy not valid from 16.000 s since boot until the end (1.0 s). Before it: 11.000 GPS fix 3D to none, "
        "12 satellites to 0, only 0 satellites; 12.000 dead reckoning. Not in the data: estimator_status_flags, "
        "failsafe_flags."
    )
    assert (found.usable, found.until, found.faults) == (False, None, 1)
    assert found.begin is not None
    assert found.begin.kind == "xy_invalid"
    assert [each.kind for each in found.cause] == ["gps_fix_lost", "few_satellites", "dead_reckoning"]
    assert "until now (1.0 s)" in verdict(flight, times=LIVE).text


def test_verdict_of_a_fault_that_ended() -> None:
    """The vehicle was not usable, from when to when."""
    flight = Flight()
    lose_gps(flight)
    flight.wait(1.0).send()
    found = verdict(flight)
    assert found.text.startswith("xy and vxy not valid from 16.000 to 18.000 s since boot (2.0 s). Before it: ")
    assert (found.usable, found.since, found.until) == (False, flight.now - 2.0, flight.now)


def test_verdict_without_faults() -> None:
    """Nothing but that there was none, and whether the data tells that the position is valid."""
    flight = Flight()
    flight.fly(5)
    found = verdict(flight)
    assert (found.text, found.usable, found.faults) == ("no faults in 105 s", True, 0)
    assert verdict(flight, times=LIVE).text == "no faults in the history of the services"
    unknown = verdict_of("1", [], topics=["vehicle_attitude"], times=Times(), end=5.0)
    assert (unknown.usable, "whether the position is valid is unknown" in unknown.text) == (None, True)


def test_verdict_of_a_vehicle_that_stays_usable() -> None:
    """A condition to watch leaves the vehicle usable."""
    flight = Flight()
    flight.gps()
    flight.fly(1)
    flight.gps(jamming_indicator=100)
    flight.fly(5)
    flight.gps()
    found = verdict(flight)
    assert found.usable is True
    assert found.text.startswith(
        "usable in all 106 s, but GNSS jamming: indicator 100 from 11.000 to 16.000 s since boo"
    )
