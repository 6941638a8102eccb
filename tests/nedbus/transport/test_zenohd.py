"""The shipped configurations in a real zenohd: routers, storage, and read-only HTTP."""

from __future__ import annotations

import base64
import datetime as dt
import itertools
import json
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import zenoh

import nedbus
from nedbus.transport import Session, open_client
from tests.flights.local_position import decode, encode
from tests.flights.messages import VLP, message
from tests.peers.certificates import client_tls, pki, secure_endpoint, tls_options, write_config
from tests.peers.command_line import run_command
from tests.peers.ports import free_endpoint
from tests.peers.processes import Process, Start
from tests.peers.zenohd import start_zenohd
from tests.waits import DEADLINE, wait_for

from .size_limits import KEYS_AND_LIMITS, received_sizes

__all__ = ["pki"]

pytestmark = pytest.mark.slow

ROUTER = "tcp/127.0.0.1:7447"
HTTP = "127.0.0.1:8000"


@pytest.fixture
def zenohd(start: Start, tmp_path: Path) -> str:
    """Run config/router.json5 in a real zenohd."""
    endpoint = free_endpoint()
    start_zenohd(start, "-c", str(write_config(tmp_path, tmp_path / "router.json5", endpoint)))
    nedbus.connect(endpoint, timeout=DEADLINE).close()
    return endpoint


@pytest.fixture
def secure(start: Start, pki: Path, tmp_path: Path) -> str:
    """Run config/router-secure.json5 in a real zenohd."""
    endpoint = secure_endpoint()
    start_zenohd(start, "-c", str(write_config(pki, tmp_path / "router-secure.json5", endpoint)))
    join(endpoint, pki, "reader").close()
    return endpoint


@pytest.fixture
def zenoh_session(zenohd: str) -> Iterator[Session]:
    """Open a plain Zenoh session."""
    with open_client([zenohd], timeout=DEADLINE) as session:
        yield session


def join(endpoint: str, pki: Path, name: str) -> nedbus.Bus:
    """Connect with the certificate of this name."""
    return nedbus.connect(endpoint, tls=client_tls(pki, name), timeout=DEADLINE)


def start_storage(start: Start, tmp_path: Path, router: str) -> Process:
    """Run config/storage.json5 in a second zenohd, as a client of a router."""
    file = write_config(tmp_path, tmp_path / "storage.json5", router, **{ROUTER: router})
    return start_zenohd(start, "-c", str(file))


def http(method: str, url: str, body: bytes | None = None) -> tuple[int, bytes]:
    """Return status and body of an HTTP response; status 0 if the connection is refused."""
    try:
        request = urllib.request.Request(url, body, method=method)  # noqa: S310 - loopback
        with urllib.request.urlopen(request, timeout=DEADLINE) as response:  # noqa: S310 - loopback
            return response.status, response.read()
    except urllib.error.HTTPError as exc:
        return exc.code, b""
    except OSError:
        return 0, b""


def last_messages(session: Session) -> list[int]:
    """Return the timestamps in all replies for vehicle 1."""
    replies = session.get(
        f"nedbus/1/{VLP}", target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE
    )
    return [decode(reply.ok.payload.to_bytes()).timestamp for reply in replies if reply.ok]


def test_storage_retains_the_last_message_of_a_vehicle(
    start: Start, tmp_path: Path, zenohd: str, zenoh_session: Session
) -> None:
    """The storage replies for a disconnected vehicle, and leaves the timestamps that readers receive unchanged."""
    start_storage(start, tmp_path, zenohd)
    with nedbus.connect(zenohd) as reader, open_client([zenohd], timeout=DEADLINE) as vehicle:
        subscription = reader.subscribe(VLP, mode="every")
        ahead = vehicle.new_timestamp().get_time() + dt.timedelta(hours=1)
        timestamps = itertools.count(1)
        received: list[nedbus.Sample[Any]] = []
        stamps: list[zenoh.Timestamp] = []

        def are_received() -> bool:
            number = next(timestamps)
            stamps.append(zenoh.Timestamp(ahead + dt.timedelta(milliseconds=number), b"\x07"))
            vehicle.put(f"nedbus/1/{VLP}", encode(message(number)), timestamp=stamps[-1])
            with suppress(nedbus.NoDataError):
                received.append(subscription.receive(0.1))
            return bool(received and last_messages(zenoh_session))

        wait_for(are_received, what="the storage and the reader")
        vehicle.close()
        last = next(timestamps) - 1
        wait_for(lambda: last_messages(zenoh_session) == [last], what="the last message")
        while received[-1].message.timestamp != last:
            received.append(subscription.receive(DEADLINE))
        assert {sample.stamp for sample in received} <= set(stamps)
        assert reader.vehicles() == {}


@pytest.mark.parametrize(("key", "limit"), KEYS_AND_LIMITS)
def test_large_puts_on_report_and_heartbeat_keys_are_not_forwarded(
    zenohd: str, zenoh_session: Session, key: str, limit: int
) -> None:
    """config/router.json5 limits the bytes of what readers count as messages."""
    with open_client([zenohd], timeout=DEADLINE) as sender:
        assert received_sizes(sender, zenoh_session, key, limit) == [limit]


def test_live_reply_takes_precedence_over_the_storage(
    start: Start, tmp_path: Path, zenohd: str, zenoh_session: Session
) -> None:
    """A live reply takes precedence, even after a restart with an earlier clock; `get` marks stored messages."""
    start_storage(start, tmp_path, zenohd)
    ahead = zenoh.Timestamp(
        zenoh_session.new_timestamp().get_time() + dt.timedelta(hours=1), b"\x07"
    )

    def is_stored() -> bool:
        zenoh_session.put(f"nedbus/1/{VLP}", encode(message(99)), timestamp=ahead)
        return last_messages(zenoh_session) == [99]

    wait_for(is_stored, what="the message in the storage")
    with nedbus.connect(zenohd) as reader:
        assert reader.latest()[0].stored
        stored = run_command("get", "-c", zenohd)
        assert stored.exit_code == 1
        assert ", only stored" in stored.out
        assert "no publisher answers: these messages are from a storage" in stored.err
        listed = run_command("list", "-c", zenohd)
        assert (listed.exit_code, "stored" in listed.out) == (0, True)
        with nedbus.connect(zenohd) as vehicle:
            vehicle.publisher(VLP, vehicle="1").publish(message(1))
            wait_for(lambda: not reader.latest()[0].stored, what="the live reply")
            assert reader.latest()[0].message == message(1)
            live = run_command("get", "-c", zenohd)
        assert live.exit_code == 0, live.err
        assert "timestamp: 1\n" in live.out
        assert "stored" not in live.out


def test_storage_waits_for_its_router_and_reconnects(start: Start, tmp_path: Path) -> None:
    """The storage may start before its router, and reconnects after a router restart."""
    endpoint = free_endpoint()
    start_storage(start, tmp_path, endpoint)
    file = write_config(tmp_path, tmp_path / "router.json5", endpoint)
    for _ in range(2):
        router = start_zenohd(start, "-c", str(file))
        with open_client([endpoint], timeout=DEADLINE) as session:

            def is_stored(session: Session = session) -> bool:
                session.put(f"nedbus/1/{VLP}", encode(message(7)))
                return last_messages(session) == [7]

            wait_for(is_stored, what="the storage")
        router.kill()


def test_http_is_read_only(start: Start, secure: str, pki: Path, tmp_path: Path) -> None:
    """With config/rest-reader.json5, GET returns messages, and PUT and DELETE affect no other client of the router."""
    address = free_endpoint().removeprefix("tcp/")
    changes = {"tls/127.0.0.1:7447": secure, HTTP: address}
    start_zenohd(
        start, "-c", str(write_config(pki, tmp_path / "rest-reader.json5", secure, **changes))
    )
    url = f"http://{address}/nedbus"
    with join(secure, pki, "vehicle-1") as vehicle, join(secure, pki, "reader") as reader:
        publisher = vehicle.publisher(VLP, vehicle="1")
        publisher.publish(message(1))
        wait_for(
            lambda: http("GET", f"{url}/1/{VLP}")[1].count(b'"key"') == 1,
            what="the vehicle over HTTP",
        )
        (answer,) = json.loads(http("GET", f"{url}/1/{VLP}")[1])
        assert decode(base64.b64decode(answer["value"])) == message(1)
        with reader.subscribe("*", mode="every") as subscription:
            assert subscription.receive(DEADLINE).message.timestamp == 1
            assert http("PUT", f"{url}/1/{VLP}", encode(message(666)))[0] == 200
            assert http("PUT", f"{url}/7/{VLP}", encode(message(667)))[0] == 200
            assert http("DELETE", f"{url}/1/{VLP}")[0] == 200
            assert http("PUT", f"http://{address}/@/local/router/config/x", b"1")[0] in (
                200,
                400,
                500,
            )
            for timestamp in (2, 3):
                publisher.publish(message(timestamp))
                assert subscription.receive(DEADLINE).message.timestamp == timestamp
            assert subscription.counts == nedbus.Counts(received=3)
        assert [sample.message.timestamp for sample in reader.latest("*")] == [3]
        assert [answer["key"] for answer in json.loads(http("GET", f"{url}/**")[1])] == [
            f"nedbus/1/{VLP}"
        ]


def test_ros_2_bridge_requires_a_separate_router(
    run_nedbus: Start, secure: str, zenohd: str, pki: Path
) -> None:
    """`nedbus ros2` fails with the secure router, which has no rules for ROS 2, unless --to names another router."""
    flags = tls_options(pki, "reader")
    with join(secure, pki, "vehicle-1") as vehicle:
        vehicle.publisher(VLP, vehicle="1")
        alone = run_nedbus("ros2", "-c", secure, *flags)
        assert alone.wait() == 1
        assert "set its endpoint with --to" in alone.err
        bridge = run_nedbus("ros2", "-c", secure, *flags, "--to", zenohd)
        wait_for(lambda: f"-> /fmu/out/{VLP}" in bridge.err, what=f"the bridge {bridge.err}")
