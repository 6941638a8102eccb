"""Recovery of lost messages by a reader in mode `every`, with real publishers and sessions on loopback.

Loopback is lossless, so messages are removed between Zenoh and the queue of one reader. The last test restarts a
real router.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing

import pytest
import zenoh

import nedbus
from nedbus import Counts
from nedbus.client.receiving import Receiver, retransmission
from nedbus.client.receiving.decoder import WAKE_UP
from nedbus.client.receiving.receiver import drain
from nedbus.timings import Timings
from nedbus.transport import RawSample, RetransmitRequest, Session, open_client, open_router
from tests.flights.local_position import encode, encoding_of
from tests.flights.messages import VLP, message
from tests.nedbus.client.lossy import Lossy, LossyQueue
from tests.nedbus.client.numbered import publish, wait_for_subscriber
from tests.peers.ports import free_endpoint
from tests.peers.queryables import answer_queries, reply_with
from tests.waits import DEADLINE, wait_for, wait_for_matching, wait_for_router

from .raw_samples import make_queue, raw

KEY = f"nedbus/7/{VLP}"


@pytest.fixture
def limit() -> int | None:
    """Return the limit of unread messages of the subscription; None for the default."""
    return None


@pytest.fixture
def lossy(
    endpoint: str, bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch, *, limit: int | None
) -> Iterator[Lossy]:
    """Subscribe to all vehicles, and wait until the publisher is matched."""
    publisher, queue = bus.publisher(VLP, vehicle="7"), LossyQueue(f"nedbus/*/{VLP}", limit=limit)
    with closing(open_client([endpoint], timeout=DEADLINE)) as session:
        lossy = Lossy(session, queue, Receiver(session, queue), publisher)
        monkeypatch.setattr(retransmission, "RetransmitRequest", lossy.request)
        with lossy.subscription:
            wait_for_subscriber(publisher)
            yield lossy


def fail(*_: object) -> None:
    raise ArithmeticError


@pytest.mark.parametrize("unanswered", [0, 3])
def test_lost_samples_are_requested_by_exact_key(lossy: Lossy, unanswered: int) -> None:
    """Lost samples are requested by their exact key, because routers match wildcards with all caches.

    A request is repeated until it is answered.
    """
    lossy.queue.missing, lossy.unanswered = {1, 2, 3, 4}, unanswered
    lossy.publish(*range(7))
    assert lossy.receive(7) == list(range(7))
    assert lossy.requests == [(KEY, 1, 5)] * (unanswered + 1)
    assert lossy.subscription.counts == Counts(received=7)


def test_samples_no_longer_in_the_cache_are_lost(
    lossy: Lossy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Messages that the publisher no longer caches count as lost after a second request."""

    def request_available(
        session: Session, key: str, name: str, numbers: range, *, timeout: float
    ) -> RetransmitRequest:
        return RetransmitRequest(
            session, key, name, range(max(3, numbers.start), numbers.stop), timeout=timeout
        )

    monkeypatch.setattr(retransmission, "RetransmitRequest", request_available)
    lossy.queue.missing = {1, 2, 3, 4}
    lossy.publish(*range(6))
    samples = [lossy.subscription.receive(DEADLINE) for _ in range(4)]
    assert [(sample.message.timestamp, sample.lost) for sample in samples] == [
        (0, 0),
        (3, 2),
        (4, 0),
        (5, 0),
    ]
    assert lossy.subscription.counts == Counts(received=4, lost=2)


def test_publisher_without_a_cache_gets_one_request(
    lossy: Lossy, zenoh_session: Session, timings: Timings
) -> None:
    """After a timeout, a third-party publisher with sequence numbers but no cache gets only one request per gap."""
    timings.retransmit_timeout = 0.2
    misses = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None)
    key = f"nedbus/foreign/{VLP}"
    foreign = zenoh.ext.declare_advanced_publisher(zenoh_session, key, sample_miss_detection=misses)
    lossy.queue.missing = {1, 3}
    wait_for_matching(zenoh_session, key)
    for timestamp in range(3):
        foreign.put(encode(message(timestamp)), encoding=encoding_of("sim"))
    assert lossy.receive(2) == [0, 2]
    tries = len(lossy.requests)
    assert tries > 1
    for timestamp in (3, 4):
        foreign.put(encode(message(timestamp)), encoding=encoding_of("sim"))
    assert lossy.receive(1) == [4]
    assert len(lossy.requests) == tries + 1
    assert lossy.subscription.counts == Counts(received=3, lost=2)
    foreign.undeclare()


def test_publisher_that_replies_again_is_retried(lossy: Lossy, timings: Timings) -> None:
    """Once a publisher that timed out replies again, its losses are recovered."""
    timings.retransmit_timeout = 0.2
    lossy.queue.missing, lossy.unanswered = {1, 3, 5}, 1_000_000
    lossy.publish(0, 1, 2)
    assert lossy.receive(2) == [0, 2]
    timings.retransmit_timeout = DEADLINE
    lossy.unanswered = 0
    lossy.publish(3, 4)
    assert lossy.receive(2) == [3, 4]
    lossy.unanswered = len(lossy.requests) + 1
    lossy.publish(5, 6)
    assert lossy.receive(2) == [5, 6]


@pytest.mark.parametrize("waits", ["without", "with a timeout"])
def test_newest_message_is_recovered_by_heartbeat(
    lossy: Lossy, zenoh_session: Session, waits: str
) -> None:
    """A heartbeat reveals the loss of the newest messages, even to a reader that waits in Zenoh without a timeout.

    The sample that wakes this reader is invisible to other readers of its session, and does not leave the process.
    """
    received: list[int] = []
    seen: zenoh.handlers.FifoChannel[zenoh.Sample] = zenoh.handlers.FifoChannel(100)
    foreign = zenoh_session.declare_subscriber(KEY, seen)
    wait_for_router(zenoh_session)
    lossless = LossyQueue(KEY)
    other = Receiver(lossy.session, lossless)

    def read() -> None:
        if waits == "without":
            received.extend(sample.message.timestamp for sample in lossy.subscription)
        else:
            while len(received) < 3:
                received.extend(lossy.receive(1))

    reader = threading.Thread(target=read)
    reader.start()
    lossy.queue.missing = {1, 2}
    lossy.publish(0)
    wait_for(lambda: received == [0], what="the first message")
    lossy.publish(1, 2)
    wait_for(lambda: received == [0, 1, 2], what="the messages announced by heartbeats")
    wait_for(lambda: lossless.waiting == 3, what="the other reader")
    lossy.subscription.close()
    reader.join(DEADLINE)
    other.close()
    assert lossy.subscription.counts == Counts(received=3)
    assert lossless.counts == Counts(dropped=3)
    elsewhere: list[zenoh.Sample] = []
    wait_for(
        lambda: len(drain(foreign.handler, elsewhere)) == 3, what="the messages in another session"
    )
    assert WAKE_UP not in {str(sample.encoding) for sample in elsewhere}
    foreign.undeclare()


def test_replies_of_other_peers_are_ignored(lossy: Lossy, zenoh_session: Session) -> None:
    """Replies to a retransmission request from peers other than the publisher are ignored."""
    forged = reply_with({KEY: encode(message(666))}, encoding=encoding_of("sim"))
    with answer_queries(zenoh_session, f"{KEY}/@adv/pub/**", forged):
        lossy.queue.missing = {1}
        lossy.publish(0, 1, 2)
        assert lossy.receive(3) == [0, 1, 2]
        assert lossy.subscription.counts == Counts(received=3)


@pytest.mark.parametrize("when", ["open", "closed"])
def test_flood_of_replies_does_not_block_the_session(
    lossy: Lossy, zenoh_session: Session, when: str
) -> None:
    """A flood of replies to a request does not block the session, not even after its reader has closed."""
    queried = threading.Event()

    def flood(query: zenoh.Query) -> None:
        with query:
            queried.set()
            for _ in range(2000):
                query.reply(KEY, b"junk")

    with answer_queries(zenoh_session, f"{KEY}/@adv/pub/**", flood):
        lossy.queue.missing = {1}
        lossy.publish(0, 1, 2)
        if when == "closed":
            assert queried.wait(DEADLINE)
            lossy.subscription.close()
        else:
            assert lossy.receive(3) == [0, 1, 2]
        queue = LossyQueue(KEY)
        other = Receiver(lossy.session, queue)

        def still_receives() -> bool:
            lossy.publish(7)
            return queue.waiting > 0

        wait_for(still_receives, what="a message for another reader of this session")
        other.close()


@pytest.mark.parametrize(
    "entity",
    [
        "a::b/1/_",
        "_",
        ":/_",
        "../1/_",
        "ab/1",
        "ab/1/_/x",
        f"{'a' * 33}/1/_",
        "ab/12345678901/_",
        "AB/1/_",
    ],
)
def test_malformed_heartbeats_are_ignored(
    lossy: Lossy, zenoh_session: Session, entity: str
) -> None:
    """A malformed heartbeat neither causes a request nor prevents requests after later heartbeats."""
    zenoh_session.put(f"nedbus/evil/{VLP}/@adv/pub/{entity}", b"\x05\x00\x00\x00")
    zenoh_session.put(f"nedbus/evil/{VLP}/@adv/pub/ab/1/_", b"longer than a number")
    lossy.queue.missing = {1}
    lossy.publish(0, 1, 2)
    assert lossy.receive(3) == [0, 1, 2]
    lossy.publish(3)
    assert lossy.receive(1) == [3]
    assert {key for key, _, _ in lossy.requests} == {KEY}
    assert not lossy.queue.gaps.requesting


def test_unanswered_requests_do_not_delay_others(lossy: Lossy, zenoh_session: Session) -> None:
    """Requests to publishers that exist only in forged heartbeats do not delay requests to real publishers."""
    taken: list[zenoh.Query] = []
    evil = f"nedbus/evil/{VLP}/@adv/pub"
    with answer_queries(zenoh_session, f"{evil}/**", taken.append):
        for number in range(1, 300):
            zenoh_session.put(f"{evil}/{number:x}/1/_", b"\x05\x00\x00\x00")
        wait_for(lambda: taken, what="a request to an invented publisher")
        lossy.queue.missing = {1}
        lossy.publish(0, 1, 2)
        assert lossy.receive(3) == [0, 1, 2]
        assert lossy.queue.gaps.requesting  # the unanswered ones are still open
        taken.clear()


def test_requests_to_publishers_without_a_message_are_bounded(
    lossy: Lossy, zenoh_session: Session
) -> None:
    """At most 16 requests to publishers that have delivered no message are open: others need the remaining slots."""
    taken: list[zenoh.Query] = []
    keys = [f"nedbus/evil{number}/{VLP}" for number in range(40)]
    with answer_queries(zenoh_session, "nedbus/*/*/@adv/pub/ab/1/**", taken.append):
        for key in keys:
            zenoh_session.put(f"{key}/@adv/pub/ab/1/_", b"\x05\x00\x00\x00")
        wait_for(
            lambda: len(lossy.queue.gaps.requesting) == len(keys),
            what="the gaps of all forged publishers",
        )
        lossy.queue.missing = {1}
        lossy.publish(0, 1, 2)
        assert lossy.receive(3) == [0, 1, 2]
        assert len(taken) > 1
        assert lossy.max_open <= 17
        taken.clear()


def test_number_of_open_requests_is_bounded(
    lossy: Lossy, bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Simultaneous gaps of 60 vehicles are requested a few at a time, and all are filled."""
    monkeypatch.setattr("nedbus.limits.REQUESTS", 4)
    publishers = [bus.publisher(VLP, vehicle=f"v{number}") for number in range(60)]
    for publisher in publishers:
        wait_for_subscriber(publisher)
    lossy.queue.missing = {1}
    for publisher in publishers:
        publish(publisher, 0, 1, 2)
    assert sorted(lossy.receive(180)) == [0] * 60 + [1] * 60 + [2] * 60
    assert lossy.subscription.counts == Counts(received=180)
    assert 1 < lossy.max_open <= 4


def test_close_counts_open_gaps_as_lost(lossy: Lossy) -> None:
    """Closing a subscription counts its open gaps as lost."""
    lossy.unanswered, lossy.queue.missing = 1_000_000, {1, 2}
    lossy.publish(*range(4))
    assert lossy.receive(1) == [0]
    wait_for(lambda: lossy.queue.gaps.requesting, what="the gap")
    lossy.subscription.close()
    assert lossy.subscription.counts.lost == 2


def test_number_of_held_back_samples_is_bounded(
    lossy: Lossy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If too many samples are held back behind gaps, the gaps count as lost and the samples are delivered."""
    monkeypatch.setattr("nedbus.limits.HELD_MESSAGES", 50)
    lossy.unanswered, lossy.queue.missing = 1_000_000, {1}
    lossy.publish(*range(60))
    assert lossy.receive(59) == [0, *range(2, 60)]
    assert lossy.subscription.counts == Counts(received=59, lost=1)


@pytest.mark.parametrize(("limit", "unread"), [(20, 11), (21, 11)])
def test_slow_reader_requests_lost_messages_only_after_reading(lossy: Lossy, unread: int) -> None:
    """While more than half of the limit is unread, nothing is requested: it would displace unread messages."""
    lossy.queue.missing = {unread}
    lossy.publish(*range(unread + 5))
    wait_for(
        lambda: (lossy.queue.waiting, lossy.queue.gaps.held) == (unread, 4),
        what="the messages before and after the gap",
    )
    polls = lossy.queue.polls
    wait_for(lambda: lossy.queue.polls > polls + 1, what="a poll in this state")
    assert lossy.requests == []
    assert lossy.receive(1) == [0]  # now half of it, or less
    wait_for(lambda: lossy.queue.waiting == unread + 4, what="the recovered message")
    assert lossy.requests == [(KEY, unread, unread + 1)]
    assert lossy.receive(unread + 4) == list(range(1, unread + 5))
    assert lossy.subscription.counts == Counts(received=unread + 5)


def test_unanswered_requests_of_a_key_are_bounded(lossy: Lossy, zenoh_session: Session) -> None:
    """At most 4 requests to publishers of one key are open, which may never answer; those of other keys are served."""
    taken: list[zenoh.Query] = []
    key = f"nedbus/foreign/{VLP}"
    misses = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None)
    foreign = [
        zenoh.ext.declare_advanced_publisher(zenoh_session, key, sample_miss_detection=misses)
        for _ in range(7)
    ]
    wait_for_matching(zenoh_session, key)
    with answer_queries(zenoh_session, f"{key}/@adv/pub/**", taken.append):
        lossy.queue.missing = {1}
        for publisher in foreign:
            for timestamp in range(3):
                publisher.put(encode(message(timestamp)), encoding=encoding_of("sim"))
        assert lossy.receive(7) == [0] * 7
        wait_for(
            lambda: len(lossy.queue.gaps.requesting) == 7,
            what="the gaps of all publishers of the key",
        )
        wait_for(lambda: taken, what="a request")
        lossy.publish(0, 1, 2)
        assert lossy.receive(3) == [0, 1, 2]
        assert 4 <= lossy.max_open <= 5
        taken.clear()
    for publisher in foreign:
        publisher.undeclare()


def test_delivery_makes_the_next_request_early() -> None:
    """Attempts for a gap are 0.1 to 0.8 s apart; once it is filled, those for the next one are close again."""
    inbox = make_queue("every")
    inbox.put([raw(0)])
    inbox.put([raw(2), raw(4)])
    [writer] = inbox.gaps.requesting
    now, pauses = 1.0, list[float]()

    def attempt(found: dict[int, RawSample]) -> None:
        nonlocal now
        assert inbox.next_request(writer, now) is not None
        inbox.on_retransmission(writer, found, ended=True, now=now)
        assert writer.request is not None
        pauses.append(round(writer.request.retry_at - now, 3))
        now = writer.request.retry_at

    for _ in range(5):
        attempt({})
    attempt({1: raw(1)})
    attempt({})
    assert pauses == [0.1, 0.2, 0.4, 0.8, 0.8, 0.05, 0.1]


def test_unexpected_error_loses_only_the_recovered_message(
    lossy: Lossy, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """An exception caused by a recovered message is logged, the message counts as lost, and the reader continues."""
    take = lossy.queue.on_retransmission
    monkeypatch.setattr(
        lossy.queue,
        "on_retransmission",
        lambda writer, found, **options: fail() if found else take(writer, found, **options),
    )
    lossy.queue.missing = {1}
    lossy.publish(0, 1, 2)
    assert lossy.receive(2) == [0, 2]
    assert lossy.subscription.counts == Counts(received=2, lost=1)
    assert any("unexpected error, recovered messages discarded" in text for text in caplog.messages)


@pytest.mark.parametrize("rest", [0, 1])
def test_newest_messages_are_recovered_after_a_router_restart(rest: int) -> None:
    """After a router restart, a reader recovers the newest messages, whether or not another message follows."""
    endpoint = free_endpoint()
    router = open_router(listen=(endpoint,))
    received: list[int] = []
    with nedbus.connect(endpoint) as vehicle, nedbus.connect(endpoint) as reader:
        publisher = vehicle.publisher(VLP, vehicle="1")
        subscription = reader.subscribe(mode="every")
        thread = threading.Thread(
            target=lambda: received.extend(sample.message.timestamp for sample in subscription)
        )
        thread.start()
        publish(publisher, 0)
        wait_for(lambda: received == [0], what="the first message")
        router.close()
        publish(publisher, *range(1, 50))
        with closing(open_router(listen=(endpoint,))):
            wait_for(lambda: vehicle.connected and reader.connected, what="both to reconnect")
            publish(publisher, *range(50, 50 + rest))
            wait_for(
                lambda: len(received) == 50 + rest, what="the messages published during the outage"
            )
            subscription.close()
            thread.join(DEADLINE)
    assert received == list(range(50 + rest))
    assert subscription.counts == Counts(received=50 + rest)
