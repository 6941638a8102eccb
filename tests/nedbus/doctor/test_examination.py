"""`nedbus doctor`: every wrong state is caused for real, and found; certificates and routers are real ones."""

from __future__ import annotations

import datetime as dt
import json
import math
import re
import socket
import ssl
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import zenoh
from pymavlink.dialects.v20 import common as mavlink

import nedbus
from nedbus.client import QueryServer
from nedbus.doctor import Finding, State, examine
from nedbus.pki import Certificate
from nedbus.settings import load_settings
from nedbus.timings import TIMINGS, Timings
from nedbus.transport import NO_HASH, Session, TopicKey, open_client, open_router
from nedbus_msgs import dds_type, status_key
from tests.flights.local_position import ROS2_TYPE, encode
from tests.flights.messages import VALID, VLP, message
from tests.flights.ulogs import write_log
from tests.peers.certificates import files_of, pki, secure_endpoint, tls_of, write_config
from tests.peers.command_line import run_command
from tests.peers.ports import free_endpoint, free_port
from tests.peers.processes import Start
from tests.waits import DEADLINE, repeating, wait_for

__all__ = ["pki"]

HOUR = 3600.0


@pytest.fixture(autouse=True)
def _listen_shortly(timings: Timings) -> None:
    """Listen for a shorter time than a person would: `look` says how long."""
    timings.min_listen, timings.tls_alert, timings.listen = 0.1, 0.1, 0.5


def look(*endpoints: str, tls: Mapping[str, Path] | None = None, listen: float = 0.1, **options: Any) -> list[Finding]:
    """Examine with these settings. `listen`: longer where something has to arrive; answers are there before."""
    settings = load_settings(None, connect=endpoints, **(tls or {}))
    TIMINGS.listen = listen
    return examine(settings, version=nedbus.__version__, **options)


def found(findings: list[Finding], check: str, state: State, text: str) -> Finding:
    """Return the finding of a check in this state whose words match; fail with all of them if there is none."""
    for each in findings:
        if (each.check, each.state) == (check, state) and re.search(text, f"{each.subject}: {each.seen}"):
            return each
    pytest.fail(f"{check} {state} {text!r} is not in\n" + "\n".join(map(str, findings)))


def hear(endpoint: str, *texts: str) -> list[Finding]:
    """Examine, each time for twice as long, until all of these are found: on a busy machine what arrives is late."""
    findings, listen = list[Finding](), 0.5
    while not all(any(re.search(text, f"{each.subject}: {each.seen}") for each in findings) for text in texts):
        assert listen < DEADLINE, findings
        findings, listen = look(endpoint, listen=listen), 2 * listen
    return findings


def is_well(findings: list[Finding]) -> bool:
    return all(each.state != "wrong" for each in findings)


@contextmanager
def flying(bus: nedbus.Bus, *vehicles: str) -> Iterator[None]:
    """Publish these vehicles, or vehicle 1."""
    publishers = [bus.publisher(VLP, vehicle=each) for each in vehicles or "1"]

    def publish() -> None:
        for publisher in publishers:
            publisher.publish(message(time.time_ns()))

    with repeating(publish):
        yield
    for publisher in publishers:
        publisher.close()


@contextmanager
def reporting(session: Session, name: str = "imitation", *, offset: float = 0.0, **status: object) -> Iterator[None]:
    """Answer as a service with this status does, whose clock is ahead by this many seconds."""
    server = QueryServer(session)
    known = {"service": name, "host": "elsewhere", "version": nedbus.__version__, "sources": []}
    server.answer_json(
        status_key(name), lambda _: [json.dumps({"now": time.time() + offset, **known, **status}).encode()]
    )
    with closing(server):
        yield


def source(**fields: object) -> dict[str, object]:
    return {"source": "mavlink:x", "state": "running", "addresses": [], "stale": [], "rejected": 0, **fields}


def test_nothing_listens(endpoint: str) -> None:
    """A refused connection is told from a name without address; where another router answers it is a warning only."""
    refused = free_endpoint()
    findings = look(refused, "tcp/no-such-host.invalid:7447", "tcp/a..b:7447")
    assert "nedbus serve" in found(findings, "endpoint", "wrong", f"{refused}: connection refused").advice
    found(findings, "endpoint", "wrong", "cannot resolve host name no-such-host")
    found(findings, "endpoint", "wrong", r"cannot resolve host name a\.\.b")
    findings = look(refused, endpoint)
    found(findings, "endpoint", "warning", "connection refused")
    found(findings, "endpoint", "ok", "a Zenoh router answers")


def test_check_that_raises(endpoint: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """An unexpected error of a check is its finding, with the error; it is not taken for a slow network."""

    def fail(*_: object) -> list[Finding]:
        raise ZeroDivisionError("by nothing")

    monkeypatch.setattr("nedbus.doctor.examination.check_endpoint", fail)
    failed = found(look(endpoint), "endpoint", "unknown", "check failed: unexpected ZeroDivisionError: by nothing")
    assert "a bug in nedbus" in failed.advice
    assert "Traceback" in caplog.text


def test_what_is_no_router(timings: Timings) -> None:
    """Another server is told from a router and from TLS; one that never answers does not hold up the doctor."""
    timings.doctor_open = timings.handshake = 0.2
    with ThreadingHTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as server:
        thread = threading.Thread(target=server.serve_forever, args=[0.01])
        thread.start()
        http = f"127.0.0.1:{server.server_address[1]}"
        with socket.create_server(("127.0.0.1", 0)) as silent:
            mute = f"127.0.0.1:{silent.getsockname()[1]}"
            findings = look(*(f"{protocol}/{where}" for protocol in ("tcp", "tls") for where in (http, mute)))
        server.shutdown()
        thread.join(DEADLINE)
    for protocol, reason in (("tcp", "cannot open a Zenoh session"), ("tls", "it does not speak TLS")):
        for where in (http, mute):
            found(findings, "endpoint", "wrong", f"{protocol}/{where}: {reason}")


def test_all_is_well(bus: nedbus.Bus, endpoint: str, raw: Session) -> None:
    """A vehicle that flies is no reason to complain: nothing is wrong, and each check says so."""
    with flying(bus), reporting(raw, sources=[source(addresses=[f"1/{VLP}"])]):
        findings = look(endpoint, vehicle="1", listen=1.0)
    assert is_well(findings), findings
    for check in ("settings", "endpoint", "router", "read", "write", "service", "vehicle", "clock"):
        assert any(each.check == check and each.state == "ok" for each in findings), check


def test_silent_vehicle(bus: nedbus.Bus, endpoint: str) -> None:
    """A vehicle with a token that sends nothing is found, with the age of its last; one asked for must exist."""
    bus.publisher(VLP, vehicle="mute")
    bus.publisher(VLP, vehicle="asleep").publish(message(1))
    findings = look(endpoint)
    found(findings, "vehicle", "warning", r"mute/.*silent for \d+ s: no message yet")
    found(findings, "vehicle", "wrong", r"asleep/.*silent for \d+ s: its last message is \S+ m?s old")
    found(look(endpoint, vehicle="7"), "vehicle", "wrong", "7: not seen under nedbus/")


def test_two_publishers_of_one_address(bus: nedbus.Bus, endpoint: str) -> None:
    """Their tokens are one token: they are told apart by who they are, at rest by the heartbeats of each."""
    with nedbus.connect(endpoint) as other:
        with flying(bus), flying(other):
            found(hear(endpoint, "2 publishers"), "vehicle", "wrong", f"1/{VLP}: 2 publishers")
        for each in (bus, other):
            each.publisher(VLP, vehicle="1").publish(message(1))
        found(hear(endpoint, "2 publishers"), "vehicle", "wrong", f"1/{VLP}: 2 publishers")


def test_payload_that_is_no_message(raw: Session, endpoint: str) -> None:
    """It is found, with the decoder's reason; another layout is named as such."""

    def publish() -> None:
        raw.put(f"nedbus/1/{VLP}", b"junk")
        raw.put(f"nedbus/2/{VLP}", b"\x92\x63\x01")  # an array: layout 99, and one value

    with repeating(publish):
        findings = hear(endpoint, "1/.*: cannot decode", "2/.*: cannot decode")
    found(findings, "vehicle", "wrong", f"1/{VLP}: cannot decode a payload")
    found(findings, "vehicle", "wrong", f"2/{VLP}: cannot decode a payload: .*layout 99")


@pytest.mark.parametrize(
    ("clocks", "text", "advice"),
    [
        ({"ahead": HOUR}, "service ahead on elsewhere: .* 60 min ahead of this host's", "either of the two"),
        ({"ahead": HOUR, "right": 0.0}, "service ahead", "set this one"),
        ({"first": -HOUR, "second": -HOUR}, "this host's clock is 60 min ahead of 2 others", "run NTP"),
    ],
    ids=["of a service", "of one service", "of this host"],
)
def test_clock_that_is_off(raw: Session, endpoint: str, clocks: Mapping[str, float], text: str, advice: str) -> None:
    """Of two clocks nobody can tell which is right; of three the one that is alone is not, this host's perhaps."""
    with ExitStack() as services:
        for name, offset in clocks.items():
            services.enter_context(reporting(raw, name, offset=offset))
        assert advice in found(look(endpoint), "clock", "wrong", text).advice


def test_publisher_whose_clock_is_off(raw: Session, endpoint: str) -> None:
    """The timestamps of messages tell as well, without any service."""
    payload = encode(message(1))

    def publish() -> None:
        later = dt.datetime.now(dt.UTC) + dt.timedelta(seconds=HOUR)
        raw.put(f"nedbus/1/{VLP}", payload, timestamp=zenoh.Timestamp(later, b"\x07"))

    with repeating(publish):
        findings = hear(endpoint, "publisher of 1/")
    found(findings, "clock", "wrong", f"publisher of 1/{VLP}: its clock is 60 min ahead of this host's")


def test_what_services_report(raw: Session, endpoint: str) -> None:
    """Sources that fail, wait, lost their vehicle or reject messages are found, the worst of many, and a version is."""
    sources = [
        source(state="failed", error="the disk is gone"),
        source(stale=["9/x"], rejected=7, rejections={"xy_valid": 7}),
        source(source="px4-zenoh:", state="waiting"),
    ]
    with reporting(raw, version="99.1.0", sources=sources):
        findings = look(endpoint)
    found(findings, "source", "wrong", "mavlink:x: failed: the disk is gone")
    found(findings, "source", "warning", "px4-zenoh:: waiting")
    found(findings, "source", "warning", "no more messages of 9/x")
    found(findings, "source", "warning", "7 messages rejected: xy_valid")
    found(findings, "version", "warning", r"nedbus 99\.1\.0 there, ")
    with reporting(raw, sources=[*sources, *50 * [source(state="waiting")]]):
        findings = look(endpoint)
    found(findings, "source", "warning", "more of the same kind")
    found(findings, "source", "wrong", "the disk is gone")


@contextmanager
def remembering(session: Session, name: str, **vehicles: Mapping[str, object]) -> Iterator[None]:
    """Answer as a service does that remembers these vehicles."""
    server = QueryServer(session)
    report = {"service": name, "host": "elsewhere", "now": 10_000.0, "events": [], "vehicles": vehicles}
    server.answer_json(status_key(name), lambda get: [json.dumps(report if get("events") else {}).encode()])
    with closing(server):
        yield


def test_what_services_remember_of_vehicles(raw: Session, endpoint: str) -> None:
    """A bad vehicle is an error, one to be watched a warning; one that is well, or was switched off, is no finding.

    Of two services that remember a vehicle the one counts that hears it. The peers answer as services do.
    """
    silent = {"severity": "bad", "text": "no position", "kinds": ["silent"]}
    with (
        remembering(
            raw,
            "first",
            sick={"severity": "bad", "text": "failsafe", "since": 9990.0, "kinds": ["failsafe"]},
            doubtful={"severity": "watch", "text": "dead reckoning", "since": 9880.0, "kinds": ["dead_reckoning"]},
            well={"severity": "info", "text": "ok"},
            off={**silent, "since": 1.0},
            gone={**silent, "since": 9999.0},
            moved={**silent, "since": 9999.0},
        ),
        remembering(raw, "second", moved={"severity": "info", "text": "ok"}),
    ):
        findings = look(endpoint)
        of_one = look(endpoint, vehicle="doubtful")
    wrong = found(findings, "vehicle", "wrong", r"sick: failsafe, since 02:46:30\.0 UTC \(10\.0 s\)")
    assert wrong.advice.endswith("'nedbus why --vehicle sick'")
    found(findings, "vehicle", "warning", "doubtful: dead reckoning, since .*2 min")
    found(findings, "vehicle", "wrong", "gone: no position")
    assert not [each for each in findings if each.subject in ("well", "off", "moved")]
    assert {each.subject for each in of_one if "nedbus why" in each.advice} == {"doubtful"}


@pytest.mark.parametrize(
    "told",
    [
        {"vehicles": {"7; reboot": {"severity": "bad", "text": "evil"}}},
        {"vehicles": {"7": {"severity": "bad", "text": "evil", "since": math.nan}}},
        {"vehicles": {"7": {"severity": "bad", "text": "evil", "since": -math.inf}}},
        {"vehicles": {"7": {"severity": "bad", "text": "evil"}}, "now": 1e300},
        {"vehicles": {"7": {"severity": "evil", "text": "evil"}}},
        {"vehicles": [7]},
    ],
    ids=["name", "nan", "inf", "now", "severity", "list"],
)
def test_account_that_makes_no_sense(raw: Session, endpoint: str, told: Mapping[str, object]) -> None:
    """Nothing of it is said, and no check is lost; the peer answers in place of a service."""
    server = QueryServer(raw)
    report = {"service": "x", "host": "x", "now": 10_000.0, "events": [], **told}
    server.answer_json(status_key("x"), lambda get: [json.dumps(report if get("events") else {}).encode()])
    with closing(server), reporting(raw, sources=[source(state="failed", error="the disk is gone")]):
        findings = look(endpoint)
    found(findings, "source", "wrong", "the disk is gone")
    assert not [each for each in findings if "evil" in each.seen or "check failed" in each.seen]


def test_vehicle_of_a_real_service_that_is_not_well(run_nedbus: Start, tmp_path: Path) -> None:
    """Events of a vehicle that a service of another process remembers, from a log of this test's, are found."""
    endpoint = free_endpoint()
    log = write_log(tmp_path / "a.ulg", range(100_000, 300_000_000, 100_000), **{**VALID, "xy_valid": False})
    run_nedbus("serve", "--listen", endpoint, "-s", f"ulog:{log}?vehicle=sick")
    with nedbus.connect(endpoint, timeout=DEADLINE) as bus:
        wait_for(lambda: bus.accounts() and bus.accounts()[0].vehicles, what="the vehicle")
    found(look(endpoint), "vehicle", "wrong", "sick: xy not valid, since ")


@pytest.mark.parametrize("now", [10**400, math.nan, -math.inf, True, "noon", None, []], ids=lambda now: str(now)[:5])
def test_status_that_makes_no_sense(raw: Session, endpoint: str, now: object) -> None:
    """A peer may answer anything: what can be understood of it is said, and no other check is lost."""
    states: list[object] = [[], {}, 7, None]
    strange = [source(state=state, stale=5, rejections=[1], addresses={}) for state in states]
    with reporting(raw, now=now, version=[1], host={}, sources=[*strange, 5, source(state="failed", error=["why"])]):
        findings = look(endpoint)
    found(findings, "source", "wrong", "mavlink:x: failed: unknown reason")
    assert not [each for each in findings if "check failed" in each.seen]


def test_keys_that_readers_do_not_look_at(raw: Session, endpoint: str) -> None:
    """Another prefix is found by its tokens or by its messages, a PX4's own keys by its tokens, unless bridged."""
    key = TopicKey(0, f"fmu/out/{VLP}", dds_type(ROS2_TYPE), NO_HASH)
    token = raw.liveliness().declare_token(key.token("MP", "abc", "px4", 1))
    with nedbus.connect(endpoint, prefix="other/fleet") as other, flying(other):
        payload = encode(message(1))
        with repeating(lambda: raw.put(f"third/1/{VLP}", payload)):
            findings = hear(endpoint, "other/fleet", "third")
        found(findings, "prefix", "warning", "other/fleet: .*the prefix here is nedbus/")
        found(findings, "prefix", "warning", "third: .*the prefix here is nedbus/")
        found(findings, "ros2", "warning", f"publishes /fmu/out/{VLP}, but no service bridges it")
        with reporting(raw, sources=[source(source="px4-zenoh:")]):
            assert not [each for each in look(endpoint) if each.check == "ros2"]
    token.undeclare()


def test_failing_source_of_a_real_service(run_nedbus: Start) -> None:
    """The report of a service of another process: in words for people, in JSON for programs, exit code 1."""
    endpoint = free_endpoint()
    service = run_nedbus("serve", "--listen", endpoint, "-s", "sim:", "-s", "ulog:nowhere.ulg")
    wait_for(lambda: "no such file" in service.err, what="the source that fails")
    doctor = run_command("doctor", "-c", endpoint)
    assert doctor.exit_code == 1, doctor.err
    words = " ".join(doctor.out.split())
    assert "wrong source ulog:nowhere.ulg: retrying: nowhere.ulg: no such file or directory" in words
    assert doctor.out.splitlines()[-1].endswith("1 wrong"), doctor.out
    told = run_command("doctor", "-c", endpoint, "--json")
    assert told.exit_code == 1
    report = json.loads(told.out)
    assert report["state"] == report["findings"][-1]["state"] == "wrong"
    assert set(report["findings"][0]) == {"check", "subject", "state", "seen", "advice"}


def test_exit_codes(bus: nedbus.Bus, endpoint: str, raw: Session, run_nedbus: Start) -> None:
    """0 when nothing is wrong, though it may warn; 2 for usage."""
    with flying(bus), reporting(raw, sources=[source(state="waiting")]):
        doctor = run_command("doctor", "-v", "1", NEDBUS_CONNECT=endpoint)
    assert (doctor.exit_code, doctor.out.splitlines()[-1].rpartition(", ")[2]) == (0, "1 warning"), doctor.out
    assert "set by NEDBUS_CONNECT" in " ".join(doctor.out.split())
    for arguments in (["-v", "a/b"], ["--mavlink", "nonsense"], ["--config", "gone.toml"]):
        refused = run_command("doctor", *arguments)
        assert (refused.exit_code, refused.err.count("\n")) == (2, 1), refused.err
    process = run_nedbus("doctor", "-c", "nonsense")
    assert (process.wait(), process.err.count("\n")) == (2, 1), process.err


def test_what_peers_send_is_harmless(raw: Session, endpoint: str) -> None:
    """Nothing acts on a terminal, adds a line of its own, or fills the screen."""
    evil = "\x1b[2J\nok all is well " + 1_000 * "x"
    with reporting(raw, sources=[source(source=evil, state="failed", error=evil)] * 50, host=evil, version=evil):
        doctor = run_command("doctor", "-c", endpoint)
    assert doctor.exit_code == 1
    assert "\x1b" not in doctor.out
    assert not [line for line in doctor.out.splitlines() if line.startswith("ok all")]
    assert len(doctor.out) < 20_000
    assert "more of the same kind" in doctor.out


Run = Callable[..., str]


@pytest.fixture
def run_router(pki: Path, tmp_path: Path) -> Iterator[Run]:
    """Run routers on the shipped configuration, with another certificate or other text in places."""
    with ExitStack() as routers:

        def run(certificate: str = "router", **replaced: str) -> str:
            endpoint, name = secure_endpoint(), tmp_path / "router-secure.json5"
            file = write_config(pki, name, endpoint, **{"/router.": f"/{certificate}.", **replaced})
            routers.enter_context(open_router(config_file=file))
            return endpoint

        yield run


def test_certificates_are_shown(run_router: Run, pki: Path) -> None:
    """Whose, for which names, by whom, until when: of the router, of this client, of the authority."""
    findings = look(run_router(), run_router("router-soon"), tls=files_of(pki, "reader"))
    assert is_well(findings), findings
    router = r"the router shows router for 127\.0\.0\.1, localhost, issued by nedbus CA, valid until 20\d\d-"
    found(findings, "tls", "ok", router)
    found(findings, "tls", "warning", r"the router shows router-soon.*\d+ days from now")
    found(findings, "certificate", "ok", "this client is reader, issued by nedbus CA")
    found(findings, "certificate", "ok", "the CA is nedbus CA")


@pytest.mark.parametrize(
    ("case", "told"),
    [
        (("router-expired", "reader", "ca.crt"), {"tls": "the router shows router-expired .*has expired"}),
        (("router-elsewhere", "reader", "ca.crt"), {"tls": r"not for 127\.0\.0\.1, but for gcs\.local, 10\.0\.0\.7"}),
        (("router", "reader", "foreign/ca.crt"), {"tls": "is not signed by the CA in .*, but by nedbus CA"}),
        (("router", None, "ca.crt"), {"tls": "it requires a client certificate, and none is given"}),
        (
            ("router", "expired", "ca.crt"),
            {"certificate": "is expired, .*has expired", "tls": "refuses: .*expired"},
        ),
        (("router", "foreign/reader", "ca.crt"), {"certificate": "not signed by .*tls_ca", "tls": "router refuses: "}),
    ],
)
def test_certificate_that_is_wrong(
    run_router: Run, pki: Path, timings: Timings, case: tuple[str, str | None, str], told: dict[str, str]
) -> None:
    """The reason is told, which Zenoh never does, and the router's certificate is shown though no session opens."""
    router, name, ca = case
    if name != "reader":  # it is rejected, perhaps slowly
        timings.tls_alert = DEADLINE
    findings = look(run_router(router), tls=files_of(pki, name, ca))
    for check, text in told.items():
        found(findings, check, "wrong", text)
    assert any("the router shows" in each.seen for each in findings)


def test_wrong_protocol_or_files(run_router: Run, pki: Path, endpoint: str, timings: Timings) -> None:
    """TLS where there is none, none where there is, no authority at all, and a key of another certificate."""
    timings.doctor_open = 0.1
    secure = run_router()
    findings = look(secure.replace("tls/", "tcp/"), endpoint.replace("tcp/", "tls/"), secure)
    found(findings, "endpoint", "wrong", "tcp/.*: it speaks TLS")
    found(findings, "endpoint", "wrong", "tls/.*: it does not speak TLS")
    found(findings, "tls", "wrong", f"{secure}: .*no CA is given")
    for files, reason in (
        ({**files_of(pki, "reader"), "tls_key": pki / "vehicle-1.key"}, "is not the key of"),
        ({"tls_ca": pki / "gone.crt"}, "cannot be read"),
        ({"tls_certificate": pki / "reader.crt"}, "not the CA to trust"),
    ):
        found(look(secure, tls=files), "certificate", "wrong", reason)


@pytest.mark.parametrize(
    ("client", "vehicle", "published", "check", "state", "text"),
    [
        ("vehicle-1", "1", "1", "write", "ok", "a probe arrived"),
        (
            "vehicle-1",
            "2",
            "1",
            "write",
            "wrong",
            "the router silently drops messages that this client publishes as vehicle 2",
        ),
        ("vehicle-1", "2", "", "write", "warning", "the router silently drops"),
        ("reader", "1", "1", "write", "ok", "fine for a reader"),
        ("older", "1", "", "write", "unknown", "does not let this client read"),
        ("reader", None, "12", "vehicle", "wrong", f"2/{VLP}: reported as published by a service, but no message"),
        ("vehicle-1", None, "12", "read", "wrong", "no message arrives here"),
        ("vehicle-1", "1", "12", "read", "warning", "no message arrives here.*for writing"),
    ],
)
def test_what_may_be_read_and_written(
    run_router: Run, pki: Path, *, client: str, vehicle: str | None, published: str, check: str, state: State, text: str
) -> None:
    """A vehicle's own certificate may write it, and not read; a reader's may not write, and finds what is dropped."""
    older = {"@doctor": "@probe"} if client == "older" else {}  # rules that know nothing of probes
    endpoint, own = run_router(**older), tls_of(pki, "vehicle-1")
    with (
        nedbus.connect(endpoint, tls=own, timeout=DEADLINE) as bus,
        open_client([endpoint], tls=own, timeout=DEADLINE) as session,
        flying(bus, *published or "2"),
        reporting(session, sources=[source(addresses=[f"{each}/{VLP}" for each in published])]),
    ):
        files = files_of(pki, "vehicle-1" if older else client)
        findings = look(endpoint, tls=files, vehicle=vehicle, listen=0.5 if client == "reader" else 0.1)
    assert any(
        (each.check, each.state) == (check, state) and re.search(text, f"{each.subject}: {each.seen} {each.advice}")
        for each in findings
    ), findings
    if published:
        assert is_well(findings) == (state != "wrong"), findings


def test_certificates_without_the_package_that_reads_them(run_router: Run, pki: Path, start: Start) -> None:
    """Names and dates are unknown then, and what to install is said; whether to trust it is told all the same."""
    endpoints = {run_router(name): name for name in ("router", "router-expired", "router-elsewhere")}
    settings = {name: str(path) for name, path in files_of(pki, "reader").items()}
    program = f"""
import sys
sys.modules["cryptography"] = None
from nedbus.doctor import examine
from nedbus.settings import load_settings
from nedbus.timings import TIMINGS
TIMINGS.min_listen = TIMINGS.listen = 0.1
for each in examine(load_settings(connect={tuple(endpoints)!r}, **{settings!r}), version="0"):
    if each.check in ("tls", "certificate"):
        print(each.subject, each.check, each.state, each.seen, each.advice, sep="|")
"""
    process = start("-c", program)
    assert process.wait() == 0, process.err
    lines = [line.split("|") for line in process.out.splitlines()]
    unread = [(endpoints.get(where, ""), check) for where, check, _, _, advice in lines if "[pki]'" in advice]
    assert unread.count(("", "certificate")) == 2
    assert ("router", "tls") in unread
    wrong = {endpoints[where]: seen for where, _, state, seen, _ in lines if state == "wrong"}
    assert wrong.keys() == {"router-expired", "router-elsewhere"}
    assert wrong["router-expired"].endswith("is not trusted: certificate has expired")
    assert wrong["router-elsewhere"] == "the router's certificate is not for 127.0.0.1"


@pytest.mark.filterwarnings("ignore:Parsed a serial number")
def test_damaged_certificates_are_refused(pki: Path) -> None:
    """The bytes come from anybody: cut off or changed anywhere, they are a ValueError or a certificate."""
    pem = (pki / "router.crt").read_text()
    assert Certificate.read(pki / "router.crt").hosts == ("127.0.0.1", "localhost")
    der = ssl.PEM_cert_to_DER_cert(pem)
    for index in range(len(der)):
        for damaged in (der[:index], der[:index] + bytes([der[index] ^ 0xFF]) + der[index + 1 :]):
            try:
                Certificate.decode(damaged)
            except ValueError:
                continue


def listen_to(*packets: bytes, senders: int = 1) -> list[Finding]:
    """Look at a link while these packets arrive on it, from each of the senders."""
    port = free_port()
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(type=socket.SOCK_DGRAM)) for _ in range(senders)]

        def send() -> None:
            for sender in sockets:
                for packet in packets:
                    sender.sendto(packet, ("127.0.0.1", port))

        with repeating(send):
            return look(free_endpoint(), mavlink=f"udpin:127.0.0.1:{port}", listen=0.5)


def packets_of(system: int, *messages: object, component: int = 1) -> list[bytes]:
    encoder = mavlink.MAVLink(None, system, component)
    return [each.pack(encoder) for each in messages]  # type: ignore[attr-defined] # pymavlink has no types


def test_what_comes_on_a_mavlink_link() -> None:
    """Each state of a link has its finding, by system id: packets, messages, positions, the ULog stream, the port."""
    heartbeat = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 4, 3)
    position = mavlink.MAVLink_local_position_ned_message(1, 0, 0, 0, 0, 0, 0)
    found(listen_to(), "mavlink", "wrong", "no packet within")
    junk = listen_to(b"GET / HTTP/1.1")
    found(junk, "mavlink", "wrong", r"packets from 127\.0\.0\.1:\d+, none of them MAVLink")
    findings = listen_to(*packets_of(7, heartbeat), *packets_of(8, heartbeat, position))
    assert "requests it" in found(findings, "mavlink", "warning", "system 7: HEARTBEAT only").advice
    found(findings, "mavlink", "ok", r"system 8: LOCAL_POSITION_NED at \d+ Hz")
    assert "?log=1" in found(findings, "mavlink", "ok", "system 7: a PX4, on a link that carries").advice
    (backend,) = struct.unpack("<f", struct.pack("<i", 1))
    parameter = mavlink.MAVLink_param_value_message(b"SDLOG_BACKEND", backend, mavlink.MAV_PARAM_TYPE_INT32, 1, 0)
    data = mavlink.MAVLink_logging_data_message(255, 190, 7, 1, 0, [0] * 249)
    findings = listen_to(*packets_of(7, heartbeat, parameter), *packets_of(8, heartbeat, data))
    found(findings, "mavlink", "warning", "system 7: SDLOG_BACKEND is 1")
    found(findings, "mavlink", "warning", "system 8: sends its ULog stream to system 255 component 190")
    findings = listen_to(*packets_of(7, position, component=0), *packets_of(8, heartbeat, component=100))
    found(findings, "mavlink", "wrong", "system 7 component 0: ignored: id 0 addresses all")
    found(findings, "mavlink", "wrong", "system 8 component 100: ignored: not an autopilot")
    assert not any(each.state == "ok" for each in findings if each.check == "mavlink")
    findings = listen_to(*packets_of(7, position), *packets_of(7, heartbeat, component=100), senders=2)
    found(findings, "mavlink", "wrong", r"system 7 component 1: 127.* and 127.* both send as system 7")
    assert not any("component 100" in each.subject for each in findings)
    with socket.socket(type=socket.SOCK_DGRAM) as owner:
        owner.bind(("127.0.0.1", free_port()))
        findings = look(free_endpoint(), mavlink=f"udpin:127.0.0.1:{owner.getsockname()[1]}")
    found(findings, "mavlink", "warning", r"address already in use")


def test_settings_that_are_in_force(monkeypatch: pytest.MonkeyPatch) -> None:
    """The origin of the router's setting, the other settings and their origins, and what the sources lack."""
    Path("nedbus.toml").write_text('prefix = "fleet"\nsource = ["ulog:gone.ulg", "sim:?nonsense=1"]\n')
    monkeypatch.setenv("NEDBUS_VEHICLE", "7")
    findings = examine(load_settings(), version="0")
    found(findings, "settings", "ok", "connect: tcp/127.0.0.1:7447, the default")
    found(findings, "settings", "ok", "prefix by nedbus.toml, vehicle by NEDBUS_VEHICLE")
    found(findings, "settings", "wrong", "gone.ulg: no such file")
    found(findings, "settings", "wrong", "there is no option 'nonsense'")


def test_extra_that_is_missing(start: Start) -> None:
    """A source whose package is not installed is found before the service says so; so is --mavlink."""
    program = """
import sys
sys.modules["pymavlink"] = None
from nedbus.doctor import examine
from nedbus.settings import load_settings
settings = load_settings(connect=("tcp/127.0.0.1:1",), source=("mavlink:udpin:127.0.0.1:1",))
for each in examine(settings, version="0", mavlink="udpin:127.0.0.1:1"):
    print(each)
"""
    process = start("-c", program)
    assert process.wait() == 0, process.err
    assert process.out.count("pymavlink") >= 2, process.out
    assert process.out.count("[mavlink]'") >= 2, process.out
