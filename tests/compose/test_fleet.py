"""Failures in a fleet of two ground stations and a cloud, each with a router, and a low-bandwidth link to the cloud."""

from __future__ import annotations

import itertools
import json
import statistics
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing
from functools import partial

import pytest

import nedbus
from nedbus.timings import TIMINGS
from nedbus.transport import open_client, query
from nedbus_msgs import Address
from tests.flights.messages import VLP
from tests.peers.ports import free_endpoint
from tests.waits import DEADLINE, wait_for

from .conftest import StartStack
from .recorder import Flight, Recorder, indices, missing
from .stack import Stack, docker

pytestmark = [pytest.mark.compose, pytest.mark.timeout(600)]

NEAR_A, NEAR_B = [Address("1", VLP), Address("2", VLP)], [Address("3", VLP)]
ALL = [*NEAR_A, *NEAR_B]
VEHICLES = [f"vehicle-{address.vehicle}" for address in ALL]


class Fleet:
    """The stack, with a published port and a recorder of all messages at each router."""

    def __init__(self, stack: Stack, endpoints: dict[str, str], closing: ExitStack) -> None:
        """Start the routers, then the vehicles; each vehicle connects to its first configured ground station."""
        self.stack = stack
        self.endpoints = endpoints
        stack.up(*endpoints)
        buses = {
            name: closing.enter_context(nedbus.connect(where, timeout=DEADLINE))
            for name, where in endpoints.items()
        }
        stack.up(*VEHICLES)
        self.cloud = buses["cloud"]
        self.readers = {
            name: Recorder(bus.subscribe(VLP, mode="every")) for name, bus in buses.items()
        }
        self.thin = Recorder(self.cloud.subscribe(VLP, mode="every", max_rate=5))
        for reader in (*self.readers.values(), self.thin):
            closing.callback(reader.close)
        self.wait_for_new_messages(*self.readers)

    def clients(self, router: str) -> int:
        """Return the number of vehicles connected to a router."""
        with closing(open_client([self.endpoints[router]], timeout=DEADLINE)) as session:
            (zid,) = session.info.routers_zid()
            (answer,) = query(session, f"@/{zid}/router", timeout=DEADLINE)
        modes = [each["whatami"] for each in json.loads(answer.payload.to_bytes())["sessions"]]
        return modes.count("client") - 2  # this session, and the reader

    def wait_for_clients(self, router: str, count: int) -> None:
        """Wait until `count` vehicles are connected to a router."""
        wait_for(lambda: self.clients(router) == count, what=f"{count} vehicles at {router}")

    def wait_for_new_messages(self, *routers: str) -> None:
        """Wait until the recorders at these routers have 100 messages of each vehicle sent after this call."""
        now = time.time_ns()
        for router in routers:
            samples = self.readers[router].samples
            wait_for(
                partial(_have_new_messages, samples, len(samples), now),
                what=f"all vehicles at {router}",
            )

    def end(self) -> None:
        """Stop the vehicles, and wait until all recorders have their last messages."""
        self.stack.compose("stop", *VEHICLES)

        def last(address: Address) -> set[int]:
            return {reader.of(address)[-1].message.timestamp for reader in self.readers.values()}

        wait_for(lambda: all(len(last(address)) == 1 for address in ALL), what="the last messages")


def _have_new_messages(samples: list[nedbus.Sample], start: int, moment: int) -> bool:
    counts = Counter(
        each.address for each in samples[start:] if each.sent is not None and each.sent > moment
    )
    return all(counts[address] >= 100 for address in ALL)


def flight_of(address: Address) -> Flight:
    """Return the flight of a vehicle."""
    return Flight(f"sim:?vehicle={address.vehicle}")


@pytest.fixture
def fleet(make_stack: StartStack) -> Iterator[Fleet]:
    """Start the fleet of docker-compose.fleet.yml."""
    ports = {"base-a": free_endpoint(), "base-b": free_endpoint()}
    published = {
        f"NEDBUS_PUBLISH_{name[-1].upper()}": where.removeprefix("tcp/")
        for name, where in ports.items()
    }
    stack = make_stack(
        "fleet", "docker-compose.fleet.yml", "tests/compose/fleet-ports.yml", **published
    )
    with ExitStack() as closing:
        yield Fleet(stack, {"cloud": stack.endpoint, **ports}, closing)


def test_router_and_radio_failures_lose_no_messages(fleet: Fleet) -> None:
    """Vehicles reconnect to the other ground station; ground stations work without the cloud; no message is lost.

    The downsampled subscriber at the cloud receives 5 of 100 messages a second, and counts none as lost.
    """
    stack = fleet.stack
    fleet.wait_for_clients("base-a", 2)
    fleet.wait_for_clients("base-b", 1)
    stack.compose("kill", "base-a")
    fleet.wait_for_new_messages("cloud", "base-b")
    fleet.wait_for_clients("base-b", 3)
    assert set(fleet.cloud.vehicles()) == {"1", "2", "3"}
    stack.compose("start", "base-a")
    fleet.wait_for_new_messages("base-a")
    assert (fleet.clients("base-a"), fleet.clients("base-b")) == (0, 3)
    thinned = {address: fleet.thin.of(address) for address in ALL}
    stack.compose("kill", "cloud")
    fleet.wait_for_new_messages("base-a", "base-b")
    stack.compose("start", "cloud")
    fleet.wait_for_new_messages("cloud")
    docker("network", "disconnect", stack.network("radio-b"), stack.container("vehicle-1"))
    fleet.wait_for_new_messages(*fleet.readers)
    fleet.wait_for_clients("base-a", 1)
    fleet.end()
    for name, reader in fleet.readers.items():
        lost, pause = 0, 0.0
        for address in ALL:
            samples = reader.of(address)
            arrived = indices(samples, flight_of(address))
            assert arrived == sorted({*arrived}), f"{address} at {name}"
            lost += missing(arrived)
            pause = max(
                pause,
                *(
                    after.received - before.received
                    for before, after in itertools.pairwise(samples)
                ),
            )
        assert lost == reader.subscription.counts.lost, name
        # On a busy machine a change of routers may take longer than publishers cache their messages.
        assert lost == 0 or pause > 1e9 * TIMINGS.retransmit_timeout / 2, (
            f"{lost} at {name}, {pause / 1e9} s"
        )
    for address, samples in thinned.items():
        kept = indices(samples, flight_of(address))
        assert statistics.median(after - before for before, after in itertools.pairwise(kept)) == 20
    assert fleet.thin.subscription.counts.lost == 0
