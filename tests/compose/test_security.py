"""The stack with certificates: permissions, tested by the messages that arrive, because Zenoh denies silently."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import nedbus
from nedbus.pki import make_authority, make_certificate
from nedbus_msgs import Address
from tests.flights.messages import VLP, message
from tests.peers.processes import Process
from tests.waits import wait_for

from .certificates import FILES, USER, distribute, join, make_certificates
from .conftest import Record, StartStack
from .recorder import Flight, Recorder, indices, is_complete
from .stack import Stack

pytestmark = [pytest.mark.compose, pytest.mark.timeout(600)]

MINE = Address("1", VLP)
CLIENTS = ("vehicle-1", "vehicle-2", "reader", "operator")


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make certificates as in docs/security.md, and some that must be rejected."""
    folder = tmp_path_factory.mktemp("pki")
    make_certificates(folder, *CLIENTS)
    make_certificate(folder, "expired", days=-1)
    make_authority(folder / "foreign")
    make_certificate(folder / "foreign", "vehicle-1")
    distribute(folder)
    return folder


@pytest.fixture
def secure(make_stack: StartStack, pki: Path) -> Stack:
    """Start the shipped stack with these certificates."""
    stack = make_stack("secure", *FILES, NEDBUS_PKI=str(pki), NEDBUS_USER=USER)
    stack.up()
    return stack


@pytest.fixture
def reader(secure: Stack, pki: Path, record: Record) -> Recorder:
    """Record all messages on the host."""
    bus = join(secure, pki, "reader")
    recorder = record(bus.subscribe("*", mode="every"))
    recorder.wait_for_more(100)
    return recorder


def check_genuine(reader: Recorder) -> None:
    """Assert that a recorder received all messages of vehicle 1 with correct values, and no others."""
    reader.wait_for_more(300)
    samples = list(reader.samples)
    assert {sample.vehicle for sample in samples} == {"1"}
    assert is_complete(indices([sample for sample in samples if sample.address == MINE], Flight()))
    assert reader.subscription.counts.invalid == 0


@pytest.mark.parametrize("name", ["vehicle-2", "reader", "operator"])
def test_denied_puts_do_not_arrive(secure: Stack, pki: Path, reader: Recorder, name: str) -> None:
    """Another vehicle, a reader and an operator may put neither messages of vehicles 1 and 3 nor a rejection."""
    with join(secure, pki, name) as intruder:
        for vehicle in ("1", "3"):
            with pytest.raises(nedbus.errors.RefusedError, match=f"vehicle {vehicle}"):
                intruder.publisher(VLP, vehicle=vehicle)
            # without asking the router
            publisher = intruder._publishers.publisher(Address(vehicle, VLP))
            for timestamp in range(1, 100):
                publisher.publish(message(timestamp))
        intruder._session.put("nedbus/@rejected/1/vehicle_local_position", b"{}")
        check_genuine(reader)
        with join(secure, pki, "reader") as other:
            assert list(other.vehicles()) == ["1"]
            assert {sample.vehicle for sample in other.latest("*")} == {"1"}


def test_certificate_cannot_publish_another_vehicle(secure: Stack, reader: Recorder) -> None:
    """Messages of vehicle 2 published with the certificate of vehicle 1 do not arrive, and the service fails."""
    impostor = secure.run("service", "serve", "-s", "sim:?vehicle=2&duration=3", "--until-done")
    assert impostor.wait(60.0) == 1, impostor.err
    assert "published" in impostor.err
    assert "the router refuses messages of vehicle 2" in impostor.err
    check_genuine(reader)


@pytest.mark.parametrize(
    ("ca", "certificate"),
    [
        ("ca.crt", None),
        ("ca.crt", "foreign/vehicle-1"),
        ("foreign/ca.crt", "vehicle-1"),
        ("ca.crt", "expired"),
    ],
    ids=["no certificate", "foreign certificate", "foreign authority", "expired certificate"],
)
def test_invalid_certificates_are_refused(
    secure: Stack, pki: Path, reader: Recorder, ca: str, certificate: str | None
) -> None:
    """Without a valid certificate no session opens, on the host and in a container, and the error names the reason."""
    with pytest.raises(
        nedbus.ConnectError, match=r"^no TLS connection to tls/.*(no certificate|signed|expired)"
    ):
        join(secure, pki, certificate, ca=ca, timeout=1.0)
    # mounted over a file of the container's folder
    volumes = [f"--volume={pki / ca}:/etc/nedbus/pki/ca.crt:ro"]
    if certificate is None:
        volumes += ["--env=NEDBUS_TLS_CERTIFICATE=", "--env=NEDBUS_TLS_KEY="]
    else:
        volumes += [
            f"--volume={pki / certificate}.{kind}:/etc/nedbus/pki/reader.{kind}:ro"
            for kind in ("crt", "key")
        ]
    echo = secure.run("subscriber", "echo", "--count", "1", options=tuple(volumes))
    assert echo.wait(60.0) == 1, echo.out
    assert "no TLS connection to tls/" in echo.err
    assert echo.out == ""
    check_genuine(reader)


PEER = """
import json, sys, threading, time, zenoh
name, puts = sys.argv[1], int(sys.argv[2])
tls = {"root_ca_certificate": "/etc/nedbus/pki/ca.crt", "enable_mtls": True}
if name != "nobody":
    tls |= {"connect_certificate": "/etc/nedbus/pki/reader.crt", "connect_private_key": "/etc/nedbus/pki/reader.key"}
settings = {
    "mode": "peer",
    "listen/endpoints": ["tcp/0.0.0.0:7448"],
    "connect/endpoints": ["tls/router:7447", "tcp/router:7447", "tcp/service:7448"],
    "connect/timeout_ms": 2000,
    "connect/exit_on_failure": False,
    "scouting/gossip/enabled": True,
    "scouting/multicast/enabled": name == "nobody",
    "transport/link/tls": tls,
}
config = zenoh.Config()
for key, value in settings.items():
    config.insert_json5(key, json.dumps(value))
session = zenoh.open(config)
seen = {"genuine": 0, "forged": 0}
def take(sample):
    seen["forged" if sample.payload.to_bytes() == b"forged" else "genuine"] += 1
subscriber = session.declare_subscriber("nedbus/1/**", take)
print("ready", flush=True)
for number in range(puts):
    session.put("nedbus/1/vehicle_local_position", b"forged")
    time.sleep(0.01)
while True:
    print(json.dumps(seen), flush=True)
    if puts:
        break
    time.sleep(0.1)
session.close()
"""


def last_count(peer: Process) -> dict[str, int]:
    """Return the number of messages that a peer has received so far."""
    lines = [line for line in peer.out.splitlines(keepends=True) if line.endswith("}\n")]
    counts: dict[str, int] = json.loads(lines[-1]) if lines else {"genuine": 0, "forged": 0}
    return counts


def test_peers_do_not_bypass_the_router(secure: Stack, pki: Path, reader: Recorder) -> None:
    """Peers do not discover each other, with or without certificates, so no forged message arrives."""
    run = ("--entrypoint", "/opt/nedbus/bin/python")
    listener = secure.run("subscriber", "-c", PEER, "reader", "0", options=run)
    wait_for(lambda: "ready" in listener.out, what=f"the listening peer {listener.err}")
    for name in ("vehicle-2", "nobody"):
        own = tuple(
            f"--volume={pki}/vehicle-2.{kind}:/etc/nedbus/pki/reader.{kind}:ro"
            for kind in ("crt", "key")
        )
        peer = secure.run("subscriber", "-c", PEER, name, "300", options=(*run, *own))
        assert peer.wait(60.0) == 0, peer.err
        assert '{"genuine": 0, "forged": 300}' in peer.out, "it receives only its own puts"
    before = last_count(listener)["genuine"]
    wait_for(lambda: last_count(listener)["genuine"] > before + 100, what="genuine messages")
    assert last_count(listener)["forged"] == 0
    check_genuine(reader)


def test_only_operators_can_query_the_admin_space(secure: Stack, pki: Path) -> None:
    """The router's admin space answers operators, but not readers."""
    with join(secure, pki, "operator") as operator, join(secure, pki, "reader") as other:
        wait_for(
            lambda: [reply.ok for reply in operator._session.get("@/*/router")], what="an answer"
        )
        assert [reply.ok for reply in other._session.get("@/*/router")] == []


def test_private_keys_do_not_leak(secure: Stack, pki: Path) -> None:
    """Neither logs nor `docker inspect` contain a private key."""
    output = secure.compose("logs") + str(secure.inspect("service")) + str(secure.inspect("router"))
    assert "PRIVATE KEY" not in output
    for name in ("router", "vehicle-1"):
        secret = (pki / f"{name}.key").read_text().splitlines()[1]
        assert secret not in output
    assert "ca.key" not in output
