"""Counts of a reader through a real router, with floods, invalid messages, unknown layouts and rejections."""

from __future__ import annotations

import json
import logging
import sys
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from types import FrameType, SimpleNamespace
from typing import Any, cast

import msgpack
import pytest
import zenoh

import nedbus
from nedbus import ClosedError, Counts, Mode
from nedbus.client import PublisherRegistry, QueryServer, RejectionReport
from nedbus.client.receiving.reorder import Reorder
from nedbus.transport import Session
from nedbus_msgs import Address
from tests.flights.local_position import ENCODING, encode
from tests.flights.messages import VLP, message
from tests.nedbus.client.numbered import numbered, publish, receive_timestamps, wait_for_subscriber
from tests.nedbus.client.test_bus import BOTH, SCHEMA
from tests.waits import DEADLINE, Stopwatch, wait_for, wait_for_matching

KEY = f"nedbus/1/{VLP}"
ADDRESS = Address("7", "estimator_local_position", 1)  # of rejected messages


@pytest.fixture
def publisher(bus: nedbus.Bus) -> nedbus.Publisher:
    """Return a publisher that has published one message, which each new reader receives."""
    publisher = bus.publisher(VLP, vehicle="1")
    publish(publisher, 1)
    return publisher


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def test_mode_every_receives_all_samples_in_order(
    client: nedbus.Bus, publisher: nedbus.Publisher
) -> None:
    """A reader in mode "every" receives each sample once and in order, and counts no loss."""
    subscription = client.subscribe(VLP, mode="every")
    first = subscription.receive(DEADLINE)
    publish(publisher, *range(2, 1002))
    taken = [first, *islice(subscription, 1000)]
    assert [sample.message.timestamp for sample in taken] == list(range(1, 1002))
    assert subscription.counts == Counts(received=1001)


def test_mode_latest_keeps_samples_of_quiet_vehicles(
    client: nedbus.Bus, publisher: nedbus.Publisher, bus: nedbus.Bus
) -> None:
    """A busy vehicle does not displace a quiet one while the reader pauses, and all messages are counted exactly."""
    subscription = client.subscribe(VLP)
    assert receive_timestamps(subscription, 1) == [1]
    publish(bus.publisher(VLP, vehicle="quiet"), 1)
    publish(publisher, *range(2, 3001))

    def is_counted() -> bool:
        """Return True if all but the newest message are counted; else publish another one, which reveals losses."""
        counts = subscription.counts
        if counts.dropped + counts.lost < publisher.published - 2:
            publish(publisher, 3000)
        return counts.dropped + counts.lost == publisher.published - 2

    wait_for(is_counted, what="the counts of all but the newest message")
    newest = {sample.vehicle: sample.message.timestamp for sample in islice(subscription, 2)}
    assert newest == {"1": 3000, "quiet": 1}
    counts = subscription.counts
    assert counts.received + counts.dropped + counts.lost == publisher.published + 1
    assert (counts.received, counts.invalid) == (3, 0)


@pytest.mark.slow
@pytest.mark.parametrize("mode", BOTH)
def test_unread_subscription_does_not_delay_other_readers(
    client: nedbus.Bus,
    endpoint: str,
    publisher: nedbus.Publisher,
    monkeypatch: pytest.MonkeyPatch,
    mode: Mode,
) -> None:
    """A full subscription delays neither other subscriptions of any bus, nor queries, nor its own close."""
    monkeypatch.setattr("nedbus.limits.RING", 256)
    monkeypatch.setattr("nedbus.limits.UNREAD_MESSAGES", 1000)
    stuck = client.subscribe(VLP, mode=mode)
    with nedbus.connect(endpoint) as other:
        read = [each.subscribe(VLP, mode="every") for each in (client, other)]
        assert [receive_timestamps(each, 1) for each in read] == [[1], [1]]
        for first in range(2, 3_001, 100):
            numbers = range(first, min(first + 100, 3_001))
            publish(publisher, *numbers)
            assert [receive_timestamps(each, len(numbers)) for each in read] == [list(numbers)] * 2
    wait_for(lambda: stuck.counts.dropped, what="a dropped message")
    wait_for(
        lambda: [s.message.timestamp for s in client.latest(VLP)] == [3_000],
        what="the last message",
    )
    assert client.subscribe(VLP).receive(DEADLINE).message.timestamp > 0
    with Stopwatch() as watch:
        stuck.close()
    assert watch.seconds < 5.0, "slow: Zenoh's timeout for a blocked close is 10 s"


def test_missing_messages_are_counted_exactly(
    endpoint: str, publisher: nedbus.Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each message of a flood that exceeds buffers and queue is counted as received, lost or dropped."""
    monkeypatch.setattr("nedbus.limits.UNREAD_MESSAGES", 1000)
    with nedbus.connect(endpoint) as other, other.subscribe(VLP, mode="every") as subscription:
        first = subscription.receive(DEADLINE)
        total = 6000
        _, *rest = message(2).__dict__.values()
        for timestamp in range(2, total + 1):
            publisher.publish_row((timestamp, *rest))
        wait_for(lambda: subscription.counts.dropped, what="a dropped message")
        lost, received, missing, last = first.lost, 1, first.lost, first.message.timestamp
        while last != total:
            sample = subscription.receive(DEADLINE)
            assert sample.message.timestamp > last + sample.lost
            lost, received = lost + sample.lost, received + 1
            missing += sample.message.timestamp - last - 1
            last = sample.message.timestamp
        counts = subscription.counts
        assert (counts.received, counts.lost, counts.invalid) == (received, lost, 0)
        assert lost + counts.dropped == missing == total - received > 0


@pytest.mark.slow
def test_two_publishers_of_one_key_lose_nothing(
    client: nedbus.Bus, bus: nedbus.Bus, endpoint: str
) -> None:
    """Publishers of one key have independent sequence numbers, even if one starts after the other has closed."""
    subscription = client.subscribe(VLP, mode="every")
    one = bus.publisher(VLP, vehicle="1")
    with nedbus.connect(endpoint) as other:
        two = other.publisher(VLP, vehicle="1")
        wait_for_subscriber(one)
        wait_for_subscriber(two)
        for timestamp in range(1, 501):
            publish(one, timestamp)
            publish(two, timestamp)
        taken = list(islice(subscription, 1000))
    one.close()
    publish(bus.publisher(VLP, vehicle="1"), *range(501, 701))
    taken += islice(subscription, 200)
    assert sum(sample.lost for sample in taken) == 0
    assert subscription.counts == Counts(received=1200)


def test_two_reading_threads_receive_a_message_each(bus: nedbus.Bus) -> None:
    """The thread that drains the ring wakes the other reading thread, which gets the second message."""
    publisher, subscription = bus.publisher(VLP, vehicle="1"), bus.subscribe(mode="every")
    wait_for_subscriber(publisher)
    with ThreadPoolExecutor(2) as pool, subscription:
        for _ in range(100):
            taken = [pool.submit(subscription.receive) for _ in range(2)]
            publisher.publish_many(numbered(2))
            assert sorted(each.result(DEADLINE).message.timestamp for each in taken) == [1, 2]


def test_invalid_samples_do_not_end_an_iteration(
    client: nedbus.Bus,
    zenoh_session: Session,
    publisher: nedbus.Publisher,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Invalid payloads and keys, deletes and wildcard puts are counted, logged once per key, and skipped."""
    subscription = client.subscribe("*", mode="every")
    assert receive_timestamps(subscription, 1) == [1]
    good = encode(message(2, x=1.0))
    for key, payload in (
        (KEY, b"garbage"),
        (KEY, msgpack.packb([1, 2, 3])),
        (f"nedbus/*/{VLP}", good),
        ("nedbus/1/vehicle_attitude", good),
        ("nedbus/1/estimator_local_position", good),
        ("nedbus/1", good),
    ):
        zenoh_session.put(key, payload)
    zenoh_session.delete(KEY)
    zenoh_session.put(f"nedbus/2/{VLP}", good)
    sample = subscription.receive(DEADLINE)
    assert (sample.vehicle, sample.message, sample.sent) == ("2", message(2, x=1.0), None)
    assert subscription.counts == Counts(received=2, invalid=7)
    warned = warnings(caplog)
    assert len(warned) == len({text.split(":")[0] for text in warned}), (
        "a key is logged more than once"
    )
    assert any("garbage" in text or "not a single msgpack value" in text for text in warned)


@pytest.mark.slow
def test_long_invalid_keys_are_not_kept(
    bus: nedbus.Bus,
    zenoh_session: Session,
    publisher: nedbus.Publisher,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """150 invalid keys of 60 kB are counted but not kept, and logged in at most 100 short lines."""
    subscription = bus.subscribe("*", mode="every")
    assert receive_timestamps(subscription, 1) == [1]
    tracemalloc.start()
    try:
        for number in range(150):
            zenoh_session.put(
                f"nedbus/{number}/{'x' * 60_000}",
                b"",
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
        wait_for(lambda: subscription.counts.invalid == 150, what="the count of all")
        allocated, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert allocated < 50 * 60_000
    warned = warnings(caplog)
    assert len(warned) == 100
    assert max(map(len, warned)) < 1000
    assert [text.endswith("; further keys are only counted") for text in warned] == 99 * [False] + [
        True
    ]


@pytest.mark.parametrize("mode", BOTH)
def test_peer_that_never_replies_does_not_delay_other_streams(
    bus: nedbus.Bus, zenoh_session: Session, mode: Mode
) -> None:
    """A peer that sends unknown layouts but answers no lookup gets one query for each, and delays no other stream."""
    held = zenoh_session.declare_queryable(SCHEMA, zenoh.handlers.RingChannel(100))
    publisher = bus.publisher(VLP, vehicle="1")
    subscription = bus.subscribe(VLP, mode=mode)
    wait_for_matching(zenoh_session, f"nedbus/2/{VLP}")
    for layout in range(100, 150):
        encoding = f"{ENCODING};hash={layout:032x}"
        zenoh_session.put(f"nedbus/2/{VLP}", msgpack.packb([layout, 1, 2]), encoding=encoding)
    wait_for(
        lambda: subscription.waiting or subscription.counts.invalid, what="the first unknown layout"
    )
    publish(publisher, 1)
    assert receive_timestamps(subscription, 1) == [1]
    wait_for(lambda: subscription.counts.invalid == 50, what="all unknown layouts")
    queries = [str(query.parameters) for query in iter(held.handler.try_recv, None)]
    assert len(queries) == len(set(queries))


def test_samples_are_counted_and_requested_again_after_an_unexpected_error(
    bus: nedbus.Bus,
    publisher: nedbus.Publisher,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """An unexpected error while samples are queued is logged; each counts as invalid and is requested again."""
    subscription = bus.subscribe(mode="every")
    assert receive_timestamps(subscription, 1) == [1]
    with monkeypatch.context() as patched:
        patched.setattr(Reorder, "accept", lambda *_, **__: 1 / 0)
        publish(publisher, *range(2, 22))
        wait_for(lambda: subscription.counts.invalid == 20, what="all samples to be counted")
    publish(publisher, 22)
    assert receive_timestamps(subscription, 21) == [*range(2, 23)]
    assert any("unexpected error, " in text and "discarded" in text for text in caplog.messages)


def test_rejection_reports_have_address_and_reason(bus: nedbus.Bus, zenoh_session: Session) -> None:
    """A rejection report has the address of the message and up to 300 characters of its reason.

    Malformed reports are ignored.
    """
    rejections = bus.rejections()
    wait_for_matching(zenoh_session, ADDRESS.rejected_key())
    for key, payload in (
        ("nedbus/@rejected/7/Nothing", b'{"reason": "no such topic"}'),
        (ADDRESS.rejected_key(), b"no JSON"),
        (Address("8", VLP).rejected_key(), b'["a list"]'),
        (ADDRESS.rejected_key(), b'{"reason": "%s"}' % (b"x" * 100_000)),
    ):
        zenoh_session.put(key, payload)
    queries = QueryServer(zenoh_session)
    PublisherRegistry(zenoh_session, queries, prefix="nedbus", is_client=True).reject(
        ADDRESS, {"reason": "x" * 1000}
    )
    reports: list[RejectionReport] = []

    def has_arrived() -> bool:
        reports.extend(rejections.take())
        return bool(reports)

    wait_for(has_arrived, what="the report")
    assert [(report.address, report.reason) for report in reports] == [(ADDRESS, "x" * 300)]
    assert rejections.take() == []
    rejections.close()
    queries.close()


def test_reports_during_a_flood_are_returned(bus: nedbus.Bus, zenoh_session: Session) -> None:
    """`take` returns at most 250 reports, even if they arrive faster than it reads them."""
    rejections = bus.rejections()
    wait_for_matching(zenoh_session, ADDRESS.rejected_key())
    zenoh_session.put(ADDRESS.rejected_key(), b'{"reason": "x is NaN"}')
    report = rejections._handler.recv()
    flood = iter(5000 * [report])
    rejections._handler = cast("Any", SimpleNamespace(try_recv=lambda: next(flood, None)))
    assert [len(rejections.take()) for _ in range(21)] == [*(20 * [250]), 0]
    rejections.close()


def test_unread_reports_are_bounded_in_bytes(bus: nedbus.Bus, zenoh_session: Session) -> None:
    """A reader holds at most 250 reports of at most 16 kB, 4 MB: larger ones are not received, older ones dropped."""
    key, block = ADDRESS.rejected_key(), zenoh.CongestionControl.BLOCK
    newest = bus._session.declare_subscriber(key, zenoh.handlers.RingChannel(1))
    rejections = bus.rejections()
    wait_for_matching(zenoh_session, key)
    for number in range(300):
        for size in (17_000, 16_000):
            report = json.dumps({"reason": f"{number}", "fields": "x" * size})
            zenoh_session.put(key, report, congestion_control=block)

    def is_last() -> bool:
        sample = newest.handler.try_recv()
        return sample is not None and b'"reason": "299"' in sample.payload.to_bytes()

    wait_for(is_last, what="the last report")
    assert [report.reason for report in rejections.take()] == [
        f"{number}" for number in range(50, 300)
    ]
    rejections.close()
    newest.undeclare()


def test_rejections_of_a_closed_bus_raise(endpoint: str) -> None:
    """After the bus is closed, its rejections raise ClosedError, and closing them is idempotent."""
    bus = nedbus.connect(endpoint)
    rejections = bus.rejections()
    bus.close()
    with pytest.raises(ClosedError):
        rejections.take()
    rejections.close()
    with pytest.raises(ClosedError):
        bus.rejections()


def test_receiving_a_sample_needs_few_python_calls(
    publisher: nedbus.Publisher, endpoint: str
) -> None:
    """A reader that waits for each sample needs at most 25 Python calls, in eight classes, to receive it."""
    called: list[list[str]] = []

    def trace(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            called[-1].append(frame.f_code.co_qualname)

    with nedbus.connect(endpoint) as other, other.subscribe(VLP, mode="every") as subscription:
        for number in range(1000):
            publish(publisher, number + 2)
            called.append([])
            sys.setprofile(trace)
            next(subscription)
            sys.setprofile(None)
            if sum("Inbox.take" in names for names in called) == 10:
                break
    # Samples received along with others need more calls, or no wait.
    waited = [names for names in called if "Inbox.take" in names]
    median = sorted(waited, key=len)[len(waited) // 2]
    assert len(median) <= 25
    classes = {name.partition(".")[0] for name in median if name[0].isupper()}
    assert classes == {
        "Subscription",
        "Receiver",
        "Inbox",
        "Reorder",
        "WriterProxy",
        "Unread",
        "Decoder",
        "Codec",
    }
