"""The readers that a publisher knows: who is away, and for how long; at times that the test gives."""

from __future__ import annotations

import pytest

from nedbus.client.publishing.flow_control import RETURN, THAW, ReaderTable


def note(readers: ReaderTable, now: float, *answers: str, late: bool = False, froze: bool = False) -> bool:
    """Note who answered a question, with a minus before one that is closed; return whether anybody is away."""
    by_reader = {each.removeprefix("-"): each.startswith("-") for each in answers}
    readers.note(by_reader, late=late, froze=froze, now=now)
    return bool(readers.away)


def known(*names: str) -> ReaderTable:
    """Return readers of which these have answered."""
    readers = ReaderTable()
    note(readers, 0.0, *names)
    return readers


def away_for(readers: ReaderTable, start: float, *answers: str) -> float:
    """Return for how many seconds somebody is still away where these readers answer twice a second."""
    now = start
    while note(readers, now, *answers):
        now += 0.5
    return now - start


def test_nobody_is_away_where_all_answer() -> None:
    """Also when new ones come, and when nobody is there."""
    readers = ReaderTable()
    assert not note(readers, 0.0)
    assert not note(readers, 1.0, "a")
    assert not note(readers, 2.0, "a", "b")


def test_reader_that_has_gone_may_return_for_5_seconds() -> None:
    """Its link was reset, perhaps, or its router has restarted; and when it was back it may go again."""
    readers = known("a", "b")
    for gone in (10.0, 20.0):
        assert note(readers, gone, "b")
        assert not note(readers, gone + 2.0, "a", "b")
    assert away_for(readers, 30.0, "b") == pytest.approx(RETURN, abs=0.6)
    assert not note(readers, 100.0, "b")  # forgotten


def test_nobodys_time_runs_while_the_publisher_has_no_router() -> None:
    """The 5 s begin when there is one again; of readers that never answered too."""
    for before in (["a"], []):
        readers = known(*before)
        note(readers, 1.0)
        for second in range(1, 60):
            readers.wait_for_link(float(second))
        assert away_for(readers, 60.0) == pytest.approx(RETURN, abs=1.6)
    late = ReaderTable()
    late.wait_for_link(0.0)
    assert not note(late, 1.0, "a"), "a reader that answers for the first time is the one that was waited for"


def test_reader_that_is_closed_is_not_waited_for() -> None:
    """It says so, with its last answer, which may be its first."""
    for before in (["a", "b"], ["b"]):
        readers = known(*before)
        assert not note(readers, 1.0, "-a", "b")
        assert not note(readers, 2.0, "b")


def test_reader_that_froze_may_return_for_90_seconds() -> None:
    """The question was open until Zenoh's lease ended: it may have been stopped."""
    readers = known("a", "b")
    assert note(readers, 10.0, "b", froze=True)
    assert away_for(readers, 10.0, "b") == pytest.approx(THAW, abs=0.6)


def test_reader_that_froze_before_its_first_answer_may_return_for_90_seconds() -> None:
    """Nobody knows its name, and somebody was there; the first one with a new name is it."""
    readers = ReaderTable()
    assert note(readers, 0.0, froze=True)
    assert note(readers, 80.0)
    assert not note(readers, 81.0, "a")
    forgotten = ReaderTable()
    note(forgotten, 0.0, froze=True)
    assert away_for(forgotten, 0.0) == pytest.approx(THAW, abs=0.6)


def test_late_reader_is_there() -> None:
    """It was asked, is connected, known or not, and has not answered in time: only its answer is waited for."""
    for before in ([], ["a"], ["b"], ["a", "b"]):
        readers = known(*before)
        assert not note(readers, 10.0, "b", late=True)
        assert not note(readers, 20.0, late=True)
        assert not note(readers, 21.0, "a", "b")
        assert not note(readers, 22.0, "a", "b")


@pytest.mark.parametrize("before", [["a", "b"], ["b"]])
def test_late_reader_that_has_gone_may_return_for_90_seconds(before: list[str]) -> None:
    """A question that was late and one that ended with the lease are one and the same standstill."""
    readers = known(*before)
    note(readers, 10.0, "b", late=True)
    assert note(readers, 11.0, "b")
    assert away_for(readers, 11.0, "b") == pytest.approx(THAW, abs=0.6)


def test_reader_that_answered_and_ended_is_not_waited_for_beside_a_silent_one() -> None:
    """The one suspected of standing still is the one that did not answer, not one that did and was closed."""
    readers = ReaderTable()
    assert not note(readers, 10.0, "a", late=True)
    assert not note(readers, 10.1, "-a", "b")
    assert not note(readers, 20.0, "b", late=True)
    assert note(readers, 20.1), "the silent one may have been stopped"
    assert not note(readers, 20.1 + THAW)
