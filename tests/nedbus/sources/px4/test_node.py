"""The ROS 2 node of `px4-zenoh:`: its queue, its thread, and the state that departed vehicles leave behind."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator

import pytest
import zenoh

from nedbus import limits
from nedbus.errors import SourceError
from nedbus.sources import Rejection, SourceMessage
from nedbus.sources.options import Px4ZenohOptions
from nedbus.sources.px4.source import Px4ZenohNode
from nedbus.sources.px4.streams import StreamRegistry
from nedbus.transport import Attachment, Session, TopicKey, open_client
from nedbus_msgs import dds_type
from tests.flights.local_position import ROS2_TYPE, downgrade, encode_cdr, type_hash
from tests.flights.messages import VLP, message
from tests.waits import DEADLINE, wait_for


class Source:
    """A running source, and what it knows about vehicles."""

    def __init__(self, endpoint: str) -> None:
        self.session = open_client([endpoint], timeout=DEADLINE)
        self.streams = StreamRegistry(Px4ZenohOptions(), vehicle="1")
        self.node = Px4ZenohNode(self.session, self.streams, domain=None)
        self.events = self.node.run()
        self.received, self.rejected = 0, Counter[str]()

    def step_until(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < end
            event = next(self.events)
            self.received += isinstance(event, SourceMessage)
            if isinstance(event, Rejection):
                self.rejected[event.reason] += event.count


@pytest.fixture
def source(endpoint: str) -> Iterator[Source]:
    """Return a source that receives from the test's router."""
    source = Source(endpoint)
    yield source
    source.node.close()
    source.session.close()


def put(session: Session, domain: int) -> zenoh.LivelinessToken:
    """Announce a vehicle in this domain, publish one message, and return the token."""
    key = TopicKey(domain, f"fmu/out/{VLP}", dds_type(ROS2_TYPE), type_hash("1.16"))
    token = session.liveliness().declare_token(key.token("MP", str(session.info.zid()), "px4", 1))
    payload = encode_cdr(downgrade(message(1), "1.16"), layout="1.16")
    session.put(str(key), payload, attachment=bytes(Attachment(1, 1, bytes(16))))
    return token


def test_departed_vehicles_leave_no_objects(source: Source, zenoh_session: Session) -> None:
    """A vehicle's liveliness tokens end when it departs, and its streams expire a minute after its last message."""
    tokens = [put(zenoh_session, domain) for domain in range(20)]
    source.step_until(lambda: source.received == len(tokens))
    source.step_until(lambda: len(source.node._subscriptions) == len(tokens))
    for token in tokens:
        token.undeclare()
    source.step_until(lambda: not source.node._subscriptions)
    source.streams.report(time.monotonic() + 61.0)
    tables = source.streams._streams, source.streams._owners, source.streams._reboots
    assert [len(each) for each in (*tables, source.node._nodes, source.node._tokens._keys)] == [
        0,
        0,
        0,
        0,
        0,
    ]


def test_messages_beyond_the_queue_are_counted_as_rejected(
    source: Source, zenoh_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Messages that arrive faster than they are decoded are not queued without limit, but counted as rejected."""
    monkeypatch.setattr(limits, "PX4_PENDING", 3)
    source.step_until(lambda: True)
    for domain in range(10):
        put(zenoh_session, domain)
    wait_for(lambda: source.node._dropped.total() == 7, what="all messages")
    source.step_until(lambda: source.received == 3)
    assert source.rejected == {"messages arrive faster than they are decoded": 7}


def test_end_of_receiving_thread_raises(source: Source) -> None:
    """If the receiving thread ends unexpectedly, the source raises SourceError, and the service restarts it."""
    source.step_until(lambda: True)
    source.node._subscriber.undeclare()
    source.node._thread.join(DEADLINE)
    with pytest.raises(SourceError, match="receiving has stopped"):
        source.step_until(lambda: False)
