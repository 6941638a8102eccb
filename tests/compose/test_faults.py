"""Fault injection: killed routers, interrupted links, frozen hosts, and subscribers that do not read."""

from __future__ import annotations

import json
import time

import pytest

import nedbus
from nedbus_msgs import Address
from tests.flights.messages import VLP
from tests.waits import DEADLINE, wait_for

from .conftest import Record, StartStack
from .recorder import Flight, indices, is_complete, missing
from .stack import docker

pytestmark = [pytest.mark.compose, pytest.mark.timeout(600)]

# limit from the return of the network to new data [s]; measured: 0.5 to 2, and 3.4 on a busy machine
RECOVERY = 10.0
OUTAGE = 10.0  # duration of a link outage [s]
LEASE = 5.0  # silence after which Zenoh closes a link [s]
MINE = Address("1", VLP)


def first_after(samples: list[nedbus.Sample], moment: int) -> nedbus.Sample:
    """Return the first sample that arrived after a time, in ns since the epoch."""
    return next(sample for sample in samples if sample.received > moment)


def sent(sample: nedbus.Sample) -> int:
    """Return the send time of a sample, in ns since the epoch."""
    assert sample.sent is not None
    return sample.sent


def test_clients_recover_from_router_restart(make_stack: StartStack, record: Record) -> None:
    """Both sides reconnect; `every` loses nothing, `latest` continues with the newest message, and counts are exact."""
    stack = make_stack("router")
    stack.up()
    with nedbus.connect(stack.endpoint, timeout=DEADLINE) as bus:
        every = record(bus.subscribe(VLP, mode="every"))
        latest = record(bus.subscribe(VLP))
        every.wait_for_more(100)
        latest.wait_for_more(100)
        stack.compose("kill", "--signal", "KILL", "router")
        wait_for(lambda: not bus.connected, what="the loss of the link")
        wait_for(lambda: not every.subscription.waiting, what="the end of what has been received")
        silent = len(every.samples)
        time.sleep(3.0)  # the outage
        assert len(every.samples) == silent
        restart = time.time_ns()
        stack.compose("start", "router")
        nedbus.connect(stack.endpoint, timeout=DEADLINE).close()  # the router accepts a new client
        back = time.time_ns()
        every.wait_for_more(1000)  # about 400 of them sent during the outage
        latest.wait_for_more(100)
        stack.compose("stop", "service")
        wait_for(
            lambda: every.samples[-1].message == latest.samples[-1].message, what="the last message"
        )
        for recorder in (every, latest):
            assert first_after(recorder.samples, restart).received - back < RECOVERY * 1e9
        flight = Flight()
        assert is_complete(indices(every.of(MINE), flight))
        assert every.subscription.counts.lost == 0
        assert sent(first_after(latest.samples, restart)) > restart
        received = indices(latest.of(MINE), flight)
        assert received == sorted(received)
        gap = missing(received)
        counts = latest.subscription.counts
        assert gap > 100
        assert gap <= counts.lost + counts.dropped <= gap + latest.unseen
        assert counts.lost == sum(sample.lost for sample in latest.samples)


def test_link_outage_is_recovered_or_counted(make_stack: StartStack, record: Record) -> None:
    """An outage of 10 s loses nothing at 100 Hz; at 400 Hz the cache is too small, and the loss is counted exactly."""
    stack = make_stack(
        "link", "docker-compose.hosts.yml", NEDBUS_SOURCE="sim:,sim:?vehicle=2&speed=4"
    )
    stack.up()
    fast = Address("2", VLP)
    with nedbus.connect(stack.endpoint, timeout=DEADLINE) as bus:
        every = record(bus.subscribe(VLP, mode="every"))
        latest = record(bus.subscribe(VLP))
        wait_for(
            lambda: every.of(MINE) and every.of(fast) and latest.of(MINE), what="both vehicles"
        )
        every.wait_for_more(500)
        link, router = stack.network("link"), stack.container("vehicle-router")
        docker("network", "disconnect", link, router)
        time.sleep(OUTAGE)
        wait_for(
            lambda: bus.vehicles() == {},
            what="the end of the lease, after which the remote vehicles are gone",
        )
        restored = time.time_ns()
        docker("network", "connect", link, router)
        latest.wait_for_more(500)
        every.wait_for_more(10_000)  # about 5,000 of them sent during the outage
        stack.compose("stop", "service")
        wait_for(
            lambda: every.of(MINE)[-1].message == latest.of(MINE)[-1].message,
            what="the last message",
        )
        wait_for(
            lambda: every.of(fast)[-1].message == latest.of(fast)[-1].message,
            what="the last message",
        )
        assert first_after(latest.samples, restored).received - restored < RECOVERY * 1e9
        assert first_after(every.samples, restored).received - restored < RECOVERY * 1e9
        assert sent(first_after(latest.of(MINE), restored)) > restored
        assert is_complete(indices(every.of(MINE), Flight()))
        samples = every.of(fast)
        received = indices(samples, Flight("sim:?vehicle=2&speed=4"))
        assert received == sorted(set(received)), "in order, without duplicates"
        assert missing(received) > 1000
        assert sum(sample.lost for sample in samples) == missing(received)
        assert every.subscription.counts.lost == missing(received)
        received = indices(latest.of(MINE), Flight())
        assert received == sorted(received)
        lost = sum(sample.lost for sample in latest.of(MINE))
        assert missing(received) - latest.subscription.counts.dropped <= lost <= missing(received)


def test_frozen_service_disappears_and_returns(make_stack: StartStack, record: Record) -> None:
    """The data of a stopped service ages; its vehicle disappears when the lease ends, and returns with the service."""
    stack = make_stack("frozen")
    stack.up()
    with nedbus.connect(stack.endpoint, timeout=DEADLINE) as bus:
        reader = record(bus.subscribe(VLP))
        reader.wait_for_more(100)
        # Signals, because `docker pause` can fail with cgroup v1; -1 is every process but init and this shell.
        stack.compose("exec", "-T", "service", "sh", "-c", "kill -STOP -1")
        frozen = time.monotonic()
        assert "1" in bus.vehicles(), "listed until the lease ends"

        def age() -> float:
            return (time.time_ns() - sent(reader.samples[-1])) / 1e9

        wait_for(lambda: age() > 2.0, what="an age of 2 s")
        wait_for(lambda: "1" not in bus.vehicles(), what="its disappearance")
        assert LEASE / 2 < time.monotonic() - frozen < 2 * LEASE
        assert bus.latest("*") == []
        stack.compose("exec", "-T", "service", "sh", "-c", "kill -CONT -1")
        reader.wait_for_more(100)
        wait_for(lambda: "1" in bus.vehicles(), what="its return")
        wait_for(lambda: age() < 1.0, what="new data")


STUCK = """
import sys, threading, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", '["tcp/router:7447"]')
config.insert_json5("connect/timeout_ms", "-1")  # the router may not listen yet
session = zenoh.open(config)
subscriber = session.declare_subscriber("nedbus/**", zenoh.handlers.FifoChannel(1))
print("stuck", flush=True)
threading.Event().wait()
"""
PUBLISHER = """
import json, resource, sys, time
import nedbus
bus = nedbus.connect("tcp/router:7447", timeout=60)
publisher = bus.publisher("vehicle_local_position", vehicle="fast")
end, count, blocked = time.monotonic() + float(sys.argv[1]), 0, 0.0
while time.monotonic() < end:
    count += 1
    fields = {"timestamp": count}
    waited, start = resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw, time.monotonic()
    publisher.publish(fields)
    took = time.monotonic() - start
    # Count only voluntary waits: on a busy machine the process may also be preempted.
    if took > 0.05 and resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw > waited:
        blocked += took
    time.sleep(0.002)
print(json.dumps({"count": count, "blocked": blocked}), flush=True)
publisher.flush(60)  # until the reader has recovered its missing messages
bus.close()
"""


def test_stuck_reader_does_not_affect_others(make_stack: StartStack, record: Record) -> None:
    """While one subscriber does not read for 60 s, another subscriber loses nothing and the publisher never blocks."""
    stack = make_stack("stuck")
    stack.up("router")
    python = ("--entrypoint", "/opt/nedbus/bin/python")
    stuck = stack.run("subscriber", "-c", STUCK, options=python)
    wait_for(lambda: "stuck" in stuck.out, what=f"the stuck reader {stuck.err}")
    with nedbus.connect(stack.endpoint, timeout=DEADLINE) as bus:
        healthy = record(bus.subscribe(VLP, mode="every"))
        publisher = stack.run("subscriber", "-c", PUBLISHER, "60", options=python)
        assert publisher.wait(180.0) == 0, publisher.err
        result = json.loads(publisher.out)
        assert result["count"] > 10_000
        assert result["blocked"] < 1.0, (
            "a subscriber that delays the publisher would do so for most of the 60 s"
        )
        wait_for(
            lambda: healthy.samples[-1].message.timestamp == result["count"],
            what="the last message",
        )
        assert healthy.subscription.counts == nedbus.Counts(received=result["count"])
        assert [sample.message.timestamp for sample in healthy.samples] == list(
            range(1, result["count"] + 1)
        )
    assert stuck.popen.poll() is None
