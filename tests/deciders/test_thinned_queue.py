"""The queue of a reader with a maximum rate: what is left out, and that it is neither lost nor dropped."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from nedbus import Counts, Mode
from nedbus.client.decoder import Decoder
from nedbus.client.layout_lookup import LayoutLookup
from nedbus.client.publisher_sequence import Hole
from nedbus.client.thinned_queue import ThinnedQueue
from nedbus.client.unthinned import PATIENCE, Unthinned
from nedbus.transport import RawSample

from .raw_samples import KEY, OTHER_KEY, drain, miss, name_of, raw, timestamps

THINNED = f"{KEY}/@rate/5"


def make_queue(mode: Mode = "every", *, max_rate: float = 5) -> ThinnedQueue:
    """Return an empty queue."""
    return ThinnedQueue(mode, Decoder(LayoutLookup(dict), prefix="nedbus"), max_rate=max_rate, name="queue")


def at(
    sent: float, number: int | None, *, key: str = THINNED, timestamp: int | None = None, publisher: str = "a"
) -> RawSample:
    """Return a sample that was sent at this second; its message's timestamp is that, in milliseconds."""
    stamp = SimpleNamespace(get_time_as_ntp64=lambda: SimpleNamespace(as_nanos=lambda: round(sent * 1e9)))
    timestamp = round(sent * 1000) if timestamp is None else timestamp
    return raw(number, timestamp=timestamp, key=key, publisher=publisher, stamp=stamp)


def test_thinned_stream_passes_whole() -> None:
    """What the publisher has thinned is not thinned again, whatever the jitter of its timestamps."""
    queue = make_queue()
    queue.put([at(sent, number) for number, sent in enumerate([1.0, 1.19, 1.41, 1.6, 1.79])])
    assert timestamps(queue) == [1000, 1190, 1410, 1600, 1790]
    assert queue.counts == Counts(received=5)
    assert queue.heard == {KEY}


def test_gap_of_a_thinned_stream_is_lost() -> None:
    """Its sequence numbers are its own: what is absent of them is counted to the message, announced or not."""
    queue = make_queue()
    queue.put([at(1.0, 0), at(1.2, 1), at(1.8, 4)])
    queue.announce_loss(miss(3))
    queue.put([at(2.6, 8)])
    assert [sample.lost for sample in drain(queue)] == [0, 0, 2, 3]
    assert queue.counts == Counts(received=4, lost=5)


def test_whole_stream_begins_with_now_after_a_break() -> None:
    """A reader turns to it when nobody sends it thinned: what its publisher keeps would take it back in time."""
    queue = make_queue()
    holes: list[Hole] = []
    queue.recover(holes.append)
    queue.unsettled_until = math.inf
    queue.put([at(1.0, 50, key=KEY)])
    queue.beat(OTHER_KEY, name_of("b"), 70, begins=False)
    assert not holes
    assert timestamps(queue) == [1000]
    queue.put([at(2.0, 7, key=f"{OTHER_KEY}/@rate/5", publisher="c")])
    assert [(hole.stream, hole.start, hole.stop) for hole in holes] == [(f"{OTHER_KEY}/@rate/5", 0, 7)]


@pytest.mark.parametrize("mode", ["latest", "every"])
def test_rest_is_thinned_here(mode: Mode) -> None:
    """Below the least step each second message is left out; a gap before it is reported with the next one."""
    queue = make_queue(mode, max_rate=0.5)
    assert queue.rate == 1
    taken = []
    for number in (0, 1, 2, 4, 5, 6, 7, 8):
        queue.put([at(10.0 + number, number, key=f"{KEY}/@rate/1")])
        taken += [(sample.message.timestamp, sample.lost) for sample in drain(queue)]
    assert taken == [(10_000, 0), (12_000, 0), (14_000, 1), (16_000, 0), (18_000, 0)]
    assert queue.counts == Counts(received=5, lost=1)
    queue.put([at(19.0, 10, key=f"{KEY}/@rate/1"), at(20.0, 11, key=f"{KEY}/@rate/1")])
    assert [sample.lost for sample in drain(queue)] == [1]


def test_whole_stream_is_thinned_here() -> None:
    """Of 100 Hz that nobody thins 5 Hz are queued; what is left out is not lost, and what is lost is."""
    queue = make_queue()
    queue.put([at(number / 100, number, key=KEY) for number in range(1000) if number != 505])
    assert timestamps(queue) == list(range(0, 10_000, 200))
    assert queue.counts == Counts(received=50, lost=1)
    assert not queue.heard


def test_last_message_comes_once() -> None:
    """It is the first if nothing else is; what it has overtaken, itself included, is left out then."""
    queue = make_queue()
    queue.put_last([at(10.0, None, key=KEY)])
    queue.put([at(9.8, 7), at(10.0, 8), at(10.2, 9)])
    queue.put_last([at(10.3, None, key=KEY)])
    assert timestamps(queue) == [10_000, 10_200]
    assert queue.counts == Counts(received=2)


def test_restart_with_an_earlier_clock_passes() -> None:
    """A vehicle that restarts before its clock is set is heard at once, thinned or whole."""
    for key in (THINNED, KEY):
        queue = make_queue()
        queue.put_last([at(1000.0, None, key=KEY)])
        queue.put([at(5.0, 0, key=key), at(5.2, 1, key=key)])
        assert timestamps(queue) == [1_000_000, 5000, 5200]


def test_message_without_a_timestamp_is_thinned_by_arrival(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plain publisher need not stamp; and a clock that stands still does not silence a stream."""
    now = [100_000_000_000]
    monkeypatch.setattr("nedbus.client.thinned_queue.time", SimpleNamespace(monotonic_ns=lambda: now[0]))
    queue, standing = make_queue(), make_queue()
    for number in range(200):
        queue.put([raw(None, timestamp=number)])
        standing.put([at(50.0, number, key=KEY, timestamp=number)])
        now[0] += 10_000_000
    assert timestamps(queue) == list(range(0, 200, 20))
    assert timestamps(standing) == list(range(0, 200, 40))


def test_stream_is_read_whole_when_nobody_thins_it() -> None:
    """One that is alive for a while and not heard thinned; a publisher that returns is waited for again."""
    unthinned = Unthinned(0.0)
    unthinned.appeared("a", 0.0)
    unthinned.appeared("b", 0.0)
    assert unthinned.needed(set(), PATIENCE - 0.1) == set()
    assert unthinned.needed({"b"}, PATIENCE) == {"a"}
    assert unthinned.needed({"a", "b"}, PATIENCE) == set()
    unthinned.gone("a", 10.0)
    assert unthinned.needed({"b"}, 20.0) == set()
    unthinned.appeared("a", 20.0)
    assert unthinned.needed({"b"}, 20.0) == set()
    assert unthinned.needed({"b"}, 20.0 + PATIENCE) == {"a"}


def test_only_stream_needs_no_token() -> None:
    """Who asks for one stream alone reads it whole when nothing comes, as a plain publisher has no token."""
    unthinned = Unthinned(0.0, always="a")
    assert unthinned.needed(set(), PATIENCE) == {"a"}
    unthinned.gone("a", 5.0)
    assert unthinned.needed(set(), 5.0) == set()
    assert unthinned.needed(set(), 5.0 + PATIENCE) == {"a"}
