"""Fixtures: a real router for each test, both clients behind one interface, processes with a deadline."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import cycle, islice
from pathlib import Path
from typing import Protocol, Self, cast

import hypothesis
import pytest
import zenoh

import nedbus
from nedbus import Mode
from nedbus.transport import Session, open_router
from nedbus_msgs import DEFAULT_TOPIC, Address, VehicleLocalPosition

# A machine that is busy fails no property.
hypothesis.settings.register_profile("nedbus", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow])
hypothesis.settings.load_profile("nedbus")

DEADLINE = 30.0  # s that a test waits for a condition before it fails
_SAID = 10_000  # characters of a process's output that a failure shows
LOGS = Path(__file__).parents[2] / "shared" / "data" / "ulog"


def pytest_configure() -> None:
    """Make Ctrl-C work: a shell's background job ignores it, and so would every process that the tests start."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that start processes, so that `make quick` can leave them out."""
    for item in items:
        if "start" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.process)


_may_start = True


def _watch_processes(event: str, _: object) -> None:
    if event == "subprocess.Popen" and not _may_start:
        raise AssertionError("this test starts a process: mark it with pytest.mark.process")


sys.addaudithook(_watch_processes)


@pytest.fixture(autouse=True)
def _no_unmarked_process(request: pytest.FixtureRequest) -> Iterator[None]:
    """Hold that the marks are true."""
    global _may_start  # noqa: PLW0603 - an audit hook can neither be removed nor be given anything
    _may_start = any(request.node.get_closest_marker(name) for name in ("process", "compose"))
    yield
    _may_start = True


def wait_for(condition: Callable[[], object], *, what: str, seconds: float = DEADLINE) -> None:
    """Wait until a condition holds, and fail with words when it never does."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"waited {seconds} s in vain for {what}"
        time.sleep(0.01)


def wait_for_reader(raw: Session, key: str) -> None:
    """Wait until a session knows of a subscriber of this key: what it publishes before goes nowhere."""
    probe = raw.declare_publisher(key)
    wait_for(lambda: cast("zenoh.MatchingStatus", probe.matching_status).matching, what=f"a subscriber of {key}")
    probe.undeclare()


@contextmanager
def repeating(action: Callable[[], object]) -> Iterator[None]:
    """Do something fifty times a second, as a vehicle does."""
    stop = threading.Event()

    def run() -> None:
        while not stop.wait(0.02):
            action()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(DEADLINE)


# From 32768 on Linux gives ports to connections that go out: one that is free now may be taken before it is used.
# Each process of pytest begins elsewhere.
_ports = islice(cycle(range(10_000, 32_000)), os.getpid() * 2503 % 22_000, None)


def free_port() -> int:
    """Return a port of loopback that nobody uses now, neither with TCP nor with UDP."""
    for port in _ports:
        with suppress(OSError), socket.socket() as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
            tcp.bind(("127.0.0.1", port))
            udp.bind(("127.0.0.1", port))
            return port
    raise AssertionError("never: ports begin again")


def free_endpoint() -> str:
    """Return a Zenoh endpoint on a free port of loopback."""
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def endpoint() -> Iterator[str]:
    """Run a router of its own for this test."""
    where = free_endpoint()
    session = open_router(listen=(where,))
    yield where
    session.close()


@pytest.fixture(autouse=True)
def _no_settings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Keep the settings of whoever runs the tests out of them."""
    for name in [name for name in os.environ if name.startswith("NEDBUS_")]:
        monkeypatch.delenv(name)
    monkeypatch.chdir(tmp_path)


class SubscriptionFace(Protocol):
    """What a subscription of either client can do, as a test sees it."""

    @property
    def counts(self) -> nedbus.Counts: ...
    def receive(self, timeout: float | None = None) -> nedbus.Sample: ...
    def take(self, count: int) -> list[nedbus.Sample]: ...
    def close(self) -> None: ...


class PublisherFace(Protocol):
    """What a publisher of either client can do, as a test sees it."""

    @property
    def published(self) -> int: ...
    def publish(self, message: VehicleLocalPosition | Mapping[str, object]) -> None: ...
    def flush(self, timeout: float = 600.0) -> bool: ...
    def close(self) -> None: ...
    def __enter__(self) -> Self: ...
    def __exit__(self, *exc: object) -> None: ...


class Client(Protocol):
    """What a bus of either client can do, as a test sees it."""

    @property
    def connected(self) -> bool: ...
    def subscribe(
        self,
        topic: str = DEFAULT_TOPIC,
        *,
        vehicle: str | int = "*",
        instance: int | None = None,
        mode: Mode = "latest",
    ) -> SubscriptionFace: ...
    def latest(
        self, topic: str = DEFAULT_TOPIC, *, vehicle: str | int = "*", instance: int | None = None
    ) -> list[nedbus.Sample]: ...
    def vehicles(self) -> dict[str, list[Address]]: ...
    def publisher(self, topic: str, *, vehicle: str | int, instance: int | None = None) -> PublisherFace: ...
    def services(self) -> list[dict[str, object]]: ...
    def close(self) -> None: ...


class SyncSubscription:
    """A Subscription that can take several at once."""

    def __init__(self, subscription: nedbus.Subscription) -> None:
        self._subscription = subscription
        self.receive = subscription.receive
        self.close = subscription.close

    @property
    def counts(self) -> nedbus.Counts:
        return self._subscription.counts

    def take(self, count: int) -> list[nedbus.Sample]:
        """Iterate, as a script does, over this many."""
        taken: list[nedbus.Sample] = []
        for sample in self._subscription:
            taken.append(sample)
            if len(taken) == count:
                break
        return taken


class SyncClient:
    """The Bus, as a test sees it."""

    def __init__(self, bus: nedbus.Bus) -> None:
        self._bus = bus
        self.latest = bus.latest
        self.vehicles = bus.vehicles
        self.publisher = bus.publisher
        self.services = bus.services
        self.close = bus.close

    @property
    def connected(self) -> bool:
        return self._bus.connected

    def subscribe(
        self,
        topic: str = DEFAULT_TOPIC,
        *,
        vehicle: str | int = "*",
        instance: int | None = None,
        mode: Mode = "latest",
    ) -> SubscriptionFace:
        return SyncSubscription(self._bus.subscribe(topic, vehicle=vehicle, instance=instance, mode=mode))


class BlockingSubscription:
    """An AsyncSubscription, driven from a test."""

    def __init__(self, runner: asyncio.Runner, subscription: nedbus.AsyncSubscription) -> None:
        self._run = runner.run
        self._subscription = subscription
        self._run(subscription.__aenter__())

    @property
    def counts(self) -> nedbus.Counts:
        return self._subscription.counts

    def receive(self, timeout: float | None = None) -> nedbus.Sample:
        return self._run(self._subscription.receive(timeout))

    def take(self, count: int) -> list[nedbus.Sample]:
        async def iterate() -> list[nedbus.Sample]:
            taken: list[nedbus.Sample] = []
            async for sample in self._subscription:
                taken.append(sample)
                if len(taken) == count:
                    break
            return taken

        return self._run(iterate())

    def close(self) -> None:
        self._run(self._subscription.close())


class BlockingPublisher:
    """An AsyncPublisher, driven from a test."""

    def __init__(self, runner: asyncio.Runner, publisher: nedbus.AsyncPublisher) -> None:
        self._run = runner.run
        self._publisher = publisher

    @property
    def published(self) -> int:
        return self._publisher.published

    def publish(self, message: VehicleLocalPosition | Mapping[str, object]) -> None:
        self._run(self._publisher.publish(message))

    def flush(self, timeout: float = 600.0) -> bool:
        return self._run(self._publisher.flush(timeout))

    def close(self) -> None:
        self._run(self._publisher.close())

    def __enter__(self) -> Self:
        self._run(self._publisher.__aenter__())
        return self

    def __exit__(self, *exc: object) -> None:
        self._run(self._publisher.__aexit__(*exc))


class BlockingClient:
    """The AsyncBus, driven from a test."""

    def __init__(self, endpoint: str) -> None:
        self._runner = asyncio.Runner()
        self._bus = nedbus.connect_async(endpoint)
        self._run = self._runner.run
        self._run(self._bus.__aenter__())

    @property
    def connected(self) -> bool:
        return self._bus.connected

    def subscribe(
        self,
        topic: str = DEFAULT_TOPIC,
        *,
        vehicle: str | int = "*",
        instance: int | None = None,
        mode: Mode = "latest",
    ) -> SubscriptionFace:
        async def subscribe() -> nedbus.AsyncSubscription:
            return self._bus.subscribe(topic, vehicle=vehicle, instance=instance, mode=mode)

        return BlockingSubscription(self._runner, self._run(subscribe()))

    def latest(
        self, topic: str = DEFAULT_TOPIC, *, vehicle: str | int = "*", instance: int | None = None
    ) -> list[nedbus.Sample]:
        return self._run(self._bus.latest(topic, vehicle=vehicle, instance=instance))

    def vehicles(self) -> dict[str, list[Address]]:
        return self._run(self._bus.vehicles())

    def publisher(self, topic: str, *, vehicle: str | int, instance: int | None = None) -> PublisherFace:
        publisher = self._run(self._bus.publisher(topic, vehicle=vehicle, instance=instance))
        return BlockingPublisher(self._runner, publisher)

    def services(self) -> list[dict[str, object]]:
        return self._run(self._bus.services())

    def close(self) -> None:
        self._run(self._bus.close())

    def end(self) -> None:
        self.close()
        self._runner.close()


@pytest.fixture(params=["sync", "async"])
def client(request: pytest.FixtureRequest, endpoint: str) -> Iterator[Client]:
    """Connect with either client."""
    if request.param == "sync":
        with nedbus.connect(endpoint) as bus:
            yield SyncClient(bus)
    else:
        driven = BlockingClient(endpoint)
        yield driven
        driven.end()


@pytest.fixture
def bus(endpoint: str) -> Iterator[nedbus.Bus]:
    """Connect another bus, as another script would."""
    with nedbus.connect(endpoint) as other:
        yield other


@pytest.fixture
def raw(endpoint: str) -> Iterator[Session]:
    """Connect a plain Zenoh session, as a client in another language would."""
    with nedbus.connect(endpoint) as other:
        yield other._session


def message(timestamp: int = 1, **fields: object) -> VehicleLocalPosition:
    """Return a message with these fields."""
    return VehicleLocalPosition.model_validate({"timestamp": timestamp, **fields})


class Process:
    """A process that a test starts: its output in files, gone at the end of the test at the latest."""

    def __init__(self, arguments: list[str], where: Path, environment: dict[str, str]) -> None:
        self._measured = any(name.startswith("COVERAGE_") for name in environment)
        self._out = where / "stdout"
        self._err = where / "stderr"
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self.popen = subprocess.Popen(
                arguments, stdout=out, stderr=err, stdin=subprocess.DEVNULL, cwd=where, env=environment
            )

    @property
    def out(self) -> str:
        return self._out.read_text()

    @property
    def err(self) -> str:
        return self._err.read_text()

    def wait(self, seconds: float = DEADLINE) -> int:
        """Wait for its end and return its exit code; fail with what it said, and where it was, when it does not end."""
        try:
            return self.popen.wait(seconds)
        except subprocess.TimeoutExpired:
            self.popen.send_signal(signal.SIGABRT)  # Python writes the stacks of all threads
            with suppress(subprocess.TimeoutExpired):
                self.popen.wait(DEADLINE)
            said = f"{self.out[-_SAID:]}{self.err[-_SAID:]}"
            pytest.fail(f"{self.popen.args!r} did not end within {seconds} s; it said:\n{said}")

    def signal(self, number: signal.Signals) -> None:
        if self._measured and number == signal.SIGINT:
            pytest.fail("start what SIGINT is to end with measured=False")
        self.popen.send_signal(number)

    def kill(self) -> None:
        self.popen.kill()
        self.popen.wait(DEADLINE)


def unmeasured() -> dict[str, str]:
    """Return an environment without coverage, for what SIGINT ends: KeyboardInterrupt can be raised in its lock."""
    return {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE_")}


Start = Callable[..., Process]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start Python processes; each is killed at the end of the test if it is still there."""
    processes: list[Process] = []

    def start_process(*arguments: str, measured: bool = True, **environment: str) -> Process:
        where = tmp_path / f"process-{len(processes)}"
        where.mkdir()
        inherited = dict(os.environ) if measured else unmeasured()
        inherited = {name: value for name, value in inherited.items() if not name.startswith("NEDBUS_")}
        environment = inherited | {"PYTHONFAULTHANDLER": "1"} | environment
        process = Process([sys.executable, *arguments], where, environment)
        processes.append(process)
        return process

    yield start_process
    for process in processes:
        process.kill()


@pytest.fixture
def run_nedbus(start: Start) -> Start:
    """Start `nedbus` with these arguments."""

    def run(*arguments: str, **environment: str) -> Process:
        return start("-m", "nedbus", *arguments, **environment)

    return run
