"""Fixtures: a real router for each test, the sync and the async client through one fixture, and processes."""

from __future__ import annotations

import asyncio
import os
import resource
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

import nedbus
from nedbus.timings import Timings
from nedbus.transport import Session, open_router
from tests.peers.ports import free_endpoint
from tests.peers.processes import ForkServer, Process, Start, without_coverage
from tests.waits import changing_timings

from .sync_adapter import sync_adapter

# 25 examples per property, or 100 with `--hypothesis-profile=all`; no time limits, which fail on a busy machine.
hypothesis.settings.register_profile(
    "nedbus",
    max_examples=25,
    deadline=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.register_profile(
    "all", hypothesis.settings.get_profile("nedbus"), max_examples=75
)
hypothesis.settings.load_profile("nedbus")


def pytest_configure() -> None:
    """Restore SIGINT and SIGHUP: test processes would inherit them as ignored from a background job or nohup."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that start processes or open a router, which `make quick` deselects."""
    for item in items:
        for fixture, mark in (("start", "process"), ("endpoint", "router")):
            if fixture in getattr(item, "fixturenames", ()):
                item.add_marker(mark)
        is_slow = item.get_closest_marker("slow") or item.get_closest_marker("long")
        if is_slow and not item.get_closest_marker("timeout"):
            # three times their duration on four busy cores, with coverage
            item.add_marker(pytest.mark.timeout(600))
        # most tests of a module that imports it call it
        if "open_router" in vars(getattr(item, "module", item)):
            item.add_marker("router")


_may_start = True


def _watch_tests(event: str, arguments: tuple[object, ...]) -> None:
    # a router raises that one
    if event == "resource.setrlimit" and arguments[0] != resource.RLIMIT_NOFILE:
        raise AssertionError(
            "this would limit pytest, too, and truncate its bytecode: limit a child process instead"
        )
    # Matplotlib runs fc-list once
    if event == "subprocess.Popen" and not _may_start and "fc-list" not in arguments:
        raise AssertionError("this test starts a process: mark it with pytest.mark.process")


sys.addaudithook(_watch_tests)


@pytest.fixture(autouse=True)
def _no_unmarked_process(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail a test that starts a process without being marked."""
    global _may_start  # noqa: PLW0603 - an audit hook can neither be removed nor take arguments
    _may_start = any(request.node.get_closest_marker(name) for name in ("process", "compose"))
    yield
    _may_start = True


@pytest.fixture
def endpoint() -> Iterator[str]:
    """Run a router for this test and return its endpoint."""
    listen = free_endpoint()
    session = open_router(listen=(listen,))
    yield listen
    session.close()


@pytest.fixture(autouse=True)
def _no_settings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Isolate tests from the developer's environment variables and working directory."""
    for name in [name for name in os.environ if name.startswith("NEDBUS_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def timings() -> Iterator[Timings]:
    """Change timings of this process for one test: `timings.stale = 0.5`."""
    with changing_timings() as changed:
        yield changed


@pytest.fixture(params=["sync", "async"])
def client(request: pytest.FixtureRequest, endpoint: str) -> Iterator[nedbus.Bus]:
    """Connect with the sync and with the async client."""
    if request.param == "sync":
        with nedbus.connect(endpoint) as bus:
            yield bus
    else:
        with (
            asyncio.Runner() as runner,
            sync_adapter(runner, nedbus.connect_async(endpoint)) as bus,
        ):
            yield bus


@pytest.fixture
def bus(endpoint: str) -> Iterator[nedbus.Bus]:
    """Connect a second bus, as another script would."""
    with nedbus.connect(endpoint) as other:
        yield other


@pytest.fixture
def zenoh_session(endpoint: str) -> Iterator[Session]:
    """Connect a plain Zenoh session, as a client in another language would."""
    with nedbus.connect(endpoint) as other:
        yield other._session


@pytest.fixture(scope="session")
def fork_server(request: pytest.FixtureRequest) -> Iterator[ForkServer]:
    """Run the fork server of this pytest worker."""
    with request.config.pluginmanager.getplugin("capturemanager").global_and_fixture_disabled():
        process = ForkServer()  # a hanging process writes its stacks to the real terminal
    yield process
    process.close()


@pytest.fixture
def start(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Start]:
    """Start Python processes, which are killed at the end of the test.

    The fork server starts them; with `fresh=True` a new interpreter does.
    """
    processes: list[Process] = []

    def start_process(
        *arguments: str, coverage: bool = True, fresh: bool = False, **environment: str
    ) -> Process:
        where = tmp_path / f"process-{len(processes)}"
        where.mkdir()
        inherited = dict(os.environ) if coverage else without_coverage()
        inherited = {
            name: value for name, value in inherited.items() if not name.startswith("NEDBUS_")
        }
        environment = inherited | {"PYTHONFAULTHANDLER": "1"} | environment
        command = [sys.executable, *arguments]
        process = Process(
            command, where, environment, None if fresh else request.getfixturevalue("fork_server")
        )
        processes.append(process)
        return process

    yield start_process
    for process in processes:
        process.kill()


@pytest.fixture
def run_nedbus(start: Start) -> Start:
    """Start `nedbus` with these arguments."""

    def run(*arguments: str, **options: str) -> Process:
        return start("-m", "nedbus", *arguments, **options)

    return run
