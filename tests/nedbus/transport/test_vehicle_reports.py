"""Reports about a vehicle through a secure router: only its own certificate may write them.

The peers are a real zenohd with the shipped access rules, real certificates of two vehicles, and two real services.
"""

from __future__ import annotations

import itertools
import json
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Final

import pytest
import zenoh

import nedbus
from nedbus.client import StreamHealth
from nedbus.pki import write_access_rules
from nedbus.transport import Session, open_client, query, token_keys
from nedbus.web.server import LiveFleet
from nedbus_msgs import Selection, ack_key
from tests.flights.messages import VLP
from tests.peers.certificates import (
    client_tls,
    pki,
    secure_endpoint,
    tls_options,
    tls_settings,
    write_config,
)
from tests.peers.command_line import CommandResult, run_command
from tests.peers.http_client import HttpClient
from tests.peers.ports import free_port
from tests.peers.processes import Process, Start
from tests.peers.queryables import answer_queries, reply_with
from tests.peers.zenohd import start_zenohd
from tests.waits import DEADLINE, wait_for

__all__ = ["pki"]

INVALID: Final = {
    "timestamp": 1, "xy_valid": False, "z_valid": True, "v_xy_valid": False, "v_z_valid": True,
    "x": 0.0, "y": 0.0, "z": -2.0, "vx": 0.0, "vy": 0.0, "vz": 0.0, "heading": 0.0,
}  # fmt: skip
FORGED_EVENT: Final = {
    "vehicle": "2", "kind": "failsafe", "change": "begin", "severity": "bad", "text": "forged failsafe", "time": 1e9,
}  # fmt: skip
UNREAD: Final = """
import sys, nedbus
with nedbus.connect() as bus:
    kept = bus.rejections(), bus.subscribe("*", mode="every")
    print("ready", flush=True)
    for sample in bus.subscribe("vehicle_attitude"):
        print(sample.message.timestamp, flush=True)
"""
"""A script that never reads the rejections and the messages to which it subscribes; it prints when it is reached."""
HEALTHY: Final = {
    "severity": "info",
    "text": "ok",
    "has_position": True,
    "topics": [VLP],
    "first": 1e9,
}


class Fleet:
    """A zenohd with the rules of two vehicles; `forge`: let vehicle 1 answer for every service it may or may not."""

    def __init__(self, endpoint: str, pki: Path, opened: ExitStack) -> None:
        self.endpoint, self._pki, self._opened = endpoint, pki, opened

    def session(self, name: str) -> Session:
        return self._opened.enter_context(
            open_client([self.endpoint], tls=client_tls(self._pki, name), timeout=DEADLINE)
        )

    def bus(self, name: str) -> nedbus.Bus:
        tls = client_tls(self._pki, name)
        return self._opened.enter_context(nedbus.connect(self.endpoint, tls=tls, timeout=DEADLINE))

    def run(self, *arguments: str) -> CommandResult:
        return run_command(
            *arguments, "--wait", "-c", self.endpoint, *tls_options(self._pki, "reader")
        )

    def options(self, name: str) -> list[str]:
        return ["-c", self.endpoint, *tls_options(self._pki, name)]

    @contextmanager
    def forging(self, *services: str, refused: Sequence[str] = ()) -> Iterator[None]:
        """Answer as vehicle 1 on its own key, on those of vehicle 2, and on keys without a vehicle, about vehicle 2."""
        session = self.session("vehicle-1")
        health = replace(StreamHealth(VLP).snapshot(), age=0.0, messages=9, usual_interval=1e9)
        source = {
            "source": "sim:", "state": "running", "addresses": [f"2/{VLP}"],
            "streams": [{"address": f"2/{VLP}", "health": asdict(health)}], "log_streams": [{"vehicle": "2"}],
        }  # fmt: skip
        # That the router refuses vehicle 2 must not let it report anything else about vehicle 2.
        status = {
            "host": socket.gethostname(), "version": nedbus.__version__, "refused": refused, "sources": [source],
        }  # fmt: skip
        with ExitStack() as answering:
            for service in ("x", *services):
                for where in ("1/", "2/", ""):
                    key = f"nedbus/@service/{where}{service}/status"
                    answering.enter_context(answer_queries(session, key, _reply(key, status)))
            yield


def _reply(key: str, status: Mapping[str, object]) -> Callable[[zenoh.Query], None]:
    def reply(asked: zenoh.Query) -> None:
        now = 2e9
        report = {
            "service": "x",
            "host": "h",
            "now": now,
            "vehicles": {"2": HEALTHY},
            "events": [FORGED_EVENT],
        }
        is_report = asked.parameters.get("events") is not None
        asked.reply(key, json.dumps(report if is_report else status), encoding="application/json")

    return reply


@pytest.fixture
def fleet(pki: Path, tmp_path: Path, start: Start) -> Iterator[Fleet]:
    """Run a zenohd that allows vehicles 1 and 2."""
    endpoint = secure_endpoint()
    file = write_config(pki, tmp_path / "router-secure.json5", endpoint)
    write_access_rules(file, ["1", "2"])
    start_zenohd(start, "-c", str(file))
    with ExitStack() as opened:
        yield Fleet(endpoint, pki, opened)


def service_of(bus: nedbus.Bus, vehicle: str) -> str | None:
    """Return the id of the service that reports a vehicle as published."""
    statuses = (
        each
        for each in bus.services()
        if each.vehicle == vehicle and any(s.addresses for s in each.sources)
    )
    return next((each.service for each in statuses), None)


@pytest.mark.slow
@pytest.mark.process
def test_health_of_a_vehicle_depends_on_its_own_certificate(fleet: Fleet) -> None:
    """`health --expect 2 --valid xy` fails while xy of vehicle 2 is invalid, whatever vehicle 1 reports about it."""
    publisher = fleet.bus("vehicle-2").publisher(VLP, vehicle="2")
    publisher.publish(INVALID)
    with fleet.forging():
        result = fleet.run("health", "--expect", "2", "--valid", "xy", "--max-age", "600")
        assert result.exit_code == 1, result.out
        assert "vehicle 2: xy not valid" in result.err
        result = fleet.run("health", "--expect", "2", "--max-age", "600")
        assert result.exit_code == 0, result.err
        assert "service x on" in result.err  # an older one: named, but no fault of vehicle 2
        publisher.close()
        result = fleet.run("health", "--expect", "2", "--max-age", "600")
        assert result.exit_code == 1, result.out
        assert "vehicle 2 is missing" in result.err


@pytest.mark.slow
@pytest.mark.process
def test_claimed_refusal_lets_no_vehicle_report_about_another(fleet: Fleet) -> None:
    """A service of vehicle 1 that reports vehicle 2 as refused measures no stream of vehicle 2: it is stale in `list`.

    `health --vehicle 2` asks vehicle 2, and goes by the age of its answer.
    """
    with fleet.bus("vehicle-2").publisher(VLP, vehicle="2") as publisher:
        publisher.publish(INVALID)
        with fleet.forging(refused=["2"]):
            reader = fleet.bus("reader")
            wait_for(
                lambda: [each for each in reader.services() if each.refused == ("2",)],
                what="the forged status",
            )
            assert [each.own_streams for each in reader.services()] == [[], []]
            # 3 s without a message make the stream stale; the forged interval of years would not.
            wait_for(lambda: "stale" in fleet.run("list").out, what="a stale stream of vehicle 2")
            assert fleet.run("health", "-v", "2", "--max-age", "0.5").exit_code == 1
            assert "ULog stream of vehicle 2" not in fleet.run("info").out


@pytest.mark.slow
@pytest.mark.process
def test_events_and_verdicts_of_a_vehicle_are_its_own(fleet: Fleet, run_nedbus: Start) -> None:
    """`why -v 2`, `events` and the page show what the service of vehicle 2 reports, and nothing of vehicle 1."""
    run_nedbus("serve", *fleet.options("vehicle-2"), "--vehicle", "2", "-s", "sim:")
    reader = fleet.bus("reader")
    wait_for(lambda: service_of(reader, "2"), what="the service of vehicle 2")
    service = service_of(reader, "2")
    assert service is not None
    with fleet.forging(service):
        # What the page, `events` and `why` show.
        reports: list[nedbus.health.AccountReport] = []

        def has_reports() -> bool:
            reports[:] = reader.accounts(within=1e9)
            return any(report.vehicles for report in reports)

        wait_for(has_reports, what="the report about vehicle 2")
        assert {name for report in reports for name in report.vehicles} == {"2"}
        assert {report.service for report in reports if report.vehicles} == {service}
        assert "forged" not in str(reports)
        assert "forged" not in fleet.run("events", "--within", "1e9", "--duration", "1").out
        assert "forged" not in fleet.run("why", "-v", "2").out
        page = LiveFleet(reader, Selection(), version="0")
        assert "forged" not in str(page.timeline.events)


@pytest.mark.process
def test_vehicle_without_a_service_has_no_forged_verdict(fleet: Fleet) -> None:
    """`why -v 2` says that no service reports vehicle 2, although vehicle 1 reports that it has no faults."""
    with fleet.forging():
        result = fleet.run("why", "-v", "2")
    assert result.exit_code != 0
    assert "no faults" not in result.out


@pytest.mark.slow
@pytest.mark.process
def test_refusal_cannot_be_hidden_by_another_vehicle(fleet: Fleet, run_nedbus: Start) -> None:
    """A service that is refused for vehicle 3 stays so in `info`, whatever vehicle 1 reports under its id."""
    run_nedbus(
        "serve", *fleet.options("vehicle-2"), "--vehicle", "2", "-s", "sim:", "-s", "sim:?vehicle=3"
    )
    reader = fleet.bus("reader")

    def refused() -> list[str]:
        return [each.service for each in reader.services() if "3" in each.refused]

    wait_for(refused, what="the refusal of vehicle 3")
    with fleet.forging(refused()[0]):
        for _ in range(3):
            assert refused()
        assert "vehicles refused by the router: 3" in fleet.run("info").out


@pytest.mark.slow
@pytest.mark.process
def test_older_service_is_named_but_not_believed(fleet: Fleet) -> None:
    """A service whose status key names no vehicle is named by health, info, list, why and the doctor.

    `why` also names the vehicles that only such a service could report.
    """
    session, key = fleet.session("vehicle-1"), "nedbus/@service/old-1/status"
    status = {
        "host": "flyer",
        "version": "0.1.0",
        "sources": [{"source": "sim:", "addresses": [f"2/{VLP}"]}],
    }
    with answer_queries(session, key, _reply(key, status)):
        [found] = fleet.bus("reader").services()
        assert (found.service, found.host, found.version, found.sources) == (
            "old-1",
            "flyer",
            "0.1.0",
            (),
        )
        health = fleet.run("health", "--services", "1")
        assert health.exit_code == 1
        assert "service old-1 on flyer runs nedbus 0.1.0" in health.err
        assert "service old-1 on flyer, nedbus 0.1.0" in fleet.run("info").out
        assert "old-1, which is older" in fleet.run("list").err
        with fleet.bus("vehicle-1").publisher(VLP, vehicle="1") as publisher:
            publisher.publish(INVALID)
            assert "service old-1 on flyer runs nedbus 0.1.0" in fleet.run("why", "-v", "1").err
        doctor = run_command("doctor", *fleet.options("reader")).out
        assert "nedbus 0.1.0 on flyer: its status does not name its vehicle" in " ".join(
            doctor.split()
        )


@pytest.mark.slow
@pytest.mark.process
def test_vehicle_without_reports_is_named_beside_others(fleet: Fleet, run_nedbus: Start) -> None:
    """`why` names a vehicle that only an older service reports, after the verdicts on all others; many in one line."""
    run_nedbus("serve", *fleet.options("vehicle-2"), "--vehicle", "2", "-s", "sim:")
    reader = fleet.bus("reader")
    wait_for(lambda: service_of(reader, "2"), what="the service of vehicle 2")
    statuses = {
        f"nedbus/@service/old-{number}/status": b'{"host": "h", "version": "0.1.0"}'
        for number in range(30)
    }
    session = fleet.session("vehicle-1")
    with (
        fleet.bus("vehicle-1").publisher(VLP, vehicle="1") as publisher,
        answer_queries(session, "nedbus/@service/*/status", reply_with(statuses)),
    ):
        publisher.publish(INVALID)
        result = fleet.run("why")
        assert result.exit_code == 0
        assert result.out.startswith("2: ")
        assert (
            "no verdict on 1: published, but no nedbus service keeps the event history"
            in result.err
        )
        assert "10 more older services" in result.err
        assert len(fleet.run("health", "--expect", "2").err.splitlines()) == 21


@pytest.mark.process
@pytest.mark.parametrize(
    "key",
    [f"nedbus/2/{VLP}", f"nedbus/2/{VLP}/@rate/5", f"nedbus/2/{VLP}/@adv/pub/1a/1/_", f"nedbus/@rejected/2/{VLP}",
     "nedbus/2/@doctor/1a"],
)  # fmt: skip
def test_other_certificates_cannot_put_on_keys_of_a_vehicle(fleet: Fleet, key: str) -> None:
    """A put of vehicle 1, a reader, an operator or a stranger on a key of vehicle 2 reaches no reader.

    Neither does one of vehicle 1 on a key expression that includes the key; a later one of vehicle 2 does.
    """
    two = fleet.session("vehicle-2")
    others = [fleet.session(name) for name in ("vehicle-1", "reader", "operator", "stranger")]
    subscriber = fleet.session("reader").declare_subscriber(key, zenoh.handlers.RingChannel(10))
    received: list[bytes] = []

    def is_received() -> bool:
        for other in others:
            other.put(key, b"1")
            other.put(key.replace("2", "*", 1), b"1")
        two.put(key, b"2")
        received.extend(
            sample.payload.to_bytes() for sample in iter(subscriber.handler.try_recv, None)
        )
        return len(received) > 2

    wait_for(is_received, what="the messages of vehicle 2")
    assert set(received) == {b"2"}


@pytest.mark.process
def test_vehicle_cannot_answer_or_announce_for_another(fleet: Fleet) -> None:
    """Vehicle 1 can neither answer queries on keys of vehicle 2 nor declare its liveliness tokens.

    Its answer on its own key cannot carry a key of vehicle 2, or one that includes it, either.
    """
    one, reader = fleet.session("vehicle-1"), fleet.session("reader")
    keys = ("nedbus/@schema/2/VehicleAttitude", "nedbus/@service/2/x/status", f"nedbus/2/{VLP}")
    own = "nedbus/@service/1/x/status"
    token = one.liveliness().declare_token(f"nedbus/2/@alive/1a/{VLP}")
    with ExitStack() as answering:
        for key in (*keys, own):
            answering.enter_context(answer_queries(one, key, _reply(key, {})))
        wait_for(lambda: query(reader, own, timeout=DEADLINE), what="the reply on its own key")
        assert [query(reader, key, timeout=1.0) for key in keys] == [[], [], []]
    carried = {"nedbus/@service/2/x/status": b"{}", "nedbus/@service/*/x/status": b"{}", own: b"{}"}
    with answer_queries(one, own, reply_with(carried)):
        replies = query(reader, "nedbus/@service/**/status", timeout=DEADLINE)
        assert [str(reply.key_expr) for reply in replies] == [own]
    assert token_keys(reader, "nedbus/2/@alive/**", timeout=1.0) == []
    del token


@pytest.mark.process
def test_only_readers_acknowledge(fleet: Fleet) -> None:
    """A query for the acknowledgements of vehicle 1 is answered by readers, and not by another vehicle."""
    one, two, reader = (
        fleet.session("vehicle-1"),
        fleet.session("vehicle-2"),
        fleet.session("reader"),
    )
    key = ack_key(f"nedbus/1/{VLP}")
    with (
        answer_queries(two, key, reply_with({key: b"2"})),
        answer_queries(reader, key, reply_with({key: b"reader"})),
    ):

        def answers() -> list[bytes]:
            return [reply.payload.to_bytes() for reply in query(one, key, timeout=DEADLINE)]

        wait_for(answers, what="the reply of the reader")
        assert answers() == [b"reader"]


@pytest.mark.process
def test_only_the_refusal_of_another_vehicle_is_believed(fleet: Fleet) -> None:
    """Vehicle 1 can report that the router refuses vehicle 2, which no vehicle could report itself."""
    session, key = fleet.session("vehicle-1"), "nedbus/@service/1/x/status"
    status = {"host": "flyer", "version": nedbus.__version__, "refused": ["2"], "sources": []}
    with answer_queries(session, key, _reply(key, status)):
        assert "vehicles refused by the router: 2" in fleet.run("info").out
        reports = fleet.bus("reader").accounts(within=1e9)
        assert [(report.vehicles, report.events) for report in reports] == [({}, ())]


@pytest.mark.slow
@pytest.mark.process
def test_service_of_several_vehicles_has_a_certificate_that_says_so(
    pki: Path, tmp_path: Path, start: Start, run_nedbus: Start
) -> None:
    """A policy that names two vehicles lets one certificate publish both, and report about both."""
    endpoint = secure_endpoint()
    file = write_config(pki, tmp_path / "router-secure.json5", endpoint)
    write_access_rules(file, ["1", "2"])
    rules = '["vehicle-1-in", "vehicle-2-in", "vehicle-out", "query-in", "query-out"]'
    subject, policy = '{ id: "routers",', '{ rules: ["router"],'
    text = file.read_text().replace(
        subject, f'{{ id: "link", cert_common_names: ["stranger"] }},\n{subject}'
    )
    file.write_text(text.replace(policy, f'{{ rules: {rules}, subjects: ["link"] }},\n{policy}'))
    start_zenohd(start, "-c", str(file))
    with ExitStack() as opened:
        fleet = Fleet(endpoint, pki, opened)
        run_nedbus(
            "serve", *fleet.options("stranger"), "-s", "sim:?vehicle=1", "-s", "sim:?vehicle=2"
        )
        reader = fleet.bus("reader")
        wait_for(
            lambda: service_of(reader, "1") and service_of(reader, "2"),
            what="the reports about both vehicles",
        )
        assert service_of(reader, "1") == service_of(reader, "2")
        assert fleet.run("health", "--expect", "1,2").exit_code == 0


def peak_memory(process: Process) -> int:
    """Return the largest resident memory of a process so far [kB]."""
    status = Path(f"/proc/{process.popen.pid}/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0])


@pytest.mark.long
def test_flood_of_reports_and_heartbeats_takes_little_memory(
    fleet: Fleet, pki: Path, start: Start, run_nedbus: Start
) -> None:
    """Puts of vehicle 1 on its @rejected and @adv keys let no reader need 1.5 times its memory at rest.

    The readers are a script that reads nothing, the exporter and the page. The puts are as large as the router's rules
    and the readers' own limits allow, and larger.
    """
    http = [HttpClient(free_port()) for _ in range(2)]
    tls = {
        f"NEDBUS_{name.upper()}": str(path) for name, path in tls_settings(pki, "reader").items()
    }
    script = start("-c", UNREAD, NEDBUS_CONNECT=fleet.endpoint, coverage=False, **tls)
    readers = [script, *(
        run_nedbus(command, "--wait", *fleet.options("reader"), "--http", client.where, coverage=False)
        for command, client in zip(("export", "web"), http, strict=True)
    )]  # fmt: skip
    vehicle = fleet.bus("vehicle-1")
    attitude = vehicle.publisher("vehicle_attitude", vehicle="1")
    timestamps = itertools.count(1)

    def received() -> list[float]:
        """Return how many messages each reader has received."""
        counts = [
            sum(client.values("nedbus_messages_received_total", topic="vehicle_attitude"))
            for client in http
        ]
        return [len(script.out.split()), *counts]

    def reach_all() -> None:
        """Publish messages until each reader has received one, and so all that was put before."""
        before = received()

        def are_reached() -> bool:
            attitude.publish({"timestamp": next(timestamps), "q": (1.0, 0.0, 0.0, 0.0)})
            return all(now > earlier for now, earlier in zip(received(), before, strict=True))

        wait_for(are_reached, what="all readers")

    wait_for(lambda: "ready" in script.out, what="the script")
    for _ in range(3):
        reach_all()
    rest = [peak_memory(process) for process in readers]
    session, block = vehicle._session, zenoh.CongestionControl.BLOCK
    report, heartbeat = f"nedbus/@rejected/1/{VLP}", f"nedbus/1/{VLP}/@adv/pub/1a/1/_"
    reason = json.dumps({"reason": "x" * 16_000}).encode()
    for _ in range(4):
        for _ in range(1500):
            session.put(report, reason, congestion_control=block)
            for size in (64, 4, 65, 16_384):
                session.put(heartbeat, bytes(size), congestion_control=block)
        session.put(report, bytes(2**20 - 1000), congestion_control=block)
        reach_all()
    peaks = [peak_memory(process) for process in readers]
    assert [peak < 1.5 * least for peak, least in zip(peaks, rest, strict=True)] == [
        True,
        True,
        True,
    ], (rest, peaks)


@pytest.mark.process
def test_zenohd_logs_certificate_and_key_of_a_denial(
    pki: Path, tmp_path: Path, start: Start
) -> None:
    """At the level that docs/security.md names, a real zenohd logs who was denied what; the doctor adds the rule."""
    endpoint = secure_endpoint()
    file = write_config(pki, tmp_path / "router-secure.json5", endpoint)
    level = "zenoh::net::routing::interceptor::access_control=trace"
    zenohd = start_zenohd(start, "-c", str(file), RUST_LOG=f"info,{level}")
    with open_client([endpoint], tls=client_tls(pki, "vehicle-1"), timeout=DEADLINE) as session:
        session.put(f"nedbus/2/{VLP}", b"")

        def denials() -> list[str]:
            lines = (zenohd.out + zenohd.err).splitlines()
            return [line for line in lines if "unauthorized" in line and f"nedbus/2/{VLP}" in line]

        wait_for(denials, what="the denial in the log")
    assert "vehicle-1" in denials()[0]
