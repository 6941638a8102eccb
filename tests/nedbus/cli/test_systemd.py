"""Notifications to systemd, received by a datagram socket of the test, and the shipped units."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from nedbus.cli.systemd import Notifier, notify, watchdog_limit
from nedbus.daemon import Daemon
from nedbus.daemon.output import SourceOutput
from nedbus.settings import load_settings
from nedbus.timings import Timings
from nedbus.transport import open_router
from tests.peers.custom_timings import start_with_timings
from tests.peers.ports import free_endpoint, free_port
from tests.peers.processes import Start
from tests.waits import DEADLINE, changing_timings, repeating, wait_for

Datagram = dict[str, str]


class Systemd:
    """A fake systemd: the datagram socket of NOTIFY_SOCKET."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(f"\0{address[1:]}" if address.startswith("@") else address)
        self.socket.settimeout(DEADLINE)

    def receive(self) -> Datagram:
        """Return the fields of the next datagram."""
        return dict(line.split("=", 1) for line in self.socket.recv(65_536).decode().split("\n"))

    def receive_until(self, is_last: Callable[[Datagram], object]) -> list[Datagram]:
        """Return all datagrams up to the first one for which `is_last` is true."""
        received: list[Datagram] = []
        end = time.monotonic() + DEADLINE
        while not received or not is_last(received[-1]):
            assert time.monotonic() < end, f"waited {DEADLINE} s in vain; received {received}"
            received.append(self.receive())
        return received


@pytest.fixture
def systemd(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Systemd]:
    """Listen on a path or an abstract address."""
    systemd = Systemd(getattr(request, "param", str(tmp_path / "notify")))
    with systemd.socket:
        yield systemd


def is_ready(datagram: Datagram) -> bool:
    return datagram.get("READY") == "1"


@contextmanager
def notified(
    systemd: Systemd,
    *sources: str,
    connect: str | None = None,
    watchdog: str | None = None,
    patience: float = DEADLINE,
) -> Iterator[tuple[Daemon, Notifier]]:
    """Run a daemon in a thread with notifications to systemd: a router, or with `connect` a client."""
    listen, routers = (None, (connect,)) if connect else ((free_endpoint(),), None)
    daemon = Daemon(
        load_settings(source=sources or ("sim:",), listen=listen, connect=routers), version="0"
    )
    environment = {"NOTIFY_SOCKET": systemd.address} | (
        {"WATCHDOG_USEC": watchdog} if watchdog else {}
    )
    thread = threading.Thread(target=daemon.run)
    thread.start()
    try:
        with changing_timings() as timings:
            timings.systemd_patience = patience
            with Notifier(daemon, environment=environment) as notifier:
                yield daemon, notifier
    finally:
        daemon.stop()
        thread.join(DEADLINE)


@pytest.fixture
def frequent_status(timings: Timings) -> None:
    """Send the status text five times a second in this process."""
    timings.systemd_status = 0.2


@pytest.mark.slow
@pytest.mark.parametrize(
    "systemd", [f"@nedbus-test-{os.getpid()}"], indirect=True, ids=["abstract"]
)
def test_ready_is_sent_when_router_listens(run_nedbus: Start, systemd: Systemd) -> None:
    """READY is sent once, when the router accepts connections, then WATCHDOG periodically; SIGTERM sends STOPPING."""
    endpoint = free_endpoint()
    environment = {"NOTIFY_SOCKET": systemd.address, "WATCHDOG_USEC": "200000"}
    process = run_nedbus("serve", "--source", "sim:", "--listen", endpoint, **environment)
    before = systemd.receive_until(is_ready)
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    socket.create_connection((host, int(port))).close()
    assert "1 source, " in before[-1]["STATUS"]
    after = [
        each
        for _ in range(3)
        for each in systemd.receive_until(lambda datagram: "WATCHDOG" in datagram)
    ]
    process.signal(signal.SIGTERM)
    after += systemd.receive_until(lambda datagram: "STOPPING" in datagram)
    assert not any(map(is_ready, after))
    assert process.wait() == 0, process.err


@pytest.mark.slow
def test_stopping_is_sent_when_sources_end(run_nedbus: Start, systemd: Systemd) -> None:
    """A service with --until-done sends STOPPING when its sources have ended."""
    arguments = ("--source", "sim:?duration=0.1", "--until-done", "--listen", free_endpoint())
    process = run_nedbus("serve", *arguments, NOTIFY_SOCKET=systemd.address)
    systemd.receive_until(lambda datagram: datagram.get("STOPPING") == "1")
    assert process.wait() == 0, process.err


@pytest.mark.usefixtures("frequent_status")
def test_silent_source_does_not_delay_ready(systemd: Systemd) -> None:
    """A silent source does not delay READY; the status text names it."""
    link = f"mavlink:udpin:127.0.0.1:{free_port()}"
    with notified(systemd, "sim:", link):
        received = systemd.receive_until(
            lambda datagram: "nothing arrives" in datagram.get("STATUS", "")
        )
    assert any(map(is_ready, received))
    status = received[-1]["STATUS"]
    assert status.startswith("2 sources, ")
    assert status.endswith(f"; {link}: nothing arrives")
    assert "\n" not in status
    assert " messages/s, 0 sessions" in status


@pytest.mark.usefixtures("frequent_status")
def test_status_continues_after_a_panic(systemd: Systemd, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a panic of Zenoh in a status update, READY and the following updates are sent."""
    status, panics = Notifier._status, iter(["panic"])

    def panic_once(notifier: Notifier) -> str:
        for text in panics:
            raise BaseException(text)  # noqa: TRY002 - like pyo3's PanicException, it is not an Exception
        return status(notifier)

    monkeypatch.setattr(Notifier, "_status", panic_once)
    with notified(systemd, "sim:"):
        systemd.receive_until(lambda datagram: "1 source, " in datagram.get("STATUS", ""))


def has_counts(datagram: Datagram, *, is_wrong: bool) -> bool:
    """Return whether the status text has counts, and reports a rejected configuration if and only if `is_wrong`."""
    return (
        "messages/s" in datagram["STATUS"]
        and ("configuration rejected" in datagram["STATUS"]) == is_wrong
    )


@pytest.mark.slow
def test_reload_sends_reloading_then_ready(start: Start, systemd: Systemd, tmp_path: Path) -> None:
    """SIGHUP sends RELOADING with the time, then READY.

    The status text keeps the error of a rejected file until a reload succeeds.
    """
    file = tmp_path / "nedbus.toml"
    text = f'listen = "{free_endpoint()}"\nsource = ["sim:"]\n'
    file.write_text(text)
    frequent = Timings(systemd_status=0.2)
    process = start_with_timings(
        start, frequent, "serve", "--config", str(file), NOTIFY_SOCKET=systemd.address
    )
    systemd.receive_until(is_ready)
    for content, is_wrong in ((text, False), ("source = [", True), (text, False)):
        file.write_text(content)
        signalled = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
        process.signal(signal.SIGHUP)
        reloading = systemd.receive_until(lambda datagram: datagram.get("RELOADING") == "1")[-1]
        assert int(reloading["MONOTONIC_USEC"]) >= signalled
        ready = systemd.receive_until(is_ready)[-1]["STATUS"]
        assert ("configuration rejected" in ready) == is_wrong
        systemd.receive_until(partial(has_counts, is_wrong=is_wrong))
    assert process.err.count("settings not reloaded, the old ones stay active: ") == 1
    process.signal(signal.SIGTERM)
    assert process.wait() == 0, process.err


@pytest.mark.usefixtures("frequent_status")
def test_watchdog_is_not_sent_without_ticks(systemd: Systemd) -> None:
    """While the main thread hangs, no WATCHDOG is sent, but the status text is still sent."""
    with notified(systemd, watchdog="20000") as (_, notifier):
        stuck = systemd.receive_until(is_ready)
        # sent after ten times the limit
        stuck += systemd.receive_until(lambda datagram: "STATUS" in datagram)
        assert not any("WATCHDOG" in datagram for datagram in stuck)
        notifier.tick()
        systemd.receive_until(lambda datagram: "WATCHDOG" in datagram)


@pytest.mark.usefixtures("frequent_status")
def test_watchdog_is_sent_with_each_status(systemd: Systemd) -> None:
    """WATCHDOG is sent much more often than systemd requires, so that a rejected or delayed one does no harm."""
    hour = 3600 * 1_000_000  # us
    with notified(systemd, watchdog=str(hour)) as (_, notifier), repeating(notifier.tick):
        for _ in range(4):
            systemd.receive_until(lambda datagram: "WATCHDOG" in datagram)


def block(monkeypatch: pytest.MonkeyPatch, method: str) -> tuple[threading.Event, threading.Event]:
    """Block sources in a method of their output; return two events: one is set on entry, the other releases all."""
    entered, opened = threading.Event(), threading.Event()
    original = getattr(SourceOutput, method)

    def wait(output: SourceOutput, *arguments: object, **options: object) -> object:
        entered.set()
        opened.wait(DEADLINE)
        return original(output, *arguments, **options)

    monkeypatch.setattr(SourceOutput, method, wait)
    return entered, opened


@pytest.mark.parametrize(
    ("source", "method"),
    [("sim:", "publish_replay"), (f"mavlink:udpin:127.0.0.1:{free_port()}", "expire_stale")],
    ids=["replay", "live"],
)
def test_watchdog_is_not_sent_while_a_source_is_stuck(
    systemd: Systemd, monkeypatch: pytest.MonkeyPatch, timings: Timings, source: str, method: str
) -> None:
    """While a source's loop is blocked, no WATCHDOG is sent, although all other threads are running."""
    limit = 0.1  # s
    timings.source_tick = limit / 2  # period of a source's loop
    entered, opened = block(monkeypatch, method)
    with (
        notified(systemd, source, watchdog=str(round(2e6 * limit))) as (daemon, notifier),
        repeating(notifier.tick),
    ):
        systemd.receive_until(is_ready)
        wait_for(entered.is_set, what="the source to block")
        wait_for(lambda: daemon.busy > limit, what="the limit")
        with notifier.reloading():
            systemd.receive_until(lambda datagram: "RELOADING" in datagram)
        wait_for(lambda: daemon.busy > 5 * limit, what="several limits")
        with notifier.reloading():
            stuck = systemd.receive_until(lambda datagram: "RELOADING" in datagram)
        # One WATCHDOG may already have been sent at the first reload.
        assert sum("WATCHDOG" in datagram for datagram in stuck) <= 1
        opened.set()
        systemd.receive_until(lambda datagram: "WATCHDOG" in datagram)


def test_watchdog_is_sent_while_replay_waits_for_readers(
    systemd: Systemd, monkeypatch: pytest.MonkeyPatch
) -> None:
    """WATCHDOG is sent while a replay at speed=max waits for slow readers, because it is not stuck."""
    entered, opened = block(monkeypatch, "publish_replay")
    with (
        notified(systemd, "sim:?speed=max&duration=3600", watchdog="20000") as (daemon, notifier),
        repeating(notifier.tick),
    ):
        wait_for(entered.is_set, what="the source to wait")
        systemd.receive_until(is_ready)
        for _ in range(10):
            systemd.receive_until(lambda datagram: "WATCHDOG" in datagram)
        assert daemon.busy == 0
        opened.set()


@pytest.mark.parametrize(
    ("text", "process", "limit"),
    [
        ("20000000", None, 20.0),
        pytest.param("20000000", str(os.getpid()), 20.0, id="own"),
        ("20000000", "1", None),  # systemd watches another process
        ("0", None, None),
        ("soon", None, None),
        ("", None, None),
    ],
)
def test_watchdog_limit_is_that_of_this_process(
    text: str, process: str | None, limit: float | None
) -> None:
    """The limit is WATCHDOG_USEC if systemd watches this process, and otherwise None."""
    environment = {"WATCHDOG_USEC": text} | ({} if process is None else {"WATCHDOG_PID": process})
    assert watchdog_limit(environment) == limit


@pytest.mark.usefixtures("frequent_status")
def test_client_waits_for_its_router(systemd: Systemd) -> None:
    """A client sends READY when its router answers; before that the status text names the endpoint."""
    endpoint = free_endpoint()
    with notified(systemd, connect=endpoint):
        assert systemd.receive() == {"STATUS": f"waiting for a router at {endpoint}"}
        router = open_router(listen=(endpoint,))
        assert "1 session" in systemd.receive_until(is_ready)[-1]["STATUS"]
        router.close()
        systemd.receive_until(lambda datagram: "no router answers" in datagram.get("STATUS", ""))


def test_client_without_router_is_ready_after_a_timeout(systemd: Systemd) -> None:
    """A client whose router does not answer sends READY after a timeout, so that it does not delay the boot."""
    with notified(systemd, connect=free_endpoint(), patience=0.1):
        assert systemd.receive_until(is_ready)[-1]["STATUS"].startswith(
            "waiting for a router at tcp/"
        )


@pytest.mark.parametrize(
    "address", [{}, {"NOTIFY_SOCKET": "vsock:2:1234"}], ids=["none", "another kind"]
)
def test_notifier_is_inactive_without_notify_socket(address: dict[str, str]) -> None:
    """Without NOTIFY_SOCKET, or with an unsupported address, no thread is started and nothing is sent."""
    daemon = Daemon(load_settings(source=("sim:",)), version="0")
    with Notifier(daemon, environment={"WATCHDOG_USEC": "1"} | address) as notifier:
        notifier.tick()
        with notifier.reloading():
            assert "nedbus-systemd" not in [thread.name for thread in threading.enumerate()]
        notifier.stopping()


def test_notify_returns_false_if_queue_is_full(systemd: Systemd) -> None:
    """`notify` returns False, and does not block, if systemd's queue is full or its socket does not exist."""
    # until the queue is full
    accepted = sum(1 for _ in iter(lambda: notify(systemd.address, READY=1), False))
    for _ in range(accepted):
        systemd.receive()
    assert notify(systemd.address, READY=1)
    Path(systemd.address).unlink()
    assert not notify(systemd.address, READY=1)


NO_DESCRIPTORS = """
import resource
from nedbus.cli.systemd import notify
resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))
print(notify("@nedbus-test", READY=1))
"""


@pytest.mark.slow
def test_notify_returns_false_without_a_file_descriptor(start: Start) -> None:
    """At the limit of open files `notify` does not raise: its thread continues, and sends again."""
    process = start("-c", NO_DESCRIPTORS, coverage=False)
    assert process.wait() == 0, process.err
    assert process.out == "False\n"


def test_ready_is_repeated_until_accepted(systemd: Systemd) -> None:
    """A READY that systemd's full queue did not accept is sent again."""
    filled = sum(1 for _ in iter(lambda: notify(systemd.address, FILLED=1), False))
    with notified(systemd) as (daemon, _):
        wait_for(daemon.ready.is_set, what="the router")
        assert [systemd.receive() for _ in range(filled)] == [{"FILLED": "1"}] * filled
        systemd.receive_until(is_ready)


# The shipped units, checked by systemd-analyze; tests/compose/test_systemd.py starts them

UNITS = Path(__file__).parents[3] / "packaging" / "systemd"
EXECUTABLE = "/opt/nedbus/bin/nedbus"
EXPOSURE = 2.0  # of 10; systemd's limit for "OK"
with_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is missing"
)


@pytest.fixture(params=["nedbus.service", "nedbus@.service", "nedbus-reader@.service"])
def unit(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Copy a unit, with an existing program instead of the installed nedbus."""
    copy = tmp_path / str(request.param)
    text = (UNITS / copy.name).read_text()
    assert EXECUTABLE in text
    copy.write_text(text.replace(EXECUTABLE, "/bin/true"))
    return copy


def analyze(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run systemd-analyze."""
    return subprocess.run(
        ["systemd-analyze", *arguments], capture_output=True, text=True, timeout=60, check=False
    )


@pytest.mark.process
@with_systemd
def test_unit_is_valid_and_hardened(unit: Path) -> None:
    """Every directive of the unit is known to systemd, and the exposure is below the documented limit."""
    done = analyze("verify", unit)
    warnings = [line for line in done.stderr.splitlines() if "nedbus" in line]
    assert (done.returncode, warnings) == (0, []), done.stderr
    done = analyze("security", "--offline=true", f"--threshold={EXPOSURE * 10:.0f}", unit)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (
        float(done.stdout.split("Overall exposure level for")[1].split(":")[1].split()[0])
        < EXPOSURE
    )


def test_template_unit_differs_only_in_its_file() -> None:
    """The template unit equals the plain one except for the settings file and the description."""
    plain, template = (
        (UNITS / name).read_text().split("\n", 1)[1]
        for name in ("nedbus.service", "nedbus@.service")
    )
    assert template == plain.replace("/nedbus.toml", "/%i.toml").replace("(nedbus)", "(nedbus %i)")


@pytest.mark.process
def test_reader_unit_expands_options_like_a_shell(tmp_path: Path) -> None:
    """OPTIONS may contain shell expansions, such as $(date); the hardening is the same as in nedbus.service."""
    text = (UNITS / "nedbus-reader@.service").read_text()
    hardening = text.partition("\nUser=")[2]
    assert hardening == (UNITS / "nedbus.service").read_text().partition("\nUser=")[2]
    [command] = re.findall(r"^ExecStart=/bin/sh -c '(.*)'$", text, re.MULTILINE)
    script = (
        command.replace(EXECUTABLE, "echo nedbus")
        .replace("exec echo", "echo")
        .replace("%i", "record")
    )
    options = {"OPTIONS": "--output $(printf 7).mcap -t '*'"}
    done = subprocess.run(
        ["/bin/sh", "-c", script.replace("$$", "$")],
        env=options,
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
    )
    assert done.stdout == "nedbus record --wait --output 7.mcap -t *\n"
