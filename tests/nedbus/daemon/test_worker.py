"""The worker of one source: states, retry pauses and streams, with a clock that advances only by waiting."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, cast

import pytest

from nedbus.client import PublisherRegistry
from nedbus.daemon import Planned
from nedbus.daemon.worker import Clock, Worker
from nedbus.errors import AddressInUseError, ClosedError, SourceError
from nedbus.events import Account
from nedbus.health import SourceStatus
from nedbus.sources import Rejection, ReplayRun, ReplaySource, Source, SourceMessage
from nedbus.sources.options import RecordedOptions
from nedbus.transport import Session
from nedbus_msgs import DEFAULT, Address, Definition, VehicleLocalPosition
from tests.flights.first_message import decode, encode_fields
from tests.flights.messages import VLP

ONE, TWO = Address("1", VLP), Address("2", VLP)
Script = list[SourceMessage | Rejection | float | None]


@dataclass
class StandingClock:
    """A clock that advances only by waiting, and stops the worker after a while."""

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
    """A registry without a session, with one publisher per address; payloads are validated and recorded."""

    clock: StandingClock
    publishers: dict[Address, SimpleNamespace] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)
    published: dict[Address, list[tuple[float, VehicleLocalPosition]]] = field(default_factory=dict)
    rejected: list[tuple[Address, Mapping[str, object]]] = field(default_factory=list)
    readers_at: float = 0.0

    def publisher(
        self, address: Address, definition: Definition[Any] | None = None, *, lossless: bool, source: str
    ) -> SimpleNamespace:
        if address in self.publishers:
            raise AddressInUseError(address)

        def publish(fields: Mapping[str, object]) -> None:
            self.published.setdefault(address, []).append((self.clock.seconds, decode(encode_fields(fields))))

        def close() -> None:
            del self.publishers[address]
            self.log.append(f"{self.clock.seconds:g} -{address.vehicle}")

        self.log.append(f"{self.clock.seconds:g} +{address.vehicle}{' lossless' if lossless else ''} {source}")
        self.publishers[address] = SimpleNamespace(
            publish=publish, close=close, relabel=lambda _: None, definition=definition or DEFAULT
        )
        return self.publishers[address]

    def has_subscriber(self, _: object) -> bool:
        return self.clock.seconds >= self.readers_at

    def reject(self, address: Address, report: Mapping[str, object]) -> None:
        self.rejected.append((address, report))


@dataclass
class FakeReplay:
    """A replay of messages, or of the generator `run`; each `open` first raises one of `failures`."""

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
        return ReplayRun(self.run() if self.run else iter(self.messages), addresses, len(self.messages), "a flight")


@dataclass
class FakeLive:
    """A live source that delivers a script, in which a number advances the clock."""

    clock: StandingClock
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


class Ran:
    """A worker, the messages it published by address, and the number of times it reported its end."""

    def __init__(self, source: object, clock: StandingClock, *, retry: bool = True) -> None:
        self.ends = 0
        self.registry = FakeRegistry(clock)
        self.worker = Worker(
            Planned(
                0, "ulog:flight.ulg", "1", source.source if isinstance(source, FakeReplay) else cast("Source", source)
            ),
            cast("PublisherRegistry", self.registry),
            clock=cast("Clock", clock),
            account=Account(),
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
        """Return the times at which messages of vehicle 1 were published."""
        return [round(seconds, 6) for seconds, _ in self.registry.published.get(ONE, [])]


def run(source: object, clock: StandingClock | None = None, *, retry: bool = True) -> Ran:
    ran = Ran(source, clock or StandingClock(), retry=retry)
    ran.worker.run()
    return ran


def test_replay_publishes_each_message_when_it_is_due() -> None:
    """At speed 2 messages are published in half the time; then the source is done, and reports it once."""
    ran = Ran(FakeReplay([at(0.0), at(1.0), at(3.0)], speed=2.0), StandingClock())
    assert ran.status.state == "starting"
    ran.worker.run()
    assert ran.times == [0.0, 0.5, 1.5]
    status = ran.status
    assert (status.state, status.published, status.done, status.total, status.ended) == ("done", 3, 3, 3, True)
    assert ran.ends == 1


def test_replay_at_full_speed_is_lossless_and_never_waits() -> None:
    """Its publishers wait for readers, but not for the clock."""
    clock = StandingClock()
    ran = run(FakeReplay([at(0.0), at(100.0)], speed=None), clock)
    assert (ran.times, clock.waits) == ([0.0, 0.0], [])
    assert ran.registry.log[0] == "0 +1 lossless ulog"


def test_replay_that_is_late_goes_on_from_there() -> None:
    """After the machine was suspended, messages are not sent faster to catch up."""
    clock = StandingClock()

    def stall() -> Iterator[SourceMessage]:
        yield at(0.0)
        clock.seconds += 10.0
        yield from (at(1.0), at(2.0))

    assert run(FakeReplay([at(0.0)], run=stall), clock).times == [0.0, 10.0, 11.0]


def test_replay_waits_for_a_reader_once() -> None:
    """With wait=1 nothing is published before there is a subscriber; later runs of a loop do not wait again."""
    ran = Ran(FakeReplay([at(0.0), at(0.5)], wait=True, loop=True), StandingClock(stop_at=2.0))
    ran.registry.readers_at = 1.0
    ran.worker.run()
    assert ran.times[:3] == [1.0, 1.5, 1.5]


def test_loop_does_not_spin() -> None:
    """A run takes at least a tenth of a second, however short the log is."""
    ran = run(FakeReplay([at(0.0)], loop=True), StandingClock(stop_at=1.0))
    assert ran.times[:10] == pytest.approx([step / 10 for step in range(10)])


def test_failure_is_retried_with_growing_pauses() -> None:
    """Pauses are 1, 2, 4, 8, 16, 30, 30 s, and start again after a success; the addresses are free meanwhile."""
    clock = StandingClock()
    failures: list[BaseException] = [SourceError("flight.ulg", "no such file")] * 7
    ran = run(FakeReplay([at(0.0)], failures), clock)
    assert clock.waits == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0]
    status = ran.status
    assert (status.state, status.retries, status.error, status.published) == ("done", 7, None, 1)
    assert ran.registry.log == ["91 +1 ulog"]

    def work() -> Iterator[SourceMessage]:
        yield at(0.0)
        yield at(40.0)
        raise SourceError("flight.ulg", "no such file")

    run(FakeReplay([at(0.0)], run=work), clock := StandingClock(stop_at=200.0))
    assert clock.waits == [40.0, 1.0] * 4 + [40.0]


class PanicException(BaseException):
    """The exception that pyo3 raises when Rust panics, as Zenoh does if the clock is before 1970."""


@pytest.mark.parametrize("retry", [True, False])
@pytest.mark.parametrize(
    ("failure", "reason"),
    [
        (SourceError("flight.ulg", "no such file"), "flight.ulg: no such file"),
        (ZeroDivisionError("1/0"), "unexpected ZeroDivisionError: 1/0"),
        (PanicException("clock before 1970"), "unexpected PanicException: clock before 1970"),
    ],
)
def test_any_failure_is_retried_or_final(failure: BaseException, reason: str, retry: bool) -> None:
    """No exception, not even a BaseException, leaves a source in state "running" after its thread has ended."""
    ran = run(FakeReplay([at(0.0)], [failure] * 9), StandingClock(stop_at=100.0), retry=retry)
    assert (ran.status.state, ran.status.ended) == (("retrying", False) if retry else ("failed", True))
    assert (ran.status.error, ran.ends) == (reason, 1)


def test_error_while_a_failure_is_handled_ends_the_source() -> None:
    """After an error in the error handling the source is failed, with the reason."""

    def panic() -> None:
        raise PanicException("poisoned")

    def break_() -> Iterator[SourceMessage]:
        yield at(0.0)
        ran.registry.publishers[ONE].close = panic
        raise ZeroDivisionError

    ran = Ran(FakeReplay([at(0.0)], run=break_), StandingClock())
    ran.worker.run()
    assert (ran.status.state, ran.status.error) == ("failed", "unexpected PanicException: poisoned")
    assert ran.ends == 1


def test_closed_session_is_a_failure_unless_the_service_is_stopped() -> None:
    """A closed session cannot be used again: the source fails with the reason."""
    status = run(FakeReplay([at(0.0)], [ClosedError()])).status
    assert (status.state, status.error) == ("failed", str(ClosedError()))
    clock = StandingClock()

    class Stopping(FakeReplay):
        def open(self) -> ReplayRun:
            clock.wait(1000.0)
            raise ClosedError

    status = run(Stopping([]), clock).status
    assert (status.state, status.error) == ("starting", None)


def test_live_source_is_retried_without_retry() -> None:
    """With --until-done a live source still recovers from failures, such as of a serial port; only replays do not."""
    clock = StandingClock(stop_at=100.0)
    ran = run(FakeLive(clock, [at(0.0)], [SourceError("mavlink:/dev/ttyACM0", "the link broke")]), clock, retry=False)
    assert (ran.times, ran.status.state, ran.status.retries) == ([1.0], "done", 1)


def test_taken_address_leaves_the_others_free() -> None:
    """If one address of a source is taken, it takes none of the others, not even briefly."""
    ran = Ran(FakeReplay([at(0.0), at(0.0, TWO)]), StandingClock(stop_at=1.0))
    ran.registry.publisher(TWO, lossless=False, source="other")
    ran.worker.run()
    assert ran.registry.log == ["0 +2 other"]
    assert ran.status.state == "retrying"
    assert "this process already publishes 2/vehicle_local_position" in str(ran.status.error)


def test_invalid_message_is_rejected_and_reported(caplog: pytest.LogCaptureFixture) -> None:
    """An invalid message is counted and reported with reason and fields, the first five are logged; others go on."""
    broken = [at(0.0, z_valid=True), *(at(number, timestamp_sample=10**9) for number in range(7))]
    ran = run(FakeReplay([*broken, at(0.0, z=1.0, z_valid=True)], speed=None))
    assert list(ran.status.rejections.values()) == [1, 7], "by field and rule, and not by value"
    assert (ran.status.published, ran.status.rejected) == (1, 8)
    address, report = ran.registry.rejected[0]
    assert (address, len(ran.registry.rejected)) == (ONE, 8)
    assert "z: must be finite while z_valid is true" in str(report["reason"])
    assert report["fields"] == {"timestamp": 0, "z_valid": True}
    assert sum("rejected" in text for text in caplog.messages) == 5


def test_live_source_publishes_what_arrives_until_it_is_stale() -> None:
    """A vehicle is published from its first message, withdrawn after 3 s without one, and published when it returns."""
    clock = StandingClock(stop_at=100.0)
    source = FakeLive(clock, [at(0.0), 1.0, at(0.0, TWO), 3.5, at(0.0), 1.0])
    ran = run(source, clock)
    assert ran.registry.log[:5] == ["0 +1 ulog", "1 +2 ulog", "3 -1", "4 -2", "4.5 +1 ulog"]
    assert source.closed == 1
    assert (ran.status.state, ran.status.published) == ("done", 3)


def test_live_states_follow_the_vehicles() -> None:
    """The state is waiting before the first message and if all are stale, else running; stale addresses are listed."""
    clock = StandingClock(stop_at=100.0)
    states: list[tuple[str, tuple[str, ...]]] = []

    class Watched(FakeLive):
        def listen(self, router: Session | None) -> Iterator[SourceMessage | Rejection | None]:
            for item in super().listen(None):
                yield item
                states.append((ran.status.state, ran.status.stale))

    ran = Ran(Watched(clock, [0.5, at(0.0), 4.0]), clock)
    ran.worker.run()
    assert states[0] == ("waiting", ())
    assert ("running", ()) in states
    assert states[-1] == ("waiting", ("1/vehicle_local_position",))


def test_live_losses_and_reboots_are_summed() -> None:
    """Messages that a source reports as lost are counted, and so are reboots of vehicles."""
    clock = StandingClock(stop_at=100.0)
    reboot = SourceMessage(0.0, ONE, {"timestamp": 0}, 0, True)
    status = run(FakeLive(clock, [SourceMessage(0.0, ONE, {"timestamp": 1}, lost=4), reboot]), clock).status
    assert (status.lost, status.reboots, status.streams[0].health.lost) == (4, 1, 4)


def test_rejections_are_bounded_and_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    """All rejections of a flood are counted; 50 senders are remembered, with 300 characters each."""
    clock = StandingClock(stop_at=100.0)
    script: Script = [Rejection(f"sender {number % 80}", "x" * 1000, ONE) for number in range(200)]
    ran = run(FakeLive(clock, script), clock)
    assert (ran.status.rejected, len(ran.status.warnings), len(ran.registry.rejected)) == (200, 50, 200)
    assert max(map(len, ran.status.warnings)) < 350
    assert sum("rejected" in text for text in caplog.messages) == 50


def test_addresses_of_a_live_source_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """One peer cannot make a service publish any number of addresses; known vehicles are not affected."""
    monkeypatch.setattr("nedbus.daemon.output._MAX_ADDRESSES", 10)
    clock = StandingClock(stop_at=100.0)
    script: Script = [at(0.0, Address(str(number), VLP)) for number in range(15)]
    status = run(FakeLive(clock, [*script, *script[:10]]), clock).status
    assert (status.published, status.rejected, len(status.addresses)) == (20, 5, 10)
    assert status.warnings == ("vehicles: more than 10 addresses: 10/vehicle_local_position is ignored",)


def test_stop_ends_a_replay_in_its_pause() -> None:
    """A stopped service publishes nothing more, and the source is neither done nor failed."""
    ran = run(FakeReplay([at(0.0), at(60.0)]), StandingClock(stop_at=5.0))
    assert (ran.times, ran.status.state, ran.ends) == ([0.0], "running", 1)
