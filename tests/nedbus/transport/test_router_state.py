"""Router state and limits: admin space, doctor, metrics, session limit, and the limit of open files."""

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
from nedbus import limits
from nedbus.daemon import Daemon
from nedbus.doctor import Finding
from nedbus.doctor.examination import check_network
from nedbus.doctor.observation import Observation
from nedbus.doctor.prober import check_endpoint
from nedbus.endpoints import DEFAULT_ENDPOINT
from nedbus.errors import ConfigError
from nedbus.monitoring import Exporter, service_pages
from nedbus.settings import load_settings
from nedbus.timings import Timings
from nedbus.transport import (
    RouterState,
    Session,
    open_client,
    open_router,
    query_routers,
    read_router_config,
    router,
    router_endpoints,
)
from nedbus.transport.router import parse_state, raise_file_limit
from tests.peers.certificates import CONFIG, write_config as write_shipped
from tests.peers.ports import free_endpoint
from tests.peers.processes import Start
from tests.peers.zenohd import start_zenohd
from tests.waits import DEADLINE, changing_timings, wait_for

ZID = "1ae1e25d2f7221abc366ddc8a944c8a4"


def write_config(folder: Path, endpoint: str, **settings: object) -> Path:
    """Write a router configuration with a limit of ten sessions."""
    file = folder / "router.json5"
    base = {
        "mode": "router",
        "listen": {"endpoints": [endpoint]},
        "transport": {"unicast": {"max_sessions": 10}},
    }
    admin = {"adminspace": {"enabled": True, "permissions": {"read": True, "write": False}}}
    scouting = {"scouting": {"multicast": {"enabled": False}, "delay": 0}}
    file.write_text(json.dumps({**base, **admin, **scouting, **settings}))
    return file


@contextmanager
def in_thread(
    target: Callable[..., object], *arguments: object, stop: Callable[[], None]
) -> Iterator[None]:
    """Run a function in a thread, and stop it on exit."""
    thread = threading.Thread(target=target, args=arguments)
    thread.start()
    try:
        yield
    finally:
        stop()
        thread.join(DEADLINE)


@pytest.fixture
def limited(tmp_path: Path) -> Iterator[str]:
    """Run a router that is limited to ten sessions, although `metadata` in its file has another limit."""
    where = free_endpoint()
    with open_router(
        config_file=write_config(tmp_path, where, metadata={"max_sessions": 7, "name": "base"})
    ):
        yield where


def router_finding(endpoint: str, seen: str) -> Finding:
    """Wait until the doctor's finding on the router is `seen`; return it. Closed sessions are still counted briefly."""
    found: list[Finding] = []

    def is_found() -> bool:
        findings = check_network(Observation("nedbus", "0", None), endpoint, None)
        found[:] = [each for each in findings if each.check == "router"]
        return [each.seen for each in found] == [seen]

    with changing_timings() as timings:
        timings.listen = timings.min_listen = 0.0
        wait_for(is_found, what=f"{seen}, not {found}")
    return found[0]


def router_states(endpoint: str) -> list[RouterState]:
    with open_client([endpoint], timeout=5.0) as session:
        return query_routers(session, timeout=5.0)


def test_every_router_of_a_mesh_reports_its_state(endpoint: str) -> None:
    """Each router reports its sessions, including those to other routers, and Zenoh's default limit of 1,000."""
    second = free_endpoint()
    with open_router(listen=[second], connect=[endpoint]) as router:
        wait_for(
            lambda: sorted(state.sessions for state in router_states(endpoint)) == [1, 2],
            what="both routers",
        )
        states = router_states(endpoint)
        assert [state.max_sessions for state in states] == [1000, 1000]
        assert str(router.zid()) in {state.zid for state in states}
        assert [state.zid for state in states] == sorted(state.zid for state in states)


def test_embedded_router_reports_its_actual_limit(limited: str) -> None:
    """The reported limit is max_sessions, even if `metadata` in the file differs; other metadata is kept."""
    assert [(state.sessions, state.max_sessions) for state in router_states(limited)] == [(1, 10)]
    with open_client([limited], timeout=5.0) as session:
        (answer,) = (reply.ok for reply in session.get("@/*/router", timeout=5.0) if reply.ok)
    assert json.loads(answer.payload.to_bytes())["metadata"] == {"max_sessions": 10, "name": "base"}


@pytest.mark.parametrize("name", ["router.json5", "router-secure.json5"])
def test_shipped_metadata_repeats_max_sessions(name: str) -> None:
    """Both shipped files have the required sections, and repeat max_sessions in `metadata`, which zenohd reports."""
    config = zenoh.Config.from_file(CONFIG / name)
    limit = json.loads(config.get_json("transport/unicast/max_sessions"))
    assert json.loads(config.get_json("metadata")) == {"max_sessions": limit}
    sections = re.findall(r"^  (\w+):", (CONFIG / name).read_text(), re.MULTILINE)
    assert {"mode", "listen", "scouting", "timestamping", "adminspace", "transport"} <= set(
        sections
    )
    assert read_router_config().max_sessions == limit == 1000


@pytest.mark.slow
def test_zenohd_reports_the_limit_of_the_shipped_file(start: Start, tmp_path: Path) -> None:
    where = free_endpoint()
    start_zenohd(start, "-c", str(write_shipped(tmp_path, tmp_path / "router.json5", where)))
    with open_client([where], timeout=DEADLINE) as session:
        assert [
            (state.sessions, state.max_sessions) for state in query_routers(session, timeout=5.0)
        ] == [(1, 1000)]


def test_malformed_router_file_raises(tmp_path: Path) -> None:
    """A malformed router file raises ConfigError instead of falling back to the default limit."""
    file = tmp_path / "router.json5"
    file.write_text("{ mode: ")
    with pytest.raises(ConfigError):
        read_router_config(file)


def test_endpoints_of_a_router_file(tmp_path: Path) -> None:
    """Given endpoints override those of the file, which may depend on the mode; without any, the default holds."""
    file = tmp_path / "router.json5"
    file.write_text(
        '{ listen: { endpoints: { router: ["tcp/[::1]:9"], client: ["tcp/[::1]:8"] } } }'
    )
    assert read_router_config(file).listen == ("tcp/[::1]:9",)
    assert router_endpoints(config_file=file) == ("tcp/[::1]:9",)
    assert router_endpoints(["tcp/[::1]:7"], file) == ("tcp/[::1]:7",)
    file.write_text("{ listen: { endpoints: { router: [] } } }")
    assert router_endpoints(config_file=file) == router_endpoints() == (DEFAULT_ENDPOINT,)


@pytest.mark.parametrize(
    ("key", "answer"),
    [
        *(
            (f"@/{ZID}/router", answer)
            for answer in (b"", b"\xff\xfe", b"[" * 2000, b"[]", b"null")
        ),
        (f"@/{ZID}/router", b'{"sessions": 7}'),
        (f"@/{ZID}/router", b'{"sessions": {"a": 1}}'),
        (
            f"@/{ZID}/router",
            b'{"sessions": [], "metadata": {"max_sessions": ' + b"9" * 5000 + b"}}",
        ),
        *(
            (key, b'{"sessions": []}')
            for key in ("@/x y/router", f"@/{ZID}0/router", f"@/{ZID}/router/config")
        ),
        (f"a/{ZID}/router", b'{"sessions": []}'),
    ],
)
def test_malformed_state_replies_are_ignored(key: str, answer: bytes) -> None:
    """A reply is ignored unless it has a session list and a key with a Zenoh id of at most 32 hexadecimal digits."""
    assert parse_state(key, answer) is None


@pytest.mark.parametrize("limit", [True, False, 0, -1, 0.5, 1e3, "1000", None, [1000], {}, 2**33])
def test_invalid_session_limit_is_unknown(limit: object) -> None:
    """With an invalid limit the sessions are reported, and the limit is None."""
    answer = json.dumps({"sessions": [{}, {}], "metadata": {"max_sessions": limit}}).encode()
    assert parse_state(f"@/{ZID}/router", answer) == RouterState(ZID, 2, None)
    for metadata in (limit, [limit], None):
        answer = json.dumps({"sessions": [{}, {}], "metadata": metadata}).encode()
        assert parse_state(f"@/{ZID}/router", answer) == RouterState(ZID, 2, None)


def test_number_and_size_of_state_replies_are_limited(
    endpoint: str, zenoh_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A peer that pretends to be many routers, or one with a huge session list, cannot exhaust memory."""
    (real,) = query_routers(zenoh_session, timeout=5.0)

    def answer(query: zenoh.Query) -> None:
        for number in range(20):
            query.reply(f"@/f{number:x}/router", b'{"sessions": []}')
        query.reply("@/abc/router", b'{"sessions": [' + b"1," * 2**20 + b"1]}")

    with open_client([endpoint], timeout=DEADLINE) as impostor:
        impostor.declare_queryable("@/*/router", answer)
        wait_for(
            lambda: len(query_routers(zenoh_session, timeout=5.0)) == 21,
            what="the replies of the impostor",
        )
        assert real.zid in {state.zid for state in query_routers(zenoh_session, timeout=5.0)}
        monkeypatch.setattr("nedbus.limits.ROUTERS", 5)
        assert len(query_routers(zenoh_session, timeout=5.0)) == 5


def test_doctor_warns_from_80_percent_of_the_session_limit(limited: str) -> None:
    """The doctor warns from 80 % of the session limit, and counts its own session."""
    with ExitStack() as stack:
        for _ in range(6):
            stack.enter_context(open_client([limited], timeout=5.0))
        finding = router_finding(limited, "7 of 10 sessions")
        assert (finding.state, finding.advice) == ("ok", "")
        stack.enter_context(open_client([limited], timeout=5.0))
        finding = router_finding(limited, "8 of 10 sessions")
        assert finding.state == "warning"
        assert "max_sessions" in finding.advice
        assert "docs/hosts.md" in finding.advice


def test_doctor_does_not_warn_about_unknown_session_limit(tmp_path: Path) -> None:
    """The doctor does not warn if `metadata` has no limit, or if the admin space is disabled."""
    where = free_endpoint()
    for metadata in (["a", "list"], "mine"):
        with open_router(config_file=write_config(tmp_path, where, metadata=metadata)):
            assert [state.max_sessions for state in router_states(where)] == [None]
            assert router_finding(where, "connected sessions: 1").state == "ok"
    with open_router(config_file=write_config(tmp_path, where, adminspace={"enabled": False})):
        assert (
            router_finding(
                where, "connected; its other sessions are not visible to this client"
            ).state
            == "ok"
        )


def test_service_metrics_have_the_session_limit_of_its_router(tmp_path: Path) -> None:
    """/metrics has the sessions and the limit of an embedded router, but no limit in a client service."""
    where = free_endpoint()
    daemon = Daemon(
        load_settings(source=("sim:",), router_config=write_config(tmp_path, where)), version="0"
    )

    def shows(text: str, daemon: Daemon = daemon) -> bool:
        return text in service_pages(daemon)["/metrics"]().content.decode()

    with in_thread(daemon.run, stop=daemon.stop):
        wait_for(daemon.ready.is_set, what="the service")
        with open_client([where], timeout=5.0):
            wait_for(lambda: shows('nedbus_sessions{role="router"} 1.0\n'), what="the session")
        assert shows('nedbus_sessions_max{role="router"} 10.0\n')
        client = Daemon(load_settings(source=("sim:",), connect=(where,)), version="0")
        assert not shows("nedbus_sessions_max{", client)


@contextmanager
def exporting(bus: nedbus.Bus) -> Iterator[Callable[..., bool]]:
    """Run an exporter, and yield a function that checks its router metrics for given lines."""
    exporter = Exporter(bus, nedbus.Selection(), version="0")

    def shows(*wanted: str) -> bool:
        text = exporter.pages["/metrics"]().content.decode()
        return all(f"nedbus_router_{each}" in text for each in wanted)

    assert not shows("sessions{")
    stop = threading.Event()
    with in_thread(exporter.run, stop, stop=stop.set):
        yield shows


def test_exporter_metrics_have_sessions_and_limits_of_routers(
    limited: str, monkeypatch: pytest.MonkeyPatch, timings: Timings
) -> None:
    """The exporter queries routers periodically, and exports the metrics of a limited number of routers."""
    timings.routers_interval = 0.05
    with nedbus.connect(limited) as bus, exporting(bus) as shows:
        (state,) = router_states(limited)
        label = f'{{router="{state.zid}"}}'
        wait_for(
            lambda: shows(f"sessions{label} 2.0\n", f"sessions_max{label} 10.0\n"),
            what="the exporter's sessions",
        )
        with open_client([limited], timeout=5.0):
            wait_for(lambda: shows(f"sessions{label} 3.0\n"), what="another session")
        wait_for(lambda: shows(f"sessions{label} 2.0\n"), what="its close")
        monkeypatch.setattr(limits, "EXPORTED_ROUTERS", 0)
        wait_for(lambda: not shows(f"sessions{label}"), what="no router")


@pytest.mark.slow
def test_exporter_retries_while_the_router_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, timings: Timings
) -> None:
    """If a router has no free session for queries, the exporter retries until one is available."""
    timings.routers_interval = 0.05
    timings.routers_session = 0.1
    where, attempts, original = free_endpoint(), [], nedbus.Bus.open_session

    def count(bus: nedbus.Bus, *, timeout: float) -> Session:
        attempts.append(timeout)
        return original(bus, timeout=timeout)

    monkeypatch.setattr(nedbus.Bus, "open_session", count)
    file = write_config(tmp_path, where, transport={"unicast": {"max_sessions": 2}})
    with (
        open_router(config_file=file),
        nedbus.connect(where) as bus,
        open_client([where], timeout=5.0) as last,
        exporting(bus) as shows,
    ):
        wait_for(lambda: len(attempts) > 1, what="a second attempt")
        assert not shows("sessions{")
        last.close()
        wait_for(lambda: shows("sessions{"), what="a free session")


def test_exporter_stops_during_an_unanswered_query(limited: str, timings: Timings) -> None:
    """The exporter stops without waiting for pending replies, because the exit timeout after a signal is shorter."""
    timings.routers_timeout = 10 * DEADLINE
    queries: list[zenoh.Query] = []
    with open_client([limited], timeout=5.0) as silent, nedbus.connect(limited) as bus:
        silent.declare_queryable(f"@/{ZID}/router", queries.append)
        with exporting(bus):
            wait_for(lambda: queries, what="the query")
            begin = time.monotonic()
        assert time.monotonic() - begin < DEADLINE


@pytest.mark.slow
def test_connect_error_names_the_session_limit_of_a_full_router(tmp_path: Path) -> None:
    """ConnectError and the doctor name the session limit; a client can connect once another session closes."""
    endpoint = free_endpoint()
    unicast = {"unicast": {"max_sessions": 1}}
    with open_router(config_file=write_config(tmp_path, endpoint, transport=unicast)):
        with open_client([endpoint], timeout=5.0):
            with pytest.raises(
                nedbus.ConnectError, match=r"at its session limit .*'nedbus doctor'"
            ):
                nedbus.connect(endpoint, timeout=0.1)
            *_, finding = check_endpoint(endpoint, None)
            assert (finding.state, "max_sessions" in finding.advice) == ("wrong", True)
        nedbus.connect(endpoint, timeout=DEADLINE).close()


class FakeResource:
    """Replacement for the module `resource` with fake limits."""

    RLIMIT_NOFILE, RLIM_INFINITY = resource.RLIMIT_NOFILE, resource.RLIM_INFINITY

    def __init__(self, soft: int, hard: int, *, refused: bool = False) -> None:
        self.limits = soft, hard
        self._refused = refused

    def getrlimit(self, which: int) -> tuple[int, int]:
        assert which == self.RLIMIT_NOFILE
        return self.limits

    def setrlimit(self, _: int, limits: tuple[int, int]) -> None:
        if self._refused:
            raise PermissionError
        self.limits = limits


@pytest.mark.parametrize(
    ("fake", "soft", "warns"),
    [
        (FakeResource(1024, 500_000), 500_000, False),
        (FakeResource(1024, resource.RLIM_INFINITY), resource.RLIM_INFINITY, False),
        (FakeResource(20_000, 20_000), 20_000, False),
        (
            FakeResource(resource.RLIM_INFINITY, resource.RLIM_INFINITY),
            resource.RLIM_INFINITY,
            False,
        ),
        (FakeResource(1024, 1500), 1500, False),
        (FakeResource(256, 1024), 1024, True),
        (FakeResource(256, 4096, refused=True), 256, True),
    ],
    ids=["raised", "no hard limit", "enough", "none", "just enough", "too low", "refused"],
)
def test_soft_limit_of_open_files_is_raised(
    fake: FakeResource,
    soft: int,
    warns: bool,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The soft limit is raised to the hard limit; a warning is logged if the hard limit is too low."""
    monkeypatch.setattr(router, "resource", fake)
    with caplog.at_level(logging.WARNING):
        raise_file_limit(1000)
    assert fake.limits[0] == soft
    assert bool(caplog.records) is warns
    if warns:
        assert f"the limit of {soft} open files allows about {soft - 100} sessions" in caplog.text


LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_NOFILE, (int(sys.argv.pop(1)), int(sys.argv.pop(1))))
from nedbus.cli import main
main()
"""


@pytest.mark.slow
def test_router_accepts_more_sessions_than_the_soft_limit(start: Start) -> None:
    """With `ulimit -S -n 64` a router accepts 100 sessions, each with an open file."""
    where, hard = free_endpoint(), resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    router = start("-c", LIMITED, "64", str(hard), "router", "--listen", where)
    with ExitStack() as sessions:
        for _ in range(100):
            sessions.enter_context(open_client([where], timeout=DEADLINE))
        assert len(list(Path(f"/proc/{router.popen.pid}/fd").iterdir())) > 100
    assert "open files" not in router.err


@pytest.mark.slow
def test_router_warns_if_the_hard_limit_is_too_low(start: Start) -> None:
    """With a hard limit of 300 open files a router starts, and logs the number of sessions that fit."""
    router = start("-c", LIMITED, "300", "300", "router", "--listen", free_endpoint())
    wait_for(lambda: "router on" in router.err, what="the router")
    assert "the limit of 300 open files allows about 200 sessions" in router.err
