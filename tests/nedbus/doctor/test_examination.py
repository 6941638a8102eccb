"""`nedbus doctor` finds faults of real routers, certificates, links and services."""

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
from contextlib import ExitStack, closing, contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import zenoh
from pymavlink.dialects.v20 import common as mavlink

import nedbus
from nedbus.client import QueryServer
from nedbus.doctor import Finding, State, examine
from nedbus.errors import ConnectError
from nedbus.pki import Certificate
from nedbus.settings import load_settings
from nedbus.timings import TIMINGS, Timings
from nedbus.transport import NO_HASH, Session, TopicKey, open_client, open_router
from nedbus_msgs import TOPICS, Address, dds_type, status_key
from tests.flights.local_position import ROS2_TYPE, encode
from tests.flights.messages import VALID, VLP, message
from tests.flights.ulogs import write_log
from tests.peers.certificates import client_tls, pki, secure_endpoint, tls_settings, write_config
from tests.peers.command_line import run_command
from tests.peers.ports import free_endpoint, free_port
from tests.peers.processes import Start
from tests.waits import DEADLINE, repeating, wait_for

__all__ = ["pki"]

HOUR = 3600.0


@pytest.fixture(autouse=True)
def _short_observation(timings: Timings) -> None:
    """Shorten the doctor's timeouts; `diagnose` sets the duration of the observation."""
    timings.min_listen, timings.tls_alert, timings.listen = 0.1, 0.1, 0.5


def diagnose(
    *endpoints: str, tls: Mapping[str, Path] | None = None, listen: float = 0.1, **options: Any
) -> list[Finding]:
    """Run the doctor with these settings; `listen`: duration of the observation [s], longer if messages must arrive."""
    settings = load_settings(None, connect=endpoints, **(tls or {}))
    TIMINGS.listen = listen
    return examine(settings, version=nedbus.__version__, **options)


def find(findings: list[Finding], check: str, state: State, text: str) -> Finding:
    """Return the matching finding of a check in this state; if there is none, fail and list all findings."""
    for each in findings:
        if (each.check, each.state) == (check, state) and re.search(
            text, f"{each.subject}: {each.seen}"
        ):
            return each
    pytest.fail(f"no finding {check} {state} {text!r} in\n" + "\n".join(map(str, findings)))


def diagnose_until(endpoint: str, *texts: str) -> list[Finding]:
    """Run the doctor, doubling the duration until it reports all texts, because a busy machine delays messages."""
    findings, listen = list[Finding](), 0.5
    while not all(
        any(re.search(text, f"{each.subject}: {each.seen}") for each in findings) for text in texts
    ):
        assert listen < DEADLINE, findings
        findings, listen = diagnose(endpoint, listen=listen), 2 * listen
    return findings


def has_no_faults(findings: list[Finding]) -> bool:
    return all(each.state != "wrong" for each in findings)


@contextmanager
def publishing(bus: nedbus.Bus, *vehicles: str) -> Iterator[None]:
    """Publish positions of these vehicles, by default of vehicle 1, as a service does: also those that are refused."""
    publishers = [bus._publishers.publisher(Address(vehicle, VLP)) for vehicle in vehicles or "1"]

    def publish() -> None:
        for publisher in publishers:
            publisher.publish(message(time.time_ns()))

    with repeating(publish):
        yield
    for publisher in publishers:
        publisher.close()


@contextmanager
def service_status(
    session: Session,
    name: str = "fake",
    *,
    vehicle: str = "1",
    offset: float = 0.0,
    **status: object,
) -> Iterator[None]:
    """Reply to queries of the status of a vehicle with this status; the service's clock is `offset` seconds ahead."""
    server = QueryServer(session)
    known = {"service": name, "host": "elsewhere", "version": nedbus.__version__, "sources": []}
    server.answer_json(
        status_key(name, vehicle=vehicle),
        lambda _: [json.dumps({"now": time.time() + offset, **known, **status}).encode()],
    )
    with closing(server):
        yield


def source(**fields: object) -> dict[str, object]:
    return {
        "source": "mavlink:x",
        "state": "running",
        "addresses": [],
        "stale": [],
        "rejected": 0,
        **fields,
    }


def test_unreachable_endpoint_is_wrong_unless_another_router_answers(endpoint: str) -> None:
    """An endpoint that refuses or does not resolve is "wrong", or only a "warning" if another router answers."""
    refused = free_endpoint()
    findings = diagnose(refused, "tcp/no-such-host.invalid:7447", "tcp/a..b:7447")
    assert (
        "nedbus serve"
        in find(findings, "endpoint", "wrong", f"{refused}: connection refused").advice
    )
    find(findings, "endpoint", "wrong", "cannot resolve host name no-such-host")
    find(findings, "endpoint", "wrong", r"cannot resolve host name a\.\.b")
    findings = diagnose(refused, endpoint)
    find(findings, "endpoint", "warning", "connection refused")
    find(findings, "endpoint", "ok", "a Zenoh router answers")


def test_unexpected_error_in_check_is_a_finding(
    endpoint: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """An unexpected error in a check becomes a finding that names the error, not a timeout."""

    def fail(*_: object) -> list[Finding]:
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr("nedbus.doctor.examination.check_endpoint", fail)
    failed = find(
        diagnose(endpoint),
        "endpoint",
        "unknown",
        "check failed: unexpected ZeroDivisionError: by zero",
    )
    assert "a bug in nedbus" in failed.advice
    assert f"unexpected error in check endpoint {endpoint}\nTraceback" in caplog.text


@pytest.mark.slow
def test_server_that_is_not_a_router_is_reported(timings: Timings) -> None:
    """An HTTP server and a server that never answers are reported as speaking neither Zenoh nor TLS."""
    timings.doctor_open = timings.handshake = 0.2
    with ThreadingHTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as server:
        thread = threading.Thread(target=server.serve_forever, args=[0.01])
        thread.start()
        http = f"127.0.0.1:{server.server_address[1]}"
        with socket.create_server(("127.0.0.1", 0)) as silent:
            mute = f"127.0.0.1:{silent.getsockname()[1]}"
            findings = diagnose(
                *(f"{protocol}/{where}" for protocol in ("tcp", "tls") for where in (http, mute))
            )
        server.shutdown()
        thread.join(DEADLINE)
    for protocol, reason in (
        ("tcp", "cannot open a Zenoh session"),
        ("tls", "it does not speak TLS"),
    ):
        for where in (http, mute):
            find(findings, "endpoint", "wrong", f"{protocol}/{where}: {reason}")


@pytest.mark.slow
def test_healthy_network_has_no_faults(
    bus: nedbus.Bus, endpoint: str, zenoh_session: Session
) -> None:
    """With a publishing vehicle, no finding is "wrong", and each check has a finding "ok"."""
    with publishing(bus), service_status(zenoh_session, sources=[source(addresses=[f"1/{VLP}"])]):
        findings = diagnose(endpoint, vehicle="1", listen=1.0)
    assert has_no_faults(findings), findings
    for check in ("settings", "endpoint", "router", "read", "write", "service", "vehicle", "clock"):
        assert any(each.check == check and each.state == "ok" for each in findings), check


def test_silent_and_missing_vehicles_are_reported(bus: nedbus.Bus, endpoint: str) -> None:
    """A silent publisher is reported with the age of its last message; a requested vehicle must exist."""
    bus.publisher(VLP, vehicle="mute")
    bus.publisher(VLP, vehicle="asleep").publish(message(1))
    findings = diagnose(endpoint)
    find(findings, "vehicle", "warning", r"mute/.*silent for \d+ s: no message yet")
    find(
        findings, "vehicle", "wrong", r"asleep/.*silent for \d+ s: its last message is \S+ m?s old"
    )
    missing = [
        each for each in diagnose(endpoint, vehicle="7") if each.seen == "not found under nedbus/"
    ]
    assert [each.advice for each in missing] == [
        "start its source: 'nedbus serve --source ...'; published: asleep, mute"
    ]


@pytest.mark.parametrize(
    ("state", "advice"),
    [
        (
            "running",
            "no source of service fake on elsewhere receives it: check the name, or start its source there",
        ),
        ("waiting", "see the findings on sources"),
    ],
)
def test_missing_vehicle_refers_to_findings_on_sources_only_if_there_are_some(
    zenoh_session: Session, endpoint: str, state: str, advice: str
) -> None:
    """The advice for a vehicle that is not published names the services, or refers to findings on their sources."""
    with service_status(zenoh_session, sources=[source(state=state)]):
        findings = diagnose(endpoint, vehicle="8")
    assert find(findings, "vehicle", "wrong", "8: not found").advice == advice
    assert any(each.check == "source" for each in findings) == (state == "waiting")


def test_publishers_of_one_address_are_named(
    zenoh_session: Session, endpoint: str, bus: nedbus.Bus
) -> None:
    """Of several publishers of an address, the services are named with host and source, others are counted."""
    address = f"1/{VLP}"
    status = service_status(zenoh_session, "a", sources=[source(addresses=[address])])
    with nedbus.connect(endpoint) as other, publishing(bus), publishing(other), status:
        findings = diagnose_until(endpoint, "2 publishers of this address: service")
    text = "service a on elsewhere .mavlink:x., and 1 that no service reports"
    find(findings, "vehicle", "wrong", f"{address}: 2 publishers of this address: {text}")


@pytest.mark.slow
def test_two_publishers_of_one_address_are_reported(bus: nedbus.Bus, endpoint: str) -> None:
    """Two publishers of one address share a token, but the source info of messages or heartbeats tells them apart."""
    with nedbus.connect(endpoint) as other:
        with publishing(bus), publishing(other):
            find(
                diagnose_until(endpoint, "2 publishers"),
                "vehicle",
                "wrong",
                f"1/{VLP}: 2 publishers",
            )
        for each in (bus, other):
            each.publisher(VLP, vehicle="1").publish(message(1))
        find(diagnose_until(endpoint, "2 publishers"), "vehicle", "wrong", f"1/{VLP}: 2 publishers")


def test_truncated_list_of_streams_is_reported(
    bus: nedbus.Bus, endpoint: str, zenoh_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A vehicle with too many liveliness tokens is left out with a finding; the others are examined."""
    monkeypatch.setattr("nedbus.limits.TOKENS_OF_VEHICLE", 20)
    keys = [f"nedbus/flood/@alive/{each:x}/{VLP}" for each in range(21)]
    tokens = [zenoh_session.liveliness().declare_token(key) for key in keys]
    with publishing(bus, "drone-7"):
        findings = diagnose(endpoint)
    find(findings, "vehicle", "unknown", "not all streams are listed")
    assert not any("publishers of this address" in each.seen for each in findings)
    assert len(tokens) == 21  # declared until now


def test_undecodable_payload_is_reported(zenoh_session: Session, endpoint: str) -> None:
    """A payload that cannot be decoded is reported with the decoder's reason, such as an unknown layout."""

    def publish() -> None:
        zenoh_session.put(f"nedbus/1/{VLP}", b"junk")
        zenoh_session.put(f"nedbus/2/{VLP}", b"\x92\x63\x01")  # an array: layout 99, and one value

    with repeating(publish):
        findings = diagnose_until(endpoint, "1/.*: cannot decode", "2/.*: cannot decode")
    find(findings, "vehicle", "wrong", f"1/{VLP}: cannot decode a payload")
    find(findings, "vehicle", "wrong", f"2/{VLP}: cannot decode a payload: .*layout 99")


@pytest.mark.parametrize(
    ("clocks", "text", "advice"),
    [
        (
            {"ahead": HOUR},
            "service ahead on elsewhere: .* 60 min ahead of this host's",
            "either clock may be off",
        ),
        ({"ahead": HOUR, "right": 0.0}, "service ahead", "set this one"),
        (
            {"first": -HOUR, "second": -HOUR},
            "this host's clock is 60 min ahead of 2 others",
            "run NTP",
        ),
    ],
    ids=["service", "one of two services", "this host"],
)
def test_clock_offset_is_reported(
    zenoh_session: Session, endpoint: str, clocks: Mapping[str, float], text: str, advice: str
) -> None:
    """Of three clocks, the one that disagrees is wrong, even if it is this host's. Of two, either may be wrong."""
    with ExitStack() as services:
        for name, offset in clocks.items():
            services.enter_context(service_status(zenoh_session, name, offset=offset))
        assert advice in find(diagnose(endpoint), "clock", "wrong", text).advice


def test_clock_offset_of_publisher_is_reported(zenoh_session: Session, endpoint: str) -> None:
    """Message timestamps reveal the offset of a publisher's clock, even without a service."""
    payload = encode(message(1))

    def publish() -> None:
        later = dt.datetime.now(dt.UTC) + dt.timedelta(seconds=HOUR)
        zenoh_session.put(f"nedbus/1/{VLP}", payload, timestamp=zenoh.Timestamp(later, b"\x07"))

    with repeating(publish):
        findings = diagnose_until(endpoint, "publisher of 1/")
    find(
        findings,
        "clock",
        "wrong",
        f"publisher of 1/{VLP}: its clock is 60 min ahead of this host's",
    )


def test_service_status_produces_findings(zenoh_session: Session, endpoint: str) -> None:
    """Failed, waiting and stale sources, rejections and other versions are reported; of many, the worst come first."""
    sources = [
        source(state="failed", error="the disk is gone"),
        source(stale=["9/x"], rejected=7, rejections={"xy_valid": 7}),
        source(source="px4-zenoh:", state="waiting"),
        source(source="mavlink:udpout:10.0.0.1:14580", state="waiting"),
        source(source="mavlink:satellite", warnings=["system 5: a satellite link"]),
    ]
    with service_status(zenoh_session, vehicle="9", version="99.1.0", sources=sources):
        findings = diagnose(endpoint)
    find(findings, "source", "wrong", "mavlink:x: failed: the disk is gone")
    assert "first address" not in find(findings, "source", "warning", "px4-zenoh:: waiting").advice
    assert (
        "first address"
        in find(findings, "source", "warning", "mavlink:udpout:10.0.0.1:14580: waiting").advice
    )
    find(findings, "source", "ok", "mavlink:satellite: system 5: a satellite link")
    find(findings, "source", "warning", "no more messages of 9/x")
    find(findings, "source", "warning", r"messages rejected: 7 \(xy_valid\)")
    find(findings, "version", "warning", r"the service runs nedbus 99\.1\.0")
    waiting = [
        source(source=f"mavlink:{number}", state="retrying", error=str(number))
        for number in range(50)
    ]
    with service_status(zenoh_session, sources=[*sources, *waiting]):
        findings = diagnose(endpoint)
    find(findings, "source", "wrong", "more findings of this check")
    find(findings, "source", "wrong", "retrying: 49")


def test_equal_findings_are_one_with_all_subjects(
    zenoh_session: Session, endpoint: str, bus: nedbus.Bus
) -> None:
    """A fault of all streams of a vehicle is one finding, which lists streams and names service and host."""
    addresses = [f"8/{topic}" for topic in TOPICS][:12]
    with (
        publishing(bus, "1"),
        service_status(zenoh_session, vehicle="8", sources=[source(addresses=addresses)]),
    ):
        findings = diagnose_until(endpoint, "reported as published", "messages arrive")
    found = [each for each in findings if "reported as published" in each.seen]
    assert len(found) == 1, found
    assert "service fake on elsewhere (mavlink:x)" in found[0].seen
    assert found[0].subject.endswith("and 7 more")
    assert not any("more finding" in each.seen for each in findings)


@contextmanager
def service_report(session: Session, name: str, **vehicles: Mapping[str, object]) -> Iterator[None]:
    """Reply to event queries with a report of these vehicles."""
    server = QueryServer(session)
    report = {
        "service": name,
        "host": "elsewhere",
        "now": 10_000.0,
        "events": [],
        "vehicles": vehicles,
    }
    for vehicle in vehicles:
        key = status_key(name, vehicle=vehicle)
        server.answer_json(key, lambda get: [json.dumps(report if get("events") else {}).encode()])
    with closing(server):
        yield


def test_vehicle_states_in_service_reports_are_findings(
    zenoh_session: Session, endpoint: str
) -> None:
    """A vehicle in state "bad" is "wrong", and one in state "watch" is a "warning".

    Vehicles that are healthy, or have been silent for an hour, are omitted.

    If two services report a vehicle, only the report of the service that receives its messages counts.
    """
    silent = {"severity": "bad", "text": "no position", "kinds": ["silent"]}
    with (
        service_report(
            zenoh_session,
            "first",
            sick={"severity": "bad", "text": "failsafe", "since": 9990.0, "kinds": ["failsafe"]},
            doubtful={
                "severity": "watch",
                "text": "dead reckoning",
                "since": 9880.0,
                "kinds": ["dead_reckoning"],
            },
            well={"severity": "info", "text": "ok"},
            off={**silent, "since": 1.0},
            gone={**silent, "since": 9999.0},
            moved={**silent, "since": 9999.0},
        ),
        service_report(zenoh_session, "second", moved={"severity": "info", "text": "ok"}),
    ):
        findings = diagnose(endpoint)
        of_one = diagnose(endpoint, vehicle="doubtful")
    wrong = find(findings, "vehicle", "wrong", r"sick: failsafe, since 02:46:30\.0 UTC \(10\.0 s\)")
    assert wrong.advice.endswith("'nedbus why --vehicle sick'")
    find(findings, "vehicle", "warning", "doubtful: dead reckoning, since .*2 min")
    find(findings, "vehicle", "wrong", "gone: no position")
    assert not [each for each in findings if each.subject in ("well", "off", "moved")]
    assert {each.subject for each in of_one if "nedbus why" in each.advice} == {"doubtful"}


@pytest.mark.parametrize(
    "invalid",
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
def test_invalid_event_report_is_ignored(
    zenoh_session: Session, endpoint: str, invalid: Mapping[str, object]
) -> None:
    """An invalid event report from a peer produces no finding and does not break a check."""
    server = QueryServer(zenoh_session)
    report = {"service": "x", "host": "x", "now": 10_000.0, "events": [], **invalid}
    server.answer_json(
        status_key("x", vehicle="1"),
        lambda get: [json.dumps(report if get("events") else {}).encode()],
    )
    with (
        closing(server),
        service_status(zenoh_session, sources=[source(state="failed", error="the disk is gone")]),
    ):
        findings = diagnose(endpoint)
    find(findings, "source", "wrong", "the disk is gone")
    assert not [each for each in findings if "evil" in each.seen or "check failed" in each.seen]


@pytest.mark.slow
def test_doctor_reports_bad_vehicle_from_event_report(run_nedbus: Start, tmp_path: Path) -> None:
    """The doctor reports a bad vehicle from the event report of a service that replays a log in another process."""
    endpoint = free_endpoint()
    log = write_log(
        tmp_path / "a.ulg", range(100_000, 300_000_000, 100_000), **{**VALID, "xy_valid": False}
    )
    run_nedbus("serve", "--listen", endpoint, "-s", f"ulog:{log}?vehicle=sick")
    with nedbus.connect(endpoint, timeout=DEADLINE) as bus:
        wait_for(lambda: any(report.vehicles for report in bus.accounts()), what="the vehicle")
    find(diagnose(endpoint), "vehicle", "wrong", "sick: xy not valid, since ")


@pytest.mark.parametrize(
    "now", [10**400, math.nan, -math.inf, True, "noon", None, []], ids=lambda now: str(now)[:5]
)
def test_invalid_service_status_does_not_break_checks(
    zenoh_session: Session, endpoint: str, now: object
) -> None:
    """The valid parts of a peer's invalid status produce findings, and no check fails."""
    states: list[object] = [[], {}, 7, None]
    strange = [source(state=state, stale=5, rejections=[1], addresses={}) for state in states]
    with service_status(
        zenoh_session,
        now=now,
        version=[1],
        host={},
        sources=[*strange, 5, source(state="failed", error=["why"])],
    ):
        findings = diagnose(endpoint)
    find(findings, "source", "wrong", "mavlink:x: failed: unknown reason")
    assert not [each for each in findings if "check failed" in each.seen]


def test_other_prefixes_and_ros2_topics_are_warnings(zenoh_session: Session, endpoint: str) -> None:
    """Tokens or messages reveal other prefixes; tokens reveal ROS 2 or PX4 topics unless they are bridged."""
    key = TopicKey(0, f"fmu/out/{VLP}", dds_type(ROS2_TYPE), NO_HASH)
    token = zenoh_session.liveliness().declare_token(key.token("MP", "abc", "px4", 1))
    with nedbus.connect(endpoint, prefix="other/fleet") as other, publishing(other):
        payload = encode(message(1))
        with repeating(lambda: zenoh_session.put(f"third/1/{VLP}", payload)):
            findings = diagnose_until(endpoint, "other/fleet", "third")
        find(findings, "prefix", "warning", "other/fleet: .*the prefix here is nedbus/")
        find(findings, "prefix", "warning", "third: .*the prefix here is nedbus/")
        find(findings, "ros2", "warning", f"publishes /fmu/out/{VLP}, but no service bridges it")
        with service_status(zenoh_session, sources=[source(source="px4-zenoh:")]):
            assert not [each for each in diagnose(endpoint) if each.check == "ros2"]
    token.undeclare()


@pytest.mark.slow
def test_doctor_reports_failing_source_of_real_service(run_nedbus: Start) -> None:
    """A failing source of a service in another process is reported as text and as JSON, with exit code 1."""
    endpoint = free_endpoint()
    service = run_nedbus("serve", "--listen", endpoint, "-s", "sim:", "-s", "ulog:nowhere.ulg")
    wait_for(lambda: "no such file" in service.err, what="the source that fails")
    doctor = run_command("doctor", "-c", endpoint)
    assert doctor.exit_code == 1, doctor.err
    words = "".join(doctor.out.split())  # a long path is folded
    assert re.search(
        r"wrongsourceulog:nowhere\.ulg:retrying:/\S+/nowhere\.ulg:nosuchfileordirectory->", words
    )
    assert doctor.out.splitlines()[-1].endswith("1 wrong"), doctor.out
    as_json = run_command("doctor", "-c", endpoint, "--json")
    assert as_json.exit_code == 1
    report = json.loads(as_json.out)
    assert report["state"] == report["findings"][-1]["state"] == "wrong"
    assert set(report["findings"][0]) == {"check", "subject", "state", "seen", "advice"}


@pytest.mark.slow
def test_exit_code_is_0_with_warnings_and_2_for_usage_errors(
    bus: nedbus.Bus, endpoint: str, zenoh_session: Session, run_nedbus: Start
) -> None:
    """The exit code is 0 if nothing is wrong, even with warnings, and 2 for usage errors."""
    with publishing(bus), service_status(zenoh_session, sources=[source(state="waiting")]):
        doctor = run_command("doctor", "-v", "1", NEDBUS_CONNECT=endpoint)
    assert (doctor.exit_code, doctor.out.splitlines()[-1].rpartition(", ")[2]) == (
        0,
        "1 warning",
    ), doctor.out
    assert "set by NEDBUS_CONNECT" in " ".join(doctor.out.split())
    for arguments in (["-v", "a/b"], ["--mavlink", "nonsense"], ["--config", "gone.toml"]):
        refused = run_command("doctor", *arguments)
        assert (refused.exit_code, refused.err.count("\n")) == (2, 1), refused.err
    process = run_nedbus("doctor", "-c", "nonsense")
    assert (process.wait(), process.err.count("\n")) == (2, 1), process.err


def test_text_from_peers_is_escaped_and_truncated(zenoh_session: Session, endpoint: str) -> None:
    """Text from peers cannot control the terminal, add lines or flood the output."""
    evil = "\x1b[2J\nok all is well " + 1_000 * "x"
    failed = [
        source(source=f"{number}{evil}", state="failed", error=f"{number}{evil}")
        for number in range(50)
    ]
    with service_status(zenoh_session, sources=failed, host=evil, version=evil):
        doctor = run_command("doctor", "-c", endpoint)
    assert doctor.exit_code == 1
    assert "\x1b" not in doctor.out
    assert not [line for line in doctor.out.splitlines() if line.startswith("ok all")]
    assert len(doctor.out) < 20_000
    assert "more findings of this check" in doctor.out


Run = Callable[..., str]


@pytest.fixture
def run_router(pki: Path, tmp_path: Path) -> Iterator[Run]:
    """Yield a function that runs a router with the shipped configuration, its certificate or other text replaced."""
    with ExitStack() as routers:

        def run(certificate: str = "router", **replaced: str) -> str:
            endpoint, name = secure_endpoint(), tmp_path / "router-secure.json5"
            file = write_config(pki, name, endpoint, **{"/router.": f"/{certificate}.", **replaced})
            routers.enter_context(open_router(config_file=file))
            return endpoint

        yield run


def test_valid_certificates_are_described(run_router: Run, pki: Path) -> None:
    """Subject, hosts, issuer and expiry of the certificates of router, client and CA are reported."""
    findings = diagnose(run_router(), run_router("router-soon"), tls=tls_settings(pki, "reader"))
    assert has_no_faults(findings), findings
    router = r"the router presents router for 127\.0\.0\.1, localhost, issued by nedbus CA, valid until 20\d\d-"
    find(findings, "tls", "ok", router)
    find(findings, "tls", "warning", r"the router presents router-soon.*\d+ days left")
    find(findings, "certificate", "ok", "this client is reader, issued by nedbus CA")
    find(findings, "certificate", "ok", "the CA is nedbus CA")


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        (
            ("router-expired", "reader", "ca.crt"),
            {"tls": "the router presents router-expired .*has expired"},
        ),
        (
            ("router-elsewhere", "reader", "ca.crt"),
            {"tls": r"not for 127\.0\.0\.1, but for gcs\.local, 10\.0\.0\.7"},
        ),
        (
            ("router", "reader", "foreign/ca.crt"),
            {"tls": "is not signed by the CA in .*, but by nedbus CA"},
        ),
        (
            ("router", None, "ca.crt"),
            {"tls": "it requires a client certificate, and none is given"},
        ),
        (
            ("router", "expired", "ca.crt"),
            {"certificate": "is expired, .*has expired", "tls": "refuses this client: .*expired"},
        ),
        (
            ("router", "foreign/reader", "ca.crt"),
            {"certificate": "not signed by .*tls_ca", "tls": "router refuses this client: "},
        ),
    ],
)
def test_invalid_certificate_is_reported_with_reason(
    run_router: Run,
    pki: Path,
    timings: Timings,
    case: tuple[str, str | None, str],
    expected: dict[str, str],
) -> None:
    """A finding states the reason, which Zenoh omits, and the router's certificate even if no session opens."""
    router, name, ca = case
    if name != "reader":  # the router's TLS alert may be slow
        timings.tls_alert = DEADLINE
    findings = diagnose(run_router(router), tls=tls_settings(pki, name, ca))
    for check, text in expected.items():
        find(findings, check, "wrong", text)
    assert any("the router presents" in each.seen for each in findings)


@pytest.mark.slow
def test_wrong_protocol_and_wrong_tls_files_are_reported(
    run_router: Run, pki: Path, endpoint: str, timings: Timings
) -> None:
    """TLS to a TCP port, TCP to a TLS port, a missing CA, and a key of another certificate are wrong."""
    timings.doctor_open = 0.1
    secure = run_router()
    findings = diagnose(secure.replace("tls/", "tcp/"), endpoint.replace("tcp/", "tls/"), secure)
    find(findings, "endpoint", "wrong", "tcp/.*: it speaks TLS")
    find(findings, "endpoint", "wrong", "tls/.*: it does not speak TLS")
    plain = secure.replace("tls/", "tcp/")
    with pytest.raises(ConnectError, match=f"{plain} speaks TLS: use tls/ instead of tcp/"):
        nedbus.connect(plain, timeout=0.1)
    find(findings, "tls", "wrong", f"{secure}: .*no CA is given")
    for files, reason in (
        ({**tls_settings(pki, "reader"), "tls_key": pki / "vehicle-1.key"}, "is not the key of"),
        ({"tls_ca": pki / "gone.crt"}, "cannot be read"),
        ({"tls_certificate": pki / "reader.crt"}, "not the CA to trust"),
    ):
        find(diagnose(secure, tls=files), "certificate", "wrong", reason)


@pytest.mark.slow
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
        (
            "reader",
            None,
            "12",
            "vehicle",
            "wrong",
            f"2/{VLP}: reported as published by service .*, but no message",
        ),
        ("vehicle-1", None, "12", "read", "wrong", "no message arrives here"),
        (
            "vehicle-1",
            "1",
            "12",
            "read",
            "warning",
            "no message arrives here.*only permits writing",
        ),
    ],
)
def test_read_and_write_permissions_are_reported(
    run_router: Run,
    pki: Path,
    *,
    client: str,
    vehicle: str | None,
    published: str,
    check: str,
    state: State,
    text: str,
) -> None:
    """The findings state what the access rules permit a client to read and write, and whose messages are dropped."""
    older = {"@doctor": "@probe"} if client == "older" else {}  # access rules without the probe key
    endpoint, own = run_router(**older), client_tls(pki, "vehicle-1")
    with (
        nedbus.connect(endpoint, tls=own, timeout=DEADLINE) as bus,
        open_client([endpoint], tls=own, timeout=DEADLINE) as session,
        publishing(bus, *published or "2"),
        service_status(
            session,
            # all that its certificate lets it say of 2
            refused=[each for each in published if each != "1"],
            sources=[source(addresses=[f"{each}/{VLP}" for each in published])],
        ),  # fmt: skip
    ):
        files = tls_settings(pki, "vehicle-1" if older else client)
        findings = diagnose(
            endpoint, tls=files, vehicle=vehicle, listen=0.5 if client == "reader" else 0.1
        )
    assert any(
        (each.check, each.state) == (check, state)
        and re.search(text, f"{each.subject}: {each.seen} {each.advice}")
        for each in findings
    ), findings
    if published:
        assert has_no_faults(findings) == (state != "wrong"), findings


@pytest.mark.slow
def test_certificates_are_verified_but_not_read_without_cryptography(
    run_router: Run, pki: Path, start: Start
) -> None:
    """Without `cryptography`, names and dates are unknown and the advice names the extra; trust is still verified."""
    endpoints = {
        run_router(name): name for name in ("router", "router-expired", "router-elsewhere")
    }
    settings = {name: str(path) for name, path in tls_settings(pki, "reader").items()}
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
    unread = [
        (endpoints.get(where, ""), check)
        for where, check, _, _, advice in lines
        if "[pki]'" in advice
    ]
    assert unread.count(("", "certificate")) == 2
    assert ("router", "tls") in unread
    wrong = {endpoints[where]: seen for where, _, state, seen, _ in lines if state == "wrong"}
    assert wrong.keys() == {"router-expired", "router-elsewhere"}
    assert wrong["router-expired"].endswith("is not trusted: certificate has expired")
    assert wrong["router-elsewhere"] == "the router's certificate is not for 127.0.0.1"


@pytest.mark.filterwarnings("ignore:Parsed a serial number")
def test_damaged_certificate_raises_value_error_or_decodes(pki: Path) -> None:
    """A certificate that is truncated or changed at any byte decodes or raises ValueError, but no other exception."""
    pem = (pki / "router.crt").read_text()
    assert Certificate.read(pki / "router.crt").hosts == ("127.0.0.1", "localhost")
    der = ssl.PEM_cert_to_DER_cert(pem)
    for index in range(len(der)):
        for damaged in (der[:index], der[:index] + bytes([der[index] ^ 0xFF]) + der[index + 1 :]):
            try:
                Certificate.decode(damaged)
            except ValueError:
                continue


def check_link(*packets: bytes, senders: int = 1) -> list[Finding]:
    """Run the doctor on a link while each of the senders sends these packets."""
    port = free_port()
    with ExitStack() as stack:
        sockets = [
            stack.enter_context(socket.socket(type=socket.SOCK_DGRAM)) for _ in range(senders)
        ]

        def send() -> None:
            for sender in sockets:
                for packet in packets:
                    sender.sendto(packet, ("127.0.0.1", port))

        with repeating(send):
            while True:  # a sender on a busy host may send nothing for that long
                findings = diagnose(free_endpoint(), mavlink=f"udpin:127.0.0.1:{port}", listen=0.5)
                if not packets or not any(
                    "no packet within" in finding.seen for finding in findings
                ):
                    return findings


def packets_of(system: int, *messages: object, component: int = 1) -> list[bytes]:
    encoder = mavlink.MAVLink(None, system, component)
    return [each.pack(encoder) for each in messages]  # type: ignore[attr-defined] # pymavlink has no types


def check_round_trip(delay: float) -> list[Finding]:
    """Run the doctor on a link with a PX4 that answers TIMESYNC after this delay [s]."""
    port, encoder, parser = free_port(), mavlink.MAVLink(None, 7, 1), mavlink.MAVLink(None)
    heartbeat = mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 4, 3
    )
    with socket.socket(type=socket.SOCK_DGRAM) as vehicle:
        vehicle.setblocking(False)

        def send() -> None:
            with suppress(BlockingIOError):
                for message in parser.parse_buffer(vehicle.recv(2048)) or []:
                    if message.get_type() == "TIMESYNC":
                        time.sleep(delay)
                        answer = mavlink.MAVLink_timesync_message(1, message.ts1)
                        vehicle.sendto(answer.pack(encoder), ("127.0.0.1", port))
                return
            vehicle.sendto(heartbeat.pack(encoder), ("127.0.0.1", port))

        with repeating(send):
            while True:  # on a busy host, no answer may arrive for that long
                findings = diagnose(free_endpoint(), mavlink=f"udpin:127.0.0.1:{port}", listen=0.5)
                if any("round trip" in finding.seen for finding in findings):
                    return findings


@pytest.mark.slow
def test_mavlink_traffic_produces_findings() -> None:
    """Packets, messages, positions, ULog stream, ignored senders and a port in use produce findings by system id."""
    heartbeat = mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 4, 3
    )
    position = mavlink.MAVLink_local_position_ned_message(1, 0, 0, 0, 0, 0, 0)
    satellite = mavlink.MAVLink_high_latency2_message(5000, 2, 12, *[0] * 24)
    assert (
        "sends nothing"
        in find(check_link(*packets_of(7, satellite)), "mavlink", "ok", "a satellite link").advice
    )
    assert "first address" not in find(check_link(), "mavlink", "wrong", "no packet within").advice
    findings = diagnose(free_endpoint(), mavlink=f"udpout:127.0.0.1:{free_port()}", listen=0.1)
    silent = find(findings, "mavlink", "wrong", "no packet within")
    assert (
        "PX4 sends only to the first address that sent to its port since its boot" in silent.advice
    )
    junk = check_link(b"GET / HTTP/1.1")
    find(junk, "mavlink", "wrong", r"no MAVLink among the packets from 127\.0\.0\.1:\d+ ")
    findings = check_link(*packets_of(7, heartbeat), *packets_of(8, heartbeat, position))
    assert "requests it" in find(findings, "mavlink", "warning", "system 7: HEARTBEAT only").advice
    find(findings, "mavlink", "ok", r"system 8: LOCAL_POSITION_NED at \d+ Hz")
    assert (
        "?log=1"
        in find(findings, "mavlink", "ok", "system 7.*: PX4 found; the link carries").advice
    )
    finding = find(
        check_round_trip(0.04),
        "mavlink",
        "ok",
        r"round trip \d+ ms: the header of the ULog stream blocks",
    )
    assert "?log=1&header=" in finding.advice
    (backend,) = struct.unpack("<f", struct.pack("<i", 1))
    parameter = mavlink.MAVLink_param_value_message(
        b"SDLOG_BACKEND", backend, mavlink.MAV_PARAM_TYPE_INT32, 1, 0
    )
    data = mavlink.MAVLink_logging_data_message(255, 190, 7, 1, 0, [0] * 249)
    findings = check_link(*packets_of(7, heartbeat, parameter), *packets_of(8, heartbeat, data))
    find(findings, "mavlink", "warning", "system 7: SDLOG_BACKEND is 1")
    find(
        findings,
        "mavlink",
        "warning",
        "system 8: sends its ULog stream to system 255 component 190",
    )
    findings = check_link(
        *packets_of(7, position, component=0), *packets_of(8, heartbeat, component=100)
    )
    find(findings, "mavlink", "wrong", "system 7 component 0: ignored: id 0 is for broadcast only")
    find(findings, "mavlink", "wrong", "system 8 component 100: ignored: not an autopilot")
    assert not any(each.state == "ok" for each in findings if each.check == "mavlink")
    findings = check_link(
        *packets_of(7, position), *packets_of(7, heartbeat, component=100), senders=2
    )
    find(
        findings, "mavlink", "wrong", r"system 7 component 1: 127.* and 127.* both send as system 7"
    )
    assert not any("component 100" in each.subject for each in findings)
    findings = check_link(
        *packets_of(7, heartbeat, position), *packets_of(255, heartbeat, component=190)
    )
    assert not [each for each in findings if each.check == "mavlink" and each.state != "ok"], (
        "a ground station"
    )
    with socket.socket(type=socket.SOCK_DGRAM) as owner:
        owner.bind(("127.0.0.1", free_port()))
        findings = diagnose(free_endpoint(), mavlink=f"udpin:127.0.0.1:{owner.getsockname()[1]}")
    find(findings, "mavlink", "warning", r"address already in use")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (mavlink.MAV_TYPE_ONBOARD_CONTROLLER, "the type MAV_TYPE_ONBOARD_CONTROLLER"),
        (250, "the unknown type 250"),
    ],
)
def test_heartbeats_of_others_with_component_1_are_named(kind: int, text: str) -> None:
    """A router or an unknown component with component id 1 is no vehicle, and is named, alone or beside a vehicle."""
    vehicle = mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 4, 3
    )
    other = mavlink.MAVLink_heartbeat_message(kind, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
    reason = f"not an autopilot: its HEARTBEAT has {text}"
    findings = check_link(*packets_of(42, other))
    find(findings, "mavlink", "wrong", f"system 42 component 1: ignored: {reason}")
    assert not any("PX4 found" in each.seen for each in findings)
    findings = check_link(*packets_of(7, vehicle), *packets_of(42, other))
    find(findings, "mavlink", "ok", f"system 42 component 1: ignored: {reason}")
    assert not any("system 42: " in f"{each.subject}: " for each in findings), "it is no vehicle"
    findings = check_link(*packets_of(7, vehicle), *packets_of(7, other))
    shared = find(
        findings,
        "mavlink",
        "warning",
        f"system 7 component 1: some HEARTBEATs are ignored: {reason}",
    )
    assert "give it a component id of its own" in shared.advice
    find(findings, "mavlink", "ok", "system 7: PX4 found")
    pressure = mavlink.MAVLink_scaled_pressure_message(1, 1.0, 1.0, 1)
    findings = check_link(*packets_of(7, pressure, vehicle), *packets_of(8, pressure))
    assert not any("system 7 component 1" in each.subject for each in findings), (
        "its heartbeat came second"
    )
    find(findings, "mavlink", "ok", "system 8 component 1: ignored: not known to be an autopilot")


def test_settings_are_reported_with_their_origin(monkeypatch: pytest.MonkeyPatch) -> None:
    """Findings name the origin of each setting and the mistakes in the sources."""
    Path("nedbus.toml").write_text(
        'prefix = "fleet"\nsource = ["ulog:gone.ulg", "sim:?nonsense=1"]\n'
    )
    monkeypatch.setenv("NEDBUS_VEHICLE", "7")
    findings = examine(load_settings(), version="0")
    find(findings, "settings", "ok", "connect: tcp/127.0.0.1:7447, the default")
    find(findings, "settings", "ok", "prefix by nedbus.toml, vehicle by NEDBUS_VEHICLE")
    find(findings, "settings", "wrong", "gone.ulg: no such file")
    find(findings, "settings", "wrong", "unknown option 'nonsense'")


@pytest.mark.slow
def test_missing_extra_is_reported(start: Start) -> None:
    """A package missing for a source or for --mavlink is reported with the extra to install."""
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
