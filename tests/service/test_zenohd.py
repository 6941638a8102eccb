"""The shipped configurations in a real zenohd: routers, a storage, and HTTP for readers."""

from __future__ import annotations

import base64
import datetime as dt
import itertools
import json
import urllib.error
import urllib.request
from contextlib import suppress
from pathlib import Path

import pytest
import zenoh

import nedbus
from nedbus.transport import make_authority, make_certificate
from nedbus_msgs import DEFAULT_TOPIC, Address, decode, encode
from tests.conftest import DEADLINE, Start, free_endpoint, message, wait_for
from tests.zenohd import start_zenohd

CONFIG = Path(__file__).parents[2] / "config"
VLP = DEFAULT_TOPIC
ROUTER = "tcp/127.0.0.1:7447"
HTTP = "127.0.0.1:8000"


def shipped(name: str, **replaced: str) -> str:
    """Return the path of a copy of a shipped file in which texts were replaced, each of which must be there."""
    text = (CONFIG / name).read_text()
    for old, new in replaced.items():
        assert old in text
        text = text.replace(old, new)
    Path(name).write_text(text)
    return str(Path(name).resolve())


@pytest.fixture
def zenohd(start: Start) -> str:
    """Run config/router.json5 in a real zenohd."""
    endpoint = free_endpoint()
    start_zenohd(start, "-c", shipped("router.json5", **{"tcp/0.0.0.0:7447": endpoint}))
    nedbus.connect(endpoint, timeout=DEADLINE).close()
    return endpoint


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make the certificates of docs/security.md."""
    folder = tmp_path_factory.mktemp("pki")
    make_authority(folder)
    make_certificate(folder, "router", hosts=["127.0.0.1"])
    for name in ("vehicle-1", "reader", "operator", "stranger"):
        make_certificate(folder, name)
    return folder


@pytest.fixture
def secure(start: Start, pki: Path) -> str:
    """Run config/router-secure.json5 in a real zenohd."""
    endpoint = free_endpoint().replace("tcp/", "tls/")
    file = shipped("router-secure.json5", **{"/etc/nedbus/pki": str(pki), "tls/0.0.0.0:7447": endpoint})
    start_zenohd(start, "-c", file)
    join(endpoint, pki, "reader").close()
    return endpoint


def join(endpoint: str, pki: Path, name: str) -> nedbus.Bus:
    """Connect as somebody."""
    tls = nedbus.Tls(pki / "ca.crt", pki / f"{name}.crt", pki / f"{name}.key")
    return nedbus.connect(endpoint, tls=tls, timeout=DEADLINE)


def http(method: str, url: str, body: bytes | None = None) -> tuple[int, bytes]:
    """Return the status and the body of an answer; 0 where nobody listens yet."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, body, method=method), timeout=DEADLINE) as answer:  # noqa: S310 - loopback
            return answer.status, answer.read()
    except urllib.error.HTTPError as exc:
        return exc.code, b""
    except OSError:
        return 0, b""


def last_messages(bus: nedbus.Bus) -> list[int]:
    """Return the timestamps of all answers for vehicle 1."""
    replies = bus._session.get(
        f"nedbus/1/{VLP}", target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE
    )
    return [decode(reply.ok.payload.to_bytes()).timestamp for reply in replies if reply.ok]


def test_storage_keeps_what_a_vehicle_sent_last(start: Start, zenohd: str) -> None:
    """config/storage.json5 answers for a vehicle that is gone, and does not touch what others receive.

    A router with a storage of its own would have to stamp anew what a vehicle whose clock is ahead sends.
    """
    storage = start_zenohd(start, "-c", shipped("storage.json5", **{ROUTER: zenohd}))
    wait_for(lambda: "started plugin storage_manager" in storage.out, what="the storage")
    with nedbus.connect(zenohd) as reader, nedbus.connect(zenohd) as vehicle:
        raw = vehicle._session
        subscription = reader.subscribe(VLP, mode="every")
        ahead = raw.new_timestamp().get_time() + dt.timedelta(hours=1)
        timestamps = itertools.count(1)
        received: list[nedbus.Sample] = []
        stamps: list[zenoh.Timestamp] = []

        def are_both_there() -> bool:
            number = next(timestamps)
            stamps.append(zenoh.Timestamp(ahead + dt.timedelta(milliseconds=number), b"\x07"))
            raw.put(f"nedbus/1/{VLP}", encode(message(number)), timestamp=stamps[-1])
            with suppress(nedbus.NoDataError):
                received.append(subscription.receive(0.1))
            return bool(received and last_messages(reader))

        wait_for(are_both_there, what="the storage and the reader")
        vehicle.close()
        last = next(timestamps) - 1
        wait_for(lambda: last_messages(reader) == [last], what="the last message")
        while received[-1].message.timestamp != last:
            received.append(subscription.receive(DEADLINE))
        assert {sample.stamp for sample in received} <= set(stamps)
        assert reader.vehicles() == {}


def test_vehicle_that_restarted_wins_over_the_storage(start: Start, run_nedbus: Start, zenohd: str) -> None:
    """A real storage keeps a message of the last run, whose clock was ahead: live answers win, and `get` tells."""
    storage = start_zenohd(start, "-c", shipped("storage.json5", **{ROUTER: zenohd}))
    wait_for(lambda: "started plugin storage_manager" in storage.out, what="the storage")
    with nedbus.connect(zenohd) as reader:
        ahead = zenoh.Timestamp(reader._session.new_timestamp().get_time() + dt.timedelta(hours=1), b"\x07")

        def is_stored() -> bool:
            reader._session.put(f"nedbus/1/{VLP}", encode(message(99)), timestamp=ahead)
            return last_messages(reader) == [99]

        wait_for(is_stored, what="the message in the storage")
        assert reader.latest()[0].stored
        stored = run_nedbus("get", "-c", zenohd)
        assert stored.wait() == 1
        assert ", only stored" in stored.out
        assert "no publisher answers: these are what a storage kept" in stored.err
        listed = run_nedbus("list", "-c", zenohd)
        assert listed.wait() == 0
        assert "stored" in listed.out
        with nedbus.connect(zenohd) as vehicle:
            vehicle.publisher(VLP, vehicle="1").publish(message(1))
            wait_for(lambda: not reader.latest()[0].stored, what="the live answer")
            assert reader.latest()[0].message == message(1)
            live = run_nedbus("get", "-c", zenohd)
            assert live.wait() == 0, live.err
            assert "timestamp: 1\n" in live.out
            assert "stored" not in live.out


def test_storage_waits_for_its_router(start: Start) -> None:
    """It may be started first, and joins again a router that was away."""
    endpoint = free_endpoint()
    start_zenohd(start, "-c", shipped("storage.json5", **{ROUTER: endpoint}))
    for _ in range(2):
        router = start_zenohd(start, "-c", shipped("router.json5", **{"tcp/0.0.0.0:7447": endpoint}))
        with nedbus.connect(endpoint, timeout=DEADLINE) as bus:

            def is_stored(bus: nedbus.Bus = bus) -> bool:
                bus._session.put(f"nedbus/1/{VLP}", encode(message(7)))
                return last_messages(bus) == [7]

            wait_for(is_stored, what="the storage")
        router.kill()


def test_http_reads_and_cannot_write(start: Start, secure: str, pki: Path) -> None:
    """config/rest-reader.json5: a GET gets the vehicle, a PUT and a DELETE reach nobody beyond that zenohd."""
    address = free_endpoint().removeprefix("tcp/")
    changes = {"/etc/nedbus/pki": str(pki), "tls/127.0.0.1:7447": secure, HTTP: address}
    start_zenohd(start, "-c", shipped("rest-reader.json5", **changes))
    url = f"http://{address}/nedbus"
    with join(secure, pki, "vehicle-1") as vehicle, join(secure, pki, "reader") as reader:
        publisher = vehicle.publisher(VLP, vehicle="1")
        publisher.publish(message(1))
        wait_for(lambda: http("GET", f"{url}/1/{VLP}")[1].count(b'"key"') == 1, what="the vehicle over HTTP")
        (answer,) = json.loads(http("GET", f"{url}/1/{VLP}")[1])
        assert decode(base64.b64decode(answer["value"])) == message(1)
        with reader.subscribe("*", mode="every") as subscription:
            assert subscription.receive(DEADLINE).message.timestamp == 1
            assert http("PUT", f"{url}/1/{VLP}", encode(message(666)))[0] == 200
            assert http("PUT", f"{url}/7/{VLP}", encode(message(667)))[0] == 200
            assert http("DELETE", f"{url}/1/{VLP}")[0] == 200
            assert http("PUT", f"http://{address}/@/local/router/config/x", b"1")[0] in (200, 400, 500)
            publisher.publish(message(2))
            assert subscription.receive(DEADLINE).message.timestamp == 2
            publisher.publish(message(3))
            assert subscription.receive(DEADLINE).message.timestamp == 3
            assert subscription.counts == nedbus.Counts(received=3)
        assert [sample.message.timestamp for sample in reader.latest("*")] == [3]
        assert [answer["key"] for answer in json.loads(http("GET", f"{url}/**")[1])] == [f"nedbus/1/{VLP}"]


@pytest.mark.parametrize("name", ["reader", "operator", "stranger"])
def test_strangers_cannot_announce_vehicles(secure: str, pki: Path, name: str) -> None:
    """Only a vehicle's own certificate declares its liveliness tokens: false ones would cost every reader."""
    vehicle, reader, stranger = (join(secure, pki, each) for each in ("vehicle-1", "reader", name))
    with vehicle, reader, stranger:
        keys = [f"nedbus/{each}/@alive/{VLP}" for each in (1, 2, "x")]
        tokens = [stranger._session.liveliness().declare_token(key) for key in keys]
        tokens += [vehicle._session.liveliness().declare_token(key) for key in keys[1:]]
        with vehicle.publisher(VLP, vehicle="1"):
            wait_for(reader.vehicles, what="the vehicle")
            assert reader.vehicles() == {"1": [Address("1", VLP)]}
        wait_for(lambda: not reader.vehicles(), what="its end, as no token of a stranger stands for it")
        assert len(tokens) == 5


def test_bridge_to_ros_2_needs_its_router(start: Start, run_nedbus: Start, secure: str, zenohd: str, pki: Path) -> None:
    """The secure router has no rule for ROS 2: `nedbus ros2` says so, and works with ROS 2's own router beside it."""
    flags = [f"--tls-ca={pki}/ca.crt", f"--tls-certificate={pki}/reader.crt", f"--tls-key={pki}/reader.key"]
    with join(secure, pki, "vehicle-1") as vehicle:
        vehicle.publisher(VLP, vehicle="1")
        alone = run_nedbus("ros2", "-c", secure, *flags)
        assert alone.wait() == 1
        assert "name it with --to" in alone.err
        bridge = run_nedbus("ros2", "-c", secure, *flags, "--to", zenohd)
        wait_for(lambda: f"-> /fmu/out/{VLP}" in bridge.err, what=f"the bridge {bridge.err}")


def test_secure_router_is_read_whole(secure: str, pki: Path) -> None:
    """What a vehicle publishes through a real zenohd with access control arrives: data, liveliness, last values."""
    with join(secure, pki, "vehicle-1") as vehicle, join(secure, pki, "reader") as reader:
        publisher = vehicle.publisher(VLP, vehicle="1")
        publisher.publish(message(1))
        wait_for(reader.latest, what="the last value")
        with reader.subscribe("*", mode="every") as subscription:
            assert subscription.receive(DEADLINE).message.timestamp == 1
            for timestamp in range(2, 1000):
                publisher.publish(message(timestamp))
            received = [subscription.receive(DEADLINE).message.timestamp for _ in range(2, 1000)]
        assert received == list(range(2, 1000))
        assert publisher.flush()
