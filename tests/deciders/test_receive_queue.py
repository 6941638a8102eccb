"""The receive queue: what a reader gets, in which order, and what is counted; with samples made by hand."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import cast

import msgpack
import pytest

import nedbus
from nedbus import Counts, Mode
from nedbus.client.layout_lookup import LayoutLookup
from nedbus_msgs import decode_row, encoding_of
from tests.conftest import DEADLINE, wait_for

from .raw_samples import INVALID, OTHER_KEY, drain, junk, make_queue, miss, raw, timestamps


def test_every_gives_all_in_order_with_their_losses() -> None:
    """Each sample once, in the order of its arrival; a gap in the sequence is told by the sample behind it."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(0), raw(1), raw(5)])
    assert [sample.lost for sample in drain(receive_queue)] == [0, 0, 3]
    assert receive_queue.counts == Counts(received=3, lost=3)


def test_gap_within_a_settled_stream_is_told_by_the_sample_behind_it() -> None:
    """Many samples of one stream are looked at together only while none is absent."""
    receive_queue = make_queue("every")
    for start in range(0, 5000, 50):
        receive_queue.put([raw(number) for number in range(start, start + 50)])
    assert not any(sample.lost for sample in drain(receive_queue))
    receive_queue.put([raw(number) for number in range(5000, 5050) if number not in {5020, 5021, 5049}])
    assert [sample.lost for sample in drain(receive_queue)] == [0] * 20 + [2] + [0] * 26
    receive_queue.put([raw(number) for number in range(5050, 5100)])
    assert [sample.lost for sample in drain(receive_queue)] == [1] + [0] * 49
    assert receive_queue.counts == Counts(received=5097, lost=3)


def test_latest_gives_the_newest_of_each_key() -> None:
    """A newer sample of a key takes the place of the one that waits, which is counted as dropped."""
    receive_queue = make_queue("latest")
    other = raw(0, key=OTHER_KEY, publisher="b")
    receive_queue.put([raw(0, timestamp=1), other, raw(1, timestamp=2), raw(2, timestamp=3)])
    assert [(sample.vehicle, sample.message.timestamp) for sample in drain(receive_queue)] == [("1", 3), ("2", 1)]
    assert receive_queue.counts == Counts(received=2, dropped=2)


def test_latest_keeps_the_losses_of_what_it_supersedes() -> None:
    """What was lost before a sample that nobody read is told by the one that is read."""
    receive_queue = make_queue("latest")
    receive_queue.put([raw(0)])
    receive_queue.announce_loss(miss(2))
    receive_queue.put([raw(3), raw(4)])
    [sample] = drain(receive_queue)
    assert sample.lost == 2
    assert receive_queue.counts == Counts(received=1, lost=2, dropped=2)


def test_latest_that_is_never_read_takes_up_the_memory_of_one_sample(caplog: pytest.LogCaptureFixture) -> None:
    """A reader of the newest messages that reads nothing harms nobody, and that is no warning."""
    receive_queue = make_queue("latest")
    receive_queue.put([raw(number) for number in range(10_000)])
    assert receive_queue.counts.dropped == 9_999
    assert len(drain(receive_queue)) == 1
    assert not caplog.messages


def test_loss_before_an_invalid_sample_is_told_by_the_next() -> None:
    """An invalid sample takes no loss with it."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(0), raw(3, payload=INVALID), raw(4)])
    assert [sample.lost for sample in drain(receive_queue)] == [0, 2]
    assert receive_queue.counts == Counts(received=2, lost=2, invalid=1)


def test_invalid_samples_are_counted_and_logged_once_for_each_key(caplog: pytest.LogCaptureFixture) -> None:
    """Whatever arrives, the good samples come through, and a flood of junk writes one line."""
    receive_queue = make_queue("every")
    wrong_key = raw(None, key="nedbus/*/vehicle_local_position")
    receive_queue.put([junk(b"junk"), junk(b""), junk(bytes(5000)), wrong_key, raw(None, timestamp=7)])
    assert timestamps(receive_queue) == [7]
    assert receive_queue.counts == Counts(received=1, invalid=4)
    assert len(caplog.messages) == 2


def test_junk_does_not_supersede_a_valid_sample() -> None:
    """What has not the size of our payloads is decoded before it may take a place."""
    receive_queue = make_queue("latest")
    receive_queue.put([raw(0, timestamp=5), junk(b"junk")])
    assert timestamps(receive_queue) == [5]


def test_unknown_layout_is_looked_up() -> None:
    """A layout that a publisher explains is read by name, from its answer on."""
    receive_queue = make_queue("every", layouts={9: ("timestamp", "brand_new", "x")})
    payloads = [msgpack.packb([layout, 4, True, 2.5]) for layout in (9, 8)]

    def put() -> int:
        receive_queue.put(list(map(junk, payloads)))
        return receive_queue.waiting

    wait_for(put, what="the answer")
    sample = drain(receive_queue)[0]
    assert (sample.message.timestamp, sample.message.x) == (4, 2.5)
    assert receive_queue.counts.invalid >= 2


def test_unexplained_layouts_are_asked_for_more_and_more_rarely() -> None:
    """One question for all, not for every message, and not only once: their publishers may come later."""
    now, asked = 0.0, list[float]()

    def find() -> dict[int, Sequence[str]]:
        asked.append(now)
        return {}

    lookup = LayoutLookup(find, now=lambda: now)
    while now < 250.0:
        lookup.learn(msgpack.packb([layout, 1, 2]) for layout in range(9, 200))
        now += 0.5
    assert asked == [0.0, 2.0, 7.0, 17.0, 47.0, 107.0, 167.0, 227.0]


def test_only_layouts_that_are_needed_are_remembered() -> None:
    """An answer may explain thousands: what nobody sends does not keep a layout out that somebody does."""
    known = dict.fromkeys(range(9, 2000), ("timestamp", "x"))
    lookup = LayoutLookup(lambda: known)
    for layout in range(1500, 1600):
        lookup.learn([msgpack.packb([layout, 1, 2.0])])
    assert list(lookup.newer) == list(range(1500, 1516))


def test_names_that_a_publisher_made_up_are_cut_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    """A layout with a name of 100,000 characters is one short line."""
    LayoutLookup(lambda: {1500: ["timestamp", 100_000 * "x"]}).learn([msgpack.packb([1500, 1, 2])])
    [line] = caplog.messages
    assert line.startswith("layout 1500 is newer than this reader; not read: xxx")
    assert len(line) < 1000


def test_answer_is_not_waited_for_by_the_thread_that_receives() -> None:
    """A peer that never answers holds up nobody; the lookup is closed all the same."""
    answering = threading.Event()

    def find() -> dict[int, Sequence[str]]:
        answering.wait(DEADLINE)
        return {9: ("timestamp", "x")}

    lookup = LayoutLookup(find)
    with pytest.raises(nedbus.UnknownLayoutError):
        lookup.check(msgpack.packb([9, 1, 2.0]))
    assert not lookup.newer
    answering.set()
    lookup.close()
    lookup.check(msgpack.packb([9, 1, 2.0]))


def test_provenance_is_that_of_each_sample() -> None:
    """The encoding of a stream may change at any sample: a source that has a field from now on."""
    receive_queue = make_queue("every")
    full, ulog = encoding_of("sim"), encoding_of("ulog", frozenset({"timestamp", "x"}))
    receive_queue.put([raw(number, encoding=each) for number, each in enumerate([full, full, ulog, full, ulog])])
    samples = drain(receive_queue)
    assert [sample.source for sample in samples] == ["sim", "sim", "ulog", "sim", "ulog"]
    assert [len(sample.missing) for sample in samples] == [0, 0, 51, 0, 51]


def test_rows_and_messages_come_from_one_queue() -> None:
    """A reader may change its form at any time."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(0, timestamp=1), raw(1, timestamp=2)])
    row = receive_queue.pop(decode_row)
    assert row is not None
    assert isinstance(row.message, nedbus.Row)
    assert timestamps(receive_queue) == [2]


def test_wait_ends_with_data_with_the_queue_or_with_its_timeout() -> None:
    """Three ends of a wait, told apart."""
    receive_queue = make_queue("every")
    assert not receive_queue.wait(0.0)
    receive_queue.put([raw(0)])
    assert receive_queue.wait(None)
    drain(receive_queue)
    assert not receive_queue.wait(0.0)
    receive_queue.end()
    assert receive_queue.wait(None)


def test_wait_ends_when_it_is_woken() -> None:
    """Whoever received in another thread lets the reader look again, whether there is something or not."""
    receive_queue = make_queue("every")
    woken = []
    receive_queue.wakeups.callback = lambda: woken.append(True)
    receive_queue.wakeups.wake()
    assert receive_queue.wait(None)
    assert woken


def test_unknown_mode_is_an_error() -> None:
    """A typo in the mode must not become another mode."""
    with pytest.raises(nedbus.AddressError, match="expected one of latest, every"):
        make_queue(cast("Mode", "newest"))
