"""How a lossless publisher waits for its readers: the window, the trickle beyond it, and readers that have gone."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from nedbus.client.acknowledgement import KEPT, WINDOW, Acknowledgement, SharedWindow
from nedbus.client.channels import CHANNEL
from nedbus.client.receive_queue import CAPACITY
from nedbus.errors import ClosedError
from nedbus.transport import LEASE

from .fake_readers import Reader, Stuck, World

LIMIT = 6192  # messages that are sent at all without an acknowledgement


@pytest.fixture
def world() -> World:
    return World()


@pytest.fixture
def acknowledgement(world: World, monkeypatch: pytest.MonkeyPatch) -> Acknowledgement:
    return world.acknowledgement(monkeypatch)


def test_limits_fit_into_each_other() -> None:
    """What is sent without an acknowledgement is still kept for recovery, and fits into the queue of each reader."""
    assert WINDOW < LIMIT < KEPT < CHANNEL < CAPACITY
    assert LIMIT + WINDOW == KEPT


def test_without_readers_it_never_waits(world: World, acknowledgement: Acknowledgement) -> None:
    """Nobody has to be waited for where nobody answers."""
    world.publish(acknowledgement, 20_000)
    assert world.now == pytest.approx(2.0)


def test_reader_that_keeps_up_is_not_waited_for(world: World, acknowledgement: Acknowledgement) -> None:
    """It is asked every 250 messages, by the number of the last one, one question at a time."""
    world.readers.append(Reader("fast"))
    world.publish(acknowledgement, 20_000)
    assert world.now == pytest.approx(2.0)
    numbers = [int(each["number"]) for each in world.asked]
    assert numbers == list(range(249, 20_000, 250))
    assert {(each["publisher"], each["read"]) for each in world.asked} == {("p:1", "1")}


def test_reader_that_reads_nothing_gets_a_window_and_a_trickle(world: World, acknowledgement: Acknowledgement) -> None:
    """2,000 messages at once, then 10 a second for others, until no more are kept; then nothing at all.

    It is connected and therefore never given up; it is asked every 10 s, and again after 0.5, 1, 2 and 4 s.
    """
    world.readers.append(Reader("stuck", rate=0.0))
    with pytest.raises(Stuck):
        world.publish(acknowledgement, 10_000)
    assert world.published == LIMIT
    assert world.sent[WINDOW - 1] == pytest.approx(0.2)
    steps = [later - earlier for earlier, later in pairwise(world.sent[WINDOW:])]
    assert steps == pytest.approx([0.1] * len(steps), abs=0.011)
    assert len(world.asked) == pytest.approx(5 * 3600 / 10, rel=0.05)


def test_window_is_shared_while_it_is_used() -> None:
    """Each publisher has its part, and what others do not use; one that has sent nothing for a second uses nothing."""
    shared = SharedWindow()
    assert shared.part("a", 0, now=0.0) == WINDOW
    assert shared.part("a", 1900, now=0.1) == WINDOW
    assert shared.part("b", 0, now=0.2) == WINDOW // 2
    assert shared.part("b", 500, now=0.3) == WINDOW // 2
    assert shared.part("a", 100, now=0.4) == WINDOW - 500
    for number in range(8):
        shared.part(f"other {number}", 1000, now=0.5)
    assert shared.part("a", 100, now=0.6) == WINDOW // 10
    assert shared.part("a", 100, now=1.8) == WINDOW


@pytest.mark.parametrize("at", [0.0, 0.1, 5.0])
def test_question_that_a_full_queue_dropped_is_asked_again(
    world: World, acknowledgement: Acknowledgement, at: float
) -> None:
    """After half a second, not when it is given up: nobody notices more than that."""
    world.readers.append(Reader("fast"))
    world.plan(at, lambda: setattr(world, "dropping", True))
    world.plan(at + 0.2, lambda: setattr(world, "dropping", False))
    world.publish(acknowledgement, 100_000)
    assert world.now < 10.0 + 0.6


def test_slow_publisher_asks_again_too(world: World, acknowledgement: Acknowledgement) -> None:
    """It looks for answers with each few messages that it sends, also while nothing holds it up."""
    world.readers.append(Reader("fast"))
    world.dropping = True
    world.plan(0.3, lambda: setattr(world, "dropping", False))
    world.publish(acknowledgement, 10_000, rate=1000.0)
    assert world.longest_pause() < 0.02


def test_reader_that_goes_on_gets_everything(world: World, acknowledgement: Acknowledgement) -> None:
    """After half an hour as well, and from then on nothing holds the publisher up."""
    reader = Reader("stuck", rate=0.0)
    world.readers.append(reader)
    world.plan(1800.0, lambda: setattr(reader, "rate", 100_000.0))
    world.publish(acknowledgement, 20_000)
    assert world.now < 1800.0 + 2.0
    assert world.longest_pause(since=1800.2) < 0.02


@pytest.mark.parametrize("rate", [100.0, 500.0, 5_000.0])
def test_slow_reader_sets_the_pace_and_is_never_without_messages(
    world: World, acknowledgement: Acknowledgement, rate: float
) -> None:
    """The publisher is a window ahead at most, and a trickle; the reader always has something to read."""
    reader = Reader("slow", rate=rate)
    world.readers += [reader, Reader("fast")]
    world.publish(acknowledgement, 10_000)
    ahead = [at - reader.rate * time for at, time in enumerate(world.sent)]
    assert max(ahead) < WINDOW * 1.5
    assert world.now == pytest.approx((10_000 - WINDOW) / rate, rel=0.2)
    assert world.longest_pause() < 0.2


def test_healthy_reader_is_never_without_a_message_for_long(world: World, acknowledgement: Acknowledgement) -> None:
    """Beside one that reads a message a second it gets ten a second, for as long as publishers keep messages."""
    world.readers += [Reader("slow", rate=1.0), Reader("fast")]
    world.publish(acknowledgement, WINDOW + 4000)
    assert world.now > 390.0
    assert world.longest_pause() < 0.2


def test_reader_that_is_closed_is_not_waited_for(world: World, acknowledgement: Acknowledgement) -> None:
    """It answers what is asked at that moment, and the publisher goes on."""
    reader = Reader("stuck", rate=0.0)
    world.readers += [reader, Reader("fast")]
    world.plan(1.0, lambda: setattr(reader, "closed", True))
    world.publish(acknowledgement, 10_000)
    assert world.now < 2.1


@pytest.mark.parametrize("rate", [math.inf, 5_000.0])
def test_reader_whose_link_was_reset_has_missed_nothing(
    world: World, acknowledgement: Acknowledgement, rate: float
) -> None:
    """It is back after 2 s: the publisher, whose own link is up, has waited for it."""
    reader = Reader("reset", rate=rate)
    world.readers += [reader, Reader("fast")]
    world.plan(0.1, lambda: setattr(reader, "alive", False))
    world.plan(2.1, lambda: setattr(reader, "alive", True))
    ahead: list[float] = []
    world.plan(2.09, lambda: ahead.append(world.published - reader.read))
    world.publish(acknowledgement, 40_000)
    assert ahead[0] < LIMIT
    assert reader.read > 40_000 - WINDOW


@pytest.mark.parametrize("away", [0.5, 4.0, 7.0, 60.0])
@pytest.mark.parametrize("answered", [True, False])
def test_no_time_runs_while_there_is_no_router(
    world: World, acknowledgement: Acknowledgement, away: float, answered: bool
) -> None:
    """A reader that comes back 3 s after the router has missed nothing, whether it has ever answered or not."""
    reader = Reader("back")
    world.readers.append(reader)
    world.publish(acknowledgement, 1000 if answered else 249)
    reader.alive = False
    world.routers.clear()
    world.plan(away, lambda: world.routers.append("r2"))
    world.plan(away + 3.0, lambda: setattr(reader, "alive", True))
    ahead: list[float] = []
    world.plan(away + 2.99, lambda: ahead.append(world.published - reader.read))
    world.publish(acknowledgement, 40_000)
    assert ahead[0] < LIMIT
    assert reader.read > 40_000 - WINDOW


def test_router_itself_needs_none(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the publishers of a router nobody has to be waited for where nobody answers."""
    world.routers.clear()
    world.publish(world.acknowledgement(monkeypatch, needs_router=False), 20_000)
    assert world.now == pytest.approx(2.0)


@pytest.mark.parametrize("rate", [math.inf, 5_000.0])
def test_reader_that_comes_back_in_time_has_missed_nothing(
    world: World, acknowledgement: Acknowledgement, rate: float
) -> None:
    """Where the router restarts, between two questions or while one is open, the publisher is no further than KEPT."""
    reader = Reader("back", rate=rate)
    world.readers += [reader, Reader("fast")]
    world.restart_router(reader, 0.1003, until=4.5)
    ahead: list[float] = []
    world.plan(4.49, lambda: ahead.append(world.published - reader.read))
    world.publish(acknowledgement, 40_000)
    assert WINDOW / 2 < ahead[0] < LIMIT
    assert reader.read > 40_000 - WINDOW


def test_reader_that_does_not_come_back_is_given_up(world: World, acknowledgement: Acknowledgement) -> None:
    """Others get ten messages a second until 5 s after the router is back, then everything."""
    reader = Reader("gone", rate=5_000.0)
    world.readers += [reader, Reader("fast")]
    world.restart_router(reader, 0.1003, until=math.inf)
    world.publish(acknowledgement, 20_000)
    assert 2.0 + 6.0 - 0.3 < world.now < 2.0 + 6.0 + 0.5
    assert world.longest_pause() < 0.2


def test_reader_that_stood_still_is_waited_for_90_seconds(world: World, acknowledgement: Acknowledgement) -> None:
    """One that was stopped (SIGSTOP) for a minute has lost nothing, though its link broke after 5 s."""
    reader = Reader("stopped", rate=100_000.0)
    world.readers += [reader, Reader("fast")]
    world.plan(0.5, lambda: setattr(reader, "stopped", world.now))
    world.plan(60.5, lambda: setattr(reader, "stopped", None))
    ahead: list[float] = []
    world.plan(60.49, lambda: ahead.append(world.published - reader.read))
    world.publish(acknowledgement, 20_000)
    assert WINDOW / 2 < ahead[0] < LIMIT
    assert 60.5 < world.now < 63.0
    assert world.longest_pause() < 0.2


@pytest.mark.parametrize(("rate", "published"), [(0.0, 10_000.0), (100.0, 10_000.0), (math.inf, 200.0)])
@pytest.mark.parametrize("second", range(20, 32, 2))
def test_reader_that_is_stopped_at_any_time_is_waited_for(
    world: World, acknowledgement: Acknowledgement, rate: float, published: float, second: int
) -> None:
    """However its lease meets questions that are answered late, or never, or that come more than a second apart."""
    reader = Reader("stopped", rate=rate)
    world.readers += [reader, Reader("fast")]
    world.plan(second, lambda: setattr(reader, "stopped", world.now))
    while world.now < second + 60.0:
        world.publish(acknowledgement, 1, rate=published)
    assert world.published - reader.read < LIMIT


def test_reader_that_never_goes_on_is_given_up(world: World, acknowledgement: Acknowledgement) -> None:
    """90 s after its lease ended the publisher goes on without it."""
    reader = Reader("stopped")
    world.readers += [reader, Reader("fast")]
    world.plan(0.5, lambda: setattr(reader, "stopped", world.now))
    world.publish(acknowledgement, 20_000)
    assert 0.5 + LEASE + 90.0 - 0.5 < world.now < 0.5 + LEASE + 90.0 + 3.0
    assert world.longest_pause() < 0.2


def test_closed_session_ends_the_wait(world: World, acknowledgement: Acknowledgement) -> None:
    """A service that is stopped does not wait for a stuck reader."""
    world.readers.append(Reader("stuck", rate=0.0))
    world.plan(30.0, lambda: setattr(world, "closed", True))
    with pytest.raises(ClosedError):
        world.publish(acknowledgement, 10_000)
    assert world.now < 50.0


def test_flush_waits_until_readers_have_what_was_published(world: World, acknowledgement: Acknowledgement) -> None:
    """To have is enough: they need not have read it."""
    world.readers.append(Reader("slow", rate=0.0))
    assert acknowledgement.wait(100, timeout=5.0)
    assert world.asked == [{"publisher": "p:1", "number": "99", "read": "0"}]
    assert world.now < 1.0


def test_flush_gives_up_in_time(world: World, acknowledgement: Acknowledgement) -> None:
    """False where a reader that is connected does not answer, and True once it does."""
    reader = Reader("stopped", stopped=0.0)
    world.readers.append(reader)
    assert not acknowledgement.wait(100, timeout=2.0)
    assert world.now == pytest.approx(2.0, abs=0.02)
    reader.stopped = None
    assert acknowledgement.wait(100, timeout=15.0)


def test_flush_asks_anew_each_time(world: World, acknowledgement: Acknowledgement) -> None:
    """A reader may have come since the last question; without a message there is nothing to wait for."""
    assert acknowledgement.wait(0, timeout=5.0)
    assert world.asked == []
    world.publish(acknowledgement, 250)
    world.advance(1.0)
    assert acknowledgement.wait(250, timeout=5.0)
    assert len(world.asked) == 2
    world.readers.append(Reader("new", stopped=world.now))
    assert not acknowledgement.wait(250, timeout=2.0)


def test_flush_waits_for_a_reader_that_may_come_back(world: World, acknowledgement: Acknowledgement) -> None:
    """For as long as one that publishes would, and not for one that answered that it is closed."""
    ended, away = Reader("ended", stopped=0.0), Reader("away")
    world.readers += [ended, away]
    world.plan(0.1, lambda: setattr(ended, "closed", True))
    world.plan(0.1, lambda: setattr(ended, "stopped", None))
    assert acknowledgement.wait(200, timeout=5.0)
    assert world.now < 0.2
    world.restart_router(away, 0.0, until=math.inf)
    assert acknowledgement.wait(300, timeout=60.0)
    assert world.now == pytest.approx(6.0, abs=0.5)


def test_number_of_the_last_message_wraps(world: World, acknowledgement: Acknowledgement) -> None:
    """After 2^32 messages the readers' count begins again, and so does the publisher's."""
    assert acknowledgement.wait(2**32 + 1, timeout=1.0)
    assert world.asked[-1]["number"] == "0"
