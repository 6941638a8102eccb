"""Worker of a source: states, backoff and stream expiry, with a fake clock that advances only by waiting."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from nedbus import clock, limits
from nedbus.client import PublisherRegistry
from nedbus.daemon import PlannedSource
from nedbus.daemon.worker import Clock, Worker
from nedbus.errors import AddressInUseError, ClosedError, SourceError
from nedbus.health import SourceStatus
from nedbus.sources import Rejection, ReplayRun, ReplaySource, Source, SourceMessage
from nedbus.sources.options import RecordedOptions
from nedbus.transport import Session
from nedbus.vehicle_events import EventLog
from nedbus_msgs import DEFAULT, Address, Definition, VehicleLocalPosition
from tests.flights.local_position import decode
from tests.flights.messages import VLP

ONE, TWO = Address("1", VLP), Address("2", VLP)
Script = list[SourceMessage | Rejection | float | None]


@dataclass
class FakeClock:
    """A clock that advances only by waiting; it stops the worker at `stop_at` seconds."""

    stop_at: float = 1000.0
    seconds: float = 0.0
    waits: list[float] = field(default_factory=list)

    def is_set(self) -> bool:
        return self.seconds >= self.stop_at

    def now(self) -> float:
        return self.seconds

    def wait(self, seconds: float) -> bool:
        self.waits.append(round(seconds, 6))
        self.seconds += seconds
        return self.is_set()


@dataclass
class FakeRegistry:
    """A publisher registry without a session; messages are validated and recorded."""

    clock: FakeClock
    publishers: dict[Address, SimpleNamespace] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)
    published: dict[Address, list[tuple[float, VehicleLocalPosition]]] = field(default_factory=dict)
    rejected: list[tuple[Address, Mapping[str, object]]] = field(default_factory=list)
    readers_at: float = 0.0

    def publisher(
        self,
        address: Address,
        definition: Definition[Any] | None = None,
        *,
        lossless: bool,
        source: str,
        short_history: bool = True,
    ) -> SimpleNamespace:
        assert short_history
        if address in self.publishers:
            raise AddressInUseError(address)

        def publish(payload: bytes, _: object) -> None:
            self.published.setdefault(address, []).append((self.clock.seconds, decode(payload)))

        def close() -> None:
            del self.publishers[address]
            self.log.append(f"{self.clock.seconds:g} -{address.vehicle}")

        self.log.append(
            f"{self.clock.seconds:g} +{address.vehicle}{' lossless' if lossless else ''} {source}"
        )
        self.publishers[address] = SimpleNamespace(
            publish_encoded=publish,
            close=close,
            relabel=lambda _: None,
            definition=definition or DEFAULT,
            source=source,
        )
        return self.publishers[address]

    def has_subscriber(self, _: object) -> bool:
        return self.clock.seconds >= self.readers_at

    def reject(self, address: Address, report: Mapping[str, object]) -> None:
        self.rejected.append((address, report))


@dataclass
class FakeReplay:
    """A replay of `messages`, or of the generator `run`; `open` raises the next of `failures`, if any."""

    messages: list[SourceMessage]
    failures: list[BaseException] = field(default_factory=list)
    speed: float | None = 1.0
    loop: bool = False
    wait: bool = False
    run: Callable[[], Iterator[SourceMessage]] | None = None

    @property
    def source(self) -> ReplaySource:
        options = RecordedOptions.model_construct(speed=self.speed, loop=self.loop, wait=self.wait)
        return ReplaySource(options, self.open)

    def open(self) -> ReplayRun:
        if self.failures:
            raise self.failures.pop(0)
        addresses = {each.address: each.definition for each in self.messages}
        return ReplayRun(
            self.run() if self.run else iter(self.messages),
            addresses,
            len(self.messages),
            "a flight",
        )


@dataclass
class FakeLive:
    """A live source that yields the items of a script; a number advances the clock by seconds."""

    clock: FakeClock
    script: Script
    failures: list[BaseException] = field(default_factory=list)
    closed: int = 0

    def listen(self, router: Session | None) -> Iterator[SourceMessage | Rejection | None]:
        try:
            yield None
            if self.failures:
                raise self.failures.pop(0)
            for item in self.script:
                if isinstance(item, float):
                    for _ in range(round(item * 4)):
                        self.clock.seconds += 0.25
                        yield None
                else:
                    yield item
        finally:
            self.closed += 1


def at(due: float, address: Address = ONE, **fields: object) -> SourceMessage:
    return SourceMessage(due, address, {"timestamp": round(due * 1e6), **fields})


class Harness:
    """A worker with a fake registry; counts the calls of `on_end`."""

    def __init__(self, source: object, clock: FakeClock, *, retry: bool = True) -> None:
        self.ends = 0
        self.registry = FakeRegistry(clock)
        self.worker = Worker(
            PlannedSource(
                0,
                "ulog:flight.ulg",
                "1",
                source.source if isinstance(source, FakeReplay) else cast("Source", source),
            ),
            cast("PublisherRegistry", self.registry),
            clock=cast("Clock", clock),
            event_log=EventLog(),
            retry=retry,
            on_end=self._count_end,
        )

    def _count_end(self) -> None:
        self.ends += 1

    @property
    def status(self) -> SourceStatus:
        return self.worker.status()

    @property
    def times(self) -> list[float]:
        """Publication times of the messages of vehicle 1 [s]."""
        return [round(seconds, 6) for seconds, _ in self.registry.published.get(ONE, [])]


def run(source: object, clock: FakeClock | None = None, *, retry: bool = True) -> Harness:
    harness = Harness(source, clock or FakeClock(), retry=retry)
    harness.worker.run()
    return harness


def test_replay_publishes_each_message_at_its_due_time() -> None:
    """At speed=2, messages are published in half the time. Then the source is done, and `on_end` is called once."""
    harness = Harness(FakeReplay([at(0.0), at(1.0), at(3.0)], speed=2.0), FakeClock())
    assert harness.status.state == "starting"
    harness.worker.run()
    assert harness.times == [0.0, 0.5, 1.5]
    status = harness.status
    assert (status.state, status.published, status.done, status.total, status.ended) == (
        "done",
        3,
        3,
        3,
        True,
    )
    assert harness.ends == 1


def test_vehicle_is_not_silent_during_a_dropout_of_a_replay() -> None:
    """While a replay waits for the end of a logging dropout of 5 s, its vehicle is not silent."""
    waits = list[float]()

    @dataclass
    class Watching(FakeClock):
        def wait(self, seconds: float) -> bool:
            waits.append(seconds)
            event_log.update(clock.steady() + 0.9 * seconds, {ONE: "stale"})
            return super().wait(seconds)

    harness = Harness(
        FakeReplay([at(0.0), replace(at(5.0), dropout=5.0), at(11.0)]), Watching(stop_at=10.0)
    )
    event_log = harness.worker._output._event_log
    harness.worker.run()
    assert waits == [5.0, 6.0]
    assert [event.kind for event in event_log.events] == ["dropout", "silent"]
    assert event_log.events[1].numbers["age"] == pytest.approx(5.4, abs=0.1)  # after the dropout


def test_replay_at_full_speed_is_lossless_and_unpaced() -> None:
    """At speed=max, publishers wait for readers, not for the clock."""
    clock = FakeClock()
    harness = run(FakeReplay([at(0.0), at(100.0)], speed=None), clock)
    assert (harness.times, clock.waits) == ([0.0, 0.0], [])
    assert harness.registry.log[0] == "0 +1 lossless ulog"


def test_stop_ends_the_opening_of_publishers() -> None:
    """On a busy computer, a stopped replay of hundreds of topics does not open the rest of its publishers."""
    clock = FakeClock(stop_at=3.0)
    harness = Harness(
        FakeReplay([at(0.0, Address(str(number), VLP)) for number in range(10)]), clock
    )
    open_publisher = harness.registry.publisher

    def open_slowly(*arguments: Any, **options: Any) -> SimpleNamespace:
        clock.seconds += 1.0
        return open_publisher(*arguments, **options)

    harness.registry.publisher = open_slowly  # type: ignore[method-assign]
    harness.worker.run()
    assert harness.status.published == 0
    assert len(harness.registry.publishers) == 3


def test_late_replay_shifts_its_schedule() -> None:
    """After its host was suspended, a replay does not send faster to catch up."""
    clock = FakeClock()

    def stall() -> Iterator[SourceMessage]:
        yield at(0.0)
        clock.seconds += 10.0
        yield from (at(1.0), at(2.0))

    assert run(FakeReplay([at(0.0)], run=stall), clock).times == [0.0, 10.0, 11.0]


def test_replay_waits_only_for_its_first_subscriber() -> None:
    """With wait=1 a replay publishes nothing before the first subscriber; later runs of a loop do not wait again."""
    harness = Harness(FakeReplay([at(0.0), at(0.5)], wait=True, loop=True), FakeClock(stop_at=2.0))
    harness.registry.readers_at = 1.0
    harness.worker.run()
    assert harness.times[:3] == [1.0, 1.5, 1.5]


@dataclass
class LateReplay(FakeReplay):
    """A replay whose second stream is found half a second after the first one."""

    def open(self) -> ReplayRun:
        addresses: dict[Address, Definition[Any]] = {ONE: DEFAULT}

        def read() -> Iterator[SourceMessage]:
            yield at(0.0)
            addresses[TWO] = DEFAULT
            yield at(0.5, TWO)

        return ReplayRun(read(), addresses, 2, "a flight")


def test_loop_keeps_the_publishers_of_streams_that_start_later() -> None:
    """A stream that is found during the first run stays open between runs."""
    harness = run(LateReplay([], loop=True), FakeClock(stop_at=2.2))
    assert [time for time, _ in harness.registry.published[TWO]] == [0.5, 1.0, 1.5, 2.0]
    opened = harness.registry.log[:2]
    assert opened == ["0 +1 ulog", "0.5 +2 ulog"]
    assert [line for line in harness.registry.log if float(line.split()[0]) < 2.0] == opened


def test_looped_replay_has_a_minimum_duration() -> None:
    """Each run of a loop takes at least 0.1 s, however short the log is."""
    harness = run(FakeReplay([at(0.0)], loop=True), FakeClock(stop_at=1.0))
    assert harness.times[:10] == pytest.approx([step / 10 for step in range(10)])


def test_failed_replay_is_retried_with_exponential_backoff() -> None:
    """The backoff is 1, 2, 4, 8, 16, 30, 30 s, and restarts after a success. A source in backoff claims no address."""
    clock = FakeClock()
    failures: list[BaseException] = [SourceError("flight.ulg", "no such file")] * 7
    harness = run(FakeReplay([at(0.0)], failures), clock)
    assert clock.waits == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0]
    status = harness.status
    assert (status.state, status.retries, status.error, status.published) == ("done", 7, None, 1)
    assert harness.registry.log == ["91 +1 ulog"]

    def work() -> Iterator[SourceMessage]:
        yield at(0.0)
        yield at(40.0)
        raise SourceError("flight.ulg", "no such file")

    run(FakeReplay([at(0.0)], run=work), clock := FakeClock(stop_at=200.0))
    assert clock.waits == [40.0, 1.0] * 4 + [40.0]


class PanicException(BaseException):
    """The exception that pyo3 raises when Rust panics; Zenoh panics if the clock is before 1970."""


@pytest.mark.parametrize("retry", [True, False])
@pytest.mark.parametrize(
    ("failure", "reason"),
    [
        (SourceError("flight.ulg", "no such file"), "flight.ulg: no such file"),
        (ZeroDivisionError("1/0"), "unexpected ZeroDivisionError: 1/0"),
        (PanicException("clock before 1970"), "unexpected PanicException: clock before 1970"),
    ],
)
def test_source_retries_or_fails_after_any_exception(
    failure: BaseException, reason: str, retry: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """After any exception, even a BaseException, the state is "retrying" or "failed", never "running".

    Each failure is one log line that names the source, with a traceback only for an unexpected exception.
    """
    harness = run(FakeReplay([at(0.0)], [failure] * 9), FakeClock(stop_at=100.0), retry=retry)
    is_expected = isinstance(failure, SourceError)
    text = (reason if is_expected else f"ulog:flight.ulg: {reason}") + "; trying again" * retry
    errors = [
        (each.getMessage(), not each.exc_info)
        for each in caplog.records
        if each.levelname == "ERROR"
    ]
    assert errors == [(text, is_expected)] * (harness.status.retries if retry else 1)
    assert (harness.status.state, harness.status.ended) == (
        ("retrying", False) if retry else ("failed", True)
    )
    assert (harness.status.error, harness.ends) == (reason, 1)


def test_exception_in_error_handling_fails_the_source() -> None:
    """An exception during error handling sets the state to "failed", with the reason."""

    def panic() -> None:
        raise PanicException("poisoned")

    def break_() -> Iterator[SourceMessage]:
        yield at(0.0)
        harness.registry.publishers[ONE].close = panic
        raise ZeroDivisionError

    harness = Harness(FakeReplay([at(0.0)], run=break_), FakeClock())
    harness.worker.run()
    assert (harness.status.state, harness.status.error) == (
        "failed",
        "unexpected PanicException: poisoned",
    )
    assert harness.ends == 1


def test_closed_session_fails_the_source_unless_stopped() -> None:
    """A closed session fails the source, unless the service is stopping."""
    status = run(FakeReplay([at(0.0)], [ClosedError()])).status
    assert (status.state, status.error) == ("failed", str(ClosedError()))
    clock = FakeClock()

    class Stopping(FakeReplay):
        def open(self) -> ReplayRun:
            clock.wait(1000.0)
            raise ClosedError

    status = run(Stopping([]), clock).status
    assert (status.state, status.error) == ("starting", None)


def test_live_source_is_always_retried() -> None:
    """With --until-done a failed live source, such as a serial port, is still retried; a replay is not."""
    clock = FakeClock(stop_at=100.0)
    harness = run(
        FakeLive(clock, [at(0.0)], [SourceError("mavlink:/dev/ttyACM0", "the link broke")]),
        clock,
        retry=False,
    )
    assert (harness.times, harness.status.state, harness.status.retries) == ([1.0], "done", 1)


def test_source_claims_all_its_addresses_or_none() -> None:
    """If one address of a source is in use, the source claims no other address, not even briefly."""
    harness = Harness(FakeReplay([at(0.0), at(0.0, TWO)]), FakeClock(stop_at=1.0))
    harness.registry.publisher(TWO, lossless=False, source="other")
    harness.worker.run()
    assert harness.registry.log == ["0 +2 other"]
    assert harness.status.state == "retrying"
    assert "this process already publishes 2/vehicle_local_position" in str(harness.status.error)


def test_invalid_message_is_rejected_and_reported(caplog: pytest.LogCaptureFixture) -> None:
    """Invalid messages are counted and reported with reason and fields; only the first five are logged."""
    broken = [at(0.0, z_valid=True), *(at(number, timestamp_sample=10**9) for number in range(7))]
    harness = run(FakeReplay([*broken, at(0.0, z=1.0, z_valid=True)], speed=None))
    assert list(harness.status.rejections.values()) == [1, 7], (
        "rejections are counted by field and rule, not by value"
    )
    assert (harness.status.published, harness.status.rejected) == (1, 8)
    address, report = harness.registry.rejected[0]
    assert (address, len(harness.registry.rejected)) == (ONE, 8)
    assert "z: must be finite while z_valid is true" in str(report["reason"])
    assert report["fields"] == {"timestamp": 0, "z_valid": True}
    assert sum("rejected" in text for text in caplog.messages) == 5


def test_live_stream_is_published_until_stale() -> None:
    """A vehicle is published from its first message, withdrawn after 3 s of silence, and republished on return."""
    clock = FakeClock(stop_at=100.0)
    source = FakeLive(clock, [at(0.0), 1.0, at(0.0, TWO), 3.5, at(0.0), 1.0])
    harness = run(source, clock)
    assert harness.registry.log[:5] == ["0 +1 ulog", "1 +2 ulog", "3 -1", "4 -2", "4.5 +1 ulog"]
    assert source.closed == 1
    assert (harness.status.state, harness.status.published) == ("done", 3)


def test_live_source_is_waiting_unless_a_vehicle_is_fresh() -> None:
    """The state is "waiting" before the first message and while all streams are stale, otherwise "running"."""
    clock = FakeClock(stop_at=100.0)
    states: list[tuple[str, tuple[str, ...]]] = []

    class Watched(FakeLive):
        def listen(self, router: Session | None) -> Iterator[SourceMessage | Rejection | None]:
            for item in super().listen(None):
                yield item
                states.append((harness.status.state, harness.status.stale))

    harness = Harness(Watched(clock, [0.5, at(0.0), 4.0]), clock)
    harness.worker.run()
    assert states[0] == ("waiting", ())
    assert ("running", ()) in states
    assert states[-1] == ("waiting", ("1/vehicle_local_position",))


def test_live_source_counts_losses_and_reboots() -> None:
    """The status counts lost messages and vehicle reboots reported by the source."""
    clock = FakeClock(stop_at=100.0)
    reboot = SourceMessage(0.0, ONE, {"timestamp": 0}, 0, True)
    status = run(
        FakeLive(clock, [SourceMessage(0.0, ONE, {"timestamp": 1}, lost=4), reboot]), clock
    ).status
    assert (status.lost, status.reboots, status.streams[0].health.lost) == (4, 1, 4)


def test_rejection_warnings_are_bounded(caplog: pytest.LogCaptureFixture) -> None:
    """All rejections of a flood are counted; warnings are kept for 50 senders, with 300 characters each."""
    clock = FakeClock(stop_at=100.0)
    script: Script = [Rejection(f"sender {number % 80}", "x" * 1000, ONE) for number in range(200)]
    harness = run(FakeLive(clock, script), clock)
    assert (
        harness.status.rejected,
        len(harness.status.warnings),
        len(harness.registry.rejected),
    ) == (200, 50, 200)
    assert max(map(len, harness.status.warnings)) < 350
    assert sum("rejected" in text for text in caplog.messages) == 50


def test_addresses_of_a_live_source_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    """A peer cannot make a service publish an unlimited number of addresses; known vehicles are not affected."""
    monkeypatch.setattr(limits, "LIVE_ADDRESSES", 10)
    clock = FakeClock(stop_at=100.0)
    script: Script = [at(0.0, Address(str(number), VLP)) for number in range(15)]
    status = run(FakeLive(clock, [*script, *script[:10]]), clock).status
    assert (status.published, status.rejected, len(status.addresses)) == (20, 5, 10)
    ignored = (
        "further addresses: the limit is 10, and 10/vehicle_local_position is the first one ignored"
    )
    assert status.warnings == (ignored,)


def test_status_has_100_streams_at_most() -> None:
    """A status has the health of 100 streams at most, because it must fit into one reply; metrics have all of them."""
    clock = FakeClock(stop_at=100.0)
    harness = run(
        FakeLive(clock, [at(0.0, Address(str(number), VLP)) for number in range(101)]), clock
    )
    assert len(harness.status.streams) == 100
    assert len(harness.worker.measures.status.streams) == 101


def test_stop_interrupts_a_replay_between_messages() -> None:
    """A stopped source publishes nothing more, and is neither done nor failed."""
    harness = run(FakeReplay([at(0.0), at(60.0)]), FakeClock(stop_at=5.0))
    assert (harness.times, harness.status.state, harness.ends) == ([0.0], "running", 1)
