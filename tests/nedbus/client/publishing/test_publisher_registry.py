"""State that closed publishers leave behind, in Python and in an embedded router."""

from __future__ import annotations

import ctypes
import gc
import weakref
from collections.abc import Iterator

import pytest

from nedbus.client import PublisherRegistry, QueryServer
from nedbus.transport import Session, open_router
from nedbus_msgs import Address, schema_key
from tests.flights.messages import VLP, message
from tests.peers.ports import free_endpoint

pytestmark = pytest.mark.router

TOPICS = VLP, "vehicle_attitude"


@pytest.fixture
def router() -> Iterator[Session]:
    """Run a router and return its own session, which embedded routers publish with."""
    with open_router(listen=(free_endpoint(),)) as session:
        yield session


@pytest.fixture
def registry(router: Session) -> Iterator[PublisherRegistry]:
    """Return the registry of a service with an embedded router."""
    queries = QueryServer(router)
    registry = PublisherRegistry(router, queries, prefix="vehicle", is_client=False)
    yield registry
    queries.close()
    registry.heartbeats.close()


def come_and_go(registry: PublisherRegistry, vehicle: str) -> list[weakref.ref[object]]:
    """Publish a vehicle, as a service does, and withdraw it; return references to the objects that it needed."""
    publishers = [registry.publisher(Address(vehicle, topic)) for topic in TOPICS]
    publishers[0].publish(message(1))
    assert registry.shared_vehicles() == set()
    directory = registry._directories[vehicle]
    used = [*publishers, *(each._writer for each in publishers), directory, directory._tokens]
    for publisher in publishers:
        publisher.close()
    return [weakref.ref(each) for each in used]


@pytest.mark.slow
def test_departed_vehicle_leaves_no_objects(registry: PublisherRegistry) -> None:
    """After the last publisher of a vehicle has closed, the registry keeps the definitions of its messages only."""
    references = [each for number in range(5) for each in come_and_go(registry, f"v{number}")]
    gc.collect()
    assert [each() for each in references if each() is not None] == []
    tables = (
        registry.publishers,
        registry._rate_listeners,
        registry._directories,
        registry.heartbeats.writers,
    )
    assert [len(each) for each in tables] == [0, 0, 0, 0]
    assert list(registry._queries._queryables) == [
        schema_key("*", vehicle="v4", prefix=registry.prefix)
    ]
    assert len(registry._definitions) == len(TOPICS)


@pytest.mark.slow
def test_departed_vehicle_leaves_no_keys_in_router(registry: PublisherRegistry) -> None:
    """An embedded router without links frees all keys of a vehicle, also those of its liveliness subscription.

    Zenoh 1.10.2 keeps the key of each liveliness subscription and query: 4.4 kB per vehicle. The limit leaves room for
    the timers of queries, 0.6 kB for a minute.
    """
    for number in range(50):
        come_and_go(registry, f"first{number}")
    gc.collect()
    before = allocated()
    for number in range(200):
        come_and_go(registry, f"v{number}")
    gc.collect()
    assert (allocated() - before) / 200 < 2000


class Mallinfo(ctypes.Structure):
    """The statistics of glibc's allocator."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in (
            *("arena", "ordblks", "smblks", "hblks", "hblkhd"),
            *("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
        )
    )


def allocated() -> int:
    """Return the bytes that this process has allocated with malloc, as Zenoh does."""
    mallinfo = ctypes.CDLL(None).mallinfo2
    mallinfo.restype = Mallinfo
    found = mallinfo()
    return int(found.uordblks + found.hblkhd)
