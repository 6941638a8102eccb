"""Malicious input on the router's port and on the data keys: no crash, no invalid message, correct counts."""

from __future__ import annotations

import random
import socket
from collections.abc import Callable, Iterator

import pytest
import zenoh

import nedbus
from nedbus_msgs import Address
from tests.flights.local_position import encode
from tests.flights.messages import VLP, message
from tests.waits import DEADLINE, wait_for

from .conftest import Record, StartStack
from .recorder import Flight, indices, is_complete

pytestmark = [pytest.mark.compose, pytest.mark.timeout(600)]

BLOCK = zenoh.CongestionControl.BLOCK
GARBAGE = [b"GET / HTTP/1.1\r\n\r\n", b"\0" * 4096, b"\xff" * 4096, b"\x16\x03\x01\x02\x00\x01\x00"]


def malformed(count: int) -> Iterator[bytes]:
    """Yield invalid payloads: random bytes, and valid messages that were truncated, extended or corrupted."""
    rng = random.Random(0)
    good = encode(message(5, timestamp_sample=3))
    late = bytearray(good)
    late[12:21] = good[3:12]  # timestamp_sample = timestamp ...
    late[20] += 1  # ... and a microsecond more
    kinds: list[Callable[[], bytes]] = [
        lambda: rng.randbytes(rng.randrange(300)),
        lambda: rng.randbytes(len(good)),
        lambda: good[: rng.randrange(len(good))],
        lambda: good + b"\0",
        lambda: bytes(late),
        lambda: b"\xdc\xff\xff" + good[3:],
        lambda: b"\xdd\xff\xff\xff\xff",
    ]
    return (kinds[number % len(kinds)]() for number in range(count))


def test_invalid_input_is_counted_and_dropped(make_stack: StartStack, record: Record) -> None:
    """Garbage on the port, invalid payloads, wildcard puts and false tokens are dropped; all valid messages arrive."""
    stack = make_stack("hostile")
    stack.up()
    host, port = stack.address.split(":")
    with nedbus.connect(stack.endpoint, timeout=DEADLINE) as bus:
        reader = record(bus.subscribe("*", mode="every"))
        latest = record(bus.subscribe("*"))
        reader.wait_for_more(100)
        rng = random.Random(1)
        for number in range(100):
            with socket.create_connection((host, int(port)), timeout=DEADLINE) as connection:
                connection.sendall(GARBAGE[number] if number < len(GARBAGE) else rng.randbytes(200))
        with nedbus.connect(stack.endpoint, timeout=DEADLINE) as hostile:
            session = hostile._session
            for payload in malformed(1000):
                session.put(f"nedbus/1/{VLP}", payload, congestion_control=BLOCK)
            for key in (
                f"nedbus/*/{VLP}",
                "nedbus/1/*",
                "nedbus/**",
                "nedbus/1/no_such_topic",
                f"nedbus/1/{VLP}/0",
            ):
                session.put(key, encode(message(1)), congestion_control=BLOCK)
            session.delete(f"nedbus/1/{VLP}", congestion_control=BLOCK)
            token = session.liveliness().declare_token("nedbus/no vehicle/@alive/1a/nothing")
            wait_for(
                lambda: reader.subscription.counts.invalid == 1006, what="1,006 invalid messages"
            )
            assert list(bus.vehicles()) == ["1"]
            token.undeclare()
        with nedbus.connect(stack.endpoint, timeout=DEADLINE) as hostile:
            hostile._session.put(f"nedbus/1/{VLP}", b"\xc0" * 10_000_000, congestion_control=BLOCK)
            reader.wait_for_more(500)
        assert reader.subscription.counts == nedbus.Counts(
            received=len(reader.samples), invalid=1006
        )
        assert is_complete(indices(reader.of(Address("1", VLP)), Flight()))
        assert 500 < latest.subscription.counts.invalid <= 1006, (
            "superseded messages are not validated"
        )
        assert {sample.vehicle for sample in reader.samples + latest.samples} == {"1"}
    for service in ("router", "service"):
        container = stack.inspect(service)
        assert container["State"]["Running"], service
        assert container["RestartCount"] == 0, service
    assert "Traceback" not in stack.compose("logs")
