"""The receive queue: what a reader gets, in which order, and what is counted; with samples made by hand."""

from __future__ import annotations

import threading
import tracemalloc
from collections.abc import Sequence

import msgpack
import pytest

import nedbus
from nedbus import Counts, Mode
from nedbus.client.layout_lookup import LayoutLookup
from nedbus.transport import RawSample
from tests.waits import DEADLINE

from .raw_samples import INVALID, OTHER_KEY, drain, junk, make_queue, miss, raw, timestamps


@pytest.mark.parametrize(
    ("mode", "announced", "arriving", "told", "counts"),
    [
        ("every", 0, [raw(1), raw(5)], [0, 0, 3], Counts(received=3, lost=3)),
        ("every", 0, [raw(3, payload=INVALID), raw(4)], [0, 2], Counts(received=2, lost=2, invalid=1)),
        ("latest", 2, [raw(3), raw(4)], [2], Counts(received=1, lost=2, dropped=2)),
    ],
)
def test_loss_is_told_by_the_next_sample_that_is_read(
    mode: Mode, announced: int, arriving: list[RawSample], told: list[int], counts: Counts
) -> None:
    """Behind a gap, announced or not; an invalid sample takes no loss with it, nor one that is superseded."""
    receive_queue = make_queue(mode)
    receive_queue.put([raw(0)])
    if announced:
        receive_queue.announce_loss(miss(announced))
    receive_queue.put(arriving)
    assert [sample.lost for sample in drain(receive_queue)] == told
    assert receive_queue.counts == counts


def test_gap_within_a_settled_stream_is_told_by_the_sample_behind_it() -> None:
    """Many samples of one stream are looked at together only while none is absent."""
    receive_queue = make_queue("every")
    for start in range(0, 2000, 50):
        receive_queue.put([raw(number) for number in range(start, start + 50)])
    assert not any(sample.lost for sample in drain(receive_queue))
    receive_queue.put([raw(number) for number in range(2000, 2050) if number not in {2020, 2021, 2049}])
    assert [sample.lost for sample in drain(receive_queue)] == [0] * 20 + [2] + [0] * 26
    receive_queue.put([raw(number) for number in range(2050, 2100)])
    assert [sample.lost for sample in drain(receive_queue)] == [1] + [0] * 49
    assert receive_queue.counts == Counts(received=2097, lost=3)


def test_latest_gives_the_newest_of_each_key(caplog: pytest.LogCaptureFixture) -> None:
    """A newer sample of a key takes the place of the one that waits, which is counted as dropped, and is no warning."""
    receive_queue = make_queue("latest")
    receive_queue.put([raw(0, key=OTHER_KEY, publisher="b"), *(raw(each, timestamp=each) for each in range(1, 1001))])
    assert receive_queue.counts == Counts(dropped=999)
    assert [(each.vehicle, each.message.timestamp) for each in drain(receive_queue)] == [("2", 1), ("1", 1000)]
    assert receive_queue.counts == Counts(received=2, dropped=999)
    assert not caplog.messages


def test_invalid_samples_are_counted_and_logged_once_for_each_key(caplog: pytest.LogCaptureFixture) -> None:
    """Whatever arrives, the good samples come through, and a flood of junk writes one line.

    What has not the size of our payloads is decoded before it may take the place of a valid sample.
    """
    latest = make_queue("latest")
    latest.put([raw(0, timestamp=5), junk(b"junk")])
    assert timestamps(latest) == [5]
    caplog.clear()
    receive_queue = make_queue("every")
    wrong_key = raw(None, key="nedbus/*/vehicle_local_position")
    receive_queue.put([junk(b"junk"), junk(b""), junk(bytes(5000)), wrong_key, raw(None, timestamp=7)])
    assert timestamps(receive_queue) == [7]
    assert receive_queue.counts == Counts(received=1, invalid=4)
    assert len(caplog.messages) == 2


def test_keys_that_a_peer_invents_fill_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is known of a key is kept for 10,000 of them, here 10; messages on others come all the same."""
    monkeypatch.setattr("nedbus.client.decoder.MAX_KEYS", 10)
    receive_queue = make_queue("every")
    tracemalloc.start()
    for number in range(2000):
        receive_queue.put([raw(None, key=f"nedbus/{number}/vehicle_local_position")])
        assert len(drain(receive_queue)) == 1
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 100_000


def test_unexplained_layouts_are_asked_for_more_and_more_rarely() -> None:
    """One question for all, not for every message, and not only once: their publishers may come later."""
    now, asked, payloads = 0.0, list[float](), [msgpack.packb([layout, 1, 2]) for layout in range(9, 40)]

    def find() -> dict[int, Sequence[str]]:
        asked.append(now)
        return {}

    lookup = LayoutLookup(find, now=lambda: now)
    while now < 250.0:
        lookup.learn(payloads)
        now += 0.5
    assert asked == [0.0, 2.0, 7.0, 17.0, 47.0, 107.0, 167.0, 227.0]


def test_only_layouts_that_are_needed_are_remembered() -> None:
    """An answer may explain thousands: what nobody sends does not keep a layout out that somebody does."""
    known = dict.fromkeys(range(9, 2000), ("timestamp", "x"))
    lookup = LayoutLookup(lambda: known)
    for layout in range(1500, 1520):
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


def test_wait_ends_with_data_when_it_is_woken_with_the_queue_or_with_its_timeout() -> None:
    """Whoever received in another thread lets the reader look again, whether there is something or not."""
    receive_queue = make_queue("every")
    assert not receive_queue.wait(0.0)
    receive_queue.put([raw(0)])
    assert receive_queue.wait(None)
    drain(receive_queue)
    assert not receive_queue.wait(0.0)
    woken: list[bool] = []
    receive_queue.wakeups.callback = lambda: woken.append(True)
    receive_queue.wakeups.wake()
    assert receive_queue.wait(None)
    assert woken
    receive_queue.end()
    assert receive_queue.wait(None)
