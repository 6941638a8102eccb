"""The queue of a reader with a maximum rate: omitted messages count as neither lost nor dropped."""

from __future__ import annotations

import math
from itertools import accumulate, combinations_with_replacement, pairwise
from types import SimpleNamespace

import hypothesis.strategies as st
import pytest
from hypothesis import given

from nedbus import Counts, Mode
from nedbus.client.rate_gate import RATES, RateGate, rate_step
from nedbus.client.receiving import Decoder, Inbox, LayoutLookup, Throttle
from nedbus.errors import ArgumentError
from nedbus.transport import RawSample
from nedbus_msgs import Address, Selection, check_max_rate

from .raw_samples import KEY, drain, put, raw, timestamps

DOWNSAMPLED = f"{KEY}/@rate/5"


def make_queue(mode: Mode = "every", *, max_rate: float = 5) -> Inbox:
    """Return an empty queue."""
    throttle = Throttle(max_rate, Selection(), prefix="nedbus")
    decoder = Decoder(LayoutLookup(lambda _: {}), prefix="nedbus")
    return Inbox(mode, decoder, key_exprs=throttle.key_exprs, throttle=throttle)


class Clock:
    """A fake monotonic clock."""

    now = 0

    def monotonic_ns(self) -> int:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Use a fake clock for downsampling."""
    clock = Clock()
    monkeypatch.setattr("nedbus.client.receiving.throttle.time", clock)
    return clock


def at(
    sent: float,
    number: int | None,
    *,
    key: str = DOWNSAMPLED,
    timestamp: int | None = None,
    publisher: str = "a",
) -> RawSample:
    """Return a sample sent at the time `sent` [s]; the timestamp of its message is that time in milliseconds."""
    stamp = SimpleNamespace(
        get_time_as_ntp64=lambda: SimpleNamespace(as_nanos=lambda: round(sent * 1e9))
    )
    timestamp = round(sent * 1000) if timestamp is None else timestamp
    return raw(number, timestamp=timestamp, key=key, publisher=publisher, stamp=stamp)


def test_downsampled_stream_passes_unchanged() -> None:
    """The reader does not downsample again what the publisher has downsampled, whatever the jitter of timestamps."""
    queue = make_queue()
    queue.put([at(sent, number) for number, sent in enumerate([1.0, 1.19, 1.41, 1.6, 1.79])])
    assert timestamps(queue) == [1000, 1190, 1410, 1600, 1790]
    assert queue.counts == Counts(received=5)
    assert queue.has_downsampled(Address.from_key(KEY))


def test_gap_in_a_downsampled_stream_counts_as_lost() -> None:
    """A gap in the sequence numbers of a downsampled stream counts as lost before the next message."""
    queue = make_queue()
    put(queue, [at(1.0, 0), at(1.2, 1), at(1.8, 4)])
    put(queue, [at(2.6, 8)])
    assert [sample.lost for sample in drain(queue)] == [0, 0, 2, 3]
    assert queue.counts == Counts(received=4, lost=5)


@pytest.mark.parametrize("mode", ["latest", "every"])
def test_reader_downsamples_below_the_lowest_rate(mode: Mode, clock: Clock) -> None:
    """At half the lowest rate the reader omits every second message; each sample reports the losses before it."""
    queue = make_queue(mode, max_rate=0.5)
    assert queue.throttle is not None
    assert queue.throttle.rate == 1
    taken = []
    for number in (0, 1, 2, 4, 5, 6, 7, 8):
        clock.now = number * 10**9
        put(queue, [at(10.0 + number, number, key=f"{KEY}/@rate/1")])
        taken += [(sample.message.timestamp, sample.lost) for sample in drain(queue)]
    assert taken == [(10_000, 0), (12_000, 0), (14_000, 1), (16_000, 0), (18_000, 0)]
    assert queue.counts == Counts(received=5, lost=1)
    clock.now += 10**9
    put(queue, [at(19.0, 10, key=f"{KEY}/@rate/1")])
    clock.now += 10**9
    put(queue, [at(20.0, 11, key=f"{KEY}/@rate/1")])
    assert [sample.lost for sample in drain(queue)] == [1]


def test_last_message_is_received_once() -> None:
    """The last message passes if it arrives first; older downsampled messages and later replies are omitted."""
    queue = make_queue()
    queue.put_last([at(10.0, None, key=KEY)])
    queue.put([at(9.8, 7), at(10.0, 8), at(10.2, 9)])
    queue.put_last([at(10.3, None, key=KEY)])
    assert timestamps(queue) == [10_000, 10_200]
    assert queue.counts == Counts(received=2)


def test_message_after_restart_with_an_earlier_clock_passes() -> None:
    """After a restart with an earlier clock, the messages of a vehicle pass at once."""
    queue = make_queue()
    queue.put_last([at(1000.0, None, key=KEY)])
    queue.put([at(5.0, 0), at(5.2, 1)])
    assert timestamps(queue) == [1_000_000, 5000, 5200]


@pytest.mark.parametrize(
    ("earlier", "expected"), [(1.5, [10_000, 11_000]), (3.0, [10_000, 7_000, 11_000])]
)
def test_downsampled_message_that_the_last_one_overtook_is_omitted(
    earlier: float, expected: list[int]
) -> None:
    """The query for the last message may be 2 s ahead of the stream; an earlier message shows a clock set back."""
    queue = make_queue()
    queue.put_last([at(10.0, None, key=KEY)])
    queue.put([at(10.0 - earlier, 0), at(11.0, 1)])
    assert timestamps(queue) == expected
    assert queue.counts == Counts(received=len(expected))


def passed(rate: float, times: list[float]) -> list[float]:
    """Return the times that pass a gate [s]."""
    gate = RateGate(rate)
    return [now for now in times if gate.passes(round(1e9 * now))]


def steady(rate: float, seconds: float) -> list[float]:
    """Return the times of a steady stream [s]."""
    return [number / rate for number in range(round(rate * seconds))]


def test_steady_stream_passes_evenly() -> None:
    """A 5 Hz gate passes every 20th message of a 100 Hz stream with jitter, without drift over ten minutes."""
    times = [number / 100 + 0.002 * math.sin(number) for number in range(60_000)]
    taken = passed(5, times)
    assert len(taken) == 3_000
    assert {round(100 * (after - before)) for before, after in pairwise(taken)} == {20}


@pytest.mark.parametrize("rate", [0.3, 1, 3, 7, 30, 33, 70, 99, 100])
@pytest.mark.parametrize("source", [100.0, 103.7, 250.0])
def test_mean_rate_is_the_requested_rate(rate: float, source: float) -> None:
    """The mean rate equals the requested rate, even if the rate of the stream is not a multiple of it."""
    seconds = 10_000 / source
    assert len(passed(rate, steady(source, seconds))) == pytest.approx(seconds * rate, abs=2)


@pytest.mark.parametrize("rate", [2, 5, 10])
def test_slower_stream_passes_completely(rate: float) -> None:
    """A stream that is not faster than the rate passes completely."""
    times = steady(2, 100.0)
    assert passed(rate, times) == times


@given(st.lists(st.floats(-0.09, 0.09), min_size=50, max_size=50))
def test_jitter_omits_at_most_one_message(jitter: list[float]) -> None:
    """Of a stream at exactly the rate, with a jitter of almost half a period, at most one message is omitted."""
    times = [number / 5 + late for number, late in enumerate(jitter)]
    assert len(passed(5, times)) >= len(times) - 1


@given(st.floats(0.1, 200.0), st.lists(st.floats(0.0, 3.0), min_size=1, max_size=200))
def test_rate_gate_never_exceeds_its_limit(rate: float, steps: list[float]) -> None:
    """In any T seconds at most rate x (T + 2.5 ms) + 2 messages pass, whatever their arrival times."""
    taken = passed(rate, list(accumulate(steps, initial=1000.0)))
    for first, last in combinations_with_replacement(range(len(taken)), 2):
        assert last - first + 1 <= rate * (taken[last] - taken[first] + 0.0025) * (1 + 1e-6) + 2


def test_stream_passes_after_its_clock_was_set_back() -> None:
    """After a restart with an earlier clock the stream passes at once."""
    gate = RateGate(5)
    times = (10**18, 10**18 + 100_000_000, 5_000_000_000, 5_100_000_000, 5_200_000_000)
    assert [gate.passes(now) for now in times] == [True, False, True, False, True]


def test_rate_step_is_the_highest_up_to_max_rate() -> None:
    """The rate requested from publishers is the highest available one up to `max_rate`, or else the lowest."""
    assert [rate_step(rate) for rate in RATES] == list(RATES)
    expected = {0.1: 1, 1.9: 1, 4.99: 2, 7: 5, 30: 20, 99: 50, 1e6: 100}
    assert {max_rate: rate_step(max_rate) for max_rate in expected} == expected


@pytest.mark.parametrize("value", [0, -1, -0.0, math.nan, math.inf, "5", True, None])
def test_invalid_max_rate_raises(value: object) -> None:
    """A rate that is not a finite number above 0 raises ArgumentError, a ValueError, with the name of the argument."""
    with pytest.raises(ArgumentError, match="max_rate") as error:
        check_max_rate(value)
    assert isinstance(error.value, ValueError)
