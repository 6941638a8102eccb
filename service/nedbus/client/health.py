"""Stream health: rate, jitter, latency, age, gaps, order, reboots, resets and flags, and the stream's state; no I/O.

Rates and ages use a monotonic clock, because the wall clock may be set at any time.
"""

from __future__ import annotations

import math
import threading
import time
from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise
from statistics import fmean, median
from typing import Any, Final, Literal, NamedTuple, get_args

from nedbus import clock, limits
from nedbus.clock import format_duration
from nedbus.samples import Sample
from nedbus.timings import TIMINGS
from nedbus_msgs import (
    DEFAULT,
    DOUBT_FLAGS,
    RESET_COUNTERS,
    FieldReader,
    Message,
    Quantity,
    describe_flags,
    get_topic,
)
from nedbus_msgs.text import counted

StateName = Literal["disconnected", "gone", "stale", "duplicate", "slow", "ok"]  # worst first

# us; PX4's time steps back by more in a reboot, by less if a message is out of order
_REBOOT_STEP: Final = 1_000_000
_FACTOR: Final = 3.0  # times the usual interval, after which there is a gap, or the stream is stale
_MIN_STEPS: Final = 5  # intervals before the usual one is known
# latest intervals, whose median is the usual one: half as many long ones are a lasting change
_USUAL: Final = 15
_SMOOTHING: Final = 0.05  # smoothing factor of the usual rate
_WINDOW: Final = 1_000_000_000  # ns
# messages that wait to be measured together, which takes half the time of one after the other
_BATCH: Final = 32
# Hz; below it, a topic without a nominal rate may be published on change
_MIN_PERIODIC_RATE: Final = 1.0
# share of intervals over three times or under a third of the usual one; more: on change
_IRREGULAR: Final = 0.2
_RECENT: Final = 60.0  # s after a reboot until a description no longer mentions it
# s, bucket limits
_LATENCY_BUCKETS: Final = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_LATE: Final = 1.0  # s; a higher latency makes a stream slow
_SLOW: Final = 0.5  # share of the usual rate; a lower rate makes a stream slow
ABSENT: Final = 1.0  # s without a message until a stream without a liveliness token counts as gone
# PX4's queue may hold old ones, so their timestamps reveal no reboot
_QUEUED: Final = "log_message"
# evaluated fields of a position
_FIELDS: Final = ("timestamp", *DOUBT_FLAGS, *RESET_COUNTERS.values())
_COUNTERS: Final = 1 + len(DOUBT_FLAGS)  # index of the first counter in _FIELDS


@dataclass(slots=True)  # not frozen, because a frozen one takes ten times as long to construct
class Health:
    """Health of one stream; values are None while there are too few messages to measure them.

    Over the last full second: `rate` [Hz], `jitter` (standard deviation of arrival intervals) [s], `latency` (median)
    and `latency_max` [s], and `flags`, the share of messages with each flag set, 0 to 1; unknown flags do not count.
    Since the start: `messages`, `lost` in transit, `gaps` (PX4 timestamps over three usual intervals apart),
    `out_of_order`, `reboots` (PX4's time stepped back by more than 1 s), `resets` per quantity, `flags_ever` (shares).
    `nominal`: PX4's rate of this topic [Hz], 0 if it has none; logs and links are usually slower.
    `age`: seconds since the last message.
    `usual_rate`: smoothed rate so far [Hz]; a `rate` far below it means that the stream has become slow.
    `usual_interval`: median of the latest 15 arrival intervals [s], None before the fifth.
    `on_change`: published on change only, so pauses and bursts are normal: by the topic's declaration or, if it has no
    nominal rate, because over a fifth of the latest 15 intervals differ from the usual one more than threefold.
    `reboot_age`: seconds since the last reboot, None before the first.
    For messages other than positions, `resets` is empty and flags are None.
    """

    rate: float | None
    nominal: float
    jitter: float | None
    latency: float | None
    latency_max: float | None
    age: float | None
    messages: int
    lost: int
    gaps: int
    out_of_order: int
    reboots: int
    flags: dict[str, float] | None
    flags_ever: dict[str, float] | None
    usual_rate: float | None = None
    resets: dict[Quantity, int] = field(default_factory=dict)
    on_change: bool = False
    usual_interval: float | None = None
    reboot_age: float | None = None

    @property
    def stale_after(self) -> float:
        """Seconds without a message until this stream is stale: 3 intervals, at least 3 s; infinity if it may pause."""
        return _stale_after(
            self.nominal, self.usual_rate, self.usual_interval, on_change=self.on_change
        )


def _stale_after(
    nominal: float, rate: float | None, interval: float | None, *, on_change: bool
) -> float:
    if not nominal and (on_change or (rate or 0) < _MIN_PERIODIC_RATE):
        return math.inf
    if interval is None:
        return TIMINGS.stale
    return max(TIMINGS.stale, _FACTOR * interval)


# messages by the values of all flags, None for unknown ones
_FlagCounts = Counter[tuple[bool | None, ...]]


def _flag_shares(counts: _FlagCounts) -> dict[str, float]:
    """Return the share of messages with each flag set; copy it before it is given away."""
    if len(counts) == 1:  # usual: no flag has changed
        (flags,) = counts
        return _shares_of_one(flags)
    shares = {}
    for index, flag in enumerate(DOUBT_FLAGS):
        known = sum(count for flags, count in counts.items() if flags[index] is not None)
        if known:
            shares[flag] = sum(count for flags, count in counts.items() if flags[index]) / known
    return shares


@lru_cache(maxsize=256)
def _shares_of_one(flags: tuple[bool | None, ...]) -> dict[str, float]:
    """Return the shares of messages that all have these flags."""
    pairs = zip(DOUBT_FLAGS, flags, strict=True)
    return {name: float(is_set) for name, is_set in pairs if is_set is not None}


class _Summary(NamedTuple):
    """Values of a window, as in Health; the dictionary belongs to others, so copy it before it is given away."""

    rate: float | None
    jitter: float | None
    latency: float | None
    latency_max: float | None
    flags: dict[str, float] | None


def _numbers() -> array[float]:
    """Return an empty array of doubles, which take 8 bytes each, a quarter of the floats in a deque."""
    return array("d")


def _keep_latest(numbers: array[float], count: int) -> None:
    """Remove all numbers but the latest `count`."""
    if len(numbers) > count:
        del numbers[:-count]


@dataclass(slots=True, eq=False)
class _Window:
    """Measurements of one second, or longer for a slow stream."""

    start: int
    messages: int = 0
    # number, mean [s], sum of squared differences from the mean
    intervals: tuple[int, float, float] = (0, 0.0, 0.0)
    latencies: array[float] = field(default_factory=_numbers)  # the latest ones [s]
    flags: _FlagCounts = field(default_factory=Counter)
    _summary: _Summary | None = None  # None after a new message

    def begin_batch(self, messages: int) -> None:
        """Count messages that are about to be measured."""
        self.messages += messages
        self._summary = None

    def add_intervals(self, intervals: Collection[float]) -> None:
        """Add intervals [s] by Chan's method."""
        (number, mean, squares), added = self.intervals, len(intervals)
        own = fmean(intervals)
        total = number + added
        squares += (
            sum([(interval - own) ** 2 for interval in intervals])
            + (own - mean) ** 2 * number * added / total
        )
        self.intervals = total, mean + (own - mean) * added / total, squares

    def add_latencies(self, latencies: list[float]) -> None:
        """Add latencies [s]; keep the latest ones."""
        self.latencies.fromlist(latencies)
        _keep_latest(self.latencies, limits.MEASURED_LATENCIES)

    def summary(self) -> _Summary:
        """Return the values of the messages so far."""
        if self._summary is None:
            self._summary = self._summarize()
        return self._summary

    def _summarize(self) -> _Summary:
        number, mean, squares = self.intervals
        rate = None
        jitter = None
        if mean > 0:
            rate = 1 / mean
            jitter = math.sqrt(squares / number)
        latency = None
        latency_max = None
        if self.latencies:
            latencies = sorted(self.latencies)
            latency = latencies[len(latencies) // 2]
            latency_max = latencies[-1]
        flags = None
        if self.flags:
            flags = _flag_shares(self.flags)
        return _Summary(rate, jitter, latency, latency_max, flags)


class Histogram:
    """Histogram of measurements; `limits` are the upper bounds of all buckets but the last, which is unbounded.

    `counts`: number of measurements in each bucket.
    """

    def __init__(self, limits: Sequence[float]) -> None:
        self.limits = tuple(limits)
        self.sum = 0.0
        self.counts = [0] * (len(self.limits) + 1)

    def add(self, value: float) -> None:
        """Count one measurement."""
        self.counts[bisect_left(self.limits, value)] += 1
        self.sum += value


@lru_cache(maxsize=1024)
def _topic_reader(topic: str) -> FieldReader:
    """Return the reader of the evaluated fields, which all streams of a topic share."""
    if topic in DEFAULT.topics:
        return FieldReader(_FIELDS)
    return FieldReader(_FIELDS[:1])


class StreamHealth:
    """Measure one stream, message by message, in constant memory; one thread may add while others read.

    All times are from one clock that the caller chooses; the default is `time.monotonic_ns`.
    """

    def __init__(self, topic: str) -> None:
        self._topic = get_topic(topic)
        self._is_position = topic in DEFAULT.topics  # the message that has flags and reset counters
        counters: Iterable[Quantity] = ()
        if self._is_position:
            counters = RESET_COUNTERS
        self._read = _topic_reader(topic)
        self._messages = self._lost = self._gaps = self._out_of_order = self._reboots = 0
        self._received: int | None = None
        self._time: int | None = None
        self._earlier = 0  # PX4's time before the last one
        self._steps = _numbers()  # the latest ones between two messages [us]
        self._usual_step = 0.0  # their median, updated every _USUAL messages and at a gap
        self._is_regular = True  # by these steps, updated with their median
        self._rebooted: int | None = None  # when the first message after the last reboot arrived
        self._intervals = _numbers()  # the latest ones between arrivals [s]
        self._usual_interval: float | None = None  # their median; None after a new one
        self._usual_rate: float | None = None
        self._flags: _FlagCounts = Counter()
        self._flags_ever: dict[str, float] | None = None  # their shares; None after a new message
        # counters of the last, and missing fields
        self._seen: tuple[tuple[int | None, ...], Collection[str]] = (), ()
        self._counters: dict[Quantity, int] = {}  # the last known ones
        self._resets: dict[Quantity, int] = dict.fromkeys(counters, 0)
        self._latencies = Histogram(_LATENCY_BUCKETS)
        self._window = _Window(0)
        self._last_window: _Window | None = None  # the last full one
        # at most _BATCH
        self._waiting = list[tuple[tuple[Any, ...], int, float | None, int, Collection[str]]]()
        self._window_end = _WINDOW  # of those that wait
        self._lock = threading.Lock()

    def add(
        self,
        message: object,
        *,
        received: int,
        latency: float | None = None,
        lost: int = 0,
        missing: Collection[str] = (),
    ) -> None:
        """Add a valid message, its row or a mapping of its fields; `missing` fields are unknown; `received` in ns."""
        if received >= self._window_end:
            self._measure()
            self._window_end = received + _WINDOW
        elif len(self._waiting) >= _BATCH:
            self._measure()
        self._waiting.append((self._read(message), received, latency, lost, missing))

    def _measure(self) -> None:
        """Measure the waiting messages, which are of one window."""
        with self._lock:
            self._measure_waiting()

    def _measure_waiting(self) -> None:
        """Measure them for a caller that holds the lock."""
        if not self._waiting:
            return
        waiting = self._waiting.copy()
        del self._waiting[: len(waiting)]  # others may be added meanwhile
        self._measure_all(*zip(*waiting, strict=True))

    def _measure_all(
        self,
        values: Sequence[tuple[Any, ...]],
        received: Sequence[int],
        latencies: Sequence[float | None],
        lost: Sequence[int],
        missing: Sequence[Collection[str]],
    ) -> None:
        if received[0] - self._window.start >= _WINDOW:
            self._begin_window(received[0])
        window = self._window
        window.begin_batch(len(values))
        self._lost += sum(lost)
        if self._received is None:
            times = received
        else:
            times = (self._received, *received)
        if len(times) > 1:
            intervals = [(later - earlier) / 1e9 for earlier, later in pairwise(times)]
            window.add_intervals(intervals)
            self._intervals.fromlist(intervals)
            _keep_latest(self._intervals, _USUAL)
            self._usual_interval = None
        self._received = received[-1]
        known = [latency for latency in latencies if latency is not None]
        window.add_latencies(known)
        for latency in known:
            self._latencies.add(latency)
        self._flags_ever = None
        for fields, absent, arrived in zip(values, missing, received, strict=True):
            rebooted = self._add_time(int(fields[0]), arrived)
            if self._is_position:
                self._add_position(
                    fields[1:_COUNTERS], fields[_COUNTERS:], absent, rebooted=rebooted
                )

    def _begin_window(self, received: int) -> None:
        if self._window.messages:
            self._last_window = self._window
        _, mean, _ = self._window.intervals
        if mean > 0:  # capped against bursts, such as recovered messages
            usual = self._usual_rate or 1 / mean
            self._usual_rate = usual + _SMOOTHING * (min(1 / mean, 2 * usual) - usual)
        self._window = _Window(received)

    def _add_position(
        self,
        flags: tuple[Any, ...],
        counters: tuple[Any, ...],
        missing: Collection[str],
        *,
        rebooted: bool,
    ) -> None:
        if rebooted or counters != self._seen[0] or missing != self._seen[1]:
            self._add_counters(counters, missing, rebooted=rebooted)
        if missing:
            flags = tuple(
                None if name in missing else flag
                for name, flag in zip(DOUBT_FLAGS, flags, strict=True)
            )
        self._window.flags[flags] += 1
        self._flags[flags] += 1

    @property
    def latencies(self) -> Histogram:
        """Latencies since the start [s]."""
        self._measure()
        return self._latencies

    @property
    def usual_interval(self) -> float | None:
        """As in Health."""
        with self._lock:
            self._measure_waiting()
            return self._median_interval()

    def _median_interval(self) -> float | None:
        if self._usual_interval is None and len(self._intervals) >= _MIN_STEPS:
            self._usual_interval = median(self._intervals)
        return self._usual_interval

    @property
    def stale_after(self) -> float:
        """As in Health."""
        interval = self.usual_interval
        return _stale_after(
            self._topic.rate, self._usual_rate, interval, on_change=self._is_on_change
        )

    @property
    def _is_on_change(self) -> bool:
        return self._topic.on_change or (not self._topic.rate and not self._is_regular)

    def snapshot(self, now: int | None = None) -> Health:
        """Return the health at time `now` [ns]."""
        if now is None:
            now = time.monotonic_ns()
        with self._lock:
            if self._waiting:
                self._measure_waiting()
            return self._health(now)

    def _health(self, now: int) -> Health:
        """Return the health at time `now` [ns] as measured so far."""
        window = self._last_window or self._window
        rate, jitter, latency, latency_max, flags = window.summary()
        age = None
        reboot_age = None
        if self._received is not None:
            age = (now - self._received) / 1e9
            if rate is not None and not (age < TIMINGS.stale or age < 2 / rate):
                rate = None
                jitter = None
            if self._rebooted is not None:
                reboot_age = (now - self._rebooted) / 1e9
        if self._flags_ever is None and self._flags:
            self._flags_ever = _flag_shares(self._flags)
        # in the order of the fields: names take three times as long
        return Health(
            rate,
            self._topic.rate,
            jitter,
            latency,
            latency_max,
            age,
            self._messages,
            self._lost,
            self._gaps,
            self._out_of_order,
            self._reboots,
            None if flags is None else flags.copy(),
            None if self._flags_ever is None else self._flags_ever.copy(),
            self._usual_rate,
            self._resets.copy(),
            self._is_on_change,
            self._median_interval(),
            reboot_age,
        )

    def _add_counters(
        self, counters: tuple[int | None, ...], missing: Collection[str], *, rebooted: bool
    ) -> None:
        self._seen = (counters, missing)
        known = self._counters
        if rebooted:
            known = {}  # it restarts them
        for (quantity, name), count in zip(RESET_COUNTERS.items(), counters, strict=True):
            if name not in missing and count is not None:
                self._resets[quantity] += (count - known.get(quantity, count)) % 256
                known[quantity] = count
        self._counters = known

    def _add_time(self, timestamp: int, received: int) -> bool:
        """Track PX4's time of a message that arrived at `received` [ns]; return whether its time restarts.

        It does with the first timestamp, and with one so far back that it means a reboot.
        """
        self._messages += 1
        last = self._time
        steps = self._steps
        if last is None or timestamp < last:
            return self._step_back(timestamp, last, received)
        self._earlier = last
        self._time = timestamp
        step = timestamp - last
        is_gap = step > _FACTOR * self._usual_step > 0 and len(steps) >= _MIN_STEPS
        self._gaps += is_gap and not self._is_on_change
        steps.append(step)
        _keep_latest(steps, _USUAL)
        if is_gap or len(steps) < _USUAL or self._messages % _USUAL == 0:
            self._usual_step = median(steps)
            if not self._topic.rate:
                self._is_regular = _is_regular(steps, self._usual_step)
        return False

    def _step_back(self, timestamp: int, last: int | None, received: int) -> bool:
        if last is None:
            step = None
        else:
            step = timestamp - last
        if (
            step is not None
            and step < -_REBOOT_STEP
            and 0 < timestamp - self._earlier <= _REBOOT_STEP
        ):
            # only the time of the last was wild
            self._out_of_order, self._time = self._out_of_order + 1, timestamp
            return False
        self._earlier = last or 0
        if step is None or step < -_REBOOT_STEP:
            if step is not None and self._topic.name != _QUEUED:
                self._reboots += 1
                self._rebooted = received
            self._time = timestamp
            self._usual_step = 0.0
            self._steps = _numbers()
            return True
        self._out_of_order += 1
        return False


def _is_regular(steps: Collection[float], usual: float) -> bool:
    """Return whether these intervals are those of a periodic stream; `usual`: their median."""
    outliers = sum(not usual / _FACTOR <= step <= usual * _FACTOR for step in steps)
    return usual > 0 and outliers <= _IRREGULAR * len(steps)


@dataclass(frozen=True, slots=True)
class StreamState:
    """Current state of a stream, with a reason unless it is ok."""

    name: StateName
    reason: str = ""

    @property
    def severity(self) -> int:
        """Index in the list of states; 0 is the worst."""
        return get_args(StateName).index(self.name)

    @property
    def is_silent(self) -> bool:
        """True if no messages arrive."""
        return self.name in ("disconnected", "gone", "stale")

    def __str__(self) -> str:
        if self.reason:
            return f"{self.name}: {self.reason}"
        return self.name


def silence_of(
    age: float, stale_after: float, *, publishers: int | None, connected: bool
) -> StateName | None:
    """Return why no messages arrive on a stream, by the age of the last one [s]; None while they do."""
    if not connected:
        return "disconnected"
    if age > ABSENT and publishers == 0:
        return "gone"
    if age > stale_after:
        return "stale"
    return None


def stream_state(
    health: Health, *, publishers: int | None = None, connected: bool = True
) -> StreamState:
    """Return the state of a stream with the given health.

    `publishers`: the number of publishers with a liveliness token; None if unknown.
    `connected`: True if there is a link to the router.
    """
    match silence_of(
        health.age or 0.0, health.stale_after, publishers=publishers, connected=connected
    ):
        case "disconnected":
            return StreamState("disconnected", "no link")
        case "gone":
            return StreamState("gone", f"last message {format_duration(health.age or 0.0)} ago")
        case "stale":
            return StreamState("stale", f"nothing for {format_duration(health.age or 0.0)}")
    if publishers is not None and publishers > 1:
        return StreamState(
            "duplicate", f"{publishers} publishers: stop one, or give it another vehicle"
        )
    reasons = []
    if health.on_change:
        usual = None
    else:
        usual = health.usual_rate
    if health.rate is not None and usual is not None and health.rate < _SLOW * usual:
        reasons.append(f"{health.rate:.1f} Hz, usually {usual:.0f}")
    # else it is the latency of an old message
    is_current = health.age is None or health.age < TIMINGS.stale
    if health.latency is not None and health.latency > _LATE and is_current:
        reasons.append(f"{format_duration(health.latency)} late, or clocks differ")
    if reasons:
        return StreamState("slow", ", ".join(reasons))
    return StreamState("ok")


def describe_stream(health: Health, state: StreamState) -> str:
    """Describe the faults of a stream (state, flags, gaps, order, recent reboots) in one line; "ok" if there are none.

    A reboot is mentioned for 60 s.
    """
    if health.flags is None:
        doubts = "ok"
    else:
        doubts = describe_flags(health.flags)
    texts = [text for text in (str(state), doubts) if text != "ok"]
    if state.name != "duplicate":
        if health.gaps:
            texts.append(counted(health.gaps, "gap"))
        if health.out_of_order:
            texts.append(f"{health.out_of_order} out of order")
        if health.reboots and health.reboot_age is not None and health.reboot_age < _RECENT:
            texts.append(counted(health.reboots, "reboot"))
    return ", ".join(texts) or "ok"


def health_of_last(
    sample: Sample[Message], *, age: float | None = None, measured: Health | None = None
) -> Health:
    """Return the health of a stream from its last message; its age is by default measured by the wall clock.

    `measured`: its health as measured by the service that publishes it, from which the usual rate and interval are
    taken; without it, a topic that has no nominal rate is never stale.
    """
    stream = StreamHealth(sample.topic)
    stream.add(sample.message, received=0, missing=sample.missing)
    if age is None:
        if sample.sent is None:
            age = 0.0
        else:
            age = max(0, clock.utc_ns() - sample.sent) / 1e9
    last = replace(stream.snapshot(0), age=age)
    if measured is None:
        return last
    return replace(
        last,
        usual_rate=measured.usual_rate,
        usual_interval=measured.usual_interval,
        on_change=measured.on_change,
    )
