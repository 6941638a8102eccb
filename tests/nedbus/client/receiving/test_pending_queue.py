"""The queue of samples to be read: order and counts, with hand-made samples."""

from __future__ import annotations

import gc
import threading
import time
import tracemalloc
import weakref
from collections import Counter
from collections.abc import Collection, Sequence
from contextlib import suppress

import msgpack
import pytest
import zenoh

import nedbus
from nedbus import Batch, Counts, Mode
from nedbus.client.receiving import Decoder, LayoutLookup, PendingQueue, layout_lookup
from nedbus.client.receiving import pending_queue as module
from nedbus.client.receiving.decoder import KeyState
from nedbus.client.receiving.layout_lookup import Schemas, Wanted
from nedbus.client.receiving.pending_queue import CAPACITY
from nedbus.client.receiving.writer_proxy import WriterProxy
from nedbus.timings import Timings
from nedbus.transport import RawSample
from nedbus_msgs import DEFAULT, codec_of
from nedbus_msgs.messages import VehicleAttitude
from tests.flights.local_position import encode, encoding_of
from tests.waits import DEADLINE, wait_for

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
    """A reply to the query for the last message is retained, a live message is not, whatever its congestion control."""
    pending_queue, block, drop = make_queue(mode), zenoh.CongestionControl.BLOCK, zenoh.CongestionControl.DROP
    arriving = [(4, "a", block), (5, "a", block), (6, "a", drop), (1, "b", drop), (2, "b", block)]
    seen = []
    for number, publisher, control in arriving:
        put(pending_queue, [raw(number, publisher=publisher, congestion_control=control)])
        seen += [sample.retained for sample in drain(pending_queue)]
    assert seen == [True, False, False, False, False]


@pytest.mark.parametrize(
    ("mode", "arriving", "told", "counts"),
    [
        ("every", [raw(1), raw(5)], [0, 0, 3], Counts(received=3, lost=3)),
        ("every", [raw(3, payload=INVALID), raw(4)], [0, 2], Counts(received=2, lost=2, invalid=1)),
        ("latest", [raw(3), raw(4)], [2], Counts(received=1, lost=2, dropped=2)),
    ],
)
def test_loss_is_reported_by_the_next_sample_that_is_read(
    mode: Mode, arriving: list[RawSample], told: list[int], counts: Counts
) -> None:
    """A loss is reported by the next valid sample behind the gap, also if another one is invalid or superseded."""
    pending_queue = make_queue(mode)
    put(pending_queue, [raw(0)])
    put(pending_queue, arriving)
    assert [sample.lost for sample in drain(pending_queue)] == told
    assert pending_queue.counts == counts


def test_gap_within_a_settled_stream_is_reported_by_the_sample_behind_it() -> None:
    """Samples of one stream are admitted as a block only if none of them is missing."""
    pending_queue = make_queue("every")
    for start in range(0, 2000, 50):
        put(pending_queue, [raw(number) for number in range(start, start + 50)])
    assert not any(sample.lost for sample in drain(pending_queue))
    put(pending_queue, [raw(number) for number in range(2000, 2050) if number not in {2020, 2021, 2049}])
    assert [sample.lost for sample in drain(pending_queue)] == [0] * 20 + [2] + [0] * 26
    put(pending_queue, [raw(number) for number in range(2050, 2100)])
    assert [sample.lost for sample in drain(pending_queue)] == [1] + [0] * 49
    assert pending_queue.counts == Counts(received=2097, lost=3)


def test_latest_gives_the_newest_of_each_key(caplog: pytest.LogCaptureFixture) -> None:
    """A newer sample of a key replaces the queued one, which counts as dropped, without a warning."""
    pending_queue = make_queue("latest")
    put(pending_queue, [raw(0, key=OTHER_KEY, publisher="b"), *(raw(each, timestamp=each) for each in range(1, 1001))])
    assert pending_queue.counts == Counts(dropped=999)
    assert [(each.vehicle, each.message.timestamp) for each in drain(pending_queue)] == [("2", 1), ("1", 1000)]
    assert pending_queue.counts == Counts(received=2, dropped=999)
    assert not caplog.messages


def test_invalid_samples_are_counted_and_logged_once_for_each_key(caplog: pytest.LogCaptureFixture) -> None:
    """Valid samples arrive among any invalid ones, and a flood of invalid ones logs one line.

    A payload of another size than ours is decoded before it may replace a valid sample.
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


def test_keys_that_a_peer_invents_fill_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """The state of 10,000 keys is kept, here of 10; messages on other keys arrive all the same."""
    monkeypatch.setattr("nedbus.client.receiving.pending_queue.MAX_KEYS", 10)
    pending_queue = make_queue("every")
    tracemalloc.start()
    for number in range(2000):
        put(pending_queue, [raw(None, key=f"nedbus/{number}/vehicle_local_position")])
        assert len(drain(pending_queue)) == 1
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 100_000


def key_of(vehicle: str) -> str:
    return f"nedbus/{vehicle}/vehicle_local_position"


def remembered() -> list[str]:
    """Return the vehicle of each stream and of each publisher in memory, over all readers."""
    gc.collect()
    objects = gc.get_objects()
    streams = [each for each in objects if isinstance(each, KeyState)]
    streams += [each.stream for each in objects if isinstance(each, WriterProxy)]
    return [stream.address.vehicle for stream in streams]


@pytest.mark.parametrize("mode", ["latest", "every"])
def test_key_that_is_silent_longest_is_forgotten(
    mode: Mode, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Beyond the limit, losses of all keys but those silent longest are counted; this is logged once, and a count."""
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
    receive("d", 0)  # c is forgotten
    assert [receive(vehicle, 9) for vehicle in "abd"] == [8, 8, 8]
    assert pending_queue.counts.forgotten == 1
    assert receive("c", 9) == 0  # a is forgotten
    assert [receive(vehicle, 12) for vehicle in "bdc"] == [2, 2, 2]
    assert (pending_queue.counts.forgotten, pending_queue.counts.lost) == (2, 30)
    assert len(caplog.messages) == 1
    assert "more than 3 keys" in caplog.text


def test_key_with_an_open_gap_is_forgotten_last(monkeypatch: pytest.MonkeyPatch) -> None:
    """A gap is given up, and counted as lost, only if all keys have one."""
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
def test_state_of_departed_streams_is_freed(mode: Mode, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 2,000 vehicles that come and go, eight at a time, those of the last ten minutes are remembered.

    A vehicle of which messages or heartbeats still arrive is not forgotten.
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
    kept = Counter(remembered())
    assert {"steady", "silent", *map(str, range(1935, 1999))} <= kept.keys()
    assert len(kept) <= 72
    assert set(kept.values()) == {2}


def test_loss_of_a_long_outage_is_counted() -> None:
    """The messages of an hour without a link are lost, and counted, although other vehicles appeared meanwhile."""
    now = [0.0]
    pending_queue = make_queue("latest", clock=lambda: now[0])
    put(pending_queue, [raw(0, key=key_of("7"), publisher="7")])
    for other in range(100):
        now[0] += 36.0
        put(pending_queue, [raw(0, key=key_of(f"v{other}"), publisher=f"v{other}")])
    put(pending_queue, [raw(90, key=key_of("7"), publisher="7")])
    drain(pending_queue)
    assert pending_queue.counts.lost == 89


def learn(lookup: LayoutLookup, payloads: Sequence[bytes]) -> None:
    """Look up the unknown layouts of these samples, and wait for the replies."""
    for payload in payloads:
        with suppress(nedbus.errors.DecodeError):
            lookup.check(codec_of(DEFAULT), payload)
    lookup.wait()


def test_unexplained_layouts_are_asked_for_more_and_more_rarely() -> None:
    """One lookup serves all messages, and is repeated at growing intervals, as publishers may start later."""
    now, asked, payloads = 0.0, list[tuple[float, Wanted]](), [msgpack.packb([layout, 1, 2]) for layout in range(9, 40)]

    def find(wanted: Collection[Wanted]) -> Schemas:
        asked.extend((now, each) for each in wanted)
        return {}

    lookup = LayoutLookup(find, now=lambda: now)
    while now < 250.0:
        learn(lookup, payloads)
        now += 0.5
    assert sorted({when for when, _ in asked}) == [0.0, 0.5, 2.5, 7.5, 17.5, 47.5, 107.5, 167.5, 227.5]
    assert len(asked) == len(set(asked)) == 9 * len(payloads)


def test_only_layouts_that_are_needed_are_remembered() -> None:
    """A reply may describe thousands of layouts: those not in use do not displace one that is."""
    fields = {"timestamp": "uint64", "x": "float32"}
    known: Schemas = {("VehicleLocalPosition", number): fields for number in range(9, 2000)}
    lookup = LayoutLookup(lambda _: known)
    for layout in range(1500, 1520):
        learn(lookup, [msgpack.packb([layout, 1, 2.0])])
    assert list(lookup.newer(DEFAULT)) == list(range(1500, 1516))


def test_names_that_a_publisher_made_up_are_cut_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    """A layout with a name of 100,000 characters is logged as one short line."""
    known: Schemas = {("VehicleLocalPosition", 1500): {"timestamp": "uint64", 100_000 * "x": "float32"}}
    learn(LayoutLookup(lambda _: known), [msgpack.packb([1500, 1, 2])])
    [line] = caplog.messages
    assert line.startswith("layout 1500 of VehicleLocalPosition is newer than this reader; not read: xxx")
    assert len(line) < 1000


def test_answer_is_not_waited_for_by_the_thread_that_receives() -> None:
    """The receiving thread does not wait for a peer that never replies, and neither does closing the lookup."""
    asked, answering = threading.Event(), threading.Event()

    def find(_: Collection[Wanted]) -> Schemas:
        asked.set()
        answering.wait(DEADLINE)
        return {("VehicleLocalPosition", 9): {"timestamp": "uint64", "x": "float32"}}

    lookup = LayoutLookup(find)
    with pytest.raises(nedbus.errors.UnknownLayoutError):
        lookup.check(codec_of(DEFAULT), msgpack.packb([9, 1, 2.0]))
    assert asked.wait(DEADLINE)
    assert not lookup.newer(DEFAULT)
    answering.set()
    lookup.close()
    lookup.check(codec_of(DEFAULT), msgpack.packb([9, 1, 2.0]))


def test_what_arrives_while_a_question_is_open_is_asked_for_next() -> None:
    """A reader waits for the replies to both lookups: the second message is not rejected for arriving a moment later.

    Layouts described by the first reply are not looked up again, although more of their messages arrived.
    """
    answering, asked = threading.Event(), list[set[Wanted]]()

    def find(wanted: Collection[Wanted]) -> Schemas:
        asked.append(set(wanted))
        answering.wait(DEADLINE)
        return {each: {"timestamp": "uint64", "x": "float32"} for each in wanted}

    lookup = LayoutLookup(find)
    for name in ("First", "First", "Second"):
        assert lookup.codec(name, "hash") is None
        wait_for(lambda: asked, what="the first lookup")
    answering.set()
    found = [lookup.codec(name, "hash", wait=True) for name in ("First", "Second")]
    assert [codec.definition.name for codec in found if codec] == ["First", "Second"]
    assert asked == [{("First", "hash")}, {("Second", "hash")}]


def test_unanswered_lookups_delay_readers_little() -> None:
    """A peer that names ever new definitions and describes none makes readers wait for 3 s, then a tenth of the time.

    What others describe is found all the same, and what is remembered of the failed ones is bounded.
    """

    def find(wanted: Collection[Wanted]) -> Schemas:
        return {each: {"timestamp": "uint64"} for each in wanted if each[0] == "Honest"}

    lookup = LayoutLookup(find)
    lookup._patience, lookup._waited = 0.0, time.monotonic()  # as after 3 s in vain
    start = time.monotonic()
    for number in range(5000):
        assert lookup.codec("Evil", str(number), wait=True) is None
    assert len(lookup._open) <= 2 * layout_lookup._MAX_UNKNOWN
    assert len(lookup._failed) <= layout_lookup._MAX_FAILED
    assert start <= lookup._waited <= time.monotonic()
    wait_for(lambda: lookup.codec("Honest", "hash"), what="the definition")
    lookup.close()


def test_definitions_that_peers_make_up_fill_no_memory(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The fields of all definitions are bounded; those in use stay, and further ones are refused, which is logged once.

    Once those that peers made up are out of use, the least recently used ones make room.
    """
    now = 0.0
    monkeypatch.setattr(layout_lookup, "_MAX_FIELDS", 10 * (1 + layout_lookup._BASE))
    lookup = LayoutLookup(lambda wanted: {each: {"timestamp": "uint64"} for each in wanted}, now=lambda: now)
    known = [lookup.codec("Honest", str(number), wait=True) for number in range(20)]
    assert [codec is not None for codec in known] == [True] * 10 + [False] * 10
    assert lookup.codec("Honest", "0") is known[0]
    assert caplog.text.count("too many messages without a file") == 1
    now += 3600.0
    assert lookup.codec("Honest", "0") is known[0]
    assert lookup.codec("Honest", "new", wait=True)
    assert [lookup.codec("Honest", str(number)) is known[number] for number in (0, 2)] == [True, True]
    assert len(lookup._codecs) == len(lookup._used) == 10


def test_wait_ends_with_data_when_it_is_woken_with_the_queue_or_with_its_timeout() -> None:
    """A wait ends when another thread has received, with or without a sample for this reader."""
    pending_queue = make_queue("every")
    assert not pending_queue.wait(0.0)
    put(pending_queue, [raw(0)])
    assert pending_queue.wait(None)
    drain(pending_queue)
    pending_queue.wait(0.0)  # perhaps for what was there
    assert not pending_queue.wait(0.0)
    woken: list[bool] = []
    pending_queue.on_wake = lambda: woken.append(True)
    pending_queue.wake()
    assert pending_queue.wait(None)
    assert woken
    pending_queue.end()
    assert pending_queue.wait(None)


# A reader that is slower than the data


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> PendingQueue:
    """Return a queue of mode `every` for 10 samples, 4 of which are kept without a copy."""
    monkeypatch.setattr(module, "CAPACITY", 10)
    monkeypatch.setattr(module, "_MAX_FRESH", 4)
    return make_queue("every")


def test_oldest_are_dropped_counted_and_warned_of_once(small: PendingQueue, caplog: pytest.LogCaptureFixture) -> None:
    """The reader continues with newer samples; dropped ones are counted, not as lost, and logged once."""
    assert CAPACITY == 65_536
    for start in range(0, 40, 10):
        assert (small.counts, len(caplog.messages)) == (Counts(dropped=max(0, start - 10)), start > 10)
        put(small, [raw(number, timestamp=number + 1) for number in range(start, start + 10)])
    samples = drain(small)
    assert [(sample.message.timestamp, sample.lost) for sample in samples] == [(each, 0) for each in range(31, 41)]
    assert small.counts == Counts(received=10, dropped=30)
    assert caplog.messages == ["queue: the reader is slower than the data: messages are dropped"]


def test_losses_before_dropped_samples_are_reported_by_a_later_one_of_the_key(small: PendingQueue) -> None:
    """A loss in transit is reported even if the sample behind the gap was dropped."""
    put(small, [raw(0), raw(3), raw(0, key=OTHER_KEY, publisher="b"), raw(2, key=OTHER_KEY, publisher="b"), raw(5)])
    put(small, [raw(number) for number in range(6, 15)])
    put(small, [raw(3, key=OTHER_KEY, publisher="b")])
    samples = drain(small)
    assert [(sample.vehicle, sample.lost) for sample in samples if sample.lost] == [("1", 3), ("2", 1)]
    assert samples[-1].vehicle == "2"
    assert small.counts == Counts(received=10, lost=4, dropped=5)


def test_losses_before_a_dropped_sample_survive_invalid_ones(small: PendingQueue) -> None:
    """Losses are reported by the next valid sample of the key."""
    put(small, [raw(0), raw(3)])
    put(small, [raw(number, payload=INVALID) for number in range(4, 13)])
    put(small, [raw(13)])
    assert [sample.lost for sample in drain(small)] == [2]
    assert small.counts == Counts(received=1, lost=2, dropped=2, invalid=9)


@pytest.mark.parametrize("in_batches", [False, True])
def test_samples_that_wait_are_kept_compact(small: PendingQueue, in_batches: bool) -> None:
    """A Zenoh sample keeps its receive buffer alive, so a sample deep in the queue is kept without it.

    It keeps its sequence number, timestamp and provenance.
    """
    encodings = [encoding_of(f"source{number}", frozenset({"timestamp"})) for number in range(9)]
    arriving = [raw(number, stamp=STAMP if number % 2 else None, encoding=encodings[number]) for number in range(9)]
    arrived = [weakref.ref(each) for each in arriving]
    while arriving:
        put(small, [arriving.pop(0)])
    assert [each() is None for each in arrived] == [False] * 5 + [True] * 4
    if in_batches:
        batch = small.pop_batch()
        assert batch is not None
        assert batch.sequence.tolist() == list(range(9))
        sent, provenances = batch.sent.tolist(), list(batch.provenances)
    else:
        samples = drain(small)
        sent, provenances = [sample.sent or 0 for sample in samples], [sample.provenance for sample in samples]
    assert sent == [STAMP.get_time_as_ntp64().as_nanos() if number % 2 else 0 for number in range(9)]
    assert [(each.source, len(each.missing)) for each in provenances] == [(f"source{each}", 52) for each in range(9)]


class Encoding(str):
    """An encoding that supports weak references."""


@pytest.mark.parametrize("mode", ["latest", "every"])
def test_stream_keeps_no_receive_buffer(mode: Mode) -> None:
    """The encoding of a Zenoh sample keeps its receive buffer alive, so the state of a stream has a copy of it."""
    pending_queue, encoding = make_queue(mode), Encoding(SOURCE)
    kept = weakref.ref(encoding)
    put(pending_queue, [raw(0, encoding=encoding)])
    del encoding
    assert [sample.source for sample in drain(pending_queue)] == ["sim"]
    assert kept() is None


def test_long_encodings_fill_no_memory(small: PendingQueue) -> None:
    """An encoding may be of any length: what is kept of one that waits is as long as nedbus's own."""
    for number in range(9):
        put(small, [raw(number, encoding=SOURCE + number * 10_000 * "x")])
    kept = [arrival[2].encoding for arrival in small._every]
    assert all(len(str(encoding)) <= 512 for encoding in kept[5:])
    assert len(drain(small)) == 9


def test_ring_that_was_full_dropped_what_is_absent(caplog: pytest.LogCaptureFixture) -> None:
    """Samples pushed out of Zenoh's ring count as dropped, not as lost in transit; this is logged once.

    Only samples taken from a full ring are affected: later gaps are losses again.
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


UNDESCRIBED = f"application/msgpack;px4_msgs/FooBar;hash={'0' * 32}"


def undescribed(payload: bytes = VALID) -> RawSample:
    """Return a sample of an undeclared message that no publisher describes."""
    return raw(None, key="nedbus/1/foo_bar", payload=Payload(payload), encoding=UNDESCRIBED)


def test_what_a_batch_left_is_read_next() -> None:
    """A batch has messages of one type; the others stay queued for samples, batches and acknowledgements."""
    for take in (timestamps, lambda pending_queue: take_batch(pending_queue).messages["timestamp"].tolist()):
        pending_queue = make_queue("every")
        put(pending_queue, [raw(0), raw(None, key="nedbus/1/vehicle_attitude", payload=ATTITUDE)])
        assert len(take_batch(pending_queue)) == 1
        assert pending_queue.waiting == 1
        assert pending_queue.wait(0.0)
        assert take(pending_queue) == [7]


def test_batch_goes_past_what_is_invalid() -> None:
    """A payload without a description neither delays a batch nor begins one of another type, whatever its bytes."""
    for payload in (VALID, VALID[:-1]):
        pending_queue = make_queue("every")
        put(pending_queue, [undescribed(payload), raw(0)])
        assert take_batch(pending_queue).sequence.tolist() == [0]
        assert pending_queue.pop_batch() is None
        assert pending_queue.counts == Counts(received=1, invalid=1)


def test_arrivals_do_not_wait_for_a_batch_that_asks(timings: Timings) -> None:
    """While a batch waits for the description of a message, arriving samples are queued at once."""
    timings.definition_timeout = DEADLINE
    asked, answered = threading.Event(), threading.Event()

    def find(_: Collection[Wanted]) -> Schemas:
        asked.set()
        answered.wait(DEADLINE)
        return {}

    pending_queue = PendingQueue("every", Decoder(LayoutLookup(find), prefix="nedbus"))
    pending_queue.put([undescribed()])
    reader = threading.Thread(target=pending_queue.pop_batch)
    reader.start()
    assert asked.wait(DEADLINE)
    pending_queue.put([raw(0)])
    assert not answered.is_set()
    assert reader.is_alive()
    answered.set()
    reader.join(DEADLINE)


def test_batch_of_newest_reports_losses_before_superseded_samples() -> None:
    """In mode latest a batch has one message per key, and reports all losses before it."""
    pending_queue = make_queue("latest")
    put(pending_queue, [raw(0), raw(3), raw(4)])
    batch = take_batch(pending_queue)
    assert (batch.sequence.tolist(), batch.lost) == ([4], 2)
    assert pending_queue.counts == Counts(received=1, lost=2, dropped=2)


def test_losses_come_with_the_batch_in_which_the_gap_is() -> None:
    """A full batch leaves the other messages, with their losses, to the next batch."""
    pending_queue = make_queue("every")
    put(pending_queue, [raw(number) for number in range(5000) if number not in {4500, 4501}])
    first, second = take_batch(pending_queue), take_batch(pending_queue)
    assert (len(first), len(second)) == (4096, 902)
    assert (first.lost, second.lost) == (0, 2)


def test_samples_and_batches_report_each_loss_once() -> None:
    """Samples and batches of one subscription report each loss once."""
    pending_queue = make_queue("every")
    put(pending_queue, [raw(0), raw(5)])
    assert sum(sample.lost for sample in drain(pending_queue)) == 4
    put(pending_queue, [raw(6), raw(9)])
    assert take_batch(pending_queue).lost == 2
    put(pending_queue, [raw(11)])
    assert [sample.lost for sample in drain(pending_queue)] == [1]
    put(pending_queue, [raw(12)])
    assert take_batch(pending_queue).lost == 0
