"""Flow control of a lossless publisher: its credit, the trickle beyond it, and readers that have gone."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import pytest

from nedbus.client.publishing.flow_control import CACHE, WINDOW, FlowControl, SharedWindow
from nedbus.client.receiving.pending_queue import CAPACITY
from nedbus.client.receiving.receiver import RING_CAPACITY
from nedbus.errors import ClosedError
from nedbus.transport import LEASE

from .fake_readers import END, Reader, Stuck, World

Interrupt = Callable[..., None]  # a method of World
LIMIT = 6192  # messages that are sent at all without an acknowledgement


@pytest.fixture
def world() -> World:
    return World()


@pytest.fixture
def control(world: World, monkeypatch: pytest.MonkeyPatch) -> FlowControl:
    return world.flow_control(monkeypatch)


def test_limits_fit_into_each_other() -> None:
    """Messages sent without an acknowledgement are still kept for recovery, and fit into the queue of each reader."""
    assert WINDOW < LIMIT < CACHE < RING_CAPACITY < CAPACITY
    assert LIMIT + WINDOW == CACHE


@pytest.mark.parametrize("routers", [["r1"], []])
def test_without_readers_it_never_waits(world: World, monkeypatch: pytest.MonkeyPatch, routers: list[str]) -> None:
    """Nobody has to be waited for where nobody answers; a router itself needs no other one for that."""
    world.routers = routers
    world.publish(world.flow_control(monkeypatch, needs_router=bool(routers)), 10_000)
    assert world.now == pytest.approx(1.0)


def test_reader_that_keeps_up_is_not_waited_for(world: World, control: FlowControl) -> None:
    """It is asked every 250 messages, by the number of the last one, one question at a time."""
    world.readers.append(Reader("fast"))
    world.publish(control, 10_000)
    assert world.now == pytest.approx(1.0)
    numbers = [int(each["number"]) for each in world.asked]
    assert numbers == list(range(249, 10_000, 250))
    assert {(each["publisher"], each["read"]) for each in world.asked} == {("p:1", "1")}


def test_reader_that_reads_nothing_gets_a_window_and_a_trickle(world: World, control: FlowControl) -> None:
    """2,000 messages at once, then 10 a second for others, until no more are kept; then nothing at all.

    It is connected and therefore never given up; it is asked again after 0.5, 1, 2, 4 and 8 s, and then every 10 s.
    """
    world.readers.append(Reader("stuck", rate=0.0))
    with pytest.raises(Stuck):
        world.publish(control, 10_000)
    assert world.published == LIMIT
    assert world.sent[WINDOW - 1] == pytest.approx(0.2)
    steps = [later - earlier for earlier, later in pairwise(world.sent[WINDOW:])]
    assert steps == pytest.approx([0.1] * len(steps), abs=0.011)
    assert len(world.asked) == pytest.approx(5 + END / 10, rel=0.05)


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


@pytest.mark.parametrize(("at", "rate", "pause"), [(0.0, 10_000.0, 0.6), (2.0, 10_000.0, 0.6), (0.0, 1000.0, 0.02)])
def test_question_that_a_full_queue_dropped_is_asked_again(
    world: World, control: FlowControl, at: float, rate: float, pause: float
) -> None:
    """After half a second, not when it is given up: nobody notices more than that, and a slow publisher nothing."""
    world.readers.append(Reader("fast"))
    world.plan(at, lambda: setattr(world, "dropping", True))
    world.plan(at + 0.2, lambda: setattr(world, "dropping", False))
    world.publish(control, round(3 * rate), rate=rate)
    assert world.now < 3.0 + pause
    assert world.longest_pause() < pause


def test_reader_that_goes_on_gets_everything(world: World, control: FlowControl) -> None:
    """After eight minutes as well, and from then on nothing holds the publisher up."""
    reader = Reader("stuck", rate=0.0)
    world.readers.append(reader)
    world.plan(480.0, lambda: setattr(reader, "rate", 100_000.0))
    world.publish(control, 20_000)
    assert world.now < 480.0 + 2.0
    assert world.longest_pause(since=480.2) < 0.02


@pytest.mark.parametrize("rate", [100.0, 500.0, 5_000.0])
def test_slow_reader_sets_the_pace_and_is_never_without_messages(
    world: World, control: FlowControl, rate: float
) -> None:
    """The publisher is a window ahead at most, and a trickle; the reader always has something to read."""
    reader = Reader("slow", rate=rate)
    world.readers += [reader, Reader("fast")]
    world.publish(control, 10_000)
    ahead = [at - reader.rate * time for at, time in enumerate(world.sent)]
    assert max(ahead) < WINDOW * 1.5
    assert world.now == pytest.approx((10_000 - WINDOW) / rate, rel=0.2)
    assert world.longest_pause() < 0.2


def test_healthy_reader_is_never_without_a_message_for_long(world: World, control: FlowControl) -> None:
    """Beside one that reads a message a second it gets ten a second, for as long as publishers keep messages."""
    world.readers += [Reader("slow", rate=1.0), Reader("fast")]
    world.publish(control, WINDOW + 1000)
    assert world.now > 90.0
    assert world.longest_pause() < 0.2


def test_reader_that_is_closed_is_not_waited_for(world: World, control: FlowControl) -> None:
    """It answers what is asked at that moment, and the publisher goes on."""
    reader = Reader("stuck", rate=0.0)
    world.readers += [reader, Reader("fast")]
    world.plan(1.0, lambda: setattr(reader, "closed", True))
    world.publish(control, 10_000)
    assert world.now < 2.1


def lead_over(world: World, control: FlowControl, reader: Reader, at: float) -> float:
    """Publish, and return how many messages a reader lacked `at` seconds later; it has read nearly all in the end."""
    lead: list[float] = []
    world.plan(at, lambda: lead.append(world.published - reader.read))
    count = world.published + 20_000
    world.publish(control, 20_000)
    assert reader.read > count - WINDOW
    return lead[0]


@pytest.mark.parametrize("rate", [math.inf, 5_000.0])
@pytest.mark.parametrize(
    ("interrupt", "begin", "end"),
    [(World.cut, 0.1, 2.1), (World.restart_router, 0.1003, 4.5), (World.stop, 0.5, 60.5), (World.stop, 0.0, 90.0)],
)
def test_reader_that_comes_back_in_time_has_missed_nothing(  # noqa: PLR0917 - a table
    world: World, control: FlowControl, rate: float, interrupt: Interrupt, begin: float, end: float
) -> None:
    """Its link was reset, the router restarted, or it was stopped, perhaps before it ever answered.

    Others get ten messages a second meanwhile, and everything soon after.
    """
    reader = Reader("back", rate=rate)
    world.readers += [reader, Reader("fast")]
    interrupt(world, reader, begin, until=end)
    assert WINDOW / 2 < lead_over(world, control, reader, end - 0.01) < LIMIT
    assert world.longest_pause() < 0.2
    assert world.now < end + 20_000 / min(rate, 10_000.0)


@pytest.mark.parametrize(
    ("interrupt", "at", "seconds"),
    [
        (World.cut, 0.1003, 5.0),
        (World.restart_router, 0.1003, 1.0 + 5.0),
        (World.stop, 0.1003, LEASE + 90.0),
        (World.stop, 0.0, LEASE + 90.0),
    ],
)
def test_reader_that_does_not_come_back_is_given_up(
    world: World, control: FlowControl, interrupt: Interrupt, at: float, seconds: float
) -> None:
    """5 s after it or the router is back, or 90 s after its lease ended; others get ten a second until then."""
    reader = Reader("gone", rate=5_000.0)
    world.readers += [reader, Reader("fast")]
    interrupt(world, reader, at, until=math.inf)
    world.publish(control, 20_000)
    assert seconds - 0.3 < world.now - 18_000 / 10_000.0 < seconds + 1.0
    assert world.longest_pause() < 0.2


@pytest.mark.parametrize("away", [0.5, 4.0, 7.0, 60.0])
@pytest.mark.parametrize("answered", [True, False])
def test_no_time_runs_while_there_is_no_router(world: World, control: FlowControl, away: float, answered: bool) -> None:
    """A reader that comes back 3 s after the router has missed nothing, whether it has ever answered or not."""
    reader = Reader("back")
    world.readers.append(reader)
    world.publish(control, 1000 if answered else 249)
    reader.alive = False
    world.routers.clear()
    world.plan(away, lambda: world.routers.append("r2"))
    world.plan(away + 3.0, lambda: setattr(reader, "alive", True))
    assert lead_over(world, control, reader, away + 2.99) < LIMIT
    assert world.now < away + 3.0 + 20_000 / 10_000.0 + 0.2


@pytest.mark.parametrize(("rate", "published"), [(0.0, 10_000.0), (100.0, 10_000.0), (math.inf, 200.0)])
@pytest.mark.parametrize("second", range(20, 30, 2))
def test_reader_that_is_stopped_at_any_time_is_waited_for(
    world: World, control: FlowControl, rate: float, published: float, second: int
) -> None:
    """However its lease meets questions that are answered late, or never, or that come more than a second apart."""
    reader = Reader("stopped", rate=rate)
    world.readers += [reader, Reader("fast")]
    world.stop(reader, second, until=math.inf)
    while world.now < second + 60.0:
        world.publish(control, 1, rate=published)
    assert world.published - reader.read < LIMIT


@pytest.mark.parametrize("others", [[], ["fast"]])
def test_reader_that_is_stopped_as_it_answers_is_known(world: World, control: FlowControl, others: list[str]) -> None:
    """Nobody else is waited for when it is back: the request that it held up had its answer."""
    reader = Reader("back", stops_in_answer=True)
    world.readers += [reader, *map(Reader, others)]
    world.plan(LEASE + 60.0, lambda: setattr(reader, "stopped", None))
    assert WINDOW / 2 < lead_over(world, control, reader, LEASE + 59.99) < LIMIT
    assert world.now < LEASE + 60.0 + 20_000 / 10_000.0


def test_reader_that_ended_beside_a_stuck_one_is_given_up_after_5_seconds(world: World, control: FlowControl) -> None:
    """It had answered the request that is still open: the stuck one may have been stopped, not this one."""
    stuck, ended = Reader("stuck", rate=0.0), Reader("ended")
    world.readers += [stuck, ended]
    world.plan(10.0, lambda: setattr(ended, "closed", True))
    world.plan(20.0, lambda: setattr(stuck, "rate", math.inf))
    world.publish(control, 10_000)
    assert world.now < 20.0 + 5.0 + 1.5


def test_closed_session_ends_the_wait(world: World, control: FlowControl) -> None:
    """A service that is stopped does not wait for a stuck reader."""
    world.readers.append(Reader("stuck", rate=0.0))
    world.plan(30.0, lambda: setattr(world, "closed", True))
    with pytest.raises(ClosedError):
        world.publish(control, 10_000)
    assert world.now < 50.0


def test_flush_waits_until_readers_have_what_was_published(world: World, control: FlowControl) -> None:
    """To have is enough: they need not have read it."""
    world.readers.append(Reader("slow", rate=0.0))
    assert control.wait(100, timeout=5.0)
    assert world.asked == [{"publisher": "p:1", "number": "99", "read": "0"}]
    assert world.now < 1.0


def test_flush_gives_up_in_time(world: World, control: FlowControl) -> None:
    """False where a reader that is connected does not answer, and True once it does."""
    reader = Reader("stopped", stopped=0.0)
    world.readers.append(reader)
    assert not control.wait(100, timeout=2.0)
    assert world.now == pytest.approx(2.0, abs=0.02)
    reader.stopped = None
    assert control.wait(100, timeout=15.0)


def test_flush_asks_anew_each_time(world: World, control: FlowControl) -> None:
    """A reader may have come since the last question; without a message there is nothing to wait for."""
    assert control.wait(0, timeout=5.0)
    assert world.asked == []
    world.publish(control, 250)
    world.advance(1.0)
    assert control.wait(250, timeout=5.0)
    assert len(world.asked) == 2
    world.readers.append(Reader("new", stopped=world.now))
    assert not control.wait(250, timeout=2.0)


def test_flush_waits_for_a_reader_that_may_come_back(world: World, control: FlowControl) -> None:
    """For as long as one that publishes would, and not for one that answered that it is closed."""
    ended, away = Reader("ended", stopped=0.0), Reader("away")
    world.readers += [ended, away]
    world.plan(0.1, lambda: setattr(ended, "closed", True))
    world.plan(0.1, lambda: setattr(ended, "stopped", None))
    assert control.wait(200, timeout=5.0)
    assert world.now < 0.2
    world.restart_router(away, 0.0, until=math.inf)
    assert control.wait(300, timeout=60.0)
    assert world.now == pytest.approx(6.0, abs=0.5)


def test_number_of_the_last_message_wraps(world: World, control: FlowControl) -> None:
    """After 2^32 messages the readers' count begins again, and so does the publisher's."""
    assert control.wait(2**32 + 1, timeout=1.0)
    assert world.asked[-1]["number"] == "0"
