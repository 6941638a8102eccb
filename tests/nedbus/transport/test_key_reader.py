"""KeyReader: the newest sample of a key, on a session of the caller."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
import zenoh
import zenoh.ext

from nedbus.errors import ClosedError
from nedbus.transport import KeyReader, Session, open_router
from tests.peers.ports import free_endpoint
from tests.waits import DEADLINE

KEY = "nedbus/mocap/vehicle_visual_odometry"


@pytest.fixture
def router() -> Iterator[Session]:
    with open_router(listen=(free_endpoint(),)) as session:
        yield session


def test_newest_sample_is_received_and_older_ones_are_counted(router: Session) -> None:
    """Of several samples that wait, a reader receives the newest; samples of other keys are not among them."""
    reader = KeyReader(router, KEY)
    for number in range(5):
        router.put(KEY, bytes([number]))
    router.put(f"{KEY}_other", b"other")
    assert reader.receive().payload.to_bytes() == b"\x04"
    assert reader.superseded == 4
    router.put(KEY, b"next")
    assert reader.receive().payload.to_bytes() == b"next"
    assert reader.superseded == 4


def test_samples_that_the_ring_has_overwritten_are_counted(router: Session) -> None:
    """If more samples arrive than the ring holds before the reader is ready, all but the newest are superseded."""
    reader, sent = KeyReader(router, KEY), 20_000
    misses = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None)
    publisher = zenoh.ext.declare_advanced_publisher(router, KEY, sample_miss_detection=misses)
    publisher.put(b"first")
    assert reader.receive().payload.to_bytes() == b"first"
    for _ in range(sent - 1):
        publisher.put(b"position")
    publisher.put(b"newest")
    assert reader.receive().payload.to_bytes() == b"newest"
    assert reader.superseded == sent - 1
    router.put(KEY, b"without a number")
    assert reader.receive().payload.to_bytes() == b"without a number"
    assert reader.superseded == sent - 1


@pytest.mark.parametrize("by_session", [False, True])
def test_close_ends_a_waiting_receive(router: Session, by_session: bool) -> None:
    """A receive raises ClosedError when another thread closes the reader or its session."""
    reader, ended = KeyReader(router, KEY), threading.Event()

    def receive() -> None:
        with pytest.raises(ClosedError):
            reader.receive()
        ended.set()

    thread = threading.Thread(target=receive)
    thread.start()
    if by_session:
        router.close()
    reader.close()
    assert ended.wait(DEADLINE)
    thread.join()
    reader.close()
    with pytest.raises(ClosedError):
        reader.receive()
