"""config/router-secure.json5 and `nedbus pki`: who may do what, proved by what arrives; denials are silent in Zenoh."""

from __future__ import annotations

import json
import re
import signal
import stat
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

import pytest
import zenoh

import nedbus
from nedbus.client.acknowledgement import WINDOW
from nedbus.daemon.write_permission import WritePermission
from nedbus.transport import (
    Session,
    make_authority,
    make_certificate,
    open_client,
    open_router,
    write_access_rules,
)
from nedbus_msgs import Address, encode
from nedbus_msgs.arrays import to_array
from tests.conftest import DEADLINE, Process, Start, free_endpoint, free_port, message, wait_for
from tests.service.test_max_rate import Clock, clock, publish, take, wait_for_demand
from tests.service.test_px4_zenoh import Px4
from tests.zenohd import start_zenohd

__all__ = ["clock"]

CONFIG = Path(__file__).parents[2] / "config"
VLP = "vehicle_local_position"

Join = Callable[[str], nedbus.Bus]


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make the certificates of a small fleet, and some that must not work."""
    folder = tmp_path_factory.mktemp("pki")
    make_authority(folder)
    make_certificate(folder, "router", hosts=["127.0.0.1", "localhost"])
    for name in ("vehicle-1", "vehicle-2", "reader", "operator"):
        make_certificate(folder, name)
    make_certificate(folder, "expired", days=-1)
    make_authority(folder / "foreign")
    make_certificate(folder / "foreign", "reader")
    return folder


@pytest.fixture
def configured(pki: Path, tmp_path: Path) -> tuple[Path, str]:
    """Copy the shipped configuration, with these certificates and a free port; return the file and its endpoint."""
    endpoint = free_endpoint().replace("tcp/", "tls/")
    text = (CONFIG / "router-secure.json5").read_text().replace("/etc/nedbus/pki", str(pki))
    file = tmp_path / "router-secure.json5"
    file.write_text(text.replace("tls/0.0.0.0:7447", endpoint))
    return file, endpoint


@pytest.fixture
def secure(configured: tuple[Path, str]) -> Iterator[str]:
    """Run a router on the shipped configuration."""
    file, endpoint = configured
    session = open_router(config_file=file)
    yield endpoint
    session.close()


@pytest.fixture
def join(secure: str, pki: Path) -> Iterator[Join]:
    """Connect as somebody."""
    opened: list[nedbus.Bus] = []

    def join_as(name: str) -> nedbus.Bus:
        ca, certificate, key = (pki / file for file in ("ca.crt", f"{name}.crt", f"{name}.key"))
        bus = nedbus.connect(secure, tls=nedbus.Tls(ca, certificate, key), timeout=DEADLINE)
        opened.append(bus)
        return bus

    yield join_as
    for bus in opened:
        bus.close()


def test_vehicle_is_read_whole(join: Join) -> None:
    """Through the secure router everything works as through an open one: data, liveliness, last values, recovery."""
    publisher = join("vehicle-1").publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    reader = join("reader")
    wait_for(lambda: reader.latest(VLP), what="the last value")
    wait_for(lambda: "1" in reader.vehicles(), what="the vehicle")
    with reader.subscribe("*", mode="every") as subscription:
        assert subscription.receive(DEADLINE).message.timestamp == 1
        for timestamp in range(2, 500):
            publisher.publish(message(timestamp))
        assert [subscription.receive(DEADLINE).message.timestamp for _ in range(2, 500)] == list(range(2, 500))


def test_vehicle_learns_what_was_read(join: Join) -> None:
    """A vehicle may ask readers how far they are, and they may answer: it waits for one that reads nothing."""
    publisher = join("vehicle-1").publisher(VLP, vehicle="1", lossless=True)
    publisher.publish(message(1))
    with join("reader").subscribe("*", mode="every") as subscription:
        assert subscription.receive(DEADLINE).message.timestamp == 1
        count = 3 * WINDOW
        sending = threading.Thread(
            target=publisher.publish_many, args=[to_array([message(number) for number in range(2, count + 1)])]
        )
        sending.start()
        wait_for(lambda: publisher.published > WINDOW, what="the first window")
        assert publisher.published < count
        assert [subscription.receive(DEADLINE).message.timestamp for _ in range(2, count + 1)][-1] == count
        sending.join(DEADLINE)
        assert publisher.flush()


@pytest.mark.parametrize("intruder", ["vehicle-2", "reader", "operator"])
def test_nobody_else_writes_a_vehicles_keys(join: Join, intruder: str) -> None:
    """What an intruder publishes as vehicle 1 reaches nobody: no data, no liveliness, no last value."""
    genuine = join("vehicle-1").publisher(VLP, vehicle="1")
    genuine.publish(message(1))
    reader = join("reader")
    with reader.subscribe("*", mode="every") as subscription:
        assert subscription.receive(DEADLINE).message.timestamp == 1
        other = join(intruder)
        other.publisher(VLP, vehicle="1").publish(message(666))
        other.publisher(VLP, vehicle="3").publish(message(667))
        genuine.publish(message(2))
        assert subscription.receive(DEADLINE).message.timestamp == 2
        genuine.publish(message(3))
        assert subscription.receive(DEADLINE).message.timestamp == 3
        assert [sample.message.timestamp for sample in reader.latest("*")] == [3]
        assert list(reader.vehicles()) == ["1"]


def test_vehicle_does_not_read_others(join: Join) -> None:
    """A vehicle's certificate is for writing: it gets no data, from another vehicle's keys or its own."""
    join("vehicle-1").publisher(VLP, vehicle="1").publish(message(1))
    wait_for(join("reader").latest, what="the message")
    assert join("vehicle-2").latest("*") == []


def test_only_operators_see_the_admin_space(join: Join) -> None:
    """Who is connected is for operators to ask."""
    operator, reader = join("operator"), join("reader")
    wait_for(lambda: [reply.ok for reply in operator._session.get("@/*/router")], what="an answer to the operator")
    assert [reply.ok for reply in reader._session.get("@/*/router")] == []


@pytest.mark.parametrize(
    ("ca", "certificate"),
    [
        ("ca.crt", None),  # no certificate
        ("ca.crt", "foreign/reader"),  # signed by somebody else
        ("foreign/ca.crt", "reader"),  # trusts somebody else
        ("ca.crt", "expired"),
    ],
)
def test_stranger_is_refused_with_a_hint(secure: str, pki: Path, ca: str, certificate: str | None) -> None:
    """The error says what to check, as Zenoh says nothing."""
    own, key = (None, None) if certificate is None else (pki / f"{certificate}.crt", pki / f"{certificate}.key")
    with pytest.raises(nedbus.ConnectError, match=r"check that tls_ca is the router's authority"):
        nedbus.connect(secure, tls=nedbus.Tls(pki / ca, own, key), timeout=0.3)


def test_plain_tcp_is_refused(secure: str) -> None:
    """The secure router speaks TLS only."""
    with pytest.raises(nedbus.ConnectError):
        nedbus.connect(secure.replace("tls/", "tcp/"), timeout=0.3)


@pytest.mark.parametrize(
    ("ca", "certificate", "key", "reason"),
    [
        (None, "vehicle-1.crt", "vehicle-1.key", "tls_ca: a certificate is given, but not"),
        ("ca.crt", None, "vehicle-1.key", "a certificate needs its key"),
        ("gone.crt", None, None, "gone.crt cannot be read"),
    ],
)
def test_half_a_setting_is_refused(
    pki: Path, monkeypatch: pytest.MonkeyPatch, *, ca: str | None, certificate: str | None, key: str | None, reason: str
) -> None:
    """A missing half or file is reported before anything is dialled, from the settings as from a script."""
    paths = [pki / file if file else None for file in (ca, certificate, key)]
    if paths[0] is not None:
        with pytest.raises(nedbus.ConfigError, match=reason):
            nedbus.connect("tls/127.0.0.1:1", timeout=0.1, tls=nedbus.Tls(paths[0], paths[1], paths[2]))
    for name, path in zip(("TLS_CA", "TLS_CERTIFICATE", "TLS_KEY"), paths, strict=True):
        if path is not None:
            monkeypatch.setenv(f"NEDBUS_{name}", str(path))
    with pytest.raises(nedbus.ConfigError, match=reason):
        nedbus.connect("tls/127.0.0.1:1", timeout=0.1)


def test_commands_use_certificates(secure: str, pki: Path, run_nedbus: Start) -> None:
    """The service and the commands take the same three files, as flags or from the environment."""
    vehicle = [f"--tls-ca={pki}/ca.crt", f"--tls-certificate={pki}/vehicle-1.crt", f"--tls-key={pki}/vehicle-1.key"]
    run_nedbus("serve", "--connect", secure, *vehicle, "-s", "sim:")
    environment = {
        "NEDBUS_TLS_CA": f"{pki}/ca.crt",
        "NEDBUS_TLS_CERTIFICATE": f"{pki}/reader.crt",
        "NEDBUS_TLS_KEY": f"{pki}/reader.key",
    }
    echo = run_nedbus("echo", "-c", secure, "-n", "20", **environment)
    assert echo.wait() == 0, echo.err
    assert len(echo.out.splitlines()) == 20
    info = run_nedbus("info", "-c", secure, **environment)
    assert info.wait() == 0
    assert "sim:" in info.out


def test_service_as_a_router_joins_with_its_certificate(secure: str, pki: Path, join: Join, run_nedbus: Start) -> None:
    """The embedded router of a vehicle shows its certificate to the router that it joins, as a client does."""
    files = [f"--tls-ca={pki}/ca.crt", f"--tls-certificate={pki}/vehicle-1.crt", f"--tls-key={pki}/vehicle-1.key"]
    near = free_endpoint()
    service = run_nedbus("serve", "--listen", near, "--connect", secure, *files, "-s", "sim:")
    wait_for(lambda: f"joined {secure}" in service.err, what=f"the link: {service.err}")
    wait_for(join("reader").latest, what="the vehicle behind its router")
    swapped = run_nedbus("serve", "--listen", free_endpoint(), "--connect", secure, "--tls-ca", "no.crt", "-s", "sim:")
    assert swapped.wait() == 2
    assert "no.crt cannot be read" in swapped.err


def test_health_of_a_vehicle_is_what_readers_get(secure: str, pki: Path, run_nedbus: Start) -> None:
    """A service that may not write its vehicle says that it publishes; a reader gets nothing, and health says so."""
    files = [f"--tls-ca={pki}/ca.crt", f"--tls-certificate={pki}/vehicle-1.crt", f"--tls-key={pki}/vehicle-1.key"]
    reader = [f"--tls-ca={pki}/ca.crt", f"--tls-certificate={pki}/reader.crt", f"--tls-key={pki}/reader.key"]
    run_nedbus("serve", "--connect", secure, *files, "-s", "sim:?vehicle=1", "-s", "sim:?vehicle=2")

    def health(vehicle: str) -> tuple[int, str]:
        process = run_nedbus("health", "-c", secure, "-v", vehicle, *reader)
        return process.wait(), process.err

    wait_for(lambda: health("1")[0] == 0, what="the vehicle that it may write")
    code, reason = health("2")
    assert code == 1
    assert "vehicle 2 is not published, though its service reports that it is" in reason


def test_px4_reaches_the_secure_router_through_its_own(join: Join, secure: str, pki: Path, run_nedbus: Start) -> None:
    """A PX4 without TLS is read through a service beside it that is its router; its own keys stay there."""
    files = [f"--tls-ca={pki}/ca.crt", f"--tls-certificate={pki}/vehicle-1.crt", f"--tls-key={pki}/vehicle-1.key"]
    beside = free_endpoint()
    service = run_nedbus(
        "serve", "--vehicle", "1", "-s", "px4-zenoh:", "--listen", beside, "--connect", secure, *files
    )  # fmt: skip
    wait_for(lambda: f"joined {secure}" in service.err, what="the secure link")
    reader = join("reader")
    beyond = reader._session.declare_subscriber("*/fmu/**", zenoh.handlers.RingChannel(10))
    with reader.subscribe("*", mode="every") as subscription, nedbus.connect(beside) as on_vehicle:
        px4 = Px4(on_vehicle._session)
        for timestamp in range(1, 101):
            px4.put(timestamp)
        samples = [subscription.receive(DEADLINE) for _ in range(100)]
    assert {(sample.vehicle, sample.topic, sample.source) for sample in samples} == {("1", VLP, "px4-zenoh")}
    assert [sample.message.timestamp for sample in samples] == list(range(1, 101))
    assert beyond.try_recv() is None


def test_list_does_not_ask_for_a_source_that_is_there(secure: str, pki: Path, run_nedbus: Start) -> None:
    """Where a service answers and no vehicle is seen, the hint is about what the router lets through."""
    files = [f"--tls-ca={pki}/ca.crt", f"--tls-certificate={pki}/vehicle-1.crt", f"--tls-key={pki}/vehicle-1.key"]
    reader = [f"--tls-ca={pki}/ca.crt", f"--tls-certificate={pki}/reader.crt", f"--tls-key={pki}/reader.key"]

    def hint() -> str:
        listed = run_nedbus("list", "-c", secure, *reader)
        assert listed.wait() == 0
        return listed.err

    assert "start a source with 'nedbus serve'" in hint()
    run_nedbus("serve", "--connect", secure, *files, "-s", "sim:?vehicle=2")
    wait_for(lambda: "a service answers, so see 'nedbus info'" in hint(), what="the other hint")


def test_pki_commands_never_overwrite(tmp_path: Path, run_nedbus: Start) -> None:
    """Keys are made once, for their owner only, and never shown."""
    folder = tmp_path / "pki"
    assert run_nedbus("pki", "cert", str(folder), "reader").wait() == 1
    for arguments in (["ca", str(folder)], ["cert", str(folder), "router", "--host", "127.0.0.1", "--host", "gcs"]):
        made = run_nedbus("pki", *arguments)
        assert made.wait() == 0, made.err
        key = Path(made.out.splitlines()[0])
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
        before = key.read_bytes()
        assert b"PRIVATE KEY" in before
        assert "PRIVATE" not in made.out + made.err
        again = run_nedbus("pki", *arguments)
        assert again.wait() == 1
        assert "it is not overwritten" in again.err
        assert key.read_bytes() == before
    assert run_nedbus("pki", "cert", str(folder), "../evil").wait() == 1


def test_router_files_set_what_they_must_and_are_commented() -> None:
    """Both files set the same outer blocks, and are full of reasons; whether these are good, a reader judges."""
    for name in ("router.json5", "router-secure.json5"):
        text = (CONFIG / name).read_text()
        assert len(re.findall(r"^\s*//", text, re.MULTILINE)) > 10
        open_words = re.findall(r"^  (\w+):", text, re.MULTILINE)
        assert {"mode", "listen", "scouting", "timestamping", "adminspace", "transport"} <= set(open_words)


def test_missing_certificate_is_named(run_nedbus: Start, tmp_path: Path) -> None:
    """A router whose certificates were forgotten says which file it misses."""
    file = tmp_path / "secure.json5"
    file.write_text((CONFIG / "router-secure.json5").read_text().replace("/etc/nedbus/pki", str(tmp_path / "nowhere")))
    router = run_nedbus("router", str(file))
    assert router.wait() == 2
    assert re.search(r"secure\.json5: \w+: \S+/nowhere/\S+ cannot be read: does it exist", router.err)


@pytest.mark.parametrize(
    ("command", "environment"),
    [(("router",), {}), (("serve", "-s", "sim:", "--router-config"), {"RUST_LOG": "zenoh=info"})],
    ids=["router", "service"],
)
def test_refused_clients_are_logged(
    run_nedbus: Start, pki: Path, tmp_path: Path, *, command: tuple[str, ...], environment: dict[str, str]
) -> None:
    """A router tells why it refuses a client, on stderr as all its log; what RUST_LOG asks of Zenoh is on stdout."""
    file, endpoint = tmp_path / "secure.json5", free_endpoint().replace("tcp/", "tls/")
    text = (CONFIG / "router-secure.json5").read_text().replace("/etc/nedbus/pki", str(pki))
    file.write_text(text.replace("tls/0.0.0.0:7447", endpoint))
    router = run_nedbus(*command, str(file), **environment)
    wait_for(lambda: f"router on {endpoint}" in router.err, what="the router")
    with nedbus.connect(endpoint, tls=nedbus.Tls(pki / "ca.crt", pki / "reader.crt", pki / "reader.key")) as bus:
        assert bus.connected
    assert "refused" not in router.err

    def logged(line: str) -> bool:
        return line in router.err

    for name, ca, reason in (
        ("foreign/reader", "ca.crt", "its certificate is of another authority"),
        ("expired", "ca.crt", "its certificate has expired"),
        (None, "ca.crt", "it shows no certificate"),
        ("reader", "foreign/ca.crt", "it does not accept the certificate of this router"),
    ):
        own = (pki / f"{name}.crt", pki / f"{name}.key") if name else (None, None)
        with pytest.raises(nedbus.ConnectError):
            nedbus.connect(endpoint, tls=nedbus.Tls(pki / ca, *own), timeout=0.1)
        wait_for(partial(logged, f"WARNING a client is refused: {reason}\n"), what=reason)
    with pytest.raises(nedbus.ConnectError):
        nedbus.connect(endpoint.replace("tls/", "tcp/"), timeout=0.1)
    wait_for(partial(logged, "a client is refused: it does not speak TLS\n"), what="the client without TLS")
    assert ("Zenoh can be reached at" in router.out) == bool(environment)
    assert "certificate" not in router.out


def test_open_router_file_works() -> None:
    """config/router.json5 starts a router that needs nothing else."""
    endpoint = free_endpoint()
    file = CONFIG / "router.json5"
    copy = Path("router.json5")
    copy.write_text(file.read_text().replace("tcp/0.0.0.0:7447", endpoint))
    session = open_router(config_file=copy)
    with nedbus.connect(endpoint) as bus:
        bus.publisher(VLP, vehicle="1").publish(message(1))
        wait_for(bus.latest, what="the message")
    session.close()


def test_thinned_stream_flows_as_the_stream_does(join: Join, clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    """A reader with a maximum rate gets what the vehicle thins, and its cache; nobody else writes it."""
    publisher = join("vehicle-1").publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    stranger, reader = join("vehicle-2"), join("reader")
    with reader.subscribe(mode="every", max_rate=5) as subscription:
        assert take(subscription, 1) == [1]
        wait_for_demand(publisher)
        stranger._session.put(Address("1", VLP).rate_key(5), encode(message(666)))
        publish(publisher, clock, 2, 1000)
        assert take(subscription, 50) == list(range(2, 1002, 20))
        assert subscription.counts.lost == 0
        assert "nobody" not in caplog.text


def flags_of(pki: Path, name: str) -> list[str]:
    """Return the options of a command that shows a certificate."""
    files = {"ca": "ca.crt", "certificate": f"{name}.crt", "key": f"{name}.key"}
    return [f"--tls-{option}={pki / file}" for option, file in files.items()]


def ask(where: str) -> tuple[int, str]:
    """Return the status and the text of a page, 0 where none is served."""
    try:
        with urllib.request.urlopen(f"http://{where}", timeout=DEADLINE) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as exc:
        return exc.code, exc.read().decode()
    except OSError:
        return 0, ""


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("certificate", "kind"),
    [("vehicle-1", "nedbus"), ("vehicle-2", "zenohd")],
    ids=["certificate of another vehicle", "certificate without a rule"],
)
def test_refused_service_says_so_until_the_rules_are_mended(
    configured: tuple[Path, str], pki: Path, run_nedbus: Start, start: Start, *, certificate: str, kind: str
) -> None:
    """Log, health, metrics and `nedbus info` say that nothing of vehicle 2 passes the router, until something does."""
    file, endpoint = configured

    def start_router() -> Process:
        return run_nedbus("router", str(file)) if kind == "nedbus" else start_zenohd(start, "-c", str(file))

    router, pages = start_router(), f"127.0.0.1:{free_port()}"
    service = run_nedbus("serve", "-c", endpoint, *flags_of(pki, certificate), "-s", "sim:?vehicle=2", "--http", pages)
    wait_for(
        lambda: "the router refuses vehicle 2: nothing of it reaches anybody" in service.err,
        what="the refusal",
        seconds=120,
    )
    refused = (503, "the router refuses vehicle 2\n")
    assert (ask(f"{pages}/healthz"), ask(f"{pages}/readyz")) == (refused, refused)
    assert 'nedbus_vehicle_refused{vehicle="2"} 1.0' in ask(f"{pages}/metrics")[1]
    assert json.loads(ask(f"{pages}/status")[1])["refused"] == ["2"]
    if certificate == "vehicle-1":  # else not even its status passes
        info = run_nedbus("info", "--wait", "-c", endpoint, *flags_of(pki, "reader"))
        assert info.wait() == 0, info.err
        assert "refused by the router: vehicle 2" in info.out
        assert re.search(rf"2/{VLP} .*refused by the router", info.out)
        health = run_nedbus("health", "--wait", "-c", endpoint, *flags_of(pki, "reader"))
        assert health.wait() == 1
        assert "the router refuses vehicle 2" in health.err

    write_access_rules(file, ["1", "2"])
    own = '{ rules: ["vehicle-2-in"], subjects: ["vehicle-2"] }'
    assert own in file.read_text()
    file.write_text(file.read_text().replace(own, own.replace('vehicle-2"] }', f'{certificate}"] }}')))
    router.kill()
    start_router()
    wait_for(lambda: "the router takes vehicle 2 now: all is well again" in service.err, what="its end", seconds=120)
    assert (ask(f"{pages}/healthz"), ask(f"{pages}/readyz")) == ((200, "ok\n"), (200, "ready\n"))
    assert 'nedbus_vehicle_refused{vehicle="2"} 0.0' in ask(f"{pages}/metrics")[1]
    health = run_nedbus("health", "--wait", "-c", endpoint, "--vehicle", "2", *flags_of(pki, "reader"))
    assert health.wait() == 0, health.err


def look(permission: WritePermission, times: int = 3) -> Mapping[str, bool]:
    """Look several times at which vehicles the router refuses, and return what is known then."""
    for _ in range(times):
        permission.check()
    return permission.refused


def permission_of(session: Session, endpoint: str, tls: nedbus.Tls) -> WritePermission:
    return WritePermission(session, [endpoint], tls=tls, prefix="nedbus", vehicles=lambda: {"1", "2"})


def test_router_that_joins_is_refused_as_a_client_is(secure: str, pki: Path) -> None:
    """What the service of an embedded router publishes passes the router that it joins, or not, by its certificate."""
    tls = nedbus.Tls(pki / "ca.crt", pki / "vehicle-1.crt", pki / "vehicle-1.key")
    with open_router(listen=(free_endpoint(),), connect=(secure,), tls=tls) as session:
        permission = permission_of(session, secure, tls)
        wait_for(lambda: look(permission, 1) == {"1": False}, what="the vehicle that is allowed")
        assert look(permission) == {"1": False, "2": True}


def test_only_access_rules_are_a_refusal(
    configured: tuple[Path, str], pki: Path, run_nedbus: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A router with older rules, without any, that is away, or that is frozen, refuses nobody."""
    monkeypatch.setattr("nedbus.daemon.write_permission._OPEN", 0.5)
    file, endpoint = configured
    shipped = file.read_text()
    tls = nedbus.Tls(pki / "ca.crt", pki / "vehicle-1.crt", pki / "vehicle-1.key")

    def start_router(text: str) -> Process:
        file.write_text(text)
        return run_nedbus("router", str(file))

    older = start_router(shipped.replace("@doctor", "@probe"))
    with open_client([endpoint], timeout=DEADLINE, tls=tls) as session:
        permission = permission_of(session, endpoint, tls)
        assert look(permission) == {}
        older.kill()
        assert look(permission) == {}
        rules = "access_control: {\n    enabled: "
        assert f"{rules}true" in shipped
        plain = start_router(shipped.replace(f"{rules}true", f"{rules}false"))
        wait_for(lambda: look(permission, 1) == {"1": False, "2": False}, what="a router that takes everything")
        plain.signal(signal.SIGSTOP)
        assert look(permission) == {"1": False, "2": False}
        plain.signal(signal.SIGCONT)
