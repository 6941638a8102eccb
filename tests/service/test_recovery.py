"""What a reader of mode `every` does about messages that do not arrive: real publishers and sessions on loopback.

Nothing is lost there, so what arrives at one reader goes missing behind Zenoh, just before its queue. In the last tests
it is a router that dies, and nothing is made.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import closing

import pytest
import zenoh

import nedbus
from nedbus import Counts
from nedbus.client import recovery as module
from nedbus.client.decoder import WAKE_UP
from nedbus.transport import KeptAnswers, RawSample, Session, ask_kept, open_router
from nedbus_msgs import encode, encoding_of
from tests.conftest import DEADLINE, free_endpoint, message, wait_for, wait_for_reader

VLP = "vehicle_local_position"
KEY = f"nedbus/7/{VLP}"


class Lossy:
    """A subscription to which the messages `missing`, by sequence number, do not come, and the questions it asks.

    `unanswered` questions get no answer, as those that a router drops.
    """

    def __init__(self, subscription: nedbus.Subscription, monkeypatch: pytest.MonkeyPatch) -> None:
        self.subscription = subscription
        self.missing: set[int] = set()
        self.asked: list[tuple[str, int, int]] = []
        self.unanswered = 0
        self.open = self.most = 0
        self._put = subscription._queue.put
        monkeypatch.setattr(subscription._queue, "put", self._lose)
        monkeypatch.setattr(module, "ask_kept", self._ask)

    def receive(self, count: int) -> list[int]:
        """Receive so many messages, and return their timestamps."""
        return [self.subscription.receive(DEADLINE).message.timestamp for _ in range(count)]

    def _lose(self, batch: Sequence[RawSample], *, overflowed: bool = False) -> None:
        left = [raw for raw in batch if raw.source_info is None or raw.source_info.source_sn not in self.missing]
        self._put(left, overflowed=overflowed)

    def _ask(self, session: Session, key: str, publisher: str, numbers: range, *, timeout: float) -> object:
        self.asked.append((key, numbers.start, numbers.stop))
        if len(self.asked) <= self.unanswered:
            return Unanswered()
        self.open += 1
        self.most = max(self.most, self.open)
        return Counted(ask_kept(session, key, publisher, numbers, timeout=timeout), self)


class Unanswered:
    """What a router that drops a question says."""

    ended = True

    def take(self) -> dict[int, RawSample]:
        return {}


class Counted:
    """Answers of a question that counts as open until they have ended."""

    def __init__(self, answers: KeptAnswers, lossy: Lossy) -> None:
        self._answers = answers
        self._lossy = lossy

    def take(self) -> dict[int, RawSample]:
        was, taken = self._answers.ended, self._answers.take()
        self._lossy.open -= self._answers.ended and not was
        return taken

    @property
    def ended(self) -> bool:
        return self._answers.ended


@pytest.fixture
def vehicle(endpoint: str) -> Iterator[nedbus.Bus]:
    with nedbus.connect(endpoint) as vehicle:
        yield vehicle


@pytest.fixture
def publisher(vehicle: nedbus.Bus) -> nedbus.Publisher:
    return vehicle.publisher(VLP, vehicle="7")


@pytest.fixture
def lossy(
    bus: nedbus.Bus, vehicle: nedbus.Bus, publisher: nedbus.Publisher, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Lossy]:
    """Subscribe to all vehicles, and wait until the vehicle knows it."""
    with bus.subscribe(VLP, mode="every") as subscription:
        wait_for_reader(vehicle._session, publisher.key)
        yield Lossy(subscription, monkeypatch)


def publish(publisher: nedbus.Publisher, *timestamps: int) -> None:
    for timestamp in timestamps:
        publisher.publish(message(timestamp))


def test_what_is_missing_is_asked_for_by_the_exact_key(lossy: Lossy, publisher: nedbus.Publisher) -> None:
    """A key expression with wildcards would be compared with the caches of all publishers, by each router."""
    lossy.missing = {1, 2, 3, 4}
    publish(publisher, *range(7))
    assert lossy.receive(7) == list(range(7))
    assert lossy.asked == [(KEY, 1, 5)]
    assert lossy.subscription.counts == Counts(received=7)


def test_question_without_an_answer_is_asked_again(lossy: Lossy, publisher: nedbus.Publisher) -> None:
    """A router that has just started does not know the publisher yet, perhaps: the message is still kept."""
    lossy.missing, lossy.unanswered = {1}, 3
    publish(publisher, 0, 1, 2)
    assert lossy.receive(3) == [0, 1, 2]
    assert lossy.asked == [(KEY, 1, 2)] * 4


def test_answer_that_is_not_whole_is_the_last(
    lossy: Lossy, publisher: nedbus.Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A publisher that sends the newest one has no more: the rest is lost, without another question."""

    def forget(session: Session, key: str, name: str, numbers: range, *, timeout: float) -> KeptAnswers:
        return ask_kept(session, key, name, numbers[-2:], timeout=timeout)

    monkeypatch.setattr(module, "ask_kept", forget)
    lossy.missing = {1, 2, 3, 4}
    publish(publisher, *range(6))
    samples = [lossy.subscription.receive(DEADLINE) for _ in range(4)]
    assert [(sample.message.timestamp, sample.lost) for sample in samples] == [(0, 0), (3, 2), (4, 0), (5, 0)]
    assert lossy.subscription.counts == Counts(received=4, lost=2)


def test_publisher_that_keeps_nothing_is_waited_for_once(
    bus: nedbus.Bus, vehicle: nedbus.Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another program numbers its messages, and has no cache: after one wait in vain it is asked once for a hole."""
    monkeypatch.setattr(module, "_PATIENCE", 0.5)
    misses = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None)
    foreign = zenoh.ext.declare_advanced_publisher(vehicle._session, KEY, sample_miss_detection=misses)
    with bus.subscribe(VLP, mode="every") as subscription:
        lossy = Lossy(subscription, monkeypatch)
        lossy.missing = {1, 3}
        wait_for_reader(vehicle._session, KEY)
        for timestamp in range(3):
            foreign.put(encode(message(timestamp)), encoding=encoding_of("sim"))
        assert lossy.receive(2) == [0, 2]
        tries = len(lossy.asked)
        assert tries > 1
        for timestamp in (3, 4):
            foreign.put(encode(message(timestamp)), encoding=encoding_of("sim"))
        assert lossy.receive(1) == [4]
        assert len(lossy.asked) == tries + 1
        assert subscription.counts == Counts(received=3, lost=2)
    foreign.undeclare()


@pytest.mark.parametrize("waits", ["without", "with a timeout"])
def test_newest_message_is_recovered_by_heartbeat(lossy: Lossy, publisher: nedbus.Publisher, waits: str) -> None:
    """No message comes after it, and whoever waits without a timeout waits for Zenoh's channel, where nothing comes."""
    received: list[int] = []

    def read() -> None:
        if waits == "without":
            received.extend(sample.message.timestamp for sample in lossy.subscription)
        else:
            while len(received) < 3:
                received.extend(lossy.receive(1))

    reader = threading.Thread(target=read)
    reader.start()
    lossy.missing = {1, 2}
    publish(publisher, 0)
    wait_for(lambda: received == [0], what="the first message")
    publish(publisher, 1, 2)
    wait_for(lambda: received == [0, 1, 2], what="what heartbeats tell of")
    lossy.subscription.close()
    reader.join(DEADLINE)
    assert lossy.subscription.counts == Counts(received=3)


def test_waking_a_reader_is_seen_by_nobody(
    bus: nedbus.Bus, lossy: Lossy, vehicle: nedbus.Bus, publisher: nedbus.Publisher
) -> None:
    """What a session sends itself is no message for its other readers, and does not leave the process."""
    channel: zenoh.handlers.FifoChannel[zenoh.Sample] = zenoh.handlers.FifoChannel(100)
    foreign = vehicle._session.declare_subscriber(KEY, channel)
    with bus.subscribe(VLP, mode="every") as other:
        wait_for_reader(vehicle._session, KEY)
        lossy.subscription._subscriber._reader_waits = True
        lossy.subscription._subscriber._wake(KEY)
        publish(publisher, 5)
        assert lossy.receive(1) == [other.receive(DEADLINE).message.timestamp] == [5]
        assert lossy.subscription.counts == other.counts == Counts(received=1)
    assert str(foreign.handler.recv().encoding) != WAKE_UP


def test_answers_of_others_are_left_out(lossy: Lossy, vehicle: nedbus.Bus, publisher: nedbus.Publisher) -> None:
    """Whoever answers in the place of a publisher, without being it, adds nothing."""
    name = publisher._acknowledgement._publisher.replace(":", "/")

    def lie(query: zenoh.Query) -> None:
        with query:
            query.reply(KEY, encode(message(666)), encoding=encoding_of("sim"))

    liar = vehicle._session.declare_queryable(f"{KEY}/@adv/pub/{name}/**", zenoh.handlers.Callback(lie, indirect=True))
    lossy.missing = {1}
    publish(publisher, 0, 1, 2)
    assert lossy.receive(3) == [0, 1, 2]
    assert lossy.subscription.counts == Counts(received=3)
    liar.undeclare()


@pytest.mark.parametrize("when", ["open", "closed"])
def test_flood_of_answers_holds_up_nobody(
    lossy: Lossy, bus: nedbus.Bus, vehicle: nedbus.Bus, publisher: nedbus.Publisher, when: str
) -> None:
    """More answers than were asked for: the session goes on receiving, also after its reader has closed."""
    asked = threading.Event()

    def flood(query: zenoh.Query) -> None:
        with query:
            asked.set()
            for _ in range(2000):
                query.reply(KEY, b"junk")

    name = publisher._acknowledgement._publisher.replace(":", "/")
    callback = zenoh.handlers.Callback(flood, indirect=True)
    liar = vehicle._session.declare_queryable(f"{KEY}/@adv/pub/{name}/**", callback)
    lossy.missing = {1}
    publish(publisher, 0, 1, 2)
    if when == "closed":
        assert asked.wait(DEADLINE)
        lossy.subscription.close()
    else:
        assert lossy.receive(3) == [0, 1, 2]
    with bus.subscribe(VLP, vehicle="8", mode="every") as other:
        second = vehicle.publisher(VLP, vehicle="8")
        wait_for_reader(vehicle._session, second.key)
        publish(second, 7)
        assert other.receive(DEADLINE).message.timestamp == 7
    liar.undeclare()


@pytest.mark.parametrize(
    "entity", ["a::b/1/_", "_", ":/_", "../1/_", "ab/1", "ab/1/_/x", f"{'a' * 33}/1/_", "ab/12345678901/_", "AB/1/_"]
)
def test_odd_heartbeats_are_none(lossy: Lossy, vehicle: nedbus.Bus, publisher: nedbus.Publisher, entity: str) -> None:
    """What no publisher of Zenoh sends asks for nothing, and keeps nobody else from being asked."""
    vehicle._session.put(f"nedbus/evil/{VLP}/@adv/pub/{entity}", b"\x05\x00\x00\x00")
    vehicle._session.put(f"nedbus/evil/{VLP}/@adv/pub/ab/1/_", b"longer than a number")
    lossy.missing = {1}
    publish(publisher, 0, 1, 2)
    assert lossy.receive(3) == [0, 1, 2]
    publish(publisher, 3)
    assert lossy.receive(1) == [3]
    assert {key for key, _, _ in lossy.asked} == {KEY}
    assert not lossy.subscription._queue.incomplete


def test_questions_that_nobody_answers_hold_up_nobody_else(
    lossy: Lossy, vehicle: nedbus.Bus, publisher: nedbus.Publisher
) -> None:
    """A peer may invent publishers by heartbeats, and take the questions for them without an answer."""
    taken: list[zenoh.Query] = []
    evil = f"nedbus/evil/{VLP}/@adv/pub"
    hole = vehicle._session.declare_queryable(f"{evil}/**", zenoh.handlers.Callback(taken.append, indirect=True))
    for number in range(1, 300):
        vehicle._session.put(f"{evil}/{number:x}/1/_", b"\x05\x00\x00\x00")
    wait_for(lambda: taken, what="a question for one that is invented")
    lossy.missing = {1}
    publish(publisher, 0, 1, 2)
    assert lossy.receive(3) == [0, 1, 2]
    assert lossy.subscription._queue.incomplete  # the others still wait
    taken.clear()
    hole.undeclare()


def test_recovery_that_ends_holds_nothing(
    lossy: Lossy, publisher: nedbus.Publisher, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A bug may end its thread: then what is missing is lost at once, and counted, and the reader goes on."""
    recovery = lossy.subscription._subscriber._recovery
    assert recovery is not None
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    monkeypatch.setattr(recovery, "_look", lambda: 1 / 0)
    wait_for(lambda: not recovery._thread.is_alive(), what="the end of the thread")
    lossy.missing = {1}
    publish(publisher, 0, 1, 2)
    assert lossy.receive(2) == [0, 2]
    assert lossy.subscription.counts == Counts(received=2, lost=1)
    assert any("recovery ends after an unexpected error" in text for text in caplog.messages)


def test_only_so_many_questions_are_open(bus: nedbus.Bus, vehicle: nedbus.Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    """What 200 vehicles miss at the same moment is asked for a few at a time, and all of it comes."""
    monkeypatch.setattr(module, "_OPEN", 8)
    publishers = [vehicle.publisher(VLP, vehicle=f"v{number}") for number in range(200)]
    with bus.subscribe(VLP, mode="every") as subscription:
        for publisher in publishers:
            wait_for_reader(vehicle._session, publisher.key)
        lossy = Lossy(subscription, monkeypatch)
        lossy.missing = {1}
        for publisher in publishers:
            publish(publisher, 0, 1, 2)
        assert sorted(lossy.receive(600)) == [0] * 200 + [1] * 200 + [2] * 200
        assert subscription.counts == Counts(received=600)
    assert 1 < lossy.most <= 8


def test_closing_counts_what_is_missing(lossy: Lossy, publisher: nedbus.Publisher) -> None:
    """A script that ends is told what it did not get."""
    lossy.unanswered = 1_000_000
    lossy.missing = {1, 2}
    publish(publisher, *range(4))
    assert lossy.receive(1) == [0]
    wait_for(lambda: lossy.subscription._queue.incomplete, what="the hole")
    lossy.subscription.close()
    assert lossy.subscription.counts.lost == 2


def test_too_much_that_waits_is_let_go(
    lossy: Lossy, publisher: nedbus.Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Memory is bounded: beyond it what is missing is lost, and what waited arrives."""
    monkeypatch.setattr(module, "_HELD", 50)
    lossy.unanswered, lossy.missing = 1_000_000, {1}
    publish(publisher, *range(60))
    assert lossy.receive(59) == [0, *range(2, 60)]
    assert lossy.subscription.counts == Counts(received=59, lost=1)


def test_reader_that_is_behind_asks_when_it_has_read(
    lossy: Lossy, publisher: nedbus.Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is recovered does not push out what a slow reader has not read yet."""
    monkeypatch.setattr(module, "_BEHIND", 5)
    lossy.missing = {10}
    publish(publisher, *range(20))
    wait_for(lambda: lossy.subscription._queue.waiting == 10, what="what comes before the hole")
    wait_for(lambda: lossy.subscription._queue.held == 9, what="what comes after it")
    asked_before = list(lossy.asked)
    assert lossy.receive(20) == list(range(20))
    assert (asked_before, lossy.asked) == ([], [(KEY, 10, 11)])


def test_unexpected_error_costs_what_caused_it(
    lossy: Lossy, publisher: nedbus.Publisher, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A bug that a recovered message triggers is logged, the message is lost, and the reader goes on."""
    fill, lossy.missing = lossy.subscription._queue.fill, {1}

    def fail(hole: object, found: Sequence[RawSample]) -> None:
        if found:
            raise ArithmeticError
        fill(hole, found)  # type: ignore[arg-type]

    monkeypatch.setattr(lossy.subscription._queue, "fill", fail)
    publish(publisher, 0, 1, 2)
    assert lossy.receive(2) == [0, 2]
    assert lossy.subscription.counts == Counts(received=2, lost=1)
    assert any("left out after an unexpected error" in text for text in caplog.messages)


def test_thinned_stream_is_asked_for_by_its_own_key(
    vehicle: nedbus.Bus, publisher: nedbus.Publisher, endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thinned copy has numbers and a cache of its own."""
    with nedbus.connect(endpoint) as other, other.subscribe(VLP, mode="every", max_rate=100) as subscription:
        lossy = Lossy(subscription, monkeypatch)
        lossy.missing = {3}
        wait_for_reader(vehicle._session, f"{KEY}/@rate/100")
        timestamp = 0

        def asked() -> bool:
            nonlocal timestamp
            timestamp += 1
            publish(publisher, timestamp)
            return bool(lossy.asked)

        wait_for(asked, what="the question")
        assert lossy.asked[0] == (f"{KEY}/@rate/100", 3, 4)
        wait_for(lambda: not subscription._queue.incomplete, what="the answer")
        assert subscription.counts.lost == 0


@pytest.mark.parametrize("rest", [0, 1])
def test_newest_messages_survive_a_restart_of_the_router(rest: int) -> None:
    """They were published while it was away, and nothing, or one more, after it: a reader that waits gets them all."""
    endpoint = free_endpoint()
    router = open_router(listen=(endpoint,))
    received: list[int] = []
    with nedbus.connect(endpoint) as vehicle, nedbus.connect(endpoint) as reader:
        publisher = vehicle.publisher(VLP, vehicle="1")
        subscription = reader.subscribe(mode="every")
        thread = threading.Thread(target=lambda: received.extend(sample.message.timestamp for sample in subscription))
        thread.start()
        publish(publisher, 0)
        wait_for(lambda: received == [0], what="the first message")
        router.close()
        publish(publisher, *range(1, 50))
        with closing(open_router(listen=(endpoint,))):
            wait_for(lambda: vehicle.connected and reader.connected, what="both to be back")
            publish(publisher, *range(50, 50 + rest))
            wait_for(lambda: len(received) == 50 + rest, what="what was published meanwhile")
            subscription.close()
            thread.join(DEADLINE)
    assert received == list(range(50 + rest))
    assert subscription.counts == Counts(received=50 + rest)


def test_publisher_that_began_during_a_break_is_asked_for_all() -> None:
    """A reader whose link broke is no late reader: it gets what a vehicle kept that it has never heard."""
    endpoint = free_endpoint()
    router = open_router(listen=(endpoint,))
    with nedbus.connect(endpoint) as vehicle, nedbus.connect(endpoint) as reader:
        subscription = reader.subscribe(mode="every")
        publish(vehicle.publisher(VLP, vehicle="1"), 0)
        assert subscription.receive(DEADLINE).message.timestamp == 0
        router.close()
        wait_for(lambda: not vehicle.connected, what="the break")
        publish(vehicle.publisher(VLP, vehicle="2"), *range(1, 20))
        with closing(open_router(listen=(endpoint,))):
            assert [subscription.receive(DEADLINE).message.timestamp for _ in range(19)] == list(range(1, 20))
            assert subscription.counts == Counts(received=20)
