"""The worker of one source: its states, its pauses, its streams; with a clock that only waiting moves."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import cast

import pytest

from nedbus.client import PublisherRegistry
from nedbus.daemon.worker import Worker
from nedbus.errors import AddressInUseError, ClosedError, SourceError
from nedbus.sources import Rejection, ReplayRun, Source, SourceMessage
from nedbus.transport import Session
from nedbus_msgs import Address, VehicleLocalPosition, decode, encode_fields

ONE, TWO = Address("1", "vehicle_local_position"), Address("2", "vehicle_local_position")
Script = list[SourceMessage | Rejection | float | None]


class StandingClock:
    """A clock that goes on only by waiting, and stops after a while."""

    def __init__(self, *, stop_at: float = 1000.0) -> None:
        self.seconds = 0.0
        self.waits: list[float] = []
        self._stop_at = stop_at

    @property
    def stopped(self) -> bool:
        return self.seconds >= self._stop_at

    def now(self) -> float:
        return self.seconds

    def time_ns(self) -> int:
        return round(self.seconds * 1e9)

    def wait(self, seconds: float) -> bool:
        self.waits.append(round(seconds, 6))
        self.seconds += seconds
        return self.stopped


@dataclass
class FakePublisher:
    """Validates fields as the real one does, and keeps what is published, and when."""

    clock: StandingClock
    close: Callable[[], object]
    published: list[tuple[float, VehicleLocalPosition]] = field(default_factory=list)

    def publish(self, fields: Mapping[str, object]) -> None:
        self.published.append((self.clock.seconds, decode(encode_fields(fields))))


class FakeRegistry:
    """One publisher for each address, as the real one has, without a session."""

    def __init__(self, clock: StandingClock) -> None:
        self.clock = clock
        self.open: dict[Address, FakePublisher] = {}
        self.log: list[str] = []
        self.published: dict[Address, list[tuple[float, VehicleLocalPosition]]] = {}
        self.rejected: list[tuple[Address, Mapping[str, object]]] = []
        self.readers_at = 0.0

    def publisher(self, address: Address, *, lossless: bool, source: str) -> FakePublisher:
        if address in self.open:
            raise AddressInUseError(address)

        def close() -> None:
            del self.open[address]
            self.log.append(f"{self.clock.seconds:g} -{address.vehicle}")

        self.log.append(f"{self.clock.seconds:g} +{address.vehicle}{' lossless' if lossless else ''} {source}")
        kept = self.published.setdefault(address, [])
        self.open[address] = FakePublisher(self.clock, close, kept)
        return self.open[address]

    def is_alive(self, address: Address) -> bool:
        return address in self.open

    def is_published(self, address: Address) -> bool:
        return address in self.open

    def is_read(self, _: object) -> bool:
        return self.clock.seconds >= self.readers_at

    def reject(self, address: Address, report: Mapping[str, object]) -> None:
        self.rejected.append((address, report))


@dataclass
class FakeReplay:
    """A replay of these messages; each of `failures` is raised by one `open` before it works."""

    messages: list[SourceMessage]
    failures: list[BaseException] = field(default_factory=list)
    speed: float | None = 1.0
    loop: bool = False
    wait: bool = False
    finite: bool = True
    opened: int = 0

    def open(self) -> ReplayRun:
        self.opened += 1
        if self.failures:
            raise self.failures.pop(0)
        addresses = tuple(dict.fromkeys(each.address for each in self.messages))
        return ReplayRun(iter(self.messages), addresses, len(self.messages), "a flight")


@dataclass
class FakeLive:
    """A live source that delivers a script: a number lets time pass."""

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


def make(source: object, clock: StandingClock, *, retry: bool = True) -> tuple[Worker, FakeRegistry, list[str]]:
    registry, ends = FakeRegistry(clock), []
    worker = Worker(
        "ulog:flight.ulg",
        cast("Source", source),
        cast("PublisherRegistry", registry),
        clock=clock,
        retry=retry,
        on_end=lambda: ends.append("end"),
    )
    return worker, registry, ends


def times(registry: FakeRegistry, address: Address = ONE) -> list[float]:
    return [round(seconds, 6) for seconds, _ in registry.published.get(address, [])]


def test_replay_publishes_each_message_when_it_is_due() -> None:
    """At speed 2 after half the time; then the source is done, and says so once."""
    clock = StandingClock()
    worker, registry, ends = make(FakeReplay([at(0.0), at(1.0), at(3.0)], speed=2.0), clock)
    assert worker.status.state == "starting"
    worker.run()
    assert times(registry) == [0.0, 0.5, 1.5]
    status = worker.status
    assert (status.state, status.published, status.done, status.total, status.ended) == ("done", 3, 3, 3, True)
    assert ends == ["end"]


def test_replay_at_full_speed_is_lossless_and_never_waits() -> None:
    """Its publishers wait for readers; it does not wait for the clock."""
    clock = StandingClock()
    worker, registry, _ = make(FakeReplay([at(0.0), at(100.0)], speed=None), clock)
    worker.run()
    assert (times(registry), clock.waits) == ([0.0, 0.0], [])
    assert registry.log[0] == "0 +1 lossless ulog"


def test_replay_that_is_late_goes_on_from_there() -> None:
    """After a pause of the machine messages are not rushed: the time that is lost is lost."""
    clock = StandingClock()

    def stall() -> Iterator[SourceMessage]:
        yield at(0.0)
        clock.seconds += 10.0
        yield from (at(1.0), at(2.0))

    source = FakeReplay([])
    source.open = lambda: ReplayRun(stall(), (ONE,), 3, "a flight")  # type: ignore[method-assign] # a clock that jumps
    worker, registry, _ = make(source, clock)
    worker.run()
    assert times(registry) == [0.0, 10.0, 11.0]


def test_replay_waits_for_a_reader_once() -> None:
    """wait=1: nothing is published before somebody subscribes; a second run of a loop does not wait again."""
    clock = StandingClock(stop_at=2.0)
    worker, registry, _ = make(FakeReplay([at(0.0), at(0.5)], wait=True, loop=True), clock)
    registry.readers_at = 1.0
    worker.run()
    assert times(registry)[:3] == [1.0, 1.5, 1.5]


def test_loop_does_not_spin() -> None:
    """A run takes a tenth of a second at least, however short the log is."""
    clock = StandingClock(stop_at=1.0)
    worker, registry, _ = make(FakeReplay([at(0.0)], loop=True), clock)
    worker.run()
    assert times(registry)[:10] == pytest.approx([step / 10 for step in range(10)])


def test_failure_is_retried_with_growing_pauses() -> None:
    """1, 2, 4, 8, 16, 30, 30 s; the status has the reason until it works, and the addresses are free meanwhile."""
    clock = StandingClock()
    failures: list[BaseException] = [SourceError("flight.ulg", "no such file")] * 7
    worker, registry, _ = make(FakeReplay([at(0.0)], failures), clock)
    worker.run()
    assert clock.waits == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0]
    status = worker.status
    assert (status.state, status.retries, status.error, status.published) == ("done", 7, None, 1)
    assert registry.log == ["91 +1 ulog"]


def test_failure_without_retry_is_final() -> None:
    """--until-done: a source that fails has failed, with its reason."""
    worker, _, ends = make(FakeReplay([], [SourceError("flight.ulg", "no such file")]), StandingClock(), retry=False)
    worker.run()
    status = worker.status
    assert (status.state, status.error, status.ended) == ("failed", "flight.ulg: no such file", True)
    assert ends == ["end"]


def test_unexpected_error_stops_this_source_only() -> None:
    """A bug in a source is a failure with its name, not the end of its thread."""
    worker, _, _ = make(FakeReplay([at(0.0)], [ZeroDivisionError("1/0")]), StandingClock())
    worker.run()
    assert (worker.status.state, worker.status.retries) == ("done", 1)


class PanicException(BaseException):
    """What pyo3 raises when Rust panics, as Zenoh does under a clock before 1970."""


@pytest.mark.parametrize("retry", [True, False])
def test_panic_is_a_failure_of_the_source(retry: bool) -> None:
    """What is no Exception is told as any other error: it never leaves a source "running" whose thread ended."""
    clock = StandingClock(stop_at=100.0)
    worker, _, ends = make(FakeReplay([at(0.0)], [PanicException("clock before 1970")] * 9), clock, retry=retry)
    worker.run()
    status = worker.status
    assert (status.state, status.ended) == (("retrying", False) if retry else ("failed", True))
    assert status.error == "an unexpected PanicException: clock before 1970"
    assert ends == ["end"]


def test_error_while_a_failure_is_handled_ends_the_source() -> None:
    """Even an error that nobody handles leaves the source failed, with the reason."""

    def panic() -> None:
        raise PanicException("poisoned")

    class Breaking(FakeReplay):
        def open(self) -> ReplayRun:
            return ReplayRun(self.break_(), (ONE,), 2, "a flight")

        def break_(self) -> Iterator[SourceMessage]:
            yield at(0.0)
            registry.open[ONE].close = panic
            raise ZeroDivisionError

    worker, registry, ends = make(Breaking([]), StandingClock())
    worker.run()
    status = worker.status
    assert (status.state, status.error) == ("failed", "an unexpected PanicException: poisoned")
    assert ends == ["end"]


def test_closed_session_is_a_failure_unless_the_service_is_stopped() -> None:
    """A session that was closed meanwhile cannot be used again: the source has failed, and says why."""
    worker, _, _ = make(FakeReplay([at(0.0)], [ClosedError()]), StandingClock())
    worker.run()
    assert (worker.status.state, worker.status.error) == ("failed", str(ClosedError()))
    clock = StandingClock()

    class Stopping(FakeReplay):
        def open(self) -> ReplayRun:
            clock.wait(1000.0)
            raise ClosedError

    worker, _, _ = make(Stopping([]), clock)
    worker.run()
    assert (worker.status.state, worker.status.error) == ("starting", None)


def test_live_source_is_retried_without_retry() -> None:
    """--until-done: a serial port that fails once does not end a live source; only replays have no second try."""
    clock = StandingClock(stop_at=100.0)
    source = FakeLive(clock, [at(0.0)], [SourceError("mavlink:/dev/ttyACM0", "the link broke")])
    worker, registry, _ = make(source, clock, retry=False)
    worker.run()
    assert (times(registry), worker.status.state, worker.status.retries) == ([1.0], "done", 1)


def test_taken_address_leaves_the_others_free() -> None:
    """A source whose second address is taken takes none, not even for a moment: others may need the first."""
    clock = StandingClock(stop_at=1.0)
    worker, registry, _ = make(FakeReplay([at(0.0), at(0.0, TWO)]), clock)
    registry.publisher(TWO, lossless=False, source="other")
    worker.run()
    assert registry.log == ["0 +2 other"]
    assert worker.status.state == "retrying"
    assert "2/vehicle_local_position is published by this process already" in str(worker.status.error)


def test_invalid_message_is_rejected_and_reported(caplog: pytest.LogCaptureFixture) -> None:
    """It is counted, reported with its reason and its fields, and the first five are logged; the others go on."""
    broken = [at(0.0, z_valid=True) for _ in range(8)]
    worker, registry, _ = make(FakeReplay([*broken, at(0.0, z=1.0, z_valid=True)], speed=None), StandingClock())
    worker.run()
    assert (worker.status.published, worker.status.rejected) == (1, 8)
    address, report = registry.rejected[0]
    assert (address, len(registry.rejected)) == (ONE, 8)
    assert "z: must be finite while z_valid is true" in str(report["reason"])
    assert report["fields"] == {"timestamp": 0, "z_valid": True}
    assert sum("rejected" in text for text in caplog.messages) == 5


def test_live_source_publishes_what_arrives_until_it_is_stale() -> None:
    """A vehicle is published from its first message on, withdrawn after 3 s without one, and comes back."""
    clock = StandingClock(stop_at=100.0)
    source = FakeLive(clock, [at(0.0), 1.0, at(0.0, TWO), 3.5, at(0.0), 1.0])
    worker, registry, _ = make(source, clock)
    worker.run()
    assert registry.log[:4] == ["0 +1 ulog", "1 +2 ulog", "3 -1", "4 -2"]
    assert registry.log[4] == "4.5 +1 ulog"
    assert source.closed == 1
    status = worker.status
    assert (status.state, status.published) == ("done", 3)


def test_live_states_follow_the_vehicles() -> None:
    """Waiting before the first message and when all are stale, running in between; stale addresses are listed."""
    clock = StandingClock(stop_at=100.0)
    states: list[tuple[str, tuple[str, ...]]] = []

    class Watched(FakeLive):
        def listen(self, router: Session | None) -> Iterator[SourceMessage | Rejection | None]:
            for item in super().listen(None):
                yield item
                states.append((worker.status.state, worker.status.stale))

    worker, _, _ = make(Watched(clock, [0.5, at(0.0), 4.0]), clock)
    worker.run()
    assert states[0] == ("waiting", ())
    assert ("running", ()) in states
    assert states[-1] == ("waiting", ("1/vehicle_local_position",))


def test_live_losses_and_reboots_are_summed() -> None:
    """What a source says was lost before it is counted, and so is each restart of a vehicle."""
    clock = StandingClock(stop_at=100.0)
    script: Script = [
        SourceMessage(0.0, ONE, {"timestamp": 1}, lost=4),
        SourceMessage(0.0, ONE, {"timestamp": 0}, 0, True),
    ]
    worker, _, _ = make(FakeLive(clock, script), clock)
    worker.run()
    status = worker.status
    assert (status.lost, status.reboots, status.streams[0].health.lost) == (4, 1, 4)


def test_rejections_are_bounded_and_told_once(caplog: pytest.LogCaptureFixture) -> None:
    """A flood from many senders is counted whole; 50 of them are remembered, each with 300 characters."""
    clock = StandingClock(stop_at=100.0)
    script: Script = [Rejection(f"sender {number % 80}", "x" * 1000, ONE) for number in range(200)]
    worker, registry, _ = make(FakeLive(clock, script), clock)
    worker.run()
    status = worker.status
    assert (status.rejected, len(status.warnings), len(registry.rejected)) == (200, 50, 200)
    assert max(map(len, status.warnings)) < 350
    assert sum("rejected" in text for text in caplog.messages) == 50


def test_addresses_of_a_live_source_are_bounded() -> None:
    """One peer cannot make a service publish without end; the vehicles that are known go on."""
    clock = StandingClock(stop_at=100.0)
    script: Script = [at(0.0, Address(str(number), "vehicle_local_position")) for number in range(1005)]
    worker, _, _ = make(FakeLive(clock, [*script, *script[:10]]), clock)
    worker.run()
    status = worker.status
    assert (status.published, status.rejected, len(status.addresses)) == (1010, 5, 1000)
    assert status.warnings == ("vehicles: more than 1000 addresses: 1000/vehicle_local_position is left out",)


def test_stop_ends_a_replay_in_its_pause() -> None:
    """A stopped service publishes nothing more, and the source is neither done nor failed."""
    clock = StandingClock(stop_at=5.0)
    worker, registry, ends = make(FakeReplay([at(0.0), at(60.0)]), clock)
    worker.run()
    assert (times(registry), worker.status.state, ends) == ([0.0], "running", ["end"])
