"""Access control of config/router-secure.json5, tested by reception, because Zenoh drops denied messages silently."""

from __future__ import annotations

import json
import re
import signal
import stat
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Final

import pytest
import zenoh

import nedbus
from nedbus.client.publishing.flow_control import WINDOW
from nedbus.client.publishing.publish_permission import PublishPermission
from nedbus.daemon.write_permission import WritePermission
from nedbus.errors import RefusedError
from nedbus.pki import write_access_rules
from nedbus.timings import Timings
from nedbus.transport import (
    Session,
    WriteVerdict,
    open_client,
    open_router,
    query,
    read_router_config,
)
from nedbus_msgs import Address, define, field_type
from nedbus_msgs.arrays import to_array
from tests.flights.local_position import encode
from tests.flights.messages import VLP, message
from tests.flights.ulogs import write_log
from tests.nedbus.client.downsampling import Clock, clock, publish, wait_for_downsampling_reader
from tests.nedbus.client.numbered import receive_timestamps
from tests.nedbus.sources.px4.test_source import Px4
from tests.peers.certificates import (
    CONFIG,
    client_tls,
    pki,
    secure_endpoint,
    tls_options,
    write_config,
)
from tests.peers.command_line import run_command, run_until_shown
from tests.peers.custom_timings import start_with_timings
from tests.peers.http_client import HttpClient
from tests.peers.ports import free_endpoint, free_port
from tests.peers.processes import Process, Start
from tests.peers.queryables import answer_queries, reply_with
from tests.peers.zenohd import ROUTER_KINDS, start_zenohd
from tests.waits import DEADLINE, wait_for, wait_for_matching

from .size_limits import received_sizes

__all__ = ["clock", "pki"]

Join = Callable[[str], nedbus.Bus]
Open = Callable[[str], Session]
NAME: Final = "VehicleLocalPosition"


@pytest.fixture
def configured(pki: Path, tmp_path: Path) -> tuple[Path, str]:
    """Write the shipped configuration with test certificates and a free port; return file and endpoint."""
    endpoint = secure_endpoint()
    return write_config(pki, tmp_path / "router-secure.json5", endpoint), endpoint


@pytest.fixture(params=ROUTER_KINDS)
def secure(request: pytest.FixtureRequest, configured: tuple[Path, str]) -> Iterator[str]:
    """Run an embedded router, or a real zenohd, with the shipped configuration."""
    file, endpoint = configured
    if request.param == "zenohd":
        start_zenohd(request.getfixturevalue("start"), "-c", str(file))
        yield endpoint
    else:
        with open_router(config_file=file):
            yield endpoint


@pytest.fixture
def join(secure: str, pki: Path) -> Iterator[Join]:
    """Yield a function that connects a bus with the certificate of a given name."""
    with ExitStack() as opened:
        yield lambda name: opened.enter_context(
            nedbus.connect(secure, tls=client_tls(pki, name), timeout=DEADLINE)
        )


@pytest.fixture
def open_as(secure: str, pki: Path) -> Iterator[Open]:
    """Yield a function that opens a plain Zenoh session with the certificate of a given name."""
    with ExitStack() as opened:
        yield lambda name: opened.enter_context(
            open_client([secure], tls=client_tls(pki, name), timeout=DEADLINE)
        )


def test_reader_receives_all_data_of_a_vehicle(join: Join) -> None:
    """Data, liveliness, last values, recovery and acknowledgements work through the secure router."""
    publisher = join("vehicle-1").publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    reader = join("reader")
    wait_for(lambda: reader.latest(VLP), what="the last value")
    wait_for(lambda: "1" in reader.vehicles(), what="the vehicle")
    with reader.subscribe("*", mode="every") as subscription:
        assert receive_timestamps(subscription, 1) == [1]
        for timestamp in range(2, 1000):
            publisher.publish(message(timestamp))
        assert receive_timestamps(subscription, 998) == list(range(2, 1000))
    assert publisher.flush()


@pytest.mark.slow
def test_lossless_publisher_waits_for_a_slow_reader(join: Join) -> None:
    """Vehicles may query the acknowledgements of readers, so a lossless publisher waits for a slow reader."""
    publisher = join("vehicle-1").publisher(VLP, vehicle="1", lossless=True)
    publisher.publish(message(1))
    with join("reader").subscribe("*", mode="every") as subscription:
        assert receive_timestamps(subscription, 1) == [1]
        count = 3 * WINDOW
        many = to_array([message(number) for number in range(2, count + 1)])
        sending = threading.Thread(target=publisher.publish_many, args=[many])
        sending.start()
        wait_for(lambda: publisher.published > WINDOW, what="the first window")
        assert publisher.published < count
        assert receive_timestamps(subscription, count - 1)[-1] == count
        sending.join(DEADLINE)
        assert publisher.flush()
        publisher.close()  # a later close would wait for the reader to reconnect


def test_message_that_is_not_built_in_is_decoded(join: Join) -> None:
    """Readers may query vehicles for definitions that are not built in, although no rule names the topic."""
    vehicle, reader = join("vehicle-1"), join("reader")
    definition = define(
        "WheelEncoders",
        [("timestamp", field_type("uint64")), ("wheel_speed", field_type("float32[2]"))],
    )
    encoders = vehicle._publishers.publisher(Address("1", "wheel_encoders"), definition)
    attitude = vehicle.publisher("vehicle_attitude", vehicle="1")
    sent = definition.model.model_validate({"timestamp": 1, "wheel_speed": (0.5, 2.0)})
    with reader.subscribe("*", mode="every") as subscription:
        for key in (encoders.key, attitude.key):
            wait_for_matching(vehicle._session, key)
        attitude.publish({"timestamp": 1, "q": (1.0, 0.0, 0.0, 0.0)})
        assert subscription.receive(DEADLINE).topic == "vehicle_attitude"

        def is_read() -> bool:
            encoders.publish(sent)
            with suppress(nedbus.NoDataError):
                return bool(subscription.receive(0.1).message.model_dump() == sent.model_dump())
            return False

        wait_for(is_read, what="the message")


def test_large_puts_on_report_and_heartbeat_keys_are_not_forwarded(open_as: Open) -> None:
    """The size filter of the secure router includes @rejected and @adv, which `**` does not match."""
    vehicle, reader = open_as("vehicle-1"), open_as("reader")
    report, heartbeat = f"nedbus/@rejected/1/{VLP}", f"nedbus/1/{VLP}/@adv/pub/1a/1/_"
    assert received_sizes(vehicle, reader, report, 16_384) == [16_384]
    assert received_sizes(vehicle, reader, heartbeat, 64) == [64]


@pytest.mark.parametrize("intruder", ["vehicle-2", "reader", "operator"])
def test_other_certificates_cannot_publish_a_vehicle(join: Join, intruder: str) -> None:
    """Readers receive no data, liveliness token or last value of vehicle 1 sent with another certificate."""
    genuine = join("vehicle-1").publisher(VLP, vehicle="1")
    genuine.publish(message(1))
    reader = join("reader")
    with reader.subscribe("*", mode="every") as subscription:
        assert receive_timestamps(subscription, 1) == [1]
        other = join(intruder)._publishers  # the bus itself refuses to make these publishers
        other.publisher(Address("1", VLP)).publish(message(666))
        other.publisher(Address("3", VLP)).publish(message(667))
        for timestamp in (2, 3):
            genuine.publish(message(timestamp))
            assert receive_timestamps(subscription, 1) == [timestamp]
        assert [sample.message.timestamp for sample in reader.latest("*")] == [3]
        assert list(reader.vehicles()) == ["1"]


@pytest.mark.slow
@pytest.mark.parametrize("certificate", ["reader", "vehicle-2"])
def test_script_learns_that_it_may_not_publish(join: Join, certificate: str) -> None:
    """A script whose certificate may not publish a vehicle gets a typed error, at the publisher and at `flush`.

    `latest` shows it what others see: its own message, which the router dropped, is not among them.
    """
    bus = join(certificate)
    with pytest.raises(
        RefusedError, match=f"vehicle 1, .* certificate .*{certificate}.crt"
    ) as caught:
        bus.publisher(VLP, vehicle="1")
    assert caught.value.vehicle == "1"
    # as one that was made before the rules changed
    with bus._publishers.publisher(Address("1", VLP)) as publisher:
        for number in range(3000):
            publisher.publish(message(number))
        with pytest.raises(RefusedError):
            publisher.flush()
        assert bus.latest(VLP, vehicle="1") == []


def test_allowed_publisher_is_probed_once(join: Join, monkeypatch: pytest.MonkeyPatch) -> None:
    """The permission of a vehicle is asked for once per link, not at each publisher or flush."""
    asked: list[str] = []
    probe = PublishPermission._probe

    def count(permission: PublishPermission, vehicle: str) -> WriteVerdict | None:
        asked.append(vehicle)
        return probe(permission, vehicle)

    monkeypatch.setattr(PublishPermission, "_probe", count)
    bus = join("vehicle-1")
    publisher = bus.publisher(VLP, vehicle="1")
    bus.publisher("vehicle_attitude", vehicle="1")
    publisher.publish(message(1))
    assert publisher.flush()
    assert asked == ["1"]


@pytest.mark.slow
def test_refused_service_fails_at_the_end_of_its_sources(
    configured: tuple[Path, str], pki: Path, start: Start, *, tmp_path: Path
) -> None:
    """`serve --until-done` exits with 1 and the reason if the router refused what it published, else with 0."""
    file, endpoint = configured
    start_zenohd(start, "-c", str(file))
    path = write_log(tmp_path / "a.ulg", range(0, 1_000_000, 10_000))
    source = ("-s", f"ulog:{path}?vehicle=1&speed=max", "--until-done", "-c", endpoint)
    refused = run_command("serve", *source, *tls_options(pki, "vehicle-2"))
    assert refused.exit_code == 1
    assert "the router refuses messages of vehicle 1, so they reach no reader" in refused.err
    assert run_command("serve", *source, *tls_options(pki, "vehicle-1")).exit_code == 0


def test_vehicle_answers_schema_queries_for_itself_only(join: Join, open_as: Open) -> None:
    """A vehicle may reply with the schema of its own messages, and for no other vehicle or session."""
    vehicle, reader = open_as("vehicle-1"), open_as("reader")
    keys = [f"nedbus/@schema/{each}/{NAME}" for each in ("2", "peer", "1")]
    with ExitStack() as answering:
        for key in keys:
            answering.enter_context(answer_queries(vehicle, key, reply_with({key: b"{}"})))

        def replies() -> list[str]:
            return [
                str(each.key_expr)
                for each in query(reader, f"nedbus/@schema/*/{NAME}", timeout=DEADLINE)
            ]

        wait_for(replies, what="the reply of vehicle 1, which is declared last")
        assert replies() == keys[2:]


@pytest.mark.parametrize("name", ["reader", "operator", "stranger"])
def test_other_certificates_cannot_declare_liveliness_tokens(
    join: Join, open_as: Open, name: str
) -> None:
    """Liveliness tokens of a vehicle are accepted only from its own certificate."""
    vehicle, reader, own, stranger = (
        join("vehicle-1"),
        join("reader"),
        open_as("vehicle-1"),
        open_as(name),
    )
    keys = [f"nedbus/{each}/@alive/1a/{VLP}" for each in (1, 2, "x")]
    tokens = [stranger.liveliness().declare_token(key) for key in keys]
    tokens += [own.liveliness().declare_token(key) for key in keys[1:]]
    with vehicle.publisher(VLP, vehicle="1"):
        wait_for(reader.vehicles, what="the vehicle")
        assert reader.vehicles() == {"1": [Address("1", VLP)]}
    wait_for(lambda: not reader.vehicles(), what="the end of the vehicle, without foreign tokens")
    assert len(tokens) == 5


def test_read_permissions_depend_on_the_certificate(join: Join, open_as: Open) -> None:
    """A vehicle receives no data, not even its own; only operators can query the admin space."""
    join("vehicle-1").publisher(VLP, vehicle="1").publish(message(1))
    wait_for(join("reader").latest, what="the message")
    assert join("vehicle-2").latest("*") == join("vehicle-1").latest("*") == []
    operator, reader = open_as("operator"), open_as("reader")
    wait_for(
        lambda: [reply.ok for reply in operator.get("@/*/router")], what="a reply to the operator"
    )
    assert [reply.ok for reply in reader.get("@/*/router")] == []


@pytest.mark.parametrize(
    ("ca", "certificate", "key", "reason"),
    [
        (None, "vehicle-1.crt", "vehicle-1.key", "tls_ca: a certificate is set, but not"),
        ("ca.crt", None, "vehicle-1.key", "a certificate needs its key"),
        ("gone.crt", None, None, "gone.crt cannot be read"),
    ],
)
def test_incomplete_tls_settings_raise(
    pki: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    ca: str | None,
    certificate: str | None,
    key: str | None,
    reason: str,
) -> None:
    """A missing CA, certificate, key or file raises before connecting, from settings and from arguments."""
    paths = [pki / file if file else None for file in (ca, certificate, key)]
    if paths[0] is not None:
        with pytest.raises(nedbus.ConfigError, match=reason):
            nedbus.connect(
                "tls/127.0.0.1:1", timeout=0.1, tls=nedbus.Tls(paths[0], paths[1], paths[2])
            )
    for name, path in zip(("TLS_CA", "TLS_CERTIFICATE", "TLS_KEY"), paths, strict=True):
        if path is not None:
            monkeypatch.setenv(f"NEDBUS_{name}", str(path))
    with pytest.raises(nedbus.ConfigError, match=reason):
        nedbus.connect("tls/127.0.0.1:1", timeout=0.1)


@pytest.mark.slow
def test_commands_accept_certificates_as_flags_or_variables(
    secure: str, pki: Path, run_nedbus: Start
) -> None:
    """Services and commands take TLS files as flags or variables. `health` reports a vehicle that the router denies."""
    run_nedbus(
        "serve",
        "-c",
        secure,
        *tls_options(pki, "vehicle-1"),
        "-s",
        "sim:?vehicle=1",
        "-s",
        "sim:?vehicle=2",
    )
    wait_for(
        lambda: (
            run_command("health", "-c", secure, "-v", "1", *tls_options(pki, "reader")).exit_code
            == 0
        ),
        what="1",
    )
    files = {"CA": "ca.crt", "CERTIFICATE": "reader.crt", "KEY": "reader.key"}
    environment = {
        "NEDBUS_CONNECT": secure,
        **{f"NEDBUS_TLS_{name}": f"{pki / file}" for name, file in files.items()},
    }
    echo = run_command("echo", "-n", "20", **environment)
    assert (echo.exit_code, len(echo.out.splitlines())) == (0, 20), echo.err

    def has_sources() -> bool:
        info = run_command("info", **environment)
        assert info.exit_code == 0
        return "sim:" in info.out

    wait_for(has_sources, what="the sources of the service in `info`")

    def is_refused() -> bool:
        refused = run_command("health", "-v", "2", **environment)
        assert refused.exit_code == 1
        return (
            "vehicle 2 is not published, although its service reports it as published"
            in refused.err
        )

    wait_for(is_refused, what="the service to learn and report the refusal, under its own vehicle")


@pytest.mark.slow
def test_px4_without_tls_is_bridged_to_the_secure_router(
    join: Join, open_as: Open, secure: str, pki: Path, run_nedbus: Start
) -> None:
    """A local service publishes the messages of a PX4 without TLS to the secure router; PX4's own keys stay local."""
    local = free_endpoint()
    service = run_nedbus(
        *("serve", "--vehicle", "1", "-s", "px4-zenoh:", "--listen", local),
        *("--connect", secure, *tls_options(pki, "vehicle-1")),
    )
    wait_for(lambda: f"joined {secure}" in service.err, what="the secure link")
    beyond = open_as("reader").declare_subscriber("*/fmu/**", zenoh.handlers.RingChannel(10))
    with (
        join("reader").subscribe("*", mode="every") as subscription,
        open_client([local], timeout=DEADLINE) as on_vehicle,
    ):
        px4 = Px4(on_vehicle)
        for timestamp in range(1, 101):
            px4.put(timestamp)
        samples = [subscription.receive(DEADLINE) for _ in range(100)]
    assert {(sample.vehicle, sample.topic, sample.source) for sample in samples} == {
        ("1", VLP, "px4-zenoh")
    }
    assert [sample.message.timestamp for sample in samples] == list(range(1, 101))
    assert beyond.try_recv() is None
    invalid = run_nedbus(
        "serve",
        "--listen",
        free_endpoint(),
        "--connect",
        secure,
        "--tls-ca",
        "no.crt",
        "-s",
        "sim:",
    )
    assert invalid.wait() == 2
    assert "no.crt cannot be read" in invalid.err


@pytest.mark.slow
def test_list_suggests_info_if_a_service_replies(secure: str, pki: Path, run_nedbus: Start) -> None:
    """If a service replies but no vehicle is visible, `list` suggests `nedbus info` instead of `nedbus serve`."""

    def hint() -> str:
        listed = run_command("list", "--wait", "-c", secure, *tls_options(pki, "reader"))
        # 1 if the router has not listed all streams in time
        return listed.err if listed.exit_code == 0 else ""

    wait_for(
        lambda: "start a source with 'nedbus serve'" in hint(), what="the hint without a service"
    )
    run_nedbus("serve", "--connect", secure, *tls_options(pki, "vehicle-1"), "-s", "sim:?vehicle=2")
    wait_for(lambda: "a service answers: see 'nedbus info'" in hint(), what="the other hint")


def test_pki_commands_never_overwrite_keys(tmp_path: Path) -> None:
    """Keys are never overwritten or printed, and are readable by their owner only."""
    folder = tmp_path / "pki"
    assert run_command("pki", "cert", str(folder), "reader").exit_code == 1
    for arguments in (
        ["ca", str(folder)],
        ["cert", str(folder), "router", "--host", "127.0.0.1", "--host", "gcs"],
    ):
        created = run_command("pki", *arguments)
        assert created.exit_code == 0, created.err
        key = Path(created.out.splitlines()[0])
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
        before = key.read_bytes()
        assert b"PRIVATE KEY" in before
        assert "PRIVATE" not in created.out + created.err
        again = run_command("pki", *arguments)
        assert again.exit_code == 1
        assert "is not overwritten" in again.err
        assert key.read_bytes() == before
    assert run_command("pki", "cert", str(folder), "../evil").exit_code == 1


@pytest.mark.slow
def test_router_names_a_missing_certificate_file(run_nedbus: Start, tmp_path: Path) -> None:
    """A router without its certificates exits with an error that names the missing file."""
    file = tmp_path / "secure.json5"
    file.write_text(
        (CONFIG / "router-secure.json5")
        .read_text()
        .replace("/etc/nedbus/pki", str(tmp_path / "nowhere"))
    )
    router = run_nedbus("router", str(file))
    assert router.wait() == 2
    assert re.search(
        r"secure\.json5: \w+: \S+/nowhere/\S+ cannot be read: check that it exists", router.err
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "environment"),
    [
        (("router",), {}),
        (("serve", "-s", "sim:", "--router-config"), {"RUST_LOG": "zenoh_link_tls=warn"}),
    ],
    ids=["router", "service"],
)
def test_refused_client_learns_the_reason(
    run_nedbus: Start,
    pki: Path,
    configured: tuple[Path, str],
    *,
    command: tuple[str, ...],
    environment: dict[str, str],
) -> None:
    """The client's error and the doctor name the reason of a refusal.

    The router's stdout is its own: Zenoh writes there only if RUST_LOG asks for it, and then names refusals, too.
    """
    file, endpoint = configured
    router = run_nedbus(*command, str(file), **environment)
    wait_for(lambda: f"router on {endpoint}" in router.err, what="the router")
    with nedbus.connect(endpoint, tls=client_tls(pki, "reader")) as bus:
        assert bus.connected

    for name, ca, advice in (
        ("foreign/reader", "ca.crt", "is not signed by the CA"),
        ("expired", "ca.crt", "expired.crt or its CA has expired"),
        (None, "ca.crt", "no certificate given: "),
        ("reader", "foreign/ca.crt", "is not signed by"),
    ):
        with pytest.raises(nedbus.ConnectError) as refused:
            nedbus.connect(endpoint, tls=client_tls(pki, name, ca), timeout=0.1)
        assert str(refused.value).startswith(f"no TLS connection to {endpoint}: ")
        assert advice in str(refused.value)
        assert len(str(refused.value)) < 250, "readable length"
    with pytest.raises(nedbus.ConnectError, match="speaks TLS"):
        nedbus.connect(endpoint.replace("tls/", "tcp/"), timeout=0.1)
    doctor = run_command("doctor", "-c", endpoint, "--tls-ca", str(pki / "ca.crt"))
    assert doctor.exit_code == 1
    assert "it requires a client certificate, and none is given" in " ".join(doctor.out.split())
    if environment:
        wait_for(lambda: "certificate expired" in router.out, what="the refusal in Zenoh's log")
        wait_for(lambda: "sent no certificates" in router.out, what="the other refusal")
    else:
        assert router.out == ""


def test_downsampled_stream_passes_the_secure_router(
    join: Join, open_as: Open, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    """A reader with max_rate receives the downsampled stream, and no other certificate can publish it."""
    publisher = join("vehicle-1").publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    stranger, reader = open_as("vehicle-2"), join("reader")
    with reader.subscribe(mode="every", max_rate=5) as subscription:
        assert receive_timestamps(subscription, 1) == [1]
        wait_for_downsampling_reader(publisher)
        stranger.put(Address("1", VLP).rate_key(5), encode(message(666)))
        publish(publisher, clock, 2, 1000)
        assert receive_timestamps(subscription, 50) == list(range(2, 1002, 20))
        assert subscription.counts.lost == 0
        assert caplog.messages == []


PERMISSION: Final = "nedbus.daemon.write_permission."
SHORT_TIMINGS: Final = Timings(
    probe_first=(0.1, 0.3),
    probe_confirm=0.3,
    probe_poll=0.3,
    probe=0.3,
    probe_unsure=0.3,
    probe_pause=0.3,
)


@pytest.mark.parametrize(
    ("certificate", "kind"),
    [("vehicle-1", "nedbus"), pytest.param("vehicle-2", "zenohd", marks=pytest.mark.slow)],
    ids=["certificate of another vehicle", "certificate without a rule"],
)
def test_denied_vehicle_is_reported_until_the_rules_are_fixed(
    configured: tuple[Path, str],
    pki: Path,
    run_nedbus: Start,
    start: Start,
    *,
    certificate: str,
    kind: str,
) -> None:
    """Log, health, metrics and `nedbus info` report that the router denies vehicle 2, until its rules allow it."""
    file, endpoint = configured

    def start_router() -> Process:
        return (
            run_nedbus("router", str(file))
            if kind == "nedbus"
            else start_zenohd(start, "-c", str(file))
        )

    router, pages = start_router(), HttpClient(free_port())
    options = (*tls_options(pki, certificate), "-s", "sim:?vehicle=2", "--http", pages.where)
    service = start_with_timings(start, SHORT_TIMINGS, "serve", "-c", endpoint, *options)
    refused = (503, "the router refuses messages of vehicle 2\n")
    wait_for(
        lambda: "messages of vehicle 2, so they reach no reader" in service.err, what="the refusal"
    )
    assert (pages.request("/healthz"), pages.request("/readyz")) == (refused, refused)
    assert pages.values("nedbus_vehicle_refused", vehicle="2") == [1.0]
    assert json.loads(pages.request("/status")[1])["refused"] == ["2"]
    reader = ("--wait", "-c", endpoint, *tls_options(pki, "reader"))
    if certificate == "vehicle-1":  # a certificate without a rule denies the status, too
        info = run_until_shown("vehicles refused by the router: 2", "info", *reader)
        assert info.exit_code == 0, info.err
        assert re.search(rf"2/{VLP} .*refused by the router", info.out)
        refusal = "the router refuses messages of vehicle 2: allow them in its access rules"
        assert run_until_shown(refusal, "health", *reader).exit_code == 1

    write_access_rules(file, ["1", "2"])
    own = '{ rules: ["vehicle-2-in"], subjects: ["vehicle-2"] }'
    assert own in file.read_text()
    file.write_text(
        file.read_text().replace(own, own.replace('vehicle-2"] }', f'{certificate}"] }}'))
    )
    router.kill()
    start_router()
    wait_for(
        lambda: "the router now accepts messages of vehicle 2" in service.err, what="the acceptance"
    )
    assert (pages.request("/healthz"), pages.request("/readyz")) == (
        (200, "ok\n"),
        (200, "ready\n"),
    )
    assert pages.values("nedbus_vehicle_refused", vehicle="2") == [0.0]
    health = run_command("health", "--vehicle", "2", *reader)
    assert health.exit_code == 0, health.err


Outcome = tuple[bool | None, float]


def permission_of(session: Session, endpoint: str, pki: Path, *vehicles: str) -> WritePermission:
    tls = client_tls(pki, "vehicle-1")
    return WritePermission(
        session, [endpoint], tls=tls, prefix="nedbus", vehicles=lambda: set(vehicles)
    )


def check(permission: WritePermission) -> Mapping[str, bool]:
    """Check once, and return the known permissions."""
    permission.check()
    return permission.refused


@pytest.mark.parametrize(
    ("history", "outcome"),  # outcome: refused or not, and the pause after the check [s]
    [
        (["denied"], (None, 1)),
        (["denied", "denied", "denied"], (True, 60)),
        (["denied", "denied", "allowed"], (False, 600)),
        (["denied", "denied", "allowed", "denied"], (None, 1)),
        (["denied", "unknown", "denied", "denied"], (True, 60)),
        (["denied", "denied", "denied", "unknown"], (True, 60)),
        (["denied", "denied", "denied", "allowed"], (False, 600)),
        (["allowed", "unknown"], (None, 60)),
        (["unknown"] * 9, (None, 60)),
    ],
    ids=lambda value: " ".join(map(str, value)),
)
def test_vehicle_is_refused_after_three_consecutive_denials(
    endpoint: str,
    zenoh_session: Session,
    pki: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    history: list[str],
    outcome: Outcome,
) -> None:
    """A vehicle counts as refused after three consecutive denials, until the router accepts a probe."""
    verdicts = iter(history)
    monkeypatch.setattr(
        "nedbus.transport.write_probe.probe_writes", lambda *_, **__: {"1": next(verdicts)}
    )
    permission = permission_of(zenoh_session, endpoint, pki, "1")
    refused, pause = outcome
    assert [permission.check() for _ in history][-1] == pause
    assert permission.refused == ({} if refused is None else {"1": refused})


def test_probes_continue_after_a_panic(
    endpoint: str,
    zenoh_session: Session,
    pki: Path,
    monkeypatch: pytest.MonkeyPatch,
    timings: Timings,
) -> None:
    """After a panic of Zenoh the permission is probed again at the next interval."""
    timings.probe_poll, timings.probe_first, timings.probe_pause = 0.01, (0.0, 0.0), 0.01
    verdicts = iter(["panic", "allowed"])

    def probe(*_: object, **__: object) -> dict[str, str]:
        if (verdict := next(verdicts, "allowed")) == "panic":
            raise BaseException(verdict)  # noqa: TRY002 - like pyo3's PanicException, it is not an Exception
        return {"1": verdict}

    monkeypatch.setattr("nedbus.transport.write_probe.probe_writes", probe)
    permission = permission_of(zenoh_session, endpoint, pki, "1")
    permission.start()
    wait_for(lambda: permission.refused == {"1": False}, what="the next probe")
    permission.close()


@pytest.mark.slow
def test_embedded_router_is_checked_like_a_client(secure: str, pki: Path, timings: Timings) -> None:
    """The permissions of a service with an embedded router depend on the certificate of its uplink."""
    timings.probe = 0.5
    with open_router(
        listen=(free_endpoint(),), connect=(secure,), tls=client_tls(pki, "vehicle-1")
    ) as session:
        permission = permission_of(session, secure, pki, "1", "2")
        wait_for(lambda: check(permission) == {"1": False}, what="the allowed vehicle")
        wait_for(lambda: check(permission) == {"1": False, "2": True}, what="the denied vehicle")


@pytest.mark.slow
def test_unreachable_or_open_router_is_not_reported_as_refusing(
    configured: tuple[Path, str],
    pki: Path,
    run_nedbus: Start,
    monkeypatch: pytest.MonkeyPatch,
    timings: Timings,
) -> None:
    """A router does not count as refusing if it has older rules or no access control, or if it is stopped or frozen."""
    timings.probe_open, timings.probe = 0.1, 0.5
    monkeypatch.setattr(f"{PERMISSION}CONFIRMED", 1)
    file, endpoint = configured
    shipped = file.read_text()
    file.write_text(shipped.replace("@doctor", "@probe"))
    older = open_router(config_file=file)
    with open_client([endpoint], timeout=DEADLINE, tls=client_tls(pki, "vehicle-1")) as session:
        permission = permission_of(session, endpoint, pki, "1", "2")
        assert check(permission) == {}
        older.close()
        assert check(permission) == {}
        rules = "access_control: {\n    enabled: "
        assert f"{rules}true" in shipped
        file.write_text(shipped.replace(f"{rules}true", f"{rules}false"))
        plain = run_nedbus("router", str(file))
        wait_for(lambda: check(permission) == {"1": False, "2": False}, what="the open router")
        plain.signal(signal.SIGSTOP)
        assert check(permission) == {"1": False, "2": False}
        plain.signal(signal.SIGCONT)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["short", "long"])
def test_tokens_of_a_vehicle_do_not_hide_others(
    configured: tuple[Path, str], pki: Path, kind: str
) -> None:
    """With 2,000 tokens of one vehicle, short or long, `vehicles()` and `list` are complete for the others."""
    file, endpoint = configured
    write_access_rules(file, ["1", "2"])
    with ExitStack() as opened:
        opened.enter_context(open_router(config_file=file))

        def join(name: str) -> nedbus.Bus:
            return opened.enter_context(
                nedbus.connect(endpoint, tls=client_tls(pki, name), timeout=DEADLINE)
            )

        publishers = [
            join("vehicle-1").publisher(topic, vehicle="1") for topic in (VLP, "vehicle_attitude")
        ]
        session, name = join("vehicle-2")._session, "x" * 60 * (kind == "long")
        tokens = [
            session.liveliness().declare_token(f"nedbus/2/@alive/{name}{each}/{VLP}")
            for each in range(2000)
        ]
        list(session.liveliness().get("nedbus/2/@alive/-", timeout=100))  # after all tokens
        reader = join("reader")
        wait_for(lambda: reader.vehicles().get("1"), what="the other vehicle")
        addresses = {each.address for each in publishers}
        wait_for(
            lambda: set(reader.vehicles()["1"]) == addresses and "2" not in reader.vehicles(),
            what="both streams",
        )
        assert not reader.vehicles().complete
        listed = run_command("list", "-c", endpoint, *tls_options(pki, "reader"))
        assert all(str(each) in listed.out for each in addresses)
        assert "the streams of '2' are not listed" in listed.err
        assert len(tokens) == 2000


RULES: Final = """{
  access_control: {
    enabled: true, default_permission: "deny",
    rules: [
      { id: "all", permission: "allow", messages: ["put"], key_exprs: ["nedbus/**"] },
      { id: "not-8", permission: "deny", flows: ["ingress"], messages: ["put"], key_exprs: ["nedbus/8/**"] },
    ],
    subjects: [{ id: "any" }, { id: "seven", cert_common_names: ["seven"] }],
    policies: [{ rules: ["all"], subjects: ["any"] }, { rules: ["not-8"], subjects: ["seven"] }],
  },
  low_pass_filter: [
    { messages: ["reply"], key_exprs: ["replies/**"], size_limit: 10 },
    { flows: ["egress"], messages: ["put"], key_exprs: ["sent/**"], size_limit: 10 },
    { messages: ["put"], key_exprs: ["received/**"], size_limit: 10 },
  ],
}"""


@pytest.mark.parametrize(
    ("certificate", "message", "flow", "key", "decision"),
    [
        ("seven", "put", "ingress", "nedbus/7/a", "rule all allows it"),
        ("seven", "put", "ingress", "nedbus/8/a", "rule not-8 denies it"),
        ("seven", "put", "egress", "nedbus/8/a", "rule all allows it"),
        ("eight", "put", "ingress", "nedbus/8/a", "rule all allows it"),
        ("seven", "put", "ingress", "other/8/a", "none of its rules includes this key: all, not-8"),
        (
            "seven",
            "query",
            "ingress",
            "nedbus/7/a",
            "no rule is for such messages of this certificate",
        ),
    ],
)
def test_decision_names_its_rule(  # noqa: PLR0917 - one row of the table
    tmp_path: Path, certificate: str, message: str, flow: Any, key: str, decision: str
) -> None:
    """A denial takes precedence over a permission, rules of every certificate apply, and the default is the last."""
    file = tmp_path / "router.json5"
    file.write_text(RULES)
    access = read_router_config(file).access
    decided = access.decide(certificate, message, flow, key)
    assert str(decided) == decision
    assert decided.is_allowed == decision.endswith("allows it")
    assert access.certificates == ["seven"]


def test_limit_of_size_holds_for_messages_that_clients_put(tmp_path: Path) -> None:
    """A filter limits what clients put if it is for put messages, and for ingress or both directions."""
    file = tmp_path / "router.json5"
    file.write_text(RULES)
    access = read_router_config(file).access
    limited = [key for key in ("replies/a", "sent/a", "received/a") if access.limits_size(key)]
    assert limited == ["received/a"]
