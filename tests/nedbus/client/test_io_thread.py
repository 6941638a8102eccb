"""The I/O thread of the process: due times, common ticks, and cleanup after a session or a publisher is closed."""

from __future__ import annotations

import logging
import math
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

import pytest
import zenoh

import nedbus
from nedbus.client import QueryServer, io_thread
from nedbus.client.io_thread import TICK, CallThread, Job
from nedbus.transport import Session, query
from tests.flights.messages import VLP, message
from tests.waits import DEADLINE, wait_for


class Calls:
    """A job that records the times of its calls."""

    def __init__(self, pause: float) -> None:
        self.pause, self.times = pause, list[float]()

    def __call__(self, now: float) -> float:
        self.times.append(now)
        return self.pause


def test_jobs_with_long_pauses_are_called_at_common_ticks() -> None:
    """Jobs that pause for a tick or longer are called together at common ticks, even if their pauses differ."""
    calls = [Calls(TICK * (1 + number / 50)) for number in range(50)]
    jobs = [Job(call) for call in calls]
    wait_for(lambda: all(len(call.times) > 5 for call in calls), what="a few rounds")
    for job in jobs:
        job.end()
    rounds = sorted({each for call in calls for each in call.times[1:]})
    assert len(rounds) <= (rounds[-1] - rounds[0]) / TICK + 2


def test_job_is_called_when_woken() -> None:
    """A job that waits for an hour is called at once after `wake()`, or at the time passed to `wake`."""
    calls = Calls(3600.0)
    job = Job(calls)
    wait_for(lambda: len(calls.times) == 1, what="the first call")
    job.wake()
    wait_for(lambda: len(calls.times) == 2, what="the second call")
    due = time.monotonic() + 0.2
    job.wake(due)
    wait_for(lambda: len(calls.times) == 3, what="the third call")
    assert calls.times[2] >= due
    job.end()


def test_wake_at_a_time_survives_earlier_calls() -> None:
    """A job woken for a later time is called then, even if it is also called before."""
    calls = Calls(math.inf)
    job = Job(calls)
    due = time.monotonic() + 0.3
    job.wake(due)
    job.wake()
    wait_for(lambda: calls.times and calls.times[-1] >= due, what="the call at the later time")
    job.end()


@pytest.mark.slow
def test_wakes_from_several_threads_are_not_lost() -> None:
    """While other threads wake a job for a later time, each `wake()` calls it at once."""
    calls, stop = Calls(math.inf), threading.Event()
    job = Job(calls)

    def wake_later() -> None:
        while not stop.is_set():
            job.wake(time.monotonic() + 3600.0)

    others = [threading.Thread(target=wake_later) for _ in range(2)]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for thread in others:
            thread.start()
        for _ in range(500):
            before = len(calls.times)
            job.wake()
            wait_for(lambda: len(calls.times) > before, what="the call")  # noqa: B023 - called immediately
    finally:
        sys.setswitchinterval(interval)
        stop.set()
        for thread in others:
            thread.join()
        job.end()


def test_end_waits_for_a_running_job() -> None:
    """`end` waits until a running call has returned, unless the job itself calls it."""
    inside, proceed = threading.Event(), threading.Event()

    def block(_: float) -> float:
        inside.set()
        assert proceed.wait(DEADLINE)
        return 0.0

    job = Job(block)
    assert inside.wait(DEADLINE)
    ending = threading.Thread(target=job.end)
    ending.start()
    proceed.set()
    ending.join(DEADLINE)
    assert not ending.is_alive()
    ends: list[Callable[[], None]] = []

    def end_itself(_: float) -> float:
        if ends:
            ends.pop()()
        return 0.0

    itself = Job(end_itself)
    ends.append(itself.end)
    wait_for(lambda: itself not in io_thread._jobs, what="the job to end itself")


@pytest.mark.parametrize("error", [SystemExit, KeyboardInterrupt])
def test_exit_in_a_job_does_not_end_the_thread(error: type[BaseException]) -> None:
    """A job that raises SystemExit or KeyboardInterrupt is called again, and other jobs keep being called."""
    calls = list[float]()

    def leave(now: float) -> float:
        calls.append(now)
        raise error

    def succeed(now: float) -> float:
        others.append(now)
        return 0.01

    others = list[float]()
    jobs = [Job(leave), Job(succeed)]
    wait_for(lambda: len(calls) > 1 and len(others) > 5, what="calls of both jobs")
    for job in jobs:
        job.end()


@pytest.mark.slow
def test_failed_job_is_called_again(caplog: pytest.LogCaptureFixture) -> None:
    """A job that raises is logged once and called again, and does not delay other jobs."""
    calls: list[float] = []

    def fail_at_first(now: float) -> float:
        calls.append(now)
        return 0.0 if len(calls) > 2 else 1 / 0

    def succeed(now: float) -> float:
        others.append(now)
        return 0.01

    others: list[float] = []
    jobs = [Job(fail_at_first), Job(succeed)]
    wait_for(lambda: len(calls) > 5 and len(others) > 5, what="calls of both jobs")
    for job in jobs:
        job.end()
    assert sum("unexpected error" in text for text in caplog.messages) == 1


def panic(*_: object) -> None:
    """Raise an error that is not an Exception, like pyo3's PanicException after a panic of Zenoh."""
    raise BaseException("panic")  # noqa: TRY002 - see above


def test_failed_call_does_not_stop_the_thread(caplog: pytest.LogCaptureFixture) -> None:
    """After calls that raise, even with a panic, a CallThread runs the next one; only the first error is logged."""
    thread, done = CallThread("nedbus-test"), threading.Event()
    thread.start()
    thread.put(panic)
    thread.put(lambda: 1 // 0)
    thread.put(done.set)
    assert done.wait(DEADLINE)
    logged = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert [record.getMessage() for record in logged] == [
        "unexpected error in thread nedbus-test (logged once)"
    ]


def test_queryable_replies_after_a_panic(bus: nedbus.Bus, zenoh_session: Session) -> None:
    """After a panic in the reply to one query, a service replies to the next ones."""
    server, replies = QueryServer(bus._session), iter([panic])

    def reply(received: zenoh.Query) -> None:
        next(replies, partial(received.reply, "nedbus/test", b"reply"))()

    server.answer("nedbus/test", reply)
    wait_for(lambda: query(zenoh_session, "nedbus/test", timeout=DEADLINE), what="a reply")
    server.close()


def test_sessions_share_threads(endpoint: str) -> None:
    """Twenty buses that publish and reply to queries need no more Python threads than one."""
    before = set(threading.enumerate())
    with ExitStack() as opened:
        buses = [opened.enter_context(nedbus.connect(endpoint)) for _ in range(20)]
        for number, bus in enumerate(buses):
            bus.publisher(VLP, vehicle=str(number)).publish(message(number))
        wait_for(lambda: len(buses[0].latest(timeout=DEADLINE)) == 20, what="all last messages")
        names = {thread.name for thread in set(threading.enumerate()) - before}
        assert names <= {"nedbus-io", "nedbus-replies", "nedbus-closer"}
        assert len(set(threading.enumerate()) - before) <= 3


@pytest.mark.parametrize("closed", ["publishers", "bus"])
def test_closed_publishers_and_sessions_leave_no_jobs(endpoint: str, closed: str) -> None:
    """Closed publishers and sessions leave no jobs; a session keeps its schema job for messages in transit."""
    before = len(io_thread._jobs)
    with nedbus.connect(endpoint) as bus:
        for number in range(30):
            with bus.publisher(VLP, vehicle=str(number)) as publisher:
                publisher.publish(message(number))
        if closed == "publishers":
            assert len(io_thread._jobs) <= before + 2  # the schema's queryable, and heartbeats
            assert bus.latest(timeout=DEADLINE) == []
        else:
            bus.publisher(VLP, vehicle="30")
    assert len(io_thread._jobs) == before
