"""Stories of a vehicle, and moments as a person writes them: hand-made messages, in no other process."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import pytest

from nedbus.events import Event, Story, Times, tell

from .flight import ARMED, Flight


def why(flight: Flight, *, at: float | None = None) -> list[Story]:
    """Return the stories of a vehicle; `at` is by the account's clock."""
    followed = flight.account.vehicles["1"]
    events = sorted(flight.account.take(0)[0], key=lambda each: each.time)
    return tell(events, followed.conditions.values(), topics=list(followed.topics), at=at)


def lose_gps(flight: Flight) -> None:
    """Lose the receiver, and a moment later the estimate."""
    flight.gps()
    flight.fly(1)
    flight.gps(fix_type=0, satellites_used=0)
    flight.wait(1.0).send(dead_reckoning=True)
    flight.wait(2.0).send(dead_reckoning=True)
    flight.wait(2.0).send(dead_reckoning=True, xy_valid=False, v_xy_valid=False)
    flight.wait(0.5).status(ARMED)
    flight.wait(0.5).status(ARMED, failsafe=True)


def recover(flight: Flight) -> None:
    flight.wait(1.0).gps()
    flight.wait(1.0).send()
    flight.wait(0.5).status(ARMED)


def test_story_that_goes_on() -> None:
    """Flags that fall together are one story; what follows from it is part of it, and no story of its own."""
    flight = Flight()
    lose_gps(flight)
    (story,) = why(flight)
    assert (story.what, story.until, story.end, story.is_bad) == ("xy and vxy not valid", None, None, True)
    assert [each.kind for each in story.before] == ["gps_fix_lost", "few_satellites", "dead_reckoning"]
    assert [each.kind for each in story.meanwhile] == ["failsafe"]
    assert story.after == ()
    assert story.lacking == ("estimator_status_flags", "failsafe_flags")


def test_story_that_ended() -> None:
    """It ends with the last flag, and says what came with its end."""
    flight = Flight()
    lose_gps(flight)
    begin = flight.now - 1.0
    recover(flight)
    (story,) = why(flight)
    assert story.since == pytest.approx(begin)
    assert story.until == pytest.approx(begin + 3.0)
    assert [(each.kind, each.change) for each in story.after] == [
        ("gps_fix_lost", "end"), ("few_satellites", "end"), ("dead_reckoning", "end"),
    ]  # fmt: skip


def test_reboot_ends_a_story() -> None:
    """Conditions from before it are over, though no message says so; the reboot itself is a story too."""
    flight = Flight()
    flight.send()
    flight.wait(1.0).send(xy_valid=False)
    flight.booted = flight.wait(1.0).now - 0.01
    flight.send()
    stories = why(flight)
    assert [(each.what.partition(":")[0], each.until) for each in stories] == [
        ("xy not valid", flight.now), ("rebooted", flight.now),
    ]  # fmt: skip


def test_end_of_one_flag_is_not_that_of_another() -> None:
    """A fault that held at the first message ends; the one that began since goes on."""
    flight = Flight()
    flight.send()
    flags: dict[str, Any] = {"cs_baro_fault": True, "fs_bad_hdg": False}
    flight.send("estimator_status_flags", **flags)
    flight.wait(1.0).send("estimator_status_flags", **flags | {"fs_bad_hdg": True})
    flight.wait(1.0).send("estimator_status_flags", **flags | {"fs_bad_hdg": True, "cs_baro_fault": False})
    assert [(each.what, each.until) for each in why(flight)] == [("EKF fault: heading", None)]


def test_what_is_watched_is_told_where_nothing_is_bad() -> None:
    """Beside something bad it is told only as far as it belongs to it, or when somebody asks about that moment."""
    flight = Flight()
    flight.gps()
    flight.fly(1)
    flight.gps(jamming_indicator=100)
    flight.fly(5)
    flight.gps()
    jammed = flight.now - 2.5
    assert [each.what for each in why(flight)] == ["GNSS jamming: indicator 100"]
    flight.fly(100)
    flight.wait(0.1).send(xy_valid=False)
    assert [each.what for each in why(flight)] == ["xy not valid"]
    assert [each.what for each in why(flight, at=jammed)] == ["GNSS jamming: indicator 100"]
    assert [each.what for each in why(flight, at=flight.now - 50)] == ["GNSS jamming: indicator 100"]
    assert [each.what for each in why(flight, at=flight.now + 50)] == ["xy not valid"]


def test_condition_whose_begin_is_not_told() -> None:
    """A condition that began before the events that are known goes on, since when it began; or from the first on."""
    flight = Flight()
    flight.send(z_valid=False)
    flight.wait(2.0).send(z_valid=False, xy_valid=False)
    held = list(flight.account.vehicles["1"].conditions.values())
    assert [(each.what, each.begin, each.until) for each in tell([], held)] == [
        ("z not valid", None, None), ("xy not valid", held[1].begin, None),
    ]  # fmt: skip


def test_nothing_was_wrong() -> None:
    """A vehicle that is armed, takes off and lands has no story, nor has one of which nothing is known."""
    flight = Flight()
    flight.send()
    flight.status(ARMED)
    flight.send("vehicle_land_detected", landed=True)
    flight.wait(1.0).send("vehicle_land_detected", landed=False)
    assert why(flight) == []
    assert tell([]) == []
    assert tell([], at=5.0) == []


def event_at(time: float, *, boot: float | None = None) -> Event:
    return Event("1", "jump", "once", "watch", "", time, boot)


EVENING = datetime(2026, 11, 22, 23, 59, 50, tzinfo=UTC).timestamp()


@pytest.mark.parametrize(
    ("text", "step"),
    [
        ("23:59:50", 0.0), ("23:59", -50.0), ("00:00:10", 20.0), ("0:00:10.5", 20.5), ("12:00", -43_190.0),
        (" 11:59:00 ", 43_150.0), ("7", -93.0), ("100.25", 0.25), ("1e2", 0.0), ("-5", -105.0),
    ],
)  # fmt: skip
def test_moment_is_found(text: str, step: float) -> None:
    """A time of day is the nearest one, also beyond midnight; a number is seconds since the vehicle's boot."""
    live, told = Times(is_live=True), event_at(EVENING, boot=100.0)
    assert live.find(text, told) - told.time == pytest.approx(step, abs=1e-3)
    of_file, told = Times(offsets={"1": EVENING - 100.0}), event_at(40.0, boot=100.0)
    assert of_file.find(text, told) - told.time == pytest.approx(step, abs=1e-3)


@pytest.mark.parametrize(
    "text", ["", "noon", "24:00", "12:60", "12:30:60", "12:30:61.5", "1:2", "12.30.00", "nan", "inf", "1:00:00:00"]
)
def test_garbage_is_no_moment(text: str) -> None:
    """A text that is no time is a ValueError, which does not repeat Python's own reason."""
    with pytest.raises(ValueError, match="no time"):
        Times(is_live=True).find(text, event_at(EVENING, boot=100.0))


def test_clock_that_is_not_known() -> None:
    """A log without UTC has seconds since boot; live, a vehicle of which nothing is known but a rejection has UTC."""
    times, told = Times(), event_at(40.0, boot=100.0)
    assert (times.clock(told), times.text(told), times.utc(told)) == ("boot", "100.000", None)
    assert times.find("99", told) == 39.0
    with pytest.raises(ValueError, match="no message of this vehicle tells UTC"):
        times.find("12:00", told)
    with pytest.raises(ValueError, match="no message of this vehicle tells when it booted"):
        Times(is_live=True).find("99", event_at(EVENING))


def test_simulator_has_unix_time() -> None:
    """Time since boot that is Unix time tells UTC by itself."""
    told = event_at(1.0, boot=EVENING)
    assert (Times().clock(told), Times().text(told)) == ("vehicle", "23:59:50.0")


def test_time_of_day_is_rounded_once() -> None:
    """59.96 s is the next minute, never 60.0."""
    assert Times(is_live=True).text(event_at(EVENING + 9.96)) == "00:00:00.0"
