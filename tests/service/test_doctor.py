"""`nedbus doctor`: every wrong state is caused for real, and found; certificates and routers are real ones."""

from __future__ import annotations

import datetime as dt
import json
import re
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import zenoh
from pymavlink.dialects.v20 import common as mavlink

import nedbus
from nedbus.client import QueryServer
from nedbus.doctor import Finding, State, examine
from nedbus.settings import load_settings
from nedbus.transport import (
    NO_HASH,
    Certificate,
    Session,
    TopicKey,
    make_authority,
    make_certificate,
    open_router,
    publisher_token,
)
from nedbus_msgs import ROS2_TYPE, dds_type, encode, status_key
from tests.conftest import DEADLINE, Start, free_endpoint, free_port, message, repeating, wait_for

CONFIG = Path(__file__).parents[2] / "config"
VLP = "vehicle_local_position"
HOUR = 3600.0


def look(
    endpoint: str, tls: dict[str, Path] | None = None, *, vehicle: str | None = None, mavlink: str | None = None
) -> list[Finding]:
    """Examine with these settings; for a shorter time than a person would."""
    settings = load_settings(None, connect=(endpoint,), **(tls or {}))
    return examine(settings, version=nedbus.__version__, vehicle=vehicle, mavlink=mavlink, listen=1.0)


def found(findings: list[Finding], check: str, state: State, text: str) -> Finding:
    """Return the finding of a check in this state whose words match; fail with all of them if there is none."""
    for each in findings:
        if (each.check, each.state) == (check, state) and re.search(text, f"{each.subject}: {each.seen}"):
            return each
    pytest.fail(f"{check} {state} {text!r} is not in\n" + "\n".join(map(str, findings)))


def is_well(findings: list[Finding]) -> bool:
    return all(each.state != "wrong" for each in findings)


@contextmanager
def flying(bus: nedbus.Bus, vehicle: str = "1") -> Iterator[None]:
    """Publish a vehicle."""
    with (
        bus.publisher(VLP, vehicle=vehicle) as publisher,
        repeating(lambda: publisher.publish(message(time.time_ns()))),
    ):
        yield


@contextmanager
def reporting(session: Session, name: str = "imitation", *, offset: float = 0.0, **status: object) -> Iterator[None]:
    """Answer as a service with this status does, whose clock is ahead by so many seconds."""
    server = QueryServer(session)
    known = {"service": name, "host": "elsewhere", "version": nedbus.__version__, "sources": []}
    server.answer_json(status_key(name), lambda: {"now": time.time() + offset, **known, **status})
    with closing(server):
        yield


def source(**fields: object) -> dict[str, object]:
    return {"source": "mavlink:x", "state": "running", "addresses": [], "stale": [], "rejected": 0, **fields}


# The way to the router.


def test_nothing_listens() -> None:
    """A refused connection is told from a name without address."""
    advice = found(look(free_endpoint()), "endpoint", "wrong", "nothing listens there").advice
    assert "nedbus serve" in advice
    found(look("tcp/no-such-host.invalid:7447"), "endpoint", "wrong", "has no address|no name server answers")
    found(look("tcp/a..b:7447"), "endpoint", "wrong", r"a\.\.b has no address")


def test_http_server_in_place_of_a_router() -> None:
    """It is told from a router, and from TLS."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    port = server.server_address[1]
    for protocol in ("tcp", "tls"):
        found(look(f"{protocol}/127.0.0.1:{port}"), "endpoint", "wrong", "an HTTP server answers there")
    server.shutdown()
    thread.join(DEADLINE)
    server.server_close()


def test_listener_that_says_nothing() -> None:
    """Whoever accepts and never answers does not hold up the doctor."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        found(look(f"tcp/127.0.0.1:{port}"), "endpoint", "wrong", "says nothing")
        found(look(f"tls/127.0.0.1:{port}"), "endpoint", "wrong", "does not speak TLS")


def test_one_of_two_routers_answers(endpoint: str) -> None:
    """The other one is worth a warning only, as the first that answers is joined."""
    settings = load_settings(connect=(free_endpoint(), endpoint))
    findings = examine(settings, version="0", listen=1.0)
    found(findings, "endpoint", "warning", "nothing listens")
    found(findings, "endpoint", "ok", "a Zenoh router answers")


# What is behind it.


def test_all_is_well(bus: nedbus.Bus, endpoint: str, raw: Session) -> None:
    """A vehicle that flies is no reason to complain: nothing is wrong, and each check says so."""
    with flying(bus), reporting(raw, sources=[source(addresses=[f"1/{VLP}"])]):
        findings = look(endpoint, vehicle="1")
    assert is_well(findings), findings
    for check in ("settings", "endpoint", "router", "read", "write", "service", "vehicle", "clock"):
        assert any(each.check == check and each.state == "ok" for each in findings), check


def test_silent_vehicle(bus: nedbus.Bus, endpoint: str) -> None:
    """Who has a token and sends nothing is found, with the age of the last message."""
    bus.publisher(VLP, vehicle="mute")
    bus.publisher(VLP, vehicle="asleep").publish(message(1))
    findings = look(endpoint)
    found(findings, "vehicle", "wrong", "mute/.*silent for 1 s: it has sent nothing yet")
    found(findings, "vehicle", "wrong", r"asleep/.*silent for 1 s: its last message is \S+ s old")


def test_vehicle_that_is_not_there(bus: nedbus.Bus, endpoint: str) -> None:
    """A vehicle that is asked for by name must be there."""
    with flying(bus):
        found(look(endpoint, vehicle="7"), "vehicle", "wrong", "7: it is not seen under nedbus/")


def test_two_publishers_of_one_address(bus: nedbus.Bus, endpoint: str) -> None:
    """Tokens of two publishers are one token: they are told apart by who they are."""
    with nedbus.connect(endpoint) as other, flying(bus), flying(other):
        found(look(endpoint), "vehicle", "wrong", f"1/{VLP}: 2 publishers")


def test_two_publishers_at_rest(bus: nedbus.Bus, endpoint: str) -> None:
    """They send nothing while the doctor listens but heartbeats, each its own."""
    with nedbus.connect(endpoint) as other:
        for each in (bus, other):
            each.publisher(VLP, vehicle="1").publish(message(1))
        found(look(endpoint), "vehicle", "wrong", f"1/{VLP}: 2 publishers")


def test_payload_that_is_no_message(raw: Session, endpoint: str) -> None:
    """It is found, with the decoder's reason; another layout is named as such."""
    with repeating(lambda: raw.put(f"nedbus/1/{VLP}", b"junk")):
        found(look(endpoint), "vehicle", "wrong", f"1/{VLP}: a payload that cannot be decoded")
    newer = b"\x92\x63\x01"  # an array: layout 99, and one value
    with repeating(lambda: raw.put(f"nedbus/1/{VLP}", newer)):
        found(look(endpoint), "vehicle", "wrong", "cannot be decoded: .*layout 99")


def test_service_whose_clock_is_off(raw: Session, endpoint: str) -> None:
    """Of two clocks nobody can tell which is right; of three the one that is alone is not."""
    with reporting(raw, "ahead", offset=HOUR):
        finding = found(look(endpoint), "clock", "wrong", "service ahead on elsewhere: .* 60 min ahead of this host's")
        assert "cannot be told" in finding.advice
        with reporting(raw, "right"):
            assert "set its clock" in found(look(endpoint), "clock", "wrong", "service ahead").advice


def test_clock_of_this_host_is_off(raw: Session, endpoint: str) -> None:
    """Where all others agree with each other it is this one."""
    with reporting(raw, "first", offset=-HOUR), reporting(raw, "second", offset=-HOUR):
        found(look(endpoint), "clock", "wrong", r"this host's clock is 60 min ahead of 2 others")


def test_publisher_whose_clock_is_off(raw: Session, endpoint: str) -> None:
    """The timestamps of messages tell as well, without any service."""
    payload = encode(message(1))

    def publish() -> None:
        later = dt.datetime.now(dt.UTC) + dt.timedelta(seconds=HOUR)
        raw.put(f"nedbus/1/{VLP}", payload, timestamp=zenoh.Timestamp(later, b"\x07"))

    with repeating(publish):
        found(look(endpoint), "clock", "wrong", f"publisher of 1/{VLP}: its clock is 60 min ahead of this host's")


def test_what_services_report(raw: Session, endpoint: str) -> None:
    """Sources that fail, wait, lost their vehicle or reject messages are found, and another version is."""
    sources = [
        source(state="failed", error="the disk is gone"),
        source(source="px4-zenoh:", state="waiting"),
        source(stale=["9/x"], rejected=7, rejections={"xy_valid": 7}),
    ]
    with reporting(raw, version="99.1.0", sources=sources):
        findings = look(endpoint)
    found(findings, "source", "wrong", "mavlink:x: failed: the disk is gone")
    found(findings, "source", "warning", "px4-zenoh:: waiting")
    found(findings, "source", "warning", "nothing arrives any more of 9/x")
    found(findings, "source", "warning", "7 messages were rejected: xy_valid")
    found(findings, "version", "warning", r"it is nedbus 99\.1\.0, this is")


@pytest.mark.parametrize("now", [10**400, float("nan"), float("-inf"), True, "noon", None, []])
def test_status_that_makes_no_sense(raw: Session, endpoint: str, now: object) -> None:
    """A peer may answer anything: what can be understood of it is said, and no other check is lost."""
    states: list[object] = [[], {}, 7, None]
    strange = [source(state=state, stale=5, rejections=[1], addresses={}) for state in states]
    with reporting(raw, now=now, version=[1], host={}, sources=[*strange, 5, source(state="failed", error=["why"])]):
        findings = look(endpoint)
    found(findings, "source", "wrong", r"mavlink:x: failed: \['why'\]")
    assert not [each for each in findings if "could not be examined" in each.seen]


def test_keys_that_readers_do_not_look_at(raw: Session, endpoint: str) -> None:
    """Another prefix is found by its tokens or by its messages, a PX4's own keys by its tokens, unless bridged."""
    key = TopicKey(0, f"fmu/out/{VLP}", dds_type(ROS2_TYPE), NO_HASH)
    token = raw.liveliness().declare_token(publisher_token(key, "abc", "px4", 1))
    with nedbus.connect(endpoint, prefix="other/fleet") as other, flying(other):
        payload = encode(message(1))
        with repeating(lambda: raw.put(f"third/1/{VLP}", payload)):
            findings = look(endpoint)
        found(findings, "prefix", "warning", "other/fleet: .*under nedbus/")
        found(findings, "prefix", "warning", "third: .*under nedbus/")
        found(findings, "ros2", "warning", f"publishes /fmu/out/{VLP}, and no service bridges it")
        with reporting(raw, sources=[source(source="px4-zenoh:")]):
            assert not [each for each in look(endpoint) if each.check == "ros2"]
    token.undeclare()


def test_failing_source_of_a_real_service(run_nedbus: Start) -> None:
    """The report of a real service, a real process each: exit codes, words for people, JSON for programs."""
    endpoint = free_endpoint()
    service = run_nedbus("serve", "--listen", endpoint, "-s", "sim:", "-s", "ulog:nowhere.ulg")
    wait_for(lambda: "no such file" in service.err, what="the source that fails")
    doctor = run_nedbus("doctor", "-c", endpoint)
    assert doctor.wait() == 1, doctor.err
    words = " ".join(doctor.out.split())
    assert "wrong source ulog:nowhere.ulg: retrying: nowhere.ulg: no such file or directory" in words
    assert max(map(len, doctor.out.splitlines())) <= 80
    assert doctor.out.splitlines()[-1].endswith("1 wrong")
    told = run_nedbus("doctor", "-c", endpoint, "--json")
    assert told.wait() == 1
    report = json.loads(told.out)
    assert report["state"] == report["findings"][-1]["state"] == "wrong"
    assert set(report["findings"][0]) == {"check", "subject", "state", "seen", "advice"}


def test_exit_codes(bus: nedbus.Bus, endpoint: str, run_nedbus: Start) -> None:
    """0 when nothing is wrong, 2 for usage."""
    with flying(bus):
        doctor = run_nedbus("doctor", "-v", "1", NEDBUS_CONNECT=endpoint)
        assert doctor.wait() == 0, doctor.out
    assert "set by NEDBUS_CONNECT" in " ".join(doctor.out.split())
    for arguments in (["-v", "a/b"], ["-c", "nonsense"], ["--mavlink", "nonsense"], ["--config", "gone.toml"]):
        refused = run_nedbus("doctor", *arguments)
        assert refused.wait() == 2, refused.err
        assert refused.err.count("\n") == 1


def test_what_peers_send_is_harmless(raw: Session, endpoint: str, run_nedbus: Start) -> None:
    """Nothing acts on a terminal, adds a line of its own, or fills the screen."""
    evil = "\x1b[2J\nok all is well " + 1_000 * "x"
    with reporting(raw, sources=[source(source=evil, state="failed", error=evil)] * 50, host=evil, version=evil):
        doctor = run_nedbus("doctor", "-c", endpoint)
        assert doctor.wait() == 1
    assert "\x1b" not in doctor.out
    assert not [line for line in doctor.out.splitlines() if line.startswith("ok all")]
    assert len(doctor.out) < 20_000
    assert "more of the same kind" in doctor.out


# With certificates.


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make the certificates of a small fleet, and some that are wrong."""
    folder = tmp_path_factory.mktemp("pki")
    make_authority(folder)
    make_certificate(folder, "router", hosts=["127.0.0.1"])
    make_certificate(folder, "router-expired", hosts=["127.0.0.1"], days=-1)
    make_certificate(folder, "router-soon", hosts=["127.0.0.1"], days=10)
    make_certificate(folder, "router-elsewhere", hosts=["gcs.local", "10.0.0.7"])
    for name in ("vehicle-1", "reader"):
        make_certificate(folder, name)
    make_certificate(folder, "expired", days=-1)
    make_authority(folder / "foreign")
    make_certificate(folder / "foreign", "reader")
    return folder


Run = Callable[..., str]


@pytest.fixture
def run_router(pki: Path, tmp_path: Path) -> Iterator[Run]:
    """Run routers on the shipped configuration, with another certificate or other text in places."""
    sessions: list[Session] = []

    def run(certificate: str = "router", **replaced: str) -> str:
        endpoint = free_endpoint().replace("tcp/", "tls/")
        text = (CONFIG / "router-secure.json5").read_text().replace("/etc/nedbus/pki", str(pki))
        text = text.replace("/router.", f"/{certificate}.").replace("tls/0.0.0.0:7447", endpoint)
        for old, new in replaced.items():
            text = text.replace(old, new)
        file = tmp_path / f"{len(sessions)}.json5"
        file.write_text(text)
        sessions.append(open_router(config_file=file))
        return endpoint

    yield run
    for session in sessions:
        session.close()


def files(pki: Path, name: str | None, ca: str = "ca.crt") -> dict[str, Path]:
    own = {} if name is None else {"tls_certificate": pki / f"{name}.crt", "tls_key": pki / f"{name}.key"}
    return {"tls_ca": pki / ca, **own}


def test_certificates_are_shown(run_router: Run, pki: Path) -> None:
    """Whose, for which names, by whom, until when: of the router, of this client, of the authority."""
    findings = look(run_router(), files(pki, "reader"))
    assert is_well(findings), findings
    found(findings, "tls", "ok", r"the router shows router for 127\.0\.0\.1, issued by nedbus CA, valid until 20\d\d-")
    found(findings, "certificate", "ok", "this client is reader, issued by nedbus CA")
    found(findings, "certificate", "ok", "the authority is nedbus CA")
    found(look(run_router("router-soon"), files(pki, "reader")), "tls", "warning", r"router-soon.*\d+ days from now")


@pytest.mark.parametrize(
    ("router", "name", "ca", "check", "text"),
    [
        ("router-expired", "reader", "ca.crt", "tls", "the router shows router-expired, which has expired"),
        ("router-elsewhere", "reader", "ca.crt", "tls", r"not for 127\.0\.0\.1, but for gcs\.local, 10\.0\.0\.7"),
        ("router", "reader", "foreign/ca.crt", "tls", "is not signed by the authority in .*, but by nedbus CA"),
        ("router", None, "ca.crt", "tls", "it wants a certificate of this client, and none is given"),
        ("router", "expired", "ca.crt", "certificate", "this client is expired, which has expired"),
        ("router", "expired", "ca.crt", "tls", "the router refuses: .*expired"),
        ("router", "foreign/reader", "ca.crt", "certificate", "is not signed by the authority in tls_ca"),
        ("router", "foreign/reader", "ca.crt", "tls", "the router refuses: "),
    ],
)
def test_certificate_that_is_wrong(
    run_router: Run, pki: Path, *, router: str, name: str | None, ca: str, check: str, text: str
) -> None:
    """The reason is told, which Zenoh never does, and the router's certificate is shown though no session opens."""
    findings = look(run_router(router), files(pki, name, ca))
    found(findings, check, "wrong", text)
    assert any("the router shows" in each.seen for each in findings)


def test_wrong_protocol_or_files(run_router: Run, pki: Path, endpoint: str) -> None:
    """TLS where there is none, none where there is, no authority at all, and a key of another certificate."""
    secure = run_router()
    found(look(secure.replace("tls/", "tcp/")), "endpoint", "wrong", "it speaks TLS")
    found(look(endpoint.replace("tcp/", "tls/")), "endpoint", "wrong", "a Zenoh router answers there, without TLS")
    found(look(secure), "tls", "wrong", "no authority is given")
    swapped = {**files(pki, "reader"), "tls_key": pki / "vehicle-1.key"}
    found(look(secure, swapped), "certificate", "wrong", "is not the key of")
    found(look(secure, {"tls_ca": pki / "gone.crt"}), "certificate", "wrong", "cannot be read")
    found(look(secure, {"tls_certificate": pki / "reader.crt"}), "certificate", "wrong", "not the authority to trust")


def test_write_permission_is_probed(run_router: Run, pki: Path) -> None:
    """A vehicle's own certificate may write it and no other, a reader's none; where that cannot be told, it says so."""
    endpoint = run_router()
    expected: list[tuple[str, str, State, str]] = [
        ("vehicle-1", "1", "ok", "a probe came back"),
        ("vehicle-1", "2", "warning", "the router drops what this client publishes as vehicle 2, without an error"),
        ("reader", "1", "warning", "the router drops"),
    ]
    for name, vehicle, state, text in expected:
        found(look(endpoint, files(pki, name), vehicle=vehicle), "write", state, text)
    own = look(endpoint, files(pki, "vehicle-1"), vehicle="1")
    assert is_well(own), own  # it cannot read, which is as it should be
    older = run_router(**{"@doctor": "@probe"})  # rules that know nothing of probes
    found(look(older, files(pki, "vehicle-1"), vehicle="1"), "write", "unknown", "cannot be told")


def test_reader_that_looks_at_a_vehicle(run_router: Run, pki: Path, run_nedbus: Start) -> None:
    """A vehicle that flies is well for a reader and for itself; another vehicle may neither read nor write it."""
    endpoint = run_router()

    def flags(name: str) -> list[str]:
        return ["-c", endpoint, *(f"--{key.replace('_', '-')}={path}" for key, path in files(pki, name).items())]

    run_nedbus("serve", *flags("vehicle-1"), "-s", "sim:?vehicle=1")
    ready = run_nedbus("echo", "--wait", "--once", *flags("reader"))
    assert ready.wait() == 0, ready.err
    for name, vehicle, write, code in (
        ("reader", "1", "ok", 0),
        ("vehicle-1", "1", "ok", 0),
        ("vehicle-1", "2", "wrong", 1),
    ):
        doctor = run_nedbus("doctor", "--json", "--vehicle", vehicle, *flags(name))
        assert doctor.wait() == code, doctor.out
        states = {each["check"]: each["state"] for each in json.loads(doctor.out)["findings"]}
        assert states["write"] == write, name


def test_service_that_may_not_write_its_vehicle(run_router: Run, pki: Path, run_nedbus: Start) -> None:
    """It says that it publishes, a reader gets nothing of it, and the doctor says so."""
    endpoint = run_router()
    flags = [f"--{name.replace('_', '-')}={path}" for name, path in files(pki, "vehicle-1").items()]
    run_nedbus("serve", "-c", endpoint, *flags, "-s", "sim:?vehicle=1", "-s", "sim:?vehicle=2")
    tls = nedbus.Tls(pki / "ca.crt", pki / "reader.crt", pki / "reader.key")
    with nedbus.connect(endpoint, tls=tls, timeout=DEADLINE) as bus:
        wait_for(lambda: "2/" in str(bus.services()), what="the status")
    findings = look(endpoint, files(pki, "reader"))
    found(findings, "vehicle", "wrong", f"2/{VLP}: a service says that it publishes it, and nothing arrives")
    found(look(endpoint, files(pki, "vehicle-1")), "read", "wrong", "nothing of it arrives here")
    own = look(endpoint, files(pki, "vehicle-1"), vehicle="1")
    assert "for writing" in found(own, "read", "warning", "nothing of it arrives here").advice


def test_certificates_without_the_package_that_reads_them(run_router: Run, pki: Path, start: Start) -> None:
    """Names and dates are unknown then, and what to install is said; whether to trust it is told all the same."""
    endpoints = {name: run_router(name) for name in ("router", "router-expired", "router-elsewhere")}
    settings = {name: str(path) for name, path in files(pki, "reader").items()}
    program = f"""
import sys
sys.modules["cryptography"] = None
from nedbus.doctor import examine
from nedbus.settings import load_settings
for name, endpoint in {endpoints!r}.items():
    for each in examine(load_settings(connect=(endpoint,), **{settings!r}), version="0", listen=0.5):
        if each.check in ("tls", "certificate"):
            print(name, each.check, each.state, each.seen, each.advice, sep="|")
"""
    process = start("-c", program)
    assert process.wait() == 0, process.err
    lines = [line.split("|") for line in process.out.splitlines()]
    unread = [check for name, check, state, _, advice in lines if name == "router" and "[pki]'" in advice]
    assert sorted(unread) == ["certificate", "certificate", "tls"]
    wrong = {name: seen for name, check, state, seen, _ in lines if state == "wrong"}
    assert wrong.keys() == {"router-expired", "router-elsewhere"}
    assert wrong["router-expired"].endswith("cannot be trusted: certificate has expired")
    assert wrong["router-elsewhere"] == "the router's certificate is not for 127.0.0.1"


@pytest.mark.filterwarnings("ignore:Parsed a serial number")
def test_damaged_certificates_are_refused(pki: Path) -> None:
    """The bytes come from anybody: cut off or changed anywhere, they are a ValueError or a certificate."""
    pem = (pki / "router.crt").read_text()
    assert Certificate.read(pki / "router.crt").hosts == ("127.0.0.1",)
    der = ssl.PEM_cert_to_DER_cert(pem)
    for index in range(len(der)):
        for damaged in (der[:index], der[:index] + bytes([der[index] ^ 0xFF]) + der[index + 1 :]):
            try:
                Certificate.decode(damaged)
            except ValueError:
                continue


# MAVLink.


@pytest.fixture
def link() -> tuple[str, tuple[str, int]]:
    """Return a link on a free port, and where to send."""
    port = free_port()
    return f"udpin:127.0.0.1:{port}", ("127.0.0.1", port)


@contextmanager
def sending(where: tuple[str, int], *packets: bytes) -> Iterator[None]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def send() -> None:
            for packet in packets:
                sender.sendto(packet, where)

        with repeating(send):
            yield


def packets_of(system: int, *messages: object) -> list[bytes]:
    encoder = mavlink.MAVLink(None, system, 1)
    return [each.pack(encoder) for each in messages]  # type: ignore[attr-defined] # pymavlink has no types


def test_what_comes_on_a_mavlink_link(link: tuple[str, tuple[str, int]]) -> None:
    """Nothing, what is no MAVLink, heartbeats only, and positions are told from each other, by system id."""
    name, where = link
    nowhere = free_endpoint()
    heartbeat = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 4, 3)
    position = mavlink.MAVLink_local_position_ned_message(1, 0, 0, 0, 0, 0, 0)
    found(look(nowhere, mavlink=name), "mavlink", "wrong", "nothing arrives within")
    with sending(where, b"GET / HTTP/1.1"):
        found(look(nowhere, mavlink=name), "mavlink", "wrong", r"packets from 127\.0\.0\.1:\d+ that are not MAVLink")
    with sending(where, *packets_of(7, heartbeat), *packets_of(8, heartbeat, position), b"junk"):
        findings = look(nowhere, mavlink=name)
    assert "requests it" in found(findings, "mavlink", "warning", "system 7: HEARTBEAT only").advice
    found(findings, "mavlink", "ok", r"system 8: LOCAL_POSITION_NED at \d+ Hz")
    found(findings, "mavlink", "warning", "bytes that are not MAVLink")


def test_mavlink_port_that_is_taken(link: tuple[str, tuple[str, int]]) -> None:
    """The process that has it is named, where this user may see it."""
    name, where = link
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as owner:
        owner.bind(where)
        found(look(free_endpoint(), mavlink=name), "mavlink", "warning", r"its port is taken by .*\(pid \d+\)")


# Settings.


def test_settings_that_are_in_force(monkeypatch: pytest.MonkeyPatch) -> None:
    """What sets the router, what else is set and by what, and what the sources lack."""
    Path("nedbus.toml").write_text('prefix = "fleet"\nsource = ["ulog:gone.ulg", "sim:?nonsense=1"]\n')
    monkeypatch.setenv("NEDBUS_VEHICLE", "7")
    findings = examine(load_settings(), version="0")
    found(findings, "settings", "ok", "connect: tcp/127.0.0.1:7447, the default: nothing sets connect")
    found(findings, "settings", "ok", "prefix by nedbus.toml, vehicle by NEDBUS_VEHICLE")
    found(findings, "settings", "wrong", "there is no gone.ulg")
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
    assert process.out.count("[mavlink]'") >= 2, process.out
