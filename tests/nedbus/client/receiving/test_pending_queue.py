"""The queue of unread samples: order, counts and limits, with fake samples."""

from __future__ import annotations

import gc
import threading
import tracemalloc
import weakref
from collections import Counter
from collections.abc import Collection
from pathlib import Path

import pytest
import zenoh

from nedbus import Batch, Counts, Mode
from nedbus.client.receiving import Decoder, LayoutLookup, PendingQueue
from nedbus.client.receiving import pending_queue as module
from nedbus.client.receiving.decoder import KeyState
from nedbus.client.receiving.layout_lookup import SchemaId, Schemas
from nedbus.client.receiving.pending_queue import CAPACITY
from nedbus.client.receiving.writer_proxy import NUMBERS, WriterProxy
from nedbus.timings import Timings
from nedbus.transport import RawSample
from nedbus_msgs.messages import VehicleAttitude
from tests.flights.local_position import encode, encoding_of
from tests.waits import DEADLINE

from .raw_samples import (
    INVALID,
    OTHER_KEY,
    SOURCE,
    VALID,
    Payload,
    drain,
    junk,
    make_queue,
    name_of,
    put,
    raw,
    timestamps,
)

STAMP = zenoh.Timestamp.parse_rfc3339("2026-11-21T00:00:00.000000000Z/33")


@pytest.mark.parametrize("mode", ["latest", "every"])
def test_first_reply_of_a_publisher_is_retained(mode: Mode) -> None:
    """The first sample of a publisher is marked as retained if it is a reply to the query for the last message."""
    pending_queue, block, drop = make_queue(mode), zenoh.CongestionControl.BLOCK, zenoh.CongestionControl.DROP
    arriving = [(4, "a", block), (5, "a", block), (6, "a", drop), (1, "b", drop), (2, "b", block)]
    seen = []
    for number, publisher, control in arriving:
        put(pending_queue, [raw(number, publisher=publisher, congestion_control=control)])
        seen += [sample.retained for sample in drain(pending_queue)]
    assert seen == [True, False, False, False, False]


class Guarded(int):
    """A counter that may only be increased by the owner of a queue's lock."""

    queue: PendingQueue

    def __add__(self, other: int) -> Guarded:
        assert self.queue._lock._is_owned()  # type: ignore[attr-defined] # not in typeshed
        increased = Guarded(int(self) + other)
        increased.queue = self.queue
        return increased


@pytest.mark.parametrize("form", ["models", "batches"])
def test_counters_are_changed_with_the_lock(form: str) -> None:
    """Reading valid and invalid messages changes the counters only with the lock, because several threads may read."""
    pending_queue = make_queue("every")
    put(pending_queue, [raw(0), raw(3, payload=INVALID), raw(4)])
    zero = pending_queue._received = Guarded()
    zero.queue = pending_queue
    for stream in pending_queue._streams.values():
        stream.unreported = zero
    if form == "batches":
        while pending_queue.pop_batch():
            pass
    else:
        drain(pending_queue)
    assert pending_queue.counts == Counts(received=2, lost=2, invalid=1)


def test_largest_reorder_buffers_are_given_up_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the limit of messages held back, here 10, the gap with the most messages behind it counts as lost."""
    monkeypatch.setattr("nedbus.client.receiving.pending_queue.MAX_HELD", 10)
    pending_queue = make_queue("every")
    pending_queue.put([raw(0), raw(2, timestamp=2)])
    pending_queue.put([raw(number, key=OTHER_KEY, publisher="b") for number in (0, *range(2, 12))])
    assert Counter(sample.vehicle for sample in drain(pending_queue)) == {"1": 1, "2": 11}
    pending_queue.put([raw(1)])
    assert timestamps(pending_queue) == [1, 2]
    assert pending_queue.counts == Counts(received=14, lost=1)


@pytest.mark.parametrize(("before", "after", "lost"), [(-4, -2, 0), (-4, -1, 2), (-2, 0, 1), (-3, 1, 3), (-1, 2, 0)])
def test_gap_across_the_wrap_of_sequence_numbers_is_lost(before: int, after: int, lost: int) -> None:
    """A gap up to the highest sequence number, or across it, counts as lost at once; others are requested."""
    pending_queue = make_queue("every")
    pending_queue.put([raw(before % NUMBERS), raw(after % NUMBERS, timestamp=2)])
    assert bool(pending_queue.counters.requesting) == (lost == 0)
    assert [each.lost for each in drain(pending_queue)] == [0, lost][: 1 + bool(lost)]
    assert pending_queue.counts.lost == lost


def test_gap_that_is_being_filled_does_not_expire(timings: Timings) -> None:
    """The timeout of a gap begins again with each message that fills a part of it."""
    pending_queue, now = make_queue("every"), 100.0
    pending_queue.put([raw(0), raw(6, timestamp=6)])
    [writer] = pending_queue.counters.requesting
    for number in range(1, 6):
        now += 0.9 * timings.retransmit_timeout
        assert pending_queue.next_request(writer, now) == range(number, 6)
        pending_queue.on_retransmission(writer, {number: raw(number, timestamp=number)}, ended=True, now=now)
    assert timestamps(pending_queue) == [1, 1, 2, 3, 4, 5, 6]
    assert pending_queue.counts == Counts(received=7)


@pytest.mark.parametrize("when", ["during a gap", "after it"])
def test_unresponsive_publisher_gets_more_than_one_request_after_a_link_change(timings: Timings, when: str) -> None:
    """A publisher that did not answer gets one request per gap, until a link change: perhaps its link was down."""
    pending_queue, now = make_queue("every"), 100.0

    def attempt() -> int:
        """Send the request of the gap, without an answer; return the number of messages lost so far."""
        [writer] = pending_queue.counters.requesting
        assert pending_queue.next_request(writer, now) is not None
        pending_queue.on_retransmission(writer, {}, ended=True, now=now)
        return pending_queue.counts.lost

    pending_queue.put([raw(0), raw(2)])
    assert attempt() == 0
    now += timings.retransmit_timeout
    assert attempt() == 1
    pending_queue.put([raw(4)])
    assert attempt() == 2
    if when == "after it":
        pending_queue.on_link_change()
    pending_queue.put([raw(6)])
    if when == "during a gap":
        pending_queue.on_link_change()
    assert attempt() == 2
    now += timings.retransmit_timeout
    assert attempt() == 3


@pytest.mark.parametrize(
    ("mode", "arriving", "losses", "counts"),
    [
        ("every", [raw(1), raw(5)], [0, 0, 3], Counts(received=3, lost=3)),
        ("every", [raw(3, payload=INVALID), raw(4)], [0, 2], Counts(received=2, lost=2, invalid=1)),
        ("latest", [raw(3), raw(4)], [2], Counts(received=1, lost=2, dropped=2)),
    ],
)
def test_loss_is_reported_by_the_next_sample_read(
    mode: Mode, arriving: list[RawSample], losses: list[int], counts: Counts
) -> None:
    """A loss is reported by the next valid sample after the gap, even after invalid or superseded samples."""
    pending_queue = make_queue(mode)
    put(pending_queue, [raw(0)])
    put(pending_queue, arriving)
    assert [sample.lost for sample in drain(pending_queue)] == losses
    assert pending_queue.counts == counts


def test_gap_within_a_batch_is_reported_by_the_sample_after_it() -> None:
    """A gap within a batch is reported by the sample after the gap, a gap at the end by the next batch."""
    pending_queue = make_queue("every")
    for start in range(0, 2000, 50):
        put(pending_queue, [raw(number) for number in range(start, start + 50)])
    assert not any(sample.lost for sample in drain(pending_queue))
    put(pending_queue, [raw(number) for number in range(2000, 2050) if number not in {2020, 2021, 2049}])
    assert [sample.lost for sample in drain(pending_queue)] == [0] * 20 + [2] + [0] * 26
    put(pending_queue, [raw(number) for number in range(2050, 2100)])
    assert [sample.lost for sample in drain(pending_queue)] == [1] + [0] * 49
    assert pending_queue.counts == Counts(received=2097, lost=3)


def test_mode_latest_keeps_the_newest_of_each_key(caplog: pytest.LogCaptureFixture) -> None:
    """A newer sample of a key replaces the queued one, which counts as dropped, without a warning."""
    pending_queue = make_queue("latest")
    put(pending_queue, [raw(0, key=OTHER_KEY, publisher="b"), *(raw(each, timestamp=each) for each in range(1, 1001))])
    assert pending_queue.counts == Counts(dropped=999)
    assert [(each.vehicle, each.message.timestamp) for each in drain(pending_queue)] == [("2", 1), ("1", 1000)]
    assert pending_queue.counts == Counts(received=2, dropped=999)
    assert not caplog.messages


def test_invalid_samples_are_counted_and_logged_once_per_key(caplog: pytest.LogCaptureFixture) -> None:
    """Invalid samples are counted, and logged once per key; valid samples between them arrive.

    A payload of unusual size is decoded before it can replace a valid sample.
    """
    latest = make_queue("latest")
    put(latest, [raw(0, timestamp=5), junk(b"junk")])
    assert timestamps(latest) == [5]
    caplog.clear()
    pending_queue = make_queue("every")
    wrong_key = raw(None, key="nedbus/*/vehicle_local_position")
    put(pending_queue, [junk(b"junk"), junk(b""), junk(bytes(5000)), wrong_key, raw(None, timestamp=7)])
    assert timestamps(pending_queue) == [7]
    assert pending_queue.counts == Counts(received=1, invalid=4)
    assert len(caplog.messages) == 2


def test_number_of_tracked_keys_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader keeps the state of at most 10,000 keys, here 10; messages on additional keys still arrive."""
    monkeypatch.setattr("nedbus.client.receiving.pending_queue.MAX_KEYS", 10)
    pending_queue = make_queue("every")
    tracemalloc.start()
    for number in range(2000):
        put(pending_queue, [raw(None, key=f"nedbus/{number}/vehicle_local_position")])
        assert len(drain(pending_queue)) == 1
    allocated, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert allocated < 100_000


def key_of(vehicle: str) -> str:
    return f"nedbus/{vehicle}/vehicle_local_position"


def vehicles_in_memory() -> list[str]:
    """Return the vehicle of each key state and of each writer proxy in memory."""
    gc.collect()
    objects = gc.get_objects()
    streams = [each for each in objects if isinstance(each, KeyState)]
    streams += [each.stream for each in objects if isinstance(each, WriterProxy)]
    return [stream.address.vehicle for stream in streams]


@pytest.mark.parametrize("mode", ["latest", "every"])
def test_least_recently_active_key_is_evicted(
    mode: Mode, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Beyond the limit, the least recently active key is evicted and counted; losses of other keys still count."""
    monkeypatch.setattr(module, "MAX_KEYS", 3)
    now = [0.0]
    pending_queue = make_queue(mode, clock=lambda: now[0])

    def receive(vehicle: str, number: int) -> int:
        now[0] += 1.0
        put(pending_queue, [raw(number, key=key_of(vehicle), publisher=vehicle)])
        return sum(sample.lost for sample in drain(pending_queue))

    for vehicle in "abcab":
        receive(vehicle, 0)
    assert not caplog.messages
    receive("d", 0)  # c is evicted
    assert [receive(vehicle, 9) for vehicle in "abd"] == [8, 8, 8]
    assert pending_queue.counts.forgotten == 1
    assert receive("c", 9) == 0  # a is evicted
    assert [receive(vehicle, 12) for vehicle in "bdc"] == [2, 2, 2]
    assert (pending_queue.counts.forgotten, pending_queue.counts.lost) == (2, 30)
    assert len(caplog.messages) == 1
    assert "more than 3 keys" in caplog.text


def test_key_with_an_open_gap_is_evicted_last(monkeypatch: pytest.MonkeyPatch) -> None:
    """A key with a gap is evicted, and its gap counted as lost, only if all keys have a gap."""
    monkeypatch.setattr(module, "MAX_KEYS", 3)
    now = [0.0]
    pending_queue = make_queue("every", clock=lambda: now[0])
    for vehicle, numbers in [("a", [0, 5]), ("b", [0]), ("c", [0, 3]), ("d", [0]), ("d", [2]), ("e", [0])]:
        now[0] += 1.0
        pending_queue.put([raw(number, key=key_of(vehicle), publisher=vehicle) for number in numbers])
    assert pending_queue.counts == Counts(lost=4, forgotten=2)  # b, then a
    assert [sample.vehicle for sample in drain(pending_queue)] == list("abcdae")
    assert len(pending_queue.counters.requesting) == 2


@pytest.mark.parametrize("mode", ["latest", "every"])
def test_state_of_silent_vehicles_is_freed(mode: Mode, monkeypatch: pytest.MonkeyPatch) -> None:
    """While 2,000 vehicles come and go, eight at a time, only the state of those of the last ten minutes is kept.

    A vehicle whose messages or heartbeats still arrive is not evicted.
    """
    monkeypatch.setattr("nedbus.client.receiving.pending_queue.KEPT_KEYS", 10)
    now = [0.0]
    pending_queue = make_queue(mode, clock=lambda: now[0])
    for number in range(2000):
        now[0] += 10.0
        put(pending_queue, [raw(number, key=key_of("steady"), publisher="steady")])
        pending_queue.on_heartbeat(key_of("silent"), name_of("silent"), 5)
        vehicles = [str(each) for each in range(max(0, number - 8), number)]
        put(pending_queue, [raw(number, key=key_of(each), publisher=each) for each in vehicles])
        drain(pending_queue)
    measured = Counter(vehicles_in_memory())
    assert {"steady", "silent", *map(str, range(1935, 1999))} <= measured.keys()
    assert len(measured) <= 72
    assert set(measured.values()) == {2}
    assert pending_queue.counts.forgotten == 0, "only keys beyond the limit are counted"


def test_losses_during_a_long_outage_are_counted() -> None:
    """Messages lost in an outage of an hour are counted, even if other vehicles appear during the outage."""
    now = [0.0]
    pending_queue = make_queue("latest", clock=lambda: now[0])
    put(pending_queue, [raw(0, key=key_of("7"), publisher="7")])
    for other in range(100):
        now[0] += 36.0
        put(pending_queue, [raw(0, key=key_of(f"v{other}"), publisher=f"v{other}")])
    put(pending_queue, [raw(90, key=key_of("7"), publisher="7")])
    drain(pending_queue)
    assert pending_queue.counts.lost == 89


def test_queue_wait_returns_on_sample_wake_end_or_timeout() -> None:
    """A wait ends when a sample arrives, `wake` is called, the queue ends, or the timeout expires."""
    pending_queue = make_queue("every")
    assert not pending_queue.wait(0.0)
    put(pending_queue, [raw(0)])
    assert pending_queue.wait(None)
    drain(pending_queue)
    pending_queue.wait(0.0)  # may return True because of the sample already read
    assert not pending_queue.wait(0.0)
    woken: list[bool] = []
    pending_queue.on_wake = lambda: woken.append(True)
    pending_queue.wake()
    assert pending_queue.wait(None)
    assert woken
    pending_queue.end()
    assert pending_queue.wait(None)


# Readers slower than the data


@pytest.fixture
def small_queue(monkeypatch: pytest.MonkeyPatch) -> PendingQueue:
    """Return a queue for mode `every` that holds 10 samples, at most 4 of them with their receive buffers."""
    monkeypatch.setattr(module, "CAPACITY", 10)
    monkeypatch.setattr(module, "_MAX_FRESH", 4)
    return make_queue("every")


def test_documented_capacity_is_that_of_the_queue() -> None:
    """A queue in mode `every` holds as many unread samples as the documentation states, and one more drops one."""
    queue = make_queue("every")
    put(queue, [raw(None)] * CAPACITY)
    assert queue.counts.dropped == 0
    put(queue, [raw(None)])
    assert queue.counts.dropped == 1
    for page in ("docs/data.md", "CONTRIBUTING.md"):
        assert f"{CAPACITY:,}" in (Path(__file__).parents[4] / page).read_text(), page


def test_oldest_samples_are_dropped_counted_and_logged_once(
    small_queue: PendingQueue, caplog: pytest.LogCaptureFixture
) -> None:
    """A full queue drops the oldest samples, which count as dropped, not as lost, and are logged once."""
    for start in range(0, 40, 10):
        assert (small_queue.counts, len(caplog.messages)) == (Counts(dropped=max(0, start - 10)), start > 10)
        put(small_queue, [raw(number, timestamp=number + 1) for number in range(start, start + 10)])
    samples = drain(small_queue)
    assert [(sample.message.timestamp, sample.lost) for sample in samples] == [(each, 0) for each in range(31, 41)]
    assert small_queue.counts == Counts(received=10, dropped=30)
    assert caplog.messages == ["queue: the reader is slower than the data, so messages are dropped"]


def test_losses_before_dropped_samples_are_reported_later(small_queue: PendingQueue) -> None:
    """A loss in transit is reported by a later sample of the key if the sample after the gap was dropped."""
    put(
        small_queue,
        [raw(0), raw(3), raw(0, key=OTHER_KEY, publisher="b"), raw(2, key=OTHER_KEY, publisher="b"), raw(5)],
    )
    put(small_queue, [raw(number) for number in range(6, 15)])
    put(small_queue, [raw(3, key=OTHER_KEY, publisher="b")])
    samples = drain(small_queue)
    assert [(sample.vehicle, sample.lost) for sample in samples if sample.lost] == [("1", 3), ("2", 1)]
    assert samples[-1].vehicle == "2"
    assert small_queue.counts == Counts(received=10, lost=4, dropped=5)


def test_losses_are_reported_by_the_next_valid_sample(small_queue: PendingQueue) -> None:
    """Losses before dropped and invalid samples are reported by the next valid sample of the key."""
    put(small_queue, [raw(0), raw(3)])
    put(small_queue, [raw(number, payload=INVALID) for number in range(4, 13)])
    put(small_queue, [raw(13)])
    assert [sample.lost for sample in drain(small_queue)] == [2]
    assert small_queue.counts == Counts(received=1, lost=2, dropped=2, invalid=9)


@pytest.mark.parametrize("in_batches", [False, True])
def test_waiting_samples_release_their_receive_buffer(small_queue: PendingQueue, in_batches: bool) -> None:
    """Samples deep in the queue are detached from their receive buffers, which Zenoh samples keep alive.

    Detached samples keep their sequence number, timestamp and provenance.
    """
    encodings = [encoding_of(f"source{number}", frozenset({"timestamp"})) for number in range(9)]
    arriving = [raw(number, stamp=STAMP if number % 2 else None, encoding=encodings[number]) for number in range(9)]
    arrived = [weakref.ref(each) for each in arriving]
    while arriving:
        put(small_queue, [arriving.pop(0)])
    assert [each() is None for each in arrived] == [False] * 5 + [True] * 4
    if in_batches:
        batch = small_queue.pop_batch()
        assert batch is not None
        assert batch.sequence.tolist() == list(range(9))
        sent, provenances = batch.sent.tolist(), list(batch.provenances)
    else:
        samples = drain(small_queue)
        sent, provenances = [sample.sent or 0 for sample in samples], [sample.provenance for sample in samples]
    assert sent == [STAMP.get_time_as_ntp64().as_nanos() if number % 2 else 0 for number in range(9)]
    assert [(each.source, len(each.missing)) for each in provenances] == [(f"source{each}", 52) for each in range(9)]


class Encoding(str):
    """An encoding that supports weak references."""


@pytest.mark.parametrize("mode", ["latest", "every"])
def test_key_state_keeps_no_receive_buffer(mode: Mode) -> None:
    """The state of a key stores a copy of the encoding, because a Zenoh encoding keeps its receive buffer alive."""
    pending_queue, encoding = make_queue(mode), Encoding(SOURCE)
    reference = weakref.ref(encoding)
    put(pending_queue, [raw(0, encoding=encoding)])
    del encoding
    assert [sample.source for sample in drain(pending_queue)] == ["sim"]
    assert reference() is None


def test_long_encodings_are_truncated(small_queue: PendingQueue) -> None:
    """Queued samples keep at most 512 characters of a long encoding."""
    for number in range(9):
        put(small_queue, [raw(number, encoding=SOURCE + number * 10_000 * "x")])
    encodings = [arrival[2].encoding for arrival in small_queue._every]
    assert all(len(str(encoding)) <= 512 for encoding in encodings[5:])
    assert len(drain(small_queue)) == 9


def test_gaps_of_a_full_ring_count_as_dropped(caplog: pytest.LogCaptureFixture) -> None:
    """Samples displaced from Zenoh's full ring count as dropped, not as lost in transit; this is logged once.

    Gaps in later batches count as losses again.
    """
    pending_queue = make_queue("every")
    put(pending_queue, [raw(0), raw(1)])
    put(pending_queue, [raw(50), raw(51), raw(60)], overflowed=True)
    put(pending_queue, [raw(100)], overflowed=True)
    put(pending_queue, [raw(101), raw(105)])
    assert [sample.lost for sample in drain(pending_queue)] == [0] * 7 + [3]
    assert pending_queue.counts == Counts(received=8, lost=3, dropped=48 + 8 + 39)
    assert len(caplog.messages) == 1


# Batches


def take_batch(pending_queue: PendingQueue) -> Batch:
    batch = pending_queue.pop_batch()
    assert batch is not None
    return batch


ATTITUDE = Payload(encode(VehicleAttitude(timestamp=7, q=(1.0, 0.0, 0.0, 0.0))))


UNDEFINED = f"application/msgpack;px4_msgs/FooBar;hash={'0' * 32}"


def undefined(payload: bytes = VALID, *, number: int | None = None, publisher: str = "a") -> RawSample:
    """Return a sample of a message whose definition no publisher has."""
    return raw(number, key="nedbus/1/foo_bar", payload=Payload(payload), encoding=UNDEFINED, publisher=publisher)


def test_messages_left_by_a_batch_are_read_next() -> None:
    """A batch has messages of one type; the others stay queued and can be read as samples or batches."""
    for take in (timestamps, lambda pending_queue: take_batch(pending_queue).messages["timestamp"].tolist()):
        pending_queue = make_queue("every")
        put(pending_queue, [raw(0), raw(None, key="nedbus/1/vehicle_attitude", payload=ATTITUDE)])
        assert len(take_batch(pending_queue)) == 1
        assert pending_queue.waiting == 1
        assert pending_queue.wait(0.0)
        assert take(pending_queue) == [7]


def test_batch_skips_messages_without_a_definition() -> None:
    """Messages without a definition are invalid, and do not delay a batch of valid ones."""
    for payload in (VALID, VALID[:-1]):
        pending_queue = make_queue("every")
        put(pending_queue, [undefined(payload), raw(0)])
        assert take_batch(pending_queue).sequence.tolist() == [0]
        assert pending_queue.pop_batch() is None
        assert pending_queue.counts == Counts(received=1, invalid=1)


def test_definition_is_requested_again_for_another_publisher() -> None:
    """After a failed lookup, a message of another publisher starts the next one at once, of the same one later."""
    queried: list[SchemaId] = []

    def find(schema_ids: Collection[SchemaId]) -> Schemas:
        queried.extend(schema_ids)
        return {}

    lookup = LayoutLookup(find, now=lambda: 0.0)
    pending_queue = PendingQueue("every", Decoder(lookup, prefix="nedbus"))
    for publisher, count in (("a", 1), ("a", 1), ("b", 2)):
        pending_queue.put([undefined(number=0, publisher=publisher)])
        lookup.wait()
        assert len(queried) == count


def test_samples_are_queued_while_a_batch_waits_for_a_lookup(timings: Timings) -> None:
    """While `pop_batch` waits for a definition, arriving samples are queued without delay."""
    timings.definition_timeout = DEADLINE
    queried, answered = threading.Event(), threading.Event()

    def find(_: Collection[SchemaId]) -> Schemas:
        queried.set()
        answered.wait(DEADLINE)
        return {}

    pending_queue = PendingQueue("every", Decoder(LayoutLookup(find), prefix="nedbus"))
    pending_queue.put([undefined()])
    reader = threading.Thread(target=pending_queue.pop_batch)
    reader.start()
    assert queried.wait(DEADLINE)
    pending_queue.put([raw(0)])
    assert not answered.is_set()
    assert reader.is_alive()
    answered.set()
    reader.join(DEADLINE)


def test_batch_in_mode_latest_reports_losses_before_superseded_samples() -> None:
    """In mode `latest` a batch has one message per key, and reports all losses before that message."""
    pending_queue = make_queue("latest")
    put(pending_queue, [raw(0), raw(3), raw(4)])
    batch = take_batch(pending_queue)
    assert (batch.sequence.tolist(), batch.lost) == ([4], 2)
    assert pending_queue.counts == Counts(received=1, lost=2, dropped=2)


def test_loss_is_reported_by_the_batch_after_the_gap() -> None:
    """Messages that do not fit into a full batch are left for the next one, which reports the losses before them."""
    pending_queue = make_queue("every")
    put(pending_queue, [raw(number) for number in range(5000) if number not in {4500, 4501}])
    first, second = take_batch(pending_queue), take_batch(pending_queue)
    assert (len(first), len(second)) == (4096, 902)
    assert (first.lost, second.lost) == (0, 2)


def test_samples_and_batches_report_each_loss_once() -> None:
    """If a subscription is read alternately as samples and as batches, each loss is reported once."""
    pending_queue = make_queue("every")
    put(pending_queue, [raw(0), raw(5)])
    assert sum(sample.lost for sample in drain(pending_queue)) == 4
    put(pending_queue, [raw(6), raw(9)])
    assert take_batch(pending_queue).lost == 2
    put(pending_queue, [raw(11)])
    assert [sample.lost for sample in drain(pending_queue)] == [1]
    put(pending_queue, [raw(12)])
    assert take_batch(pending_queue).lost == 0
