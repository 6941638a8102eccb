"""Heartbeats of nedbus as received by Zenoh's own advanced subscriber."""

from __future__ import annotations

from contextlib import closing

import pytest
import zenoh

import nedbus
from nedbus.client.receiving.receiver import drain
from nedbus.transport import Heartbeats, Session, follow_heartbeats, open_client
from tests.flights.local_position import decode
from tests.flights.messages import VLP
from tests.nedbus.client.downsampling import Link, wait_for_downsampling_reader
from tests.nedbus.client.numbered import publish, wait_for_subscriber
from tests.nedbus.transport.size_limits import KEYS_AND_LIMITS, received_sizes
from tests.waits import DEADLINE, wait_for, wait_for_matching


def test_last_message_is_recovered_by_zenoh(endpoint: str, bus: nedbus.Bus) -> None:
    """Zenoh's advanced subscriber recovers the last message after a heartbeat, without a further message."""
    channel: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(100)
    recovery = zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None)
    samples: list[zenoh.Sample] = []

    def received() -> list[int]:
        return [
            decode(sample.payload.to_bytes()).timestamp
            for sample in drain(subscriber.handler, samples)
        ]

    with closing(Link(endpoint)) as link, open_client([link.endpoint], timeout=5.0) as session:
        publisher = bus.publisher(VLP, vehicle="1")
        subscriber = zenoh.ext.declare_advanced_subscriber(
            session, publisher.key, channel, recovery=recovery
        )
        wait_for_subscriber(publisher)
        publish(publisher, 1)
        wait_for(lambda: received() == [1], what="the first message")
        link.cut()
        wait_for(lambda: not session.info.routers_zid(), what="the end of the link")
        publish(publisher, 2)
        link.broken = False
        wait_for(lambda: received() == [1, 2], what="the last message")
        subscriber.undeclare()


def test_downsampled_streams_have_heartbeats(bus: nedbus.Bus, zenoh_session: Session) -> None:
    """A downsampled stream has its own sequence numbers, and its heartbeats carry the last sequence number."""
    heartbeats: Heartbeats = {}
    take, undeclare = follow_heartbeats(zenoh_session, f"nedbus/*/{VLP}/@rate/*")
    with bus.publisher(VLP, vehicle="1") as publisher, bus.subscribe(VLP, mode="every", max_rate=1):
        wait_for_downsampling_reader(publisher)

        def publish_until_heartbeat() -> bool:
            publish(publisher, publisher.published)
            heartbeats.update(take())
            return bool(heartbeats)

        wait_for(publish_until_heartbeat, what="a heartbeat")
    [((key, _), number)] = heartbeats.items()
    assert key == f"{publisher.key}/@rate/1"
    assert number < 10 < publisher.published
    undeclare()


def test_unread_heartbeats_are_bounded_in_bytes(endpoint: str, zenoh_session: Session) -> None:
    """A reader that is busy holds at most 4096 heartbeats, of at most 64 bytes: the router drops larger ones."""
    end, block = "nedbus/end", zenoh.CongestionControl.BLOCK
    with open_client([endpoint], timeout=DEADLINE) as reader:
        take, undeclare = follow_heartbeats(reader, f"nedbus/*/{VLP}")
        ended = reader.declare_subscriber(end, zenoh.handlers.RingChannel(1))
        wait_for_matching(zenoh_session, end)
        wait_for_matching(zenoh_session, f"nedbus/1/{VLP}/@adv/pub/1a/1/_")
        for number in range(5000):
            zenoh_session.put(
                f"nedbus/{number}/{VLP}/@adv/pub/1a/1/_", bytes(4), congestion_control=block
            )
            zenoh_session.put(
                f"nedbus/5000/{VLP}/@adv/pub/1a/1/_", bytes(65), congestion_control=block
            )
        zenoh_session.put(end, b"", congestion_control=block)
        wait_for(ended.handler.try_recv, what="the end")
        assert [key.split("/")[1] for key, _ in take()] == [
            str(number) for number in range(904, 5000)
        ]
        undeclare()


@pytest.mark.parametrize(("key", "limit"), KEYS_AND_LIMITS)
def test_router_drops_large_puts_on_report_and_heartbeat_keys(
    endpoint: str, zenoh_session: Session, key: str, limit: int
) -> None:
    """The router of nedbus limits the bytes of what readers count as messages."""
    with open_client([endpoint], timeout=DEADLINE) as reader:
        assert received_sizes(zenoh_session, reader, key, limit) == [limit]
