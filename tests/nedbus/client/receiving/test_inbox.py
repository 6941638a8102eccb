"""The queue of unread samples: order, counts and limits, with fake samples."""

from __future__ import annotations

import gc
import threading
import tracemalloc
import weakref
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Any

import pytest
import zenoh

import nedbus
from nedbus import Batch, Counts, Mode, limits
from nedbus.client.receiving import (
    Decoder,
    Inbox,
    LayoutLookup,
)
from nedbus.client.receiving.arrival import Stream
from nedbus.client.receiving.layout_lookup import SchemaId, Schemas
from nedbus.client.receiving.writer_proxy import NUMBERS, WriterProxy
from nedbus.timings import Timings
from nedbus.transport import RawSample
from nedbus_msgs import Codec, Definition, codec_of, encoding_of as provenance_encoding
from nedbus_msgs.messages import VehicleAttitude
from tests.flights.local_position import encode, encoding_of
from tests.waits import DEADLINE, wait_for

from .raw_samples import (
    INVALID,
    KEY,
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
    inbox, block, drop = (
        make_queue(mode),
        zenoh.CongestionControl.BLOCK,
        zenoh.CongestionControl.DROP,
    )
    arriving = [(4, "a", block), (5, "a", block), (6, "a", drop), (1, "b", drop), (2, "b", block)]
    seen = []
    for number, publisher, control in arriving:
        put(inbox, [raw(number, publisher=publisher, congestion_control=control)])
        seen += [sample.retained for sample in drain(inbox)]
    assert seen == [True, False, False, False, False]


class Guarded(int):
    """A counter that may only be increased by the owner of a queue's lock."""

    queue: Inbox

    def __add__(self, other: int) -> Guarded:
        assert self.queue._lock._is_owned()  # type: ignore[attr-defined] # not in typeshed
        increased = Guarded(int(self) + other)
        increased.queue = self.queue
        return increased

    def __sub__(self, other: int) -> Guarded:
        return self + -other


@pytest.mark.parametrize("form", ["models", "batches"])
def test_counters_are_changed_with_the_lock(form: str) -> None:
    """Reading valid and invalid messages changes the counters only with the lock, because several threads may read."""
    inbox = make_queue("every")
    put(inbox, [raw(0), raw(3, payload=INVALID), raw(4)])
    zero = inbox._counters.received = Guarded()
    zero.queue = inbox
    for stream in inbox.streams:
        stream.unreported = zero
    if form == "batches":
        while inbox.pop_batch():
            pass
    else:
        drain(inbox)
    assert inbox.counts == Counts(received=2, lost=2, invalid=1)


@pytest.mark.parametrize(
    ("before", "after"), [(0, 0), (0, 1), (0, 20), (1, 0), (1, 1), (3, 3), (20, 0)]
)
def test_number_from_another_publisher_does_not_continue_a_sequence(
    before: int, after: int
) -> None:
    """A message of publisher b, with the number that publisher a sends next, leaves the gap of a open."""
    inbox = make_queue("every")
    inbox.put([raw(0), raw(0, publisher="b"), raw(1)])
    assert inbox.counts.discarded == 0
    stop = 2 + before
    batch = [raw(number) for number in range(2, stop)] + [raw(stop, publisher="b")]
    inbox.put([*batch, *(raw(number) for number in range(stop + 1, stop + 1 + after))])
    requested = {each.name: inbox.next_request(each, 0.0) for each in list(inbox.gaps.requesting)}
    missed_by_a = {name_of("a"): range(stop, stop + 1)} if after else {}
    assert requested == {**missed_by_a, name_of("b"): range(1, stop)}


def test_messages_of_several_keys_in_a_batch_keep_their_order() -> None:
    """Consecutive messages of one key among those of others are read once each, in order of arrival."""
    inbox = make_queue("every")
    inbox.put([raw(0), raw(0, key=OTHER_KEY, publisher="b")])
    drain(inbox)
    batch = [
        *(raw(number, timestamp=number) for number in (1, 2, 3)),
        raw(1, key=OTHER_KEY, publisher="b", timestamp=11),
        *(raw(number, timestamp=number) for number in (4, 5)),
        *(raw(number, key=OTHER_KEY, publisher="b", timestamp=10 + number) for number in (2, 3, 4)),
        raw(6, timestamp=6),
    ]
    inbox.put(batch)
    assert timestamps(inbox) == [1, 2, 3, 11, 4, 5, 12, 13, 14, 6]
    inbox.put([raw(7, timestamp=7), raw(5, key=OTHER_KEY, publisher="b", timestamp=15)])
    assert timestamps(inbox) == [7, 15]
    assert inbox.counts == Counts(received=14)


def test_number_from_another_publisher_among_other_keys_does_not_continue_a_sequence() -> None:
    """A message of publisher c between two of publisher a leaves the gap of a open, also beside those of other keys."""
    inbox = make_queue("every")
    inbox.put([raw(0), raw(0, publisher="c"), raw(0, key=OTHER_KEY, publisher="b"), raw(1)])
    others = [raw(number, key=OTHER_KEY, publisher="b") for number in range(1, 8)]
    inbox.put([raw(2), raw(3, publisher="c"), *others, raw(4)])
    requested = {
        writer.name: inbox.next_request(writer, 0.0) for writer in [*inbox.gaps.requesting]
    }
    assert requested == {name_of("a"): range(3, 4), name_of("c"): range(1, 3)}


def test_largest_reorder_buffers_are_given_up_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the limit of messages held back, here 10, the gap with the most messages behind it counts as lost."""
    monkeypatch.setattr("nedbus.limits.HELD_MESSAGES", 10)
    inbox = make_queue("every")
    inbox.put([raw(0), raw(2, timestamp=2)])
    inbox.put([raw(number, key=OTHER_KEY, publisher="b") for number in (0, *range(2, 12))])
    assert Counter(sample.vehicle for sample in drain(inbox)) == {"1": 1, "2": 11}
    inbox.put([raw(1)])
    assert timestamps(inbox) == [1, 2]
    assert inbox.counts == Counts(received=14, lost=1)


@pytest.mark.parametrize(
    ("before", "after", "lost"), [(-4, -2, 0), (-4, -1, 2), (-2, 0, 1), (-3, 1, 3), (-1, 2, 0)]
)
def test_gap_across_the_wrap_of_sequence_numbers_is_lost(
    before: int, after: int, lost: int
) -> None:
    """A gap up to the highest sequence number, or across it, counts as lost at once; others are requested."""
    inbox = make_queue("every")
    inbox.put([raw(before % NUMBERS), raw(after % NUMBERS, timestamp=2)])
    assert bool(inbox.gaps.requesting) == (lost == 0)
    assert [each.lost for each in drain(inbox)] == [0, lost][: 1 + bool(lost)]
    assert inbox.counts.lost == lost


def test_gap_that_is_being_filled_does_not_expire(timings: Timings) -> None:
    """The timeout of a gap begins again with each message that fills a part of it."""
    inbox, now = make_queue("every"), 100.0
    inbox.put([raw(0), raw(6, timestamp=6)])
    [writer] = inbox.gaps.requesting
    for number in range(1, 6):
        now += 0.9 * timings.retransmit_timeout
        assert inbox.next_request(writer, now) == range(number, 6)
        inbox.on_retransmission(
            writer, {number: raw(number, timestamp=number)}, ended=True, now=now
        )
    assert timestamps(inbox) == [1, 1, 2, 3, 4, 5, 6]
    assert inbox.counts == Counts(received=7)


@pytest.mark.parametrize(
    ("seconds", "requested"),
    [(None, range(5, 6)), (0.0, range(6)), (9.0, range(6)), (11.0, range(5, 6))],
)
def test_heartbeat_of_an_unknown_publisher_requests_what_the_outage_may_have_lost(
    seconds: float | None, requested: range
) -> None:
    """For 10 s after a link change, an unknown publisher may have sent all its messages during the outage.

    What it no longer caches predates the subscription, and is not lost.
    """
    now = 100.0
    inbox = make_queue("every", clock=lambda: now)
    if seconds is not None:
        inbox.on_link_change()
        now += seconds
    inbox.on_heartbeat(KEY, name_of("b"), 5)
    [writer] = inbox.gaps.requesting
    assert inbox.next_request(writer, 100.0) == requested
    answered = {number: raw(number, timestamp=number, publisher="b") for number in requested}
    inbox.on_retransmission(writer, answered, ended=True, now=100.0)
    assert inbox.next_request(writer, 101.0) is None
    assert timestamps(inbox) == list(requested)
    assert inbox.counts == Counts(received=len(requested))


@pytest.mark.parametrize("when", ["during a gap", "after it"])
def test_unresponsive_publisher_gets_more_than_one_request_after_a_link_change(
    timings: Timings, when: str
) -> None:
    """A publisher that did not answer gets one request per gap, until a link change: perhaps its link was down."""
    inbox, now = make_queue("every"), 100.0

    def attempt() -> int:
        """Send the request of the gap, without an answer; return the number of messages lost so far."""
        [writer] = inbox.gaps.requesting
        assert inbox.next_request(writer, now) is not None
        inbox.on_retransmission(writer, {}, ended=True, now=now)
        return inbox.counts.lost

    inbox.put([raw(0), raw(2)])
    assert attempt() == 0
    now += timings.retransmit_timeout
    assert attempt() == 1
    inbox.put([raw(4)])
    assert attempt() == 2
    if when == "after it":
        inbox.on_link_change()
    inbox.put([raw(6)])
    if when == "during a gap":
        inbox.on_link_change()
    assert attempt() == 2
    now += timings.retransmit_timeout
    assert attempt() == 3


def test_answer_shows_that_a_publisher_responds_even_if_its_end_comes_later(
    timings: Timings,
) -> None:
    """A publisher that did not answer, and then does, gets more than one request for its next gap."""
    inbox, now = make_queue("every"), 100.0
    inbox.put([raw(0), raw(2)])
    [writer] = inbox.gaps.requesting
    for _ in range(2):
        assert inbox.next_request(writer, now) == range(1, 2)
        inbox.on_retransmission(writer, {}, ended=True, now=now)
        now += timings.retransmit_timeout
    assert inbox.counts.lost == 1
    inbox.put([raw(4)])
    assert inbox.next_request(writer, now) == range(3, 4)
    inbox.on_retransmission(writer, {3: raw(3)}, ended=False, now=now)
    inbox.on_retransmission(writer, {}, ended=True, now=now)
    inbox.put([raw(6)])
    assert inbox.next_request(writer, now) == range(5, 6)
    inbox.on_retransmission(writer, {}, ended=True, now=now)
    assert inbox.counts.lost == 1


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
    inbox = make_queue(mode)
    put(inbox, [raw(0)])
    put(inbox, arriving)
    assert [sample.lost for sample in drain(inbox)] == losses
    assert inbox.counts == counts


def test_gap_within_a_batch_is_reported_by_the_sample_after_it() -> None:
    """A gap within a batch is reported by the sample after the gap, a gap at the end by the next batch."""
    inbox = make_queue("every")
    for start in range(0, 2000, 50):
        put(inbox, [raw(number) for number in range(start, start + 50)])
    assert not any(sample.lost for sample in drain(inbox))
    put(inbox, [raw(number) for number in range(2000, 2050) if number not in {2020, 2021, 2049}])
    assert [sample.lost for sample in drain(inbox)] == [0] * 20 + [2] + [0] * 26
    put(inbox, [raw(number) for number in range(2050, 2100)])
    assert [sample.lost for sample in drain(inbox)] == [1] + [0] * 49
    assert inbox.counts == Counts(received=2097, lost=3)


def test_mode_latest_keeps_the_newest_of_each_key(caplog: pytest.LogCaptureFixture) -> None:
    """A newer sample of a key replaces the queued one, which counts as dropped, without a warning."""
    inbox = make_queue("latest")
    put(
        inbox,
        [
            raw(0, key=OTHER_KEY, publisher="b"),
            *(raw(each, timestamp=each) for each in range(1, 1001)),
        ],
    )
    assert inbox.counts == Counts(dropped=999)
    assert [(each.vehicle, each.message.timestamp) for each in drain(inbox)] == [
        ("2", 1),
        ("1", 1000),
    ]
    assert inbox.counts == Counts(received=2, dropped=999)
    assert not caplog.messages


def test_invalid_samples_are_counted_and_logged_once_per_key(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Invalid samples are counted, and logged once per key; valid samples between them arrive.

    A payload of unusual size is decoded before it can replace a valid sample.
    """
    latest = make_queue("latest")
    put(latest, [raw(0, timestamp=5), junk(b"junk")])
    assert timestamps(latest) == [5]
    caplog.clear()
    inbox = make_queue("every")
    wrong_key = raw(None, key="nedbus/*/vehicle_local_position")
    put(inbox, [junk(b"junk"), junk(b""), junk(bytes(5000)), wrong_key, raw(None, timestamp=7)])
    assert timestamps(inbox) == [7]
    assert inbox.counts == Counts(received=1, invalid=4)
    assert len(caplog.messages) == 2


@pytest.mark.slow
def test_number_of_tracked_keys_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader keeps the state of at most 10,000 keys, here 10; messages on additional keys still arrive."""
    monkeypatch.setattr("nedbus.limits.KEYS", 10)
    inbox = make_queue("every")
    tracemalloc.start()
    for number in range(2000):
        put(inbox, [raw(None, key=f"nedbus/{number}/vehicle_local_position")])
        assert len(drain(inbox)) == 1
    allocated, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert allocated < 100_000


def key_of(vehicle: str) -> str:
    return f"nedbus/{vehicle}/vehicle_local_position"


def vehicles_in_memory() -> list[str]:
    """Return the vehicle of each key state and of each writer proxy in memory."""
    gc.collect()
    objects = gc.get_objects()
    streams = [each for each in objects if isinstance(each, Stream)]
    streams += [each.stream for each in objects if isinstance(each, WriterProxy)]
    return [stream.address.vehicle for stream in streams]


@pytest.mark.parametrize("mode", ["latest", "every"])
def test_least_recently_active_key_is_evicted(
    mode: Mode, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Beyond the limit, the least recently active key is evicted and counted; losses of other keys still count."""
    monkeypatch.setattr("nedbus.limits.KEYS", 3)
    now = [0.0]
    inbox = make_queue(mode, clock=lambda: now[0])

    def receive(vehicle: str, number: int) -> int:
        now[0] += 1.0
        put(inbox, [raw(number, key=key_of(vehicle), publisher=vehicle)])
        return sum(sample.lost for sample in drain(inbox))

    for vehicle in "abcab":
        receive(vehicle, 0)
    assert not caplog.messages
    receive("d", 0)  # c is evicted
    assert [receive(vehicle, 9) for vehicle in "abd"] == [8, 8, 8]
    assert inbox.counts.forgotten == 1
    assert receive("c", 9) == 0  # a is evicted
    assert [receive(vehicle, 12) for vehicle in "bdc"] == [2, 2, 2]
    assert (inbox.counts.forgotten, inbox.counts.lost) == (2, 30)
    assert len(caplog.messages) == 1
    assert "more than 3 keys" in caplog.text


def test_key_with_an_open_gap_is_evicted_last(monkeypatch: pytest.MonkeyPatch) -> None:
    """A key with a gap is evicted, and its gap counted as lost, only if all keys have a gap."""
    monkeypatch.setattr("nedbus.limits.KEYS", 3)
    now = [0.0]
    inbox = make_queue("every", clock=lambda: now[0])
    for vehicle, numbers in [
        ("a", [0, 5]),
        ("b", [0]),
        ("c", [0, 3]),
        ("d", [0]),
        ("d", [2]),
        ("e", [0]),
    ]:
        now[0] += 1.0
        inbox.put([raw(number, key=key_of(vehicle), publisher=vehicle) for number in numbers])
    assert inbox.counts == Counts(lost=4, forgotten=2)  # b, then a
    assert [sample.vehicle for sample in drain(inbox)] == list("abcdae")
    assert len(inbox.gaps.requesting) == 2


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["latest", "every"])
def test_state_of_silent_vehicles_is_freed(mode: Mode, monkeypatch: pytest.MonkeyPatch) -> None:
    """While 2,000 vehicles come and go, eight at a time, only the state of those of the last ten minutes is kept.

    A vehicle whose messages or heartbeats still arrive is not evicted.
    """
    monkeypatch.setattr("nedbus.limits.KEPT_KEYS", 10)
    now = [0.0]
    inbox = make_queue(mode, clock=lambda: now[0])
    for number in range(2000):
        now[0] += 10.0
        put(inbox, [raw(number, key=key_of("steady"), publisher="steady")])
        inbox.on_heartbeat(key_of("silent"), name_of("silent"), 5)
        vehicles = [str(each) for each in range(max(0, number - 8), number)]
        put(inbox, [raw(number, key=key_of(each), publisher=each) for each in vehicles])
        drain(inbox)
    measured = Counter(vehicles_in_memory())
    assert {"steady", "silent", *map(str, range(1935, 1999))} <= measured.keys()
    assert len(measured) <= 72
    assert set(measured.values()) == {2}
    assert inbox.counts.forgotten == 0, "only keys beyond the limit are counted"


def test_losses_during_a_long_outage_are_counted() -> None:
    """Messages lost in an outage of an hour are counted, even if other vehicles appear during the outage."""
    now = [0.0]
    inbox = make_queue("latest", clock=lambda: now[0])
    put(inbox, [raw(0, key=key_of("7"), publisher="7")])
    for other in range(100):
        now[0] += 36.0
        put(inbox, [raw(0, key=key_of(f"v{other}"), publisher=f"v{other}")])
    put(inbox, [raw(90, key=key_of("7"), publisher="7")])
    drain(inbox)
    assert inbox.counts.lost == 89


def test_queue_wait_returns_on_sample_wake_end_or_timeout() -> None:
    """A wait ends when a sample arrives, `wake` is called, the queue ends, or the timeout expires."""
    inbox = make_queue("every")
    assert not inbox.wait(0.0)
    put(inbox, [raw(0)])
    assert inbox.wait(None)
    drain(inbox)
    inbox.wait(0.0)  # may return True because of the sample already read
    assert not inbox.wait(0.0)
    woken: list[bool] = []
    inbox.on_wake = lambda: woken.append(True)
    inbox.wake()
    assert inbox.wait(None)
    assert woken
    inbox.end()
    assert inbox.wait(None)


# Readers slower than the data


@pytest.fixture
def small_queue(monkeypatch: pytest.MonkeyPatch) -> Inbox:
    """Return a queue for mode `every` that holds 10 samples, at most 4 of them with their receive buffers."""
    monkeypatch.setattr(limits, "UNREAD_MESSAGES", 10)
    monkeypatch.setattr("nedbus.limits.BUFFERED_MESSAGES", 4)
    return make_queue("every")


def test_documented_capacity_is_that_of_the_queue() -> None:
    """A queue in mode `every` holds as many unread samples as the documentation states, and one more drops one."""
    queue = make_queue("every")
    put(queue, [raw(None)] * limits.UNREAD_MESSAGES)
    assert queue.counts.dropped == 0
    put(queue, [raw(None)])
    assert queue.counts.dropped == 1
    for page in ("docs/data.md", "CONTRIBUTING.md"):
        assert f"{limits.UNREAD_MESSAGES:,}" in (Path(__file__).parents[4] / page).read_text(), page


def test_oldest_samples_are_dropped_counted_and_logged_once(
    small_queue: Inbox, caplog: pytest.LogCaptureFixture
) -> None:
    """A full queue drops the oldest samples, which count as dropped, not as lost, and are logged once."""
    for start in range(0, 40, 10):
        assert (small_queue.counts, len(caplog.messages)) == (
            Counts(dropped=max(0, start - 10)),
            start > 10,
        )
        put(small_queue, [raw(number, timestamp=number + 1) for number in range(start, start + 10)])
    samples = drain(small_queue)
    assert [(sample.message.timestamp, sample.lost) for sample in samples] == [
        (each, 0) for each in range(31, 41)
    ]
    assert small_queue.counts == Counts(received=10, dropped=30)
    assert caplog.messages == ["queue: the reader is slower than the data, so messages are dropped"]


def test_losses_before_dropped_samples_are_reported_later(small_queue: Inbox) -> None:
    """A loss in transit is reported by a later sample of the key if the sample after the gap was dropped."""
    put(
        small_queue,
        [
            raw(0),
            raw(3),
            raw(0, key=OTHER_KEY, publisher="b"),
            raw(2, key=OTHER_KEY, publisher="b"),
            raw(5),
        ],
    )
    put(small_queue, [raw(number) for number in range(6, 15)])
    put(small_queue, [raw(3, key=OTHER_KEY, publisher="b")])
    samples = drain(small_queue)
    assert [(sample.vehicle, sample.lost) for sample in samples if sample.lost] == [
        ("1", 3),
        ("2", 1),
    ]
    assert samples[-1].vehicle == "2"
    assert small_queue.counts == Counts(received=10, lost=4, dropped=5)


def test_losses_are_reported_by_the_next_valid_sample(small_queue: Inbox) -> None:
    """Losses before dropped and invalid samples are reported by the next valid sample of the key."""
    put(small_queue, [raw(0), raw(3)])
    put(small_queue, [raw(number, payload=INVALID) for number in range(4, 13)])
    put(small_queue, [raw(13)])
    assert [sample.lost for sample in drain(small_queue)] == [2]
    assert small_queue.counts == Counts(received=1, lost=2, dropped=2, invalid=9)


def test_losses_stay_with_their_stream_after_an_invalid_batch() -> None:
    """If all messages of a batch are invalid, the next valid message of each stream reports the losses of its own."""
    inbox = make_queue("every")
    put(inbox, [raw(0), raw(0, key=OTHER_KEY, publisher="b")])
    assert len(drain(inbox)) == 2
    put(inbox, [raw(3, payload=INVALID), raw(6, key=OTHER_KEY, publisher="b", payload=INVALID)])
    assert inbox.pop_batch() is None
    put(inbox, [raw(7, key=OTHER_KEY, publisher="b"), raw(4)])
    assert {sample.vehicle: sample.lost for sample in drain(inbox)} == {"1": 2, "2": 5}
    assert inbox.counts == Counts(received=4, lost=7, invalid=2)


@pytest.mark.parametrize("in_batches", [False, True])
def test_waiting_samples_release_their_receive_buffer(small_queue: Inbox, in_batches: bool) -> None:
    """Samples deep in the queue are detached from their receive buffers, which Zenoh samples keep alive.

    Detached samples keep their sequence number, timestamp and provenance.
    """
    encodings = [encoding_of(f"source{number}", frozenset({"timestamp"})) for number in range(9)]
    arriving = [
        raw(number, stamp=STAMP if number % 2 else None, encoding=encodings[number])
        for number in range(9)
    ]
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
        sent, provenances = (
            [sample.sent or 0 for sample in samples],
            [sample.provenance for sample in samples],
        )
    assert sent == [
        STAMP.get_time_as_ntp64().as_nanos() if number % 2 else 0 for number in range(9)
    ]
    assert [(each.source, len(each.missing)) for each in provenances] == [
        (f"source{each}", 52) for each in range(9)
    ]


class Encoding(str):
    """An encoding that supports weak references."""


@pytest.mark.parametrize("mode", ["latest", "every"])
def test_key_state_keeps_no_receive_buffer(mode: Mode) -> None:
    """The state of a key stores a copy of the encoding, because a Zenoh encoding keeps its receive buffer alive."""
    inbox, encoding = make_queue(mode), Encoding(SOURCE)
    reference = weakref.ref(encoding)
    put(inbox, [raw(0, encoding=encoding)])
    del encoding
    assert [sample.source for sample in drain(inbox)] == ["sim"]
    assert reference() is None


def test_long_encodings_are_truncated(small_queue: Inbox) -> None:
    """Queued samples keep at most 512 characters of a long encoding."""
    for number in range(9):
        put(small_queue, [raw(number, encoding=SOURCE + number * 10_000 * "x")])
    encodings = [arrival.raw.encoding for arrival in small_queue._unread._every]
    assert all(len(str(encoding)) <= 512 for encoding in encodings[5:])
    assert len(drain(small_queue)) == 9


def test_gaps_of_a_full_ring_count_as_dropped(caplog: pytest.LogCaptureFixture) -> None:
    """Samples displaced from Zenoh's full ring count as dropped, not as lost in transit; this is logged once.

    Gaps in later batches count as losses again.
    """
    inbox = make_queue("every")
    put(inbox, [raw(0), raw(1)])
    put(inbox, [raw(50), raw(51), raw(60)], overflowed=True)
    put(inbox, [raw(100)], overflowed=True)
    put(inbox, [raw(101), raw(105)])
    assert [sample.lost for sample in drain(inbox)] == [0] * 7 + [3]
    assert inbox.counts == Counts(received=8, lost=3, dropped=48 + 8 + 39)
    assert len(caplog.messages) == 1


# Batches


def take_batch(inbox: Inbox) -> Batch:
    batch = inbox.pop_batch()
    assert batch is not None
    return batch


ATTITUDE = Payload(encode(VehicleAttitude(timestamp=7, q=(1.0, 0.0, 0.0, 0.0))))


UNDEFINED = f"application/msgpack;px4_msgs/FooBar;hash={'0' * 32}"


def undefined(
    payload: bytes = VALID, *, number: int | None = None, publisher: str = "a"
) -> RawSample:
    """Return a sample of a message whose definition no publisher has."""
    return raw(
        number,
        key="nedbus/1/foo_bar",
        payload=Payload(payload),
        encoding=UNDEFINED,
        publisher=publisher,
    )


def test_messages_left_by_a_batch_are_read_next() -> None:
    """A batch has messages of one type; the others stay queued and can be read as samples or batches."""
    for take in (timestamps, lambda inbox: take_batch(inbox).messages["timestamp"].tolist()):
        inbox = make_queue("every")
        put(inbox, [raw(0), raw(None, key="nedbus/1/vehicle_attitude", payload=ATTITUDE)])
        assert len(take_batch(inbox)) == 1
        assert inbox.waiting == 1
        assert inbox.wait(0.0)
        assert take(inbox) == [7]


def test_batch_skips_messages_without_a_definition() -> None:
    """Messages without a definition are invalid, and do not delay a batch of valid ones."""
    for payload in (VALID, VALID[:-1]):
        inbox = make_queue("every")
        put(inbox, [undefined(payload), raw(0)])
        assert take_batch(inbox).sequence.tolist() == [0]
        assert inbox.pop_batch() is None
        assert inbox.counts == Counts(received=1, invalid=1)


class LateLookup(LayoutLookup):
    """A lookup whose answer arrives just after a reader has stopped waiting for it."""

    def __init__(self, definition: Definition[Any]) -> None:
        super().__init__(lambda _: {})
        self.waits, self._definition = 0, definition

    def codec(self, *_: object, wait: bool = False, **__: object) -> Codec[Any] | None:
        self.waits += wait
        return codec_of(self._definition) if self.waits > wait else None


@pytest.mark.parametrize("rows", [False, True])
def test_message_without_an_available_definition_is_invalid(
    rows: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """A reader skips a message of an unknown definition; it counts as invalid, and the log has the reason."""
    inbox = make_queue("every")
    put(inbox, [undefined(number=0), raw(0)])
    read = inbox.pop(rows=rows)
    assert read is not None
    assert read.topic == "vehicle_local_position"
    assert inbox.pop(rows=rows) is None
    assert inbox.counts == Counts(received=1, invalid=1)
    assert ["received no definition of" in text for text in caplog.messages] == [True]


def test_definition_that_arrives_while_a_batch_is_decoded_does_not_apply_to_a_part_of_it() -> None:
    """All messages of a batch get the same answer to the lookup of their definition, which is awaited once."""
    definition = nedbus.define_msg("RangeBeacon", "uint64 timestamp\nfloat32 range\n")
    payload = Payload(codec_of(definition).encode_fields({"timestamp": 1, "range": 2.5}))
    lookup = LateLookup(definition)
    inbox = Inbox("every", Decoder(lookup, prefix="nedbus"))
    encoding = provenance_encoding(definition, None)

    def put_three(first: int) -> None:
        numbers = range(first, first + 3)
        put(
            inbox,
            [
                raw(each, key="nedbus/1/range_beacon", payload=payload, encoding=encoding)
                for each in numbers
            ],
        )

    put_three(0)
    assert inbox.pop_batch() is None
    assert (lookup.waits, inbox.counts) == (1, Counts(invalid=3))
    put_three(3)
    assert take_batch(inbox).messages["range"].tolist() == [2.5] * 3


def test_definition_is_requested_again_for_another_publisher() -> None:
    """After a failed lookup, a message of another publisher starts the next one at once, of the same one later."""
    queried: list[SchemaId] = []

    def find(schema_ids: Collection[SchemaId]) -> Schemas:
        queried.extend(schema_ids)
        return {}

    lookup = LayoutLookup(find, now=lambda: 0.0)
    inbox = Inbox("every", Decoder(lookup, prefix="nedbus"))
    for publisher, count in (("a", 1), ("a", 1), ("b", 2)):
        inbox.put([undefined(number=0, publisher=publisher)])
        lookup.wait()
        assert len(queried) == count


@pytest.mark.parametrize("form", ["sample", "batch"])
def test_samples_are_queued_while_a_reader_waits_for_a_lookup(timings: Timings, form: str) -> None:
    """While a reader waits for a definition, arriving samples are queued without delay, and its own does not count."""
    timings.definition_timeout = DEADLINE
    queried, answered = threading.Event(), threading.Event()

    def find(_: Collection[SchemaId]) -> Schemas:
        queried.set()
        answered.wait(DEADLINE)
        return {}

    inbox = Inbox("every", Decoder(LayoutLookup(find), prefix="nedbus"))
    inbox.put([undefined()])
    reader = threading.Thread(target=inbox.pop if form == "sample" else inbox.pop_batch)
    reader.start()
    assert queried.wait(DEADLINE)
    wait_for(lambda: inbox.waiting == 0, what="the reader")
    assert inbox.counts == Counts()
    inbox.put([raw(0)])
    assert not answered.is_set()
    assert reader.is_alive()
    answered.set()
    reader.join(DEADLINE)


def test_batch_in_mode_latest_reports_losses_before_superseded_samples() -> None:
    """In mode `latest` a batch has one message per key, and reports all losses before that message."""
    inbox = make_queue("latest")
    put(inbox, [raw(0), raw(3), raw(4)])
    batch = take_batch(inbox)
    assert (batch.sequence.tolist(), batch.lost) == ([4], 2)
    assert inbox.counts == Counts(received=1, lost=2, dropped=2)


def test_loss_is_reported_by_the_batch_after_the_gap() -> None:
    """Messages that do not fit into a full batch are left for the next one, which reports the losses before them."""
    inbox = make_queue("every")
    put(inbox, [raw(number) for number in range(5000) if number not in {4500, 4501}])
    first, second = take_batch(inbox), take_batch(inbox)
    assert (len(first), len(second)) == (4096, 902)
    assert (first.lost, second.lost) == (0, 2)


def test_samples_and_batches_report_each_loss_once() -> None:
    """If a subscription is read alternately as samples and as batches, each loss is reported once."""
    inbox = make_queue("every")
    put(inbox, [raw(0), raw(5)])
    assert sum(sample.lost for sample in drain(inbox)) == 4
    put(inbox, [raw(6), raw(9)])
    assert take_batch(inbox).lost == 2
    put(inbox, [raw(11)])
    assert [sample.lost for sample in drain(inbox)] == [1]
    put(inbox, [raw(12)])
    assert take_batch(inbox).lost == 0


def test_superseded_messages_free_their_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """In mode `latest`, only the newest message of a key counts towards the limit of bytes."""
    monkeypatch.setattr(limits, "UNREAD_BYTES", 5 * len(VALID) // 2)
    inbox = make_queue("latest")
    for number in range(3):
        put(inbox, [raw(number, timestamp=number + 1)])
    assert timestamps(inbox) == [3]
    assert inbox.counts == Counts(received=1, dropped=2)


@pytest.mark.parametrize(
    ("back", "is_late"), [(1, True), (1000, True), (65_536, True), (65_537, False)]
)
def test_step_back_by_more_than_65_536_numbers_is_a_restart(back: int, *, is_late: bool) -> None:
    """A message up to 65,536 numbers back is late, and discarded; beyond that, its publisher has restarted."""
    inbox = make_queue("every")
    put(inbox, [raw(100_000), raw(100_001 - back)])
    assert inbox.counts.discarded == is_late
    assert len(drain(inbox)) == 2 - is_late
