"""What a service tells systemd: a real datagram socket in its place, and real services."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from nedbus.cli.systemd import Notifier, NotifySocket, watchdog_interval
from nedbus.daemon import Daemon
from nedbus.daemon.output import SourceOutput
from nedbus.settings import load_settings
from nedbus.transport import open_router
from tests.conftest import DEADLINE, Start, free_endpoint, free_port, repeating, wait_for

Datagram = dict[str, str]


class Systemd:
    """What systemd is to a service: a socket that takes datagrams."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(f"\0{address[1:]}" if address.startswith("@") else address)
        self._socket.settimeout(DEADLINE)

    def receive(self) -> Datagram:
        """Return the fields of the next datagram."""
        return dict(line.split("=", 1) for line in self._socket.recv(65_536).decode().split("\n"))

    def receive_until(self, wanted: Callable[[Datagram], object]) -> list[Datagram]:
        """Return all datagrams up to one that is wanted."""
        received: list[Datagram] = []
        end = time.monotonic() + DEADLINE
        while not received or not wanted(received[-1]):
            assert time.monotonic() < end, f"waited in vain; there came {received}"
            received.append(self.receive())
        return received

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def systemd(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Systemd]:
    """Listen at a path, or at an abstract address."""
    systemd = Systemd(getattr(request, "param", str(tmp_path / "notify")))
    yield systemd
    systemd.close()


def is_ready(datagram: Datagram) -> bool:
    return datagram.get("READY") == "1"


@contextmanager
def running(daemon: Daemon) -> Iterator[None]:
    """Run a daemon in a thread."""
    thread = threading.Thread(target=daemon.run)
    thread.start()
    try:
        yield
    finally:
        daemon.stop()
        thread.join(DEADLINE)


def simulation(*, listen: str | None = None, connect: str | None = None) -> Daemon:
    """Return a daemon that simulates a vehicle."""
    return publishing("sim:", listen=listen, connect=connect)


def publishing(source: str, *, listen: str | None = None, connect: str | None = None) -> Daemon:
    """Return a daemon with one source."""
    settings = load_settings(source=(source,), listen=listen and (listen,), connect=connect and (connect,))
    return Daemon(settings, version="0")


@pytest.mark.parametrize("systemd", [f"@nedbus-test-{os.getpid()}"], indirect=True, ids=["abstract"])
def test_ready_when_router_listens(run_nedbus: Start, systemd: Systemd) -> None:
    """READY comes once, when the router accepts connections, with a status; after SIGTERM comes STOPPING."""
    endpoint = free_endpoint()
    process = run_nedbus("serve", "--source", "sim:", "--listen", endpoint, NOTIFY_SOCKET=systemd.address)
    before = systemd.receive_until(is_ready)
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    socket.create_connection((host, int(port))).close()
    assert "1 source, " in before[-1]["STATUS"]
    process.signal(signal.SIGTERM)
    after = systemd.receive_until(lambda datagram: "STOPPING" in datagram)
    assert not any(map(is_ready, after))
    assert process.wait() == 0, process.err


def test_end_by_itself_is_said(run_nedbus: Start, systemd: Systemd) -> None:
    """A service that ends when its sources do says so, too."""
    arguments = ("--source", "sim:?duration=0.1", "--until-done", "--listen", free_endpoint())
    process = run_nedbus("serve", *arguments, NOTIFY_SOCKET=systemd.address)
    systemd.receive_until(lambda datagram: datagram.get("STOPPING") == "1")
    assert process.wait() == 0, process.err


def test_status_of_silent_source(run_nedbus: Start, systemd: Systemd) -> None:
    """A source that nobody speaks to does not delay READY; the status names it, and what the others publish."""
    link = f"mavlink:udpin:{free_endpoint().removeprefix('tcp/')}"
    arguments = ("--source", "sim:", "--source", link, "--listen", free_endpoint())
    run_nedbus("serve", *arguments, NOTIFY_SOCKET=systemd.address)
    received = systemd.receive_until(lambda datagram: "nothing arrives" in datagram.get("STATUS", ""))
    assert any(map(is_ready, received))
    status = received[-1]["STATUS"]
    assert status.startswith("2 sources, ")
    assert status.endswith(f"; {link}: nothing arrives")
    assert "\n" not in status
    assert " messages/s, 0 sessions" in status


def test_reload_is_answered(run_nedbus: Start, systemd: Systemd, tmp_path: Path) -> None:
    """SIGHUP is answered with RELOADING and the time, then READY; what is wrong with the new file is in the status."""
    file = tmp_path / "nedbus.toml"
    text = f'listen = "{free_endpoint()}"\nsource = ["sim:"]\n'
    file.write_text(text)
    process = run_nedbus("serve", "--config", str(file), NOTIFY_SOCKET=systemd.address)
    systemd.receive_until(is_ready)
    for content, words in ((text, ""), ("source = [", "is rejected"), (text, "")):
        file.write_text(content)
        asked = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
        process.signal(signal.SIGHUP)
        reloading = systemd.receive_until(lambda datagram: datagram.get("RELOADING") == "1")[-1]
        assert int(reloading["MONOTONIC_USEC"]) >= asked
        ready = systemd.receive_until(is_ready)[-1]
        assert words in ready["STATUS"]
    process.signal(signal.SIGTERM)
    assert process.wait() == 0, process.err


def test_rejected_reload_stays_in_status(systemd: Systemd) -> None:
    """The error of a reload is passed on, and stays in the status until another one works."""
    daemon = simulation(listen=free_endpoint())
    with running(daemon), Notifier(daemon, environment={"NOTIFY_SOCKET": systemd.address}) as notifier:
        systemd.receive_until(is_ready)
        with pytest.raises(ValueError, match="on purpose"), notifier.reloading():
            raise ValueError("on purpose")
        systemd.receive_until(is_ready)
        systemd.receive_until(lambda datagram: "messages/s" in (text := datagram["STATUS"]) and "on purpose" in text)
        with notifier.reloading():
            pass
        systemd.receive_until(is_ready)
        systemd.receive_until(lambda datagram: "messages/s" in (text := datagram["STATUS"]) and "purpose" not in text)


def test_watchdog_of_working_process(run_nedbus: Start, systemd: Systemd) -> None:
    """A process that works says so, again and again."""
    arguments = ("serve", "--source", "sim:", "--listen", free_endpoint())
    run_nedbus(*arguments, NOTIFY_SOCKET=systemd.address, WATCHDOG_USEC="200000")
    for _ in range(3):
        systemd.receive_until(lambda datagram: datagram.get("WATCHDOG") == "1")


def test_no_watchdog_without_ticks(systemd: Systemd) -> None:
    """While the main thread does not work, nobody says that it does; the status goes on."""
    environment = {"NOTIFY_SOCKET": systemd.address, "WATCHDOG_USEC": "20000"}
    daemon = simulation(listen=free_endpoint())
    with running(daemon), Notifier(daemon, environment=environment) as notifier:
        stuck = systemd.receive_until(is_ready)
        stuck += systemd.receive_until(lambda datagram: "STATUS" in datagram)  # a second later, 50 times the limit
        assert not any("WATCHDOG" in datagram for datagram in stuck)
        notifier.tick()
        systemd.receive_until(lambda datagram: "WATCHDOG" in datagram)


@dataclass
class Gate:
    """Where sources block: `entered` is set as soon as one does, and all go on once `opened` is."""

    entered: threading.Event = field(default_factory=threading.Event)
    opened: threading.Event = field(default_factory=threading.Event)


def block(monkeypatch: pytest.MonkeyPatch, method: str) -> Gate:
    """Let the sources that are started after this block in a method of their output."""
    gate = Gate()
    original = getattr(SourceOutput, method)

    def wait(output: SourceOutput, *arguments: object) -> object:
        gate.entered.set()
        gate.opened.wait(DEADLINE)
        return original(output, *arguments)

    monkeypatch.setattr(SourceOutput, method, wait)
    return gate


@pytest.mark.parametrize(
    ("source", "method"),
    [("sim:", "publish"), (f"mavlink:udpin:127.0.0.1:{free_port()}", "expire_stale")],
    ids=["replay", "live"],
)
def test_no_watchdog_while_a_source_is_stuck(
    systemd: Systemd, monkeypatch: pytest.MonkeyPatch, source: str, method: str
) -> None:
    """While the loop of a source does not go round there is no ping, though all other threads work; then there is."""
    limit = 0.3  # s; a live source goes round every 0.25 s
    environment = {"NOTIFY_SOCKET": systemd.address, "WATCHDOG_USEC": str(round(2e6 * limit))}
    daemon = publishing(source, listen=free_endpoint())
    gate = block(monkeypatch, method)
    with running(daemon), Notifier(daemon, environment=environment) as notifier, repeating(notifier.tick):
        systemd.receive_until(is_ready)
        wait_for(gate.entered.is_set, what="the source to block")
        wait_for(lambda: daemon.busy > limit, what="the limit")
        with notifier.reloading():
            systemd.receive_until(lambda datagram: "RELOADING" in datagram)
        wait_for(lambda: daemon.busy > 7 * limit, what="several limits")
        with notifier.reloading():
            stuck = systemd.receive_until(lambda datagram: "RELOADING" in datagram)
        # One may have been on its way at the first reload.
        assert sum("WATCHDOG" in datagram for datagram in stuck) <= 1
        gate.opened.set()
        systemd.receive_until(lambda datagram: "WATCHDOG" in datagram)


def test_watchdog_of_a_source_that_may_take_any_time(systemd: Systemd, monkeypatch: pytest.MonkeyPatch) -> None:
    """A replay as fast as its readers take it waits for them, for as long as it takes: that is not stuck."""
    environment = {"NOTIFY_SOCKET": systemd.address, "WATCHDOG_USEC": "20000"}
    daemon = publishing("sim:?speed=max&duration=3600", listen=free_endpoint())
    gate = block(monkeypatch, "publish")
    with running(daemon), Notifier(daemon, environment=environment) as notifier, repeating(notifier.tick):
        wait_for(gate.entered.is_set, what="the source to wait")
        systemd.receive_until(is_ready)
        for _ in range(10):
            systemd.receive_until(lambda datagram: "WATCHDOG" in datagram)
        assert daemon.busy == 0
        gate.opened.set()


@pytest.mark.parametrize(
    ("limit", "process", "interval"),
    [
        ("20000000", None, 10.0),
        pytest.param("20000000", str(os.getpid()), 10.0, id="own"),
        ("20000000", "1", None),  # it is another process that systemd watches
        ("0", None, None),
        ("soon", None, None),
        ("", None, None),
    ],
)
def test_watchdog_interval(limit: str, process: str | None, interval: float | None) -> None:
    """The interval is half of what systemd waits, when it is this process that it waits for."""
    environment = {"WATCHDOG_USEC": limit} | ({} if process is None else {"WATCHDOG_PID": process})
    assert watchdog_interval(environment) == interval


def test_client_waits_for_its_router(systemd: Systemd) -> None:
    """A client is not ready before its router is there, and says for whom it waits."""
    endpoint = free_endpoint()
    daemon = simulation(connect=endpoint)
    with running(daemon), Notifier(daemon, environment={"NOTIFY_SOCKET": systemd.address}):
        assert systemd.receive() == {"STATUS": f"waits for a router at {endpoint}"}
        router = open_router(listen=(endpoint,))
        assert "1 session" in systemd.receive_until(is_ready)[-1]["STATUS"]
        router.close()
        systemd.receive_until(lambda datagram: "no router answers" in datagram.get("STATUS", ""))


def test_client_is_started_without_its_router(systemd: Systemd) -> None:
    """A client whose router does not answer for long counts as started: neither it nor the boot is held up."""
    daemon = simulation(connect=free_endpoint())
    with running(daemon), Notifier(daemon, environment={"NOTIFY_SOCKET": systemd.address}, patience=0.1):
        assert systemd.receive_until(is_ready)[-1]["STATUS"].startswith("waits for a router at tcp/")


def test_nothing_without_notify_socket(endpoint: str) -> None:
    """Where systemd does not ask, there is no thread, and nothing to do."""
    notifier = Notifier(simulation(connect=endpoint), environment={"WATCHDOG_USEC": "1"})
    with notifier:
        notifier.tick()
        with notifier.reloading():
            assert "nedbus-systemd" not in [thread.name for thread in threading.enumerate()]
        notifier.stopping()


def test_address_that_cannot_be_used(caplog: pytest.LogCaptureFixture) -> None:
    """An address of another kind is warned of."""
    assert not NotifySocket("vsock:2:1234").active
    assert "neither a path nor @NAME" in caplog.text


def test_systemd_that_does_not_listen(systemd: Systemd) -> None:
    """What cannot be told now, is told later; nothing waits for it."""
    notify = NotifySocket(systemd.address)
    taken = 0
    while notify.send(READY=1):  # until the queue of the socket is full
        taken += 1
    for _ in range(taken):
        systemd.receive()
    assert notify.send(READY=1)
    Path(systemd.address).unlink()
    assert not notify.send(READY=1)
    notify.close()
    assert not notify.send(READY=1)


def test_ready_is_repeated_until_it_is_taken(systemd: Systemd) -> None:
    """A READY that finds no room is sent again: systemd would wait for it in vain."""
    full = NotifySocket(systemd.address)
    filled = 0
    while full.send(FILLED=1):
        filled += 1
    daemon = simulation(listen=free_endpoint())
    with running(daemon), Notifier(daemon, environment={"NOTIFY_SOCKET": systemd.address}):
        wait_for(daemon.ready.is_set, what="the router")
        assert [systemd.receive() for _ in range(filled)] == [{"FILLED": "1"}] * filled
        systemd.receive_until(is_ready)
    full.close()
