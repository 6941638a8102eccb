"""Limits of a router: its own report, the command that shows it, and the files that it may open."""

from __future__ import annotations

import json
import logging
import re
import resource
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import zenoh

import nedbus
from nedbus.daemon import Daemon
from nedbus.doctor import Finding
from nedbus.doctor.examination import check_network
from nedbus.doctor.observation import Observation
from nedbus.doctor.prober import check_endpoint
from nedbus.errors import ConfigError
from nedbus.monitoring import Exporter, exporter, service_pages
from nedbus.settings import load_settings
from nedbus.timings import Timings
from nedbus.transport import RouterState, Session, ask_routers, open_client, open_router, read_router_config, router
from nedbus.transport.router import allow_sessions, read_state
from tests.peers.certificates import CONFIG
from tests.peers.certificates import write_config as write_shipped
from tests.peers.ports import free_endpoint
from tests.peers.processes import Start
from tests.peers.zenohd import start_zenohd
from tests.waits import DEADLINE, changing_timings, wait_for

ZID = "1ae1e25d2f7221abc366ddc8a944c8a4"


def write_config(folder: Path, endpoint: str, **settings: object) -> Path:
    """Write a router's file with room for ten sessions."""
    file = folder / "router.json5"
    known = {"mode": "router", "listen": {"endpoints": [endpoint]}, "transport": {"unicast": {"max_sessions": 10}}}
    admin = {"adminspace": {"enabled": True, "permissions": {"read": True, "write": False}}}
    alone = {"scouting": {"multicast": {"enabled": False}, "delay": 0}}
    file.write_text(json.dumps({**known, **admin, **alone, **settings}))
    return file


@contextmanager
def in_thread(target: Callable[..., object], *arguments: object, end: Callable[[], None]) -> Iterator[None]:
    """Run something meanwhile, and end it."""
    thread = threading.Thread(target=target, args=arguments)
    thread.start()
    try:
        yield
    finally:
        end()
        thread.join(DEADLINE)


@pytest.fixture
def small(tmp_path: Path) -> Iterator[str]:
    """Run a router with room for ten sessions, whose file says otherwise to those who ask."""
    where = free_endpoint()
    with open_router(config_file=write_config(tmp_path, where, metadata={"max_sessions": 7, "name": "base"})):
        yield where


def router_in(endpoint: str, seen: str) -> Finding:
    """Return what the doctor finds of the only router when it sees this; who has just left counts for a moment."""
    found: list[Finding] = []

    def look() -> bool:
        findings = check_network(Observation("nedbus", "0", None), endpoint, None)
        found[:] = [each for each in findings if each.check == "router"]
        return [each.seen for each in found] == [seen]

    with changing_timings() as timings:
        timings.listen = timings.min_listen = 0.0
        wait_for(look, what=f"{seen}, not {found}")
    return found[0]


def ask(endpoint: str) -> list[RouterState]:
    with open_client([endpoint], timeout=5.0) as session:
        return ask_routers(session, timeout=5.0)


def test_every_router_of_a_mesh_answers(endpoint: str) -> None:
    """Each has its own sessions, a joined router among them, and Zenoh's default of 1,000."""
    second = free_endpoint()
    with open_router(listen=[second], connect=[endpoint]) as router:
        wait_for(lambda: sorted(state.sessions for state in ask(endpoint)) == [1, 2], what="both routers")
        states = ask(endpoint)
        assert [state.max_sessions for state in states] == [1000, 1000]
        assert str(router.zid()) in {state.zid for state in states}
        assert [state.zid for state in states] == sorted(state.zid for state in states)


def test_router_tells_what_it_really_accepts(small: str) -> None:
    """A number that was changed in one place of the file only does not deceive anybody; the rest of it stays."""
    assert [(state.max_sessions, state.load) for state in ask(small)] == [(10, 0.1)]
    with open_client([small], timeout=5.0) as session:
        (answer,) = (reply.ok for reply in session.get("@/*/router", timeout=5.0) if reply.ok)
    assert json.loads(answer.payload.to_bytes())["metadata"] == {"max_sessions": 10, "name": "base"}


@pytest.mark.parametrize("name", ["router.json5", "router-secure.json5"])
def test_shipped_files_say_it_twice_alike(name: str) -> None:
    """A zenohd tells only what stands in `metadata`: it is the limit itself; both files have the same blocks."""
    config = zenoh.Config.from_file(CONFIG / name)
    limit = json.loads(config.get_json("transport/unicast/max_sessions"))
    assert json.loads(config.get_json("metadata")) == {"max_sessions": limit}
    blocks = re.findall(r"^  (\w+):", (CONFIG / name).read_text(), re.MULTILINE)
    assert {"mode", "listen", "scouting", "timestamping", "adminspace", "transport"} <= set(blocks)
    assert read_router_config().max_sessions == limit == 1000


@pytest.mark.slow
def test_zenohd_tells_what_its_file_says(start: Start, tmp_path: Path) -> None:
    """The shipped file, in the real program."""
    where = free_endpoint()
    start_zenohd(start, "-c", str(write_shipped(tmp_path, tmp_path / "router.json5", where)))
    with open_client([where], timeout=DEADLINE) as session:
        assert [(state.sessions, state.max_sessions) for state in ask_routers(session, timeout=5.0)] == [(1, 1000)]


def test_limit_of_a_broken_file_is_an_error(tmp_path: Path) -> None:
    """It is not taken for the default."""
    file = tmp_path / "router.json5"
    file.write_text("{ mode: ")
    with pytest.raises(ConfigError):
        read_router_config(file)


@pytest.mark.parametrize(
    ("key", "answer"),
    [
        *((f"@/{ZID}/router", answer) for answer in (b"", b"\xff\xfe", b"[" * 100_000, b"[]", b"null")),
        (f"@/{ZID}/router", b'{"sessions": 7}'),
        (f"@/{ZID}/router", b'{"sessions": {"a": 1}}'),
        (f"@/{ZID}/router", b'{"sessions": [], "metadata": {"max_sessions": ' + b"9" * 5000 + b"}}"),
        *((key, b'{"sessions": []}') for key in ("@/x y/router", f"@/{ZID}0/router", f"@/{ZID}/router/config")),
        (f"a/{ZID}/router", b'{"sessions": []}'),
    ],
)
def test_answers_that_make_no_sense(key: str, answer: bytes) -> None:
    """Any peer may answer anything: it is no router; an id is at most 16 bytes in hexadecimal digits, for a label."""
    assert read_state(key, answer) is None


@pytest.mark.parametrize("room", [True, False, 0, -1, 0.5, 1e3, "1000", None, [1000], {}, 2**33])
def test_limits_that_make_no_sense(room: object) -> None:
    """The sessions count, and the limit is not known."""
    answer = json.dumps({"sessions": [{}, {}], "metadata": {"max_sessions": room}}).encode()
    assert read_state(f"@/{ZID}/router", answer) == RouterState(ZID, 2, None)
    for metadata in (room, [room], None):
        answer = json.dumps({"sessions": [{}, {}], "metadata": metadata}).encode()
        assert read_state(f"@/{ZID}/router", answer) == RouterState(ZID, 2, None)


def test_large_and_many_answers(endpoint: str, zenoh_session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    """A peer that claims to be many routers, or one with a book of sessions, fills no reader's memory."""
    (real,) = ask_routers(zenoh_session, timeout=5.0)

    def answer(query: zenoh.Query) -> None:
        for number in range(20):
            query.reply(f"@/f{number:x}/router", b'{"sessions": []}')
        query.reply("@/abc/router", b'{"sessions": [' + b"1," * 2**20 + b"1]}")

    with open_client([endpoint], timeout=DEADLINE) as impostor:
        impostor.declare_queryable("@/*/router", answer)
        wait_for(lambda: len(ask_routers(zenoh_session, timeout=5.0)) == 21, what="the answers of the impostor")
        assert real.zid in {state.zid for state in ask_routers(zenoh_session, timeout=5.0)}
        monkeypatch.setattr("nedbus.transport.router._MAX_ROUTERS", 5)
        assert len(ask_routers(zenoh_session, timeout=5.0)) == 5


def test_doctor_warns_from_four_fifths_on(small: str) -> None:
    """Below it is told how many there are of how many; the doctor itself is one of them."""
    with ExitStack() as closing_them:
        for _ in range(6):
            closing_them.enter_context(open_client([small], timeout=5.0))
        finding = router_in(small, "7 of 10 sessions")
        assert (finding.state, finding.advice) == ("ok", "")
        closing_them.enter_context(open_client([small], timeout=5.0))
        finding = router_in(small, "8 of 10 sessions")
        assert finding.state == "warning"
        assert "max_sessions" in finding.advice
        assert "docs/hosts.md" in finding.advice


def test_router_whose_limit_is_not_told(tmp_path: Path) -> None:
    """Metadata is the user's, and may be anything: the count alone is no reason to warn, nor is no answer at all."""
    where = free_endpoint()
    for metadata in (["a", "list"], "mine"):
        with open_router(config_file=write_config(tmp_path, where, metadata=metadata)):
            assert [(state.max_sessions, state.load) for state in ask(where)] == [(None, None)]
            assert router_in(where, "connected sessions: 1").state == "ok"
    with open_router(config_file=write_config(tmp_path, where, adminspace={"enabled": False})):
        assert router_in(where, "connected; its other sessions are not visible to this client").state == "ok"


def test_metrics_of_a_service_with_a_router(tmp_path: Path) -> None:
    """They have the limit of the embedded router; a client has none."""
    where = free_endpoint()
    daemon = Daemon(load_settings(source=("sim:",), router_config=write_config(tmp_path, where)), version="0")

    def shows(text: str, daemon: Daemon = daemon) -> bool:
        return text in service_pages(daemon)["/metrics"]().content.decode()

    with in_thread(daemon.run, end=daemon.stop):
        wait_for(daemon.ready.is_set, what="the service")
        with open_client([where], timeout=5.0):
            wait_for(lambda: shows('nedbus_sessions{role="router"} 1.0\n'), what="the session")
        assert shows('nedbus_sessions_max{role="router"} 10.0\n')
        client = Daemon(load_settings(source=("sim:",), connect=(where,)), version="0")
        assert not shows("nedbus_sessions_max{", client)


@contextmanager
def exporting(bus: nedbus.Bus) -> Iterator[Callable[..., bool]]:
    """Run an exporter, and yield whether its metrics of routers have all of these lines."""
    exporter = Exporter(bus, nedbus.Selection(), version="0")

    def shows(*wanted: str) -> bool:
        text = exporter.pages["/metrics"]().content.decode()
        return all(f"nedbus_router_{each}" in text for each in wanted)

    assert not shows("sessions{")
    stop = threading.Event()
    with in_thread(exporter.run, stop, end=stop.set):
        yield shows


def test_metrics_of_an_exporter(small: str, monkeypatch: pytest.MonkeyPatch, timings: Timings) -> None:
    """It asks the routers now and then, keeps the first few, and knows nothing of them when they are silent."""
    timings.routers_interval = 0.05
    with nedbus.connect(small) as bus, exporting(bus) as shows:
        (state,) = ask(small)
        label = f'{{router="{state.zid}"}}'
        wait_for(lambda: shows(f"sessions{label} 2.0\n", f"sessions_max{label} 10.0\n"), what="the exporter's sessions")
        with open_client([small], timeout=5.0):
            wait_for(lambda: shows(f"sessions{label} 3.0\n"), what="one more")
        wait_for(lambda: shows(f"sessions{label} 2.0\n"), what="its end")
        monkeypatch.setattr(exporter, "_MAX_ROUTERS", 0)
        wait_for(lambda: not shows(f"sessions{label}"), what="nobody")


def test_exporter_at_a_full_router(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, timings: Timings) -> None:
    """Without a session to ask with it goes on reading, and asks as soon as there is room for one."""
    timings.routers_interval = 0.05
    timings.routers_session = 0.1
    where, tries, original = free_endpoint(), [], nedbus.Bus.open_session

    def count(bus: nedbus.Bus, *, timeout: float) -> Session:
        tries.append(timeout)
        return original(bus, timeout=timeout)

    monkeypatch.setattr(nedbus.Bus, "open_session", count)
    file = write_config(tmp_path, where, transport={"unicast": {"max_sessions": 2}})
    with (
        open_router(config_file=file),
        nedbus.connect(where) as bus,
        open_client([where], timeout=5.0) as last,
        exporting(bus) as shows,
    ):
        wait_for(lambda: len(tries) > 1, what="a second attempt")
        assert not shows("sessions{")
        last.close()
        wait_for(lambda: shows("sessions{"), what="room")


def test_exporter_ends_while_a_router_does_not_answer(small: str) -> None:
    """Its end waits for no answer: after a signal a command has less time than a router has for it."""
    kept: list[zenoh.Query] = []
    with open_client([small], timeout=5.0) as silent, nedbus.connect(small) as bus:
        silent.declare_queryable(f"@/{ZID}/router", kept.append)
        with exporting(bus):
            wait_for(lambda: kept, what="the question")
            begin = time.monotonic()
        assert time.monotonic() - begin < Timings().routers_timeout / 2


def test_client_of_a_full_router(tmp_path: Path) -> None:
    """It is told of the sessions as one cause, in the error and by the doctor; when one has gone it gets in."""
    endpoint = free_endpoint()
    unicast = {"unicast": {"max_sessions": 1}}
    with open_router(config_file=write_config(tmp_path, endpoint, transport=unicast)):
        with open_client([endpoint], timeout=5.0):
            with pytest.raises(nedbus.ConnectError, match=r"no room for more sessions .*'nedbus doctor'"):
                nedbus.connect(endpoint, timeout=0.1)
            *_, finding = check_endpoint(endpoint, None)
            assert (finding.state, "max_sessions" in finding.advice) == ("wrong", True)
        nedbus.connect(endpoint, timeout=DEADLINE).close()


class Limits:
    """Limits of a process that is not this one, in place of the module `resource`."""

    RLIMIT_NOFILE, RLIM_INFINITY = resource.RLIMIT_NOFILE, resource.RLIM_INFINITY

    def __init__(self, soft: int, hard: int, *, refused: bool = False) -> None:
        self.now = soft, hard
        self._refused = refused

    def getrlimit(self, which: int) -> tuple[int, int]:
        assert which == self.RLIMIT_NOFILE
        return self.now

    def setrlimit(self, _: int, limits: tuple[int, int]) -> None:
        if self._refused:
            raise PermissionError
        self.now = limits


@pytest.mark.parametrize(
    ("limits", "soft", "warns"),
    [
        (Limits(1024, 500_000), 500_000, False),
        (Limits(1024, resource.RLIM_INFINITY), resource.RLIM_INFINITY, False),
        (Limits(20_000, 20_000), 20_000, False),
        (Limits(resource.RLIM_INFINITY, resource.RLIM_INFINITY), resource.RLIM_INFINITY, False),
        (Limits(1024, 1500), 1500, False),
        (Limits(256, 1024), 1024, True),
        (Limits(256, 4096, refused=True), 256, True),
    ],
    ids=["raised", "no hard limit", "enough", "none", "just enough", "too low", "refused"],
)
def test_files_of_a_router(
    limits: Limits, soft: int, warns: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The soft limit is raised to the hard one; a warning says that this is too low."""
    monkeypatch.setattr(router, "resource", limits)
    with caplog.at_level(logging.WARNING):
        allow_sessions(1000)
    assert limits.now[0] == soft
    assert bool(caplog.records) is warns
    if warns:
        assert f"the limit of {soft} open files has room for about {soft - 100} sessions" in caplog.text


LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_NOFILE, (int(sys.argv.pop(1)), int(sys.argv.pop(1))))
from nedbus.cli import main
main()
"""


def test_router_takes_more_sessions_than_the_soft_limit(start: Start) -> None:
    """With `ulimit -S -n 64` a router takes a hundred sessions, each of them an open file."""
    where, hard = free_endpoint(), resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    router = start("-c", LIMITED, "64", str(hard), "router", "--listen", where)
    with ExitStack() as sessions:
        for _ in range(100):
            sessions.enter_context(open_client([where], timeout=DEADLINE))
        assert len(list(Path(f"/proc/{router.popen.pid}/fd").iterdir())) > 100
    assert "open files" not in router.err


def test_router_that_may_not_says_so(start: Start) -> None:
    """With a hard limit of 300 it starts, and logs how many sessions it has room for."""
    router = start("-c", LIMITED, "300", "300", "router", "--listen", free_endpoint())
    wait_for(lambda: "router on" in router.err, what="the router")
    assert "the limit of 300 open files has room for about 200 sessions" in router.err
