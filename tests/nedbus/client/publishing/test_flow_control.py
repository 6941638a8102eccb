"""Flow control of a lossless publisher: its credit, the trickle beyond it, and readers that leave."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest

from nedbus import limits
from nedbus.client.publishing.flow_control import CACHE, WINDOW, FlowControl, Readers, SharedWindow
from nedbus.errors import ClosedError
from nedbus.timings import TIMINGS, Timings
from tests.waits import DEADLINE

from .fake_readers import END, FakeSession, Reader, Stuck

Interrupt = Callable[..., None]  # a method of FakeSession
LIMIT = 6192  # messages sent without any acknowledgement


@pytest.fixture
def session() -> FakeSession:
    return FakeSession()


@pytest.fixture
def control(session: FakeSession, monkeypatch: pytest.MonkeyPatch, timings: Timings) -> FlowControl:
    return session.flow_control(monkeypatch, timings)


def test_unacknowledged_messages_fit_into_cache_and_queues() -> None:
    """Unacknowledged messages fit into the history cache for recovery, and into the queue of each reader."""
    assert WINDOW < LIMIT < CACHE < limits.RING < limits.UNREAD_MESSAGES
    assert LIMIT + WINDOW == CACHE


@pytest.mark.parametrize("routers", [["r1"], []])
def test_publisher_without_readers_never_waits(
    session: FakeSession, monkeypatch: pytest.MonkeyPatch, timings: Timings, routers: list[str]
) -> None:
    """A publisher without readers never waits, whether its session is a client or a router."""
    session.routers = routers
    session.publish(session.flow_control(monkeypatch, timings, needs_router=bool(routers)), 10_000)
    assert session.now == pytest.approx(1.0)


@pytest.mark.slow
def test_publisher_sends_no_requests_until_its_key_has_a_subscriber(
    session: FakeSession, monkeypatch: pytest.MonkeyPatch, timings: Timings
) -> None:
    """With the router in its process, a publisher requests nothing without a subscriber, and the first one at once."""
    control = session.flow_control(
        monkeypatch, timings, needs_router=False, is_matched=lambda: bool(session.readers)
    )
    session.publish(control, 10_000)
    assert not session.requests
    session.readers.append(Reader("stuck", rate=0.0, read=10_000))
    session.publish(control, WINDOW)
    assert int(session.requests[0]["number"]) in range(10_000, 10_016)
    with pytest.raises(Stuck):
        session.publish(control, 10_000)
    assert session.published - 10_000 == pytest.approx(LIMIT, abs=16)


def test_flow_control_of_a_known_reader_does_not_depend_on_its_subscription(
    session: FakeSession, monkeypatch: pytest.MonkeyPatch, timings: Timings
) -> None:
    """A reader that loses its link also loses its subscription; the publisher waits for its return as ever."""
    reader = Reader("cut")
    control = session.flow_control(
        monkeypatch, timings, needs_router=False, is_matched=lambda: reader.is_linked(session.now)
    )
    session.readers.append(reader)
    session.publish(control, 5000)
    reader.alive = False
    session.schedule(TIMINGS.return_wait / 2, lambda: setattr(reader, "alive", True))
    session.publish(control, 10_000)
    assert session.now > TIMINGS.return_wait / 2


def test_fast_reader_does_not_delay_the_publisher(
    session: FakeSession, control: FlowControl
) -> None:
    """The publisher requests an acknowledgement every 250 messages, and never waits for a fast reader."""
    session.readers.append(Reader("fast"))
    session.publish(control, 10_000)
    assert session.now == pytest.approx(1.0)
    numbers = [int(each["number"]) for each in session.requests]
    assert numbers == list(range(249, 10_000, 250))
    assert {(each["publisher"], each["read"]) for each in session.requests} == {("p:1", "1")}


@pytest.mark.slow
def test_stuck_reader_gets_a_window_and_a_trickle(
    session: FakeSession, control: FlowControl
) -> None:
    """A stuck reader gets 2,000 messages at once, then 10 per second until the history cache is full, then none.

    The publisher waits for a connected reader forever: it repeats its request after 0.5, 1, 2, 4 and 8 s, then
    every 10 s.
    """
    session.readers.append(Reader("stuck", rate=0.0))
    with pytest.raises(Stuck):
        session.publish(control, 10_000)
    assert session.published == LIMIT
    assert session.sent[WINDOW - 1] == pytest.approx(0.2)
    steps = [later - earlier for earlier, later in pairwise(session.sent[WINDOW:])]
    assert steps == pytest.approx([0.1] * len(steps), abs=0.011)
    assert len(session.requests) == pytest.approx(5 + END / 10, rel=0.05)


def test_window_is_shared_by_active_publishers() -> None:
    """Active publishers share the window; what one of them does not use is available to the others.

    A publisher is inactive after a second without messages.
    """
    shared = SharedWindow()
    assert shared.share("a", 0, now=0.0) == WINDOW
    assert shared.share("a", 1900, now=0.1) == WINDOW
    assert shared.share("b", 0, now=0.2) == WINDOW // 2
    assert shared.share("b", 500, now=0.3) == WINDOW // 2
    assert shared.share("a", 100, now=0.4) == WINDOW - 500
    for number in range(8):
        shared.share(f"other {number}", 1000, now=0.5)
    assert shared.share("a", 100, now=0.6) == WINDOW // 10
    assert shared.share("a", 100, now=1.8) == WINDOW


def test_each_of_many_publishers_has_a_window_of_100_messages() -> None:
    """However many publishers share the window, 100 messages of each may be unacknowledged."""
    shared = SharedWindow()
    assert [shared.share(f"{number}", 100, now=0.0) for number in range(500)][-1] == 100


def test_shares_of_two_threads_do_not_overwrite_each_other() -> None:
    """A publisher that asks for its share while another thread does waits, so neither entry is lost."""
    shared = SharedWindow()
    other = threading.Thread(target=shared.share, args=["b", 500], kwargs={"now": 0.2})

    class Interrupted(dict[str, tuple[int, float]]):
        """Entries that another thread changes while they are read, unless it has to wait."""

        def items(self) -> Any:
            if other.ident is None:
                other.start()
                other.join(0.05)  # ends at once if it does not wait
            return super().items()

    shared._unread = Interrupted()
    shared.share("a", 1000, now=0.1)
    other.join(DEADLINE)
    assert set(shared._unread) == {"a", "b"}


@pytest.mark.parametrize(
    ("at", "rate", "pause"), [(0.0, 10_000.0, 0.6), (2.0, 10_000.0, 0.6), (0.0, 1000.0, 0.02)]
)
def test_request_dropped_by_a_full_queue_is_repeated(
    session: FakeSession, control: FlowControl, at: float, rate: float, pause: float
) -> None:
    """An acknowledgement request that a full queue dropped is repeated after half a second."""
    session.readers.append(Reader("fast"))
    session.schedule(at, lambda: setattr(session, "dropping", True))
    session.schedule(at + 0.2, lambda: setattr(session, "dropping", False))
    session.publish(control, round(3 * rate), rate=rate)
    assert session.now < 3.0 + pause
    assert session.longest_pause() < pause


@pytest.mark.slow
def test_reader_that_resumes_gets_all_messages(session: FakeSession, control: FlowControl) -> None:
    """A reader that resumes after eight minutes gets all messages, and no longer delays the publisher."""
    reader = Reader("stuck", rate=0.0)
    session.readers.append(reader)
    session.schedule(480.0, lambda: setattr(reader, "rate", 100_000.0))
    session.publish(control, 20_000)
    assert session.now < 480.0 + 2.0
    assert session.longest_pause(since=480.2) < 0.02


@pytest.mark.parametrize("rate", [100.0, 500.0, 5_000.0])
def test_slow_reader_sets_the_pace_and_never_starves(
    session: FakeSession, control: FlowControl, rate: float
) -> None:
    """The publisher is ahead of a slow reader by at most a window and a trickle; the reader never has to wait."""
    reader = Reader("slow", rate=rate)
    session.readers += [reader, Reader("fast")]
    session.publish(control, 10_000)
    ahead = [at - reader.rate * time for at, time in enumerate(session.sent)]
    assert max(ahead) < WINDOW * 1.5
    assert session.now == pytest.approx((10_000 - WINDOW) / rate, rel=0.2)
    assert session.longest_pause() < 0.2


def test_fast_reader_gets_ten_messages_per_second_despite_a_slow_one(
    session: FakeSession, control: FlowControl
) -> None:
    """With a reader of one message per second, other readers get ten per second while the history cache has room."""
    session.readers += [Reader("slow", rate=1.0), Reader("fast")]
    session.publish(control, WINDOW + 1000)
    assert session.now > 90.0
    assert session.longest_pause() < 0.2


def test_closed_reader_does_not_delay_the_publisher(
    session: FakeSession, control: FlowControl
) -> None:
    """The publisher continues once a stuck reader closes, because a closing reader acknowledges the open request."""
    reader = Reader("stuck", rate=0.0)
    session.readers += [reader, Reader("fast")]
    session.schedule(1.0, lambda: setattr(reader, "closed", True))
    session.publish(control, 10_000)
    assert session.now < 2.1


def measure_lead(session: FakeSession, control: FlowControl, reader: Reader, at: float) -> float:
    """Publish 20,000 messages to a reader; return how many were published but unread after `at` seconds."""
    lead: list[float] = []
    session.schedule(at, lambda: lead.append(session.published - reader.read))
    count = session.published + 20_000
    session.publish(control, 20_000)
    assert reader.read > count - WINDOW
    return lead[0]


@pytest.mark.parametrize("rate", [math.inf, 5_000.0])
@pytest.mark.parametrize(
    ("interrupt", "begin", "end"),
    [
        (FakeSession.cut, 0.1, 2.1),
        (FakeSession.restart_router, 0.1003, 4.5),
        (FakeSession.stop, 0.5, 60.5),
        (FakeSession.stop, 0.0, 90.0),
    ],
)
def test_reader_that_returns_in_time_misses_nothing(  # noqa: PLR0917 - a table
    session: FakeSession,
    control: FlowControl,
    rate: float,
    interrupt: Interrupt,
    begin: float,
    end: float,
) -> None:
    """A reader gets all messages, even if its link was reset, its router restarted, or its process was suspended.

    Until it returns, other readers get ten messages per second.
    """
    reader = Reader("back", rate=rate)
    session.readers += [reader, Reader("fast")]
    interrupt(session, reader, begin, until=end)
    assert WINDOW / 2 < measure_lead(session, control, reader, end - 0.01) < LIMIT
    assert session.longest_pause() < 0.2
    assert session.now < end + 20_000 / min(rate, 10_000.0)


@pytest.mark.parametrize(
    ("interrupt", "at", "seconds"),
    [
        (FakeSession.cut, 0.1003, 5.0),
        (FakeSession.restart_router, 0.1003, 1.0 + 5.0),
        (FakeSession.stop, 0.1003, TIMINGS.lease + 90.0),
        (FakeSession.stop, 0.0, TIMINGS.lease + 90.0),
    ],
)
def test_publisher_stops_waiting_for_a_lost_reader(
    session: FakeSession, control: FlowControl, interrupt: Interrupt, at: float, seconds: float
) -> None:
    """The publisher stops waiting for a disconnected reader after 5 s with a router.

    It stops waiting for a suspended reader 90 s after the reader's lease expires. Until then, other readers get ten
    messages per second.
    """
    reader = Reader("gone", rate=5_000.0)
    session.readers += [reader, Reader("fast")]
    interrupt(session, reader, at, until=math.inf)
    session.publish(control, 20_000)
    assert seconds - 0.3 < session.now - 18_000 / 10_000.0 < seconds + 1.0
    assert session.longest_pause() < 0.2


@pytest.mark.parametrize("away", [0.5, 4.0, 7.0, 60.0])
@pytest.mark.parametrize("answered", [True, False])
def test_publisher_waits_for_readers_while_the_router_is_away(
    session: FakeSession, control: FlowControl, away: float, answered: bool
) -> None:
    """The publisher waits for its readers until the router is back: a reader that returns 3 s later misses nothing."""
    reader = Reader("back")
    session.readers.append(reader)
    session.publish(control, 1000 if answered else 249)
    reader.alive = False
    session.routers.clear()
    session.schedule(away, lambda: session.routers.append("r2"))
    session.schedule(away + 3.0, lambda: setattr(reader, "alive", True))
    assert measure_lead(session, control, reader, away + 2.99) < LIMIT
    assert session.now < away + 3.0 + 20_000 / 10_000.0 + 0.2


@pytest.mark.parametrize(
    ("rate", "published"), [(0.0, 10_000.0), (100.0, 10_000.0), (math.inf, 200.0)]
)
@pytest.mark.parametrize("second", range(20, 30, 2))
def test_publisher_waits_for_a_suspended_reader(
    session: FakeSession, control: FlowControl, rate: float, published: float, second: int
) -> None:
    """The publisher waits for a suspended reader, whenever its lease expires between requests and late replies."""
    reader = Reader("stopped", rate=rate)
    session.readers += [reader, Reader("fast")]
    session.stop(reader, second, until=math.inf)
    while session.now < second + 60.0:
        session.publish(control, 1, rate=published)
    assert session.published - reader.read < LIMIT


@pytest.mark.parametrize("others", [[], ["fast"]])
@pytest.mark.parametrize("back", [0.1, 60.0])
def test_reader_suspended_while_replying_is_recognized(
    session: FakeSession, control: FlowControl, others: list[str], back: float
) -> None:
    """A reader suspended while replying is recognized when it returns; the publisher waits for no other reader."""
    reader = Reader("back", stops_in_answer=True)
    session.readers += [reader, *map(Reader, others)]
    session.schedule(TIMINGS.lease + back, lambda: setattr(reader, "stopped", None))
    assert WINDOW / 2 < measure_lead(session, control, reader, TIMINGS.lease + back - 0.01) < LIMIT
    assert session.now < TIMINGS.lease + back + 20_000 / 10_000.0


def test_change_of_routers_shortens_no_wait() -> None:
    """A reader that replies stays known when routers change, and a suspended one is awaited for its full 90 s."""
    readers = Readers()
    readers.update({"a": False}, froze=False, now=0.0)
    readers.wait_for_link(1.0)
    assert not readers.is_one_missing
    readers.update({}, froze=True, now=10.0)
    readers.wait_for_link(11.0)
    readers.update({}, froze=False, now=10.0 + TIMINGS.frozen_wait - 0.1)
    assert readers.is_one_missing
    readers.update({}, froze=False, now=10.0 + TIMINGS.frozen_wait)
    assert readers.is_empty


def test_reader_that_closes_while_another_is_stuck_does_not_delay_the_publisher(
    session: FakeSession, control: FlowControl
) -> None:
    """If a reader closes while another is stuck, the publisher stops waiting for it 5 s after the other resumes."""
    stuck, ended = Reader("stuck", rate=0.0), Reader("ended")
    session.readers += [stuck, ended]
    session.schedule(10.0, lambda: setattr(ended, "closed", True))
    session.schedule(20.0, lambda: setattr(stuck, "rate", math.inf))
    session.publish(control, 10_000)
    assert session.now < 20.0 + 5.0 + 1.5


def test_closed_session_ends_the_wait(session: FakeSession, control: FlowControl) -> None:
    """Closing the session ends the wait for a stuck reader."""
    session.readers.append(Reader("stuck", rate=0.0))
    session.schedule(30.0, lambda: setattr(session, "closed", True))
    with pytest.raises(ClosedError):
        session.publish(control, 10_000)
    assert session.now < 50.0


def test_flush_waits_only_for_reception(session: FakeSession, control: FlowControl) -> None:
    """A flush waits until readers have received all messages, not until they have read them."""
    session.readers.append(Reader("slow", rate=0.0))
    assert control.wait_for_reception(100, timeout=5.0)
    assert session.requests == [{"publisher": "p:1", "number": "99", "read": "0"}]
    assert session.now < 1.0


def test_flush_returns_false_on_timeout(session: FakeSession, control: FlowControl) -> None:
    """A flush returns False if a connected reader does not reply, and True once it does."""
    reader = Reader("stopped", stopped=0.0)
    session.readers.append(reader)
    assert not control.wait_for_reception(100, timeout=2.0)
    assert session.now == pytest.approx(2.0, abs=0.02)
    reader.stopped = None
    assert control.wait_for_reception(100, timeout=15.0)


def test_each_flush_sends_a_new_request(session: FakeSession, control: FlowControl) -> None:
    """Each flush sends a new request, because there may be new readers; before the first message it sends none."""
    assert control.wait_for_reception(0, timeout=5.0)
    assert session.requests == []
    session.publish(control, 250)
    session.advance(1.0)
    assert control.wait_for_reception(250, timeout=5.0)
    assert len(session.requests) == 2
    session.readers.append(Reader("new", stopped=session.now))
    assert not control.wait_for_reception(250, timeout=2.0)


def test_flush_waits_for_a_lost_reader(session: FakeSession, control: FlowControl) -> None:
    """A flush waits for a disconnected reader as long as publishing would, but not for a closed reader."""
    ended, away = Reader("ended", stopped=0.0), Reader("away")
    session.readers += [ended, away]
    session.schedule(0.1, lambda: setattr(ended, "closed", True))
    session.schedule(0.1, lambda: setattr(ended, "stopped", None))
    assert control.wait_for_reception(200, timeout=5.0)
    assert session.now < 0.2
    session.restart_router(away, 0.0, until=math.inf)
    assert control.wait_for_reception(300, timeout=60.0)
    assert session.now == pytest.approx(6.0, abs=0.5)


def test_message_number_in_acknowledgement_request_wraps(
    session: FakeSession, control: FlowControl
) -> None:
    """The message number in an acknowledgement request wraps at 2^32, as the reader's numbers do."""
    assert control.wait_for_reception(2**32 + 1, timeout=1.0)
    assert session.requests[-1]["number"] == "0"
