"""Places of one vehicle's messages on the axis of a file: pauses, late and old messages, set clocks, reboots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from statistics import median_low
from typing import Any, Final, Generic, NamedTuple, Protocol, TypeVar

from nedbus_msgs import Address, is_unix_time

from .vehicle_clock import is_boot_possible

NEAR: Final = 1_000_000
"""Microseconds by which usual messages are older or newer than the newest one."""

LATENESS: Final = 60_000_000
"""Microseconds; a message that arrived later than this is old, and keeps its place in the file."""

_CREDIBLE_PAUSE: Final = 30 * 86_400_000_000  # us between two log times; a longer one is damage
# us by which the last message may be ahead; further ahead its timestamp is damaged
_CREDIBLE_END: Final = 86_400_000_000
_CONFIRM: Final = 20  # messages in a row that show that a clock has changed
_AGREEING: Final = 3  # streams that show together that a clock has gone on
# messages of a log that may be late between the first ones after a pause
_LATE_AFTER_PAUSE: Final = 5


class Message(Protocol):
    """What an order needs of a message; it sets `at`, seconds since the first message of the file.

    `time`: its log time [us], or its timestamp in a file without log times.
    """

    address: Address
    at: float
    time: int
    error: str | None
    logged: Any

    @property
    def timestamp(self) -> Any:
        """The vehicle's time [us]; None or 0 without one."""


M = TypeVar("M", bound=Message)


class Item(NamedTuple, Generic[M]):
    """A message: its stream, its timestamp, 0 without one, its log time, None without one, and its number.

    `shift`: of the recorder's clock before this message; see `Track.shift`.
    """

    message: M
    stream: Any
    stamp: int
    log: int | None
    number: int
    shift: int = 0

    @property
    def lag(self) -> int | None:
        """Log time minus timestamp [us]; None without a log time."""
        if self.log is None:
            return None
        return self.log - self.stamp


class Placed(NamedTuple, Generic[M]):
    """A message and its place on the axis [us]."""

    place: int
    item: Item[M]


class _Part(NamedTuple):
    """A part of the axis: its base, and the log time minus the timestamp."""

    base: int
    lag: int | None


class _Change(NamedTuple, Generic[M]):
    """A change of the clock that doubtful messages suggest, from the message with this index on."""

    begin: int
    first: Item[M]
    is_ahead: bool
    is_unix: bool


class Track(Generic[M]):
    """The messages of one vehicle: their places on the axis, from `begin` on.

    `unordered`: messages, by address, whose timestamps are out of order. `on_part`: called for each new part with its
    first place and timestamp.

    `newest`, `log`: timestamp and log time of the newest message [us]. `lag`: log time minus timestamp, None without
    log times [us]. `last`: the last timestamp of each stream [us]. `changes`: of a clock that was set to a Unix time.
    """

    def __init__(self, unordered: Counter[Address], on_part: Callable[[int, int], object]) -> None:
        self.unordered = unordered
        self._on_part = on_part
        self.is_open = False  # True from `begin` on
        self.changes = 0
        self.base = 0
        self.newest = 0
        self.log: int | None = None
        self.lag: int | None = None
        self.is_unix = False
        self.last: dict[Any, int] = {}
        self._batched: dict[Any, int] = {}  # the last timestamp of streams that were written later
        self.doubtful: list[Item[M]] = []
        self._newest_before = 0  # timestamp of the newest message before the doubtful ones [us]
        self._passed = 0  # usual messages since the first doubtful one
        self._previous: _Part | None = None

    def begin(self, first: Item[M], place: int) -> None:
        """Put the first message of the vehicle's clock in its place."""
        self.is_open = True
        self.base = place - first.stamp
        self.is_unix = bool(is_unix_time(first.stamp))
        self._set_newest(first)
        self._on_part(place, first.stamp)

    @property
    def shift(self) -> int:
        """Place minus log time of the newest message [us]: how far the recorder's clock has been set back."""
        if self.log is None:
            return 0
        return self.base + self.newest - self.log

    def add(self, item: Item[M]) -> list[Placed[M]]:
        """Return the messages whose places are known now; this one may have to wait for others."""
        if not item.stamp:
            return [Placed(self._place_of_log(item.log), item)]
        place = self._place(item)
        if place is None:
            return self._doubt(item)
        placed = [Placed(place, item)]
        if not self.doubtful:
            return placed
        if self._has_gone_on():
            return placed + self._decide()
        self._passed += 1
        if self._says_nothing(item):
            return placed
        earlier = self._place_outliers(self.doubtful, self._newest_before)
        self.doubtful = []
        return earlier + placed

    def _doubt(self, item: Item[M]) -> list[Placed[M]]:
        """Add a doubtful message; return the places of all of them if they are enough to decide."""
        if not self.doubtful:
            self._newest_before = self.newest
            self._passed = 0
        self.doubtful.append(item)
        is_enough = len(self.doubtful) >= _CONFIRM
        if is_enough or self._is_set_back():
            return self._decide()
        return []

    def _says_nothing(self, item: Item[M]) -> bool:
        """Return whether a usual message leaves it open whether the doubtful ones went on after a pause.

        A log may have late messages of other streams between those that went on.
        """
        if item.log is not None or self._passed > _LATE_AFTER_PAUSE:
            return False
        are_ahead = all(other.stamp > self.newest for other in self.doubtful)
        are_others = all(other.stream is not item.stream for other in self.doubtful)
        return are_ahead and are_others

    def end(self) -> list[Placed[M]]:
        """Return the places of the messages that still wait."""
        placed: list[Placed[M]] = []
        if self._passed:
            placed += self._place_outliers(self.doubtful, self._newest_before)
            self.doubtful = []
        while self.doubtful:
            placed += self._decide(is_end=True)
        return placed

    def _set_newest(self, item: Item[M]) -> None:
        self.newest = item.stamp
        self.log = item.log
        self.lag = item.lag

    def _place(self, item: Item[M]) -> int | None:
        """Return the place of a message that continues the vehicle's clock, None for a doubtful one."""
        before = self.last.get(item.stream, 0)
        is_back = item.stamp < before
        agrees = _agree(item.lag, self.lag)
        may_restart = self.is_unix or not agrees
        if is_back and item.log is not None and may_restart:
            return None  # late, set back, or rebooted
        if not agrees and self._continues_doubtful(item):
            return None  # the new clock has reached the time of the old one
        if agrees or abs(item.stamp - self.newest) <= NEAR:
            if is_back and item.log is None:
                self.unordered[item.message.address] += 1
                # a log keeps the order of each stream, in which the vehicle wrote it
                return self.base + before
            self._follow(item)
            return self.base + item.stamp
        if self._is_batched(item, before):
            self.last[item.stream] = item.stamp
            self._batched[item.stream] = item.stamp
            return self.base + item.stamp
        return self._place_before_change(item)

    def _is_batched(self, item: Item[M], before: int) -> bool:
        """Return whether a message continues a stream that a recorder wrote later than others."""
        if not before:
            return False
        if item.log is None and self.doubtful:
            return False
        if item.stamp == self._batched.get(item.stream):
            return True  # sent twice with one timestamp
        latest = min(before + LATENESS, self.newest)
        return before < item.stamp <= latest

    def _continues_doubtful(self, item: Item[M]) -> bool:
        """Return whether the log time of a message runs with that of the doubtful ones."""
        if not self.doubtful:
            return False
        return _agree(item.lag, self.doubtful[-1].lag)

    def _place_before_change(self, item: Item[M]) -> int | None:
        """Return the place of a message from before the last change of the clock, as of a stream in a later batch."""
        previous = self._previous
        if previous is None or not _agree(item.lag, previous.lag):
            return None
        return previous.base + item.stamp  # `last` is of the clock after the change

    def _follow(self, item: Item[M]) -> None:
        self.last[item.stream] = item.stamp
        if item.stamp >= self.newest:
            self.newest = item.stamp
            self.log = item.log
        if item.log is not None:
            self.lag = item.lag

    def _place_of_log(self, log: int | None) -> int:
        """Return the place of a message without a timestamp."""
        if self.newest or log is None or self.log is None:
            return self.base + self.newest  # the order of the file
        return self.base + max(0, log - self.log)

    def _place_outliers(self, items: Sequence[Item[M]], newest: int) -> list[Placed[M]]:
        """Place messages that do not continue the clock.

        Late and old ones, and those of a stream that runs ahead of the others, have the place of their time; all others
        that of the file.

        `newest`: the newest timestamp before them.
        """
        placed: list[Placed[M]] = []
        ahead = _streams_ahead(items, newest)
        for item in items:
            if item.stream in ahead and item.stamp > newest:
                self.last[item.stream] = item.stamp
                stamp = item.stamp
            else:
                stamp = self._stamp_of_outlier(item, newest)
            place = self.base + stamp
            placed.append(Placed(place, item))
        return placed

    def _stamp_of_outlier(self, item: Item[M], newest: int) -> int:
        """Return the timestamp at whose place a message is that does not continue the clock."""
        before = self.last.get(item.stream, 0)
        is_same_clock = is_unix_time(item.stamp) == self.is_unix
        is_between = before < item.stamp < newest
        is_old = is_same_clock and is_between  # a stream may begin with old messages
        is_late = self._is_late(item, newest)
        continues = before in (0, item.stamp) or is_old
        is_far = abs(item.stamp - before) > LATENESS
        if not continues and (item.log is None or is_far):
            self.unordered[item.message.address] += 1
        if item.log is None and item.stamp < before:
            return before  # a log keeps the order of each stream
        if not is_late and item.stamp <= newest:
            self.last[item.stream] = item.stamp
        if is_late or is_old:
            return item.stamp
        return newest

    def _is_late(self, item: Item[M], newest: int) -> bool:
        if item.lag is None or self.lag is None:
            return False
        if item.stamp >= newest or item.stamp == self.last.get(item.stream):
            return False
        return item.lag - self.lag <= LATENESS

    def _has_gone_on(self) -> bool:
        """Return whether several streams went on after the same pause, while others still have earlier messages."""
        ahead = [item for item in self.doubtful if item.stamp > self.newest]
        if len(ahead) < _AGREEING:
            return False
        middle = median_low(item.stamp for item in ahead)
        agreeing = [item for item in ahead if abs(item.stamp - middle) <= NEAR]
        streams = {id(item.stream) for item in agreeing}
        return len(streams) >= _AGREEING

    def _is_set_back(self) -> bool:
        """Return whether a synchronized clock was set back: a stream goes on from an earlier time."""
        last = self.doubtful[-1]
        if not self.is_unix or last.log is None or last.stamp > self.newest:
            return False
        own = [item.stamp for item in self.doubtful if item.stream is last.stream]
        return min(own) < last.stamp

    def _decide(self, *, is_end: bool = False) -> list[Placed[M]]:
        """Decide on the doubtful messages: those that advance together show where the vehicle's clock is."""
        items = self.doubtful
        self.doubtful = []
        change = self._suggested_change(items)
        if not self._is_possible(change, items, is_end=is_end):
            return self._place_outliers(items, self.newest)
        placed = self._place_outliers(items[: change.begin], self.newest)
        if self._is_pause(change):
            self._set_newest(change.first)
        else:
            self._begin_part(change)
        for item in items[change.begin :]:
            placed += self.add(item)
        return placed

    def _suggested_change(self, items: Sequence[Item[M]]) -> _Change[M]:
        """Return the change to the clock of most of these messages, from the first one on it."""
        middle = median_low(item.stamp for item in items)
        is_ahead = middle > self.newest
        is_unix = bool(is_unix_time(middle))

        def is_on_clock(item: Item[M]) -> bool:
            is_same_side = (item.stamp > self.newest) == is_ahead
            is_same_clock = is_unix_time(item.stamp) == is_unix
            return is_same_side and is_same_clock and item.stamp <= middle + NEAR

        on_clock = [is_on_clock(item) for item in items]
        begin = on_clock.index(True)
        return _Change(begin, items[begin], is_ahead, is_unix)

    def _is_pause(self, change: _Change[M]) -> bool:
        """Return whether the clock has only run on: it was not set, and the vehicle did not reboot."""
        if not change.is_ahead or change.is_unix != self.is_unix:
            return False
        elapsed = self._elapsed(change.first)
        if not change.is_unix or elapsed is None:
            return True
        step = change.first.stamp - self.newest
        return step - elapsed <= NEAR  # otherwise the log times run on: the clock was set

    def _begin_part(self, change: _Change[M]) -> None:
        """Begin a new part of the axis: the clock was set, or the vehicle rebooted."""
        gap = self._elapsed(change.first)
        if gap is None:
            has_unix_time = change.is_unix or self.is_unix
            gap = 0
            if not change.is_ahead and not has_unix_time:  # a reboot
                gap = change.first.stamp
        if change.is_unix and self.is_unix:
            self.changes += 1
        self._previous = _Part(self.base, self.lag)
        place = self.base + self.newest + gap
        self.begin(change.first, place)
        self.last.clear()
        self._batched.clear()

    def _elapsed(self, item: Item[M]) -> int | None:
        """Return the log time that has passed until a message [us]; None if it is unknown, or damaged."""
        if item.log is None or self.log is None:
            return None
        elapsed = item.log - self.log
        if 0 <= elapsed <= _CREDIBLE_PAUSE:
            return elapsed
        return None

    def _is_possible(self, change: _Change[M], items: Sequence[Item[M]], *, is_end: bool) -> bool:
        """Return whether the vehicle's clock may have changed to that of these messages."""
        is_single = len(items) == 1
        if not change.is_ahead:
            return not is_single and self._may_have_gone_back(change, items)
        if is_single:
            is_same_clock = change.is_unix == self.is_unix
            is_credible = change.first.stamp - self.newest <= _CREDIBLE_END
            return is_end and is_same_clock and is_credible
        return True

    def _may_have_gone_back(self, change: _Change[M], items: Sequence[Item[M]]) -> bool:
        """Return whether the vehicle may have rebooted, or its Unix time may have been set back."""
        first = change.first
        set_back = set[Any]()
        for item in items:
            if self.last.get(item.stream, 0) > item.stamp:
                set_back.add(item.stream)
        if first.log is None or self.log is None:  # a log: a few streams may have waited in a queue
            return len(set_back) >= min(_AGREEING, len(self.last))
        if change.is_unix != self.is_unix:
            return True
        if not set_back:  # streams that appear now, which were late
            return False
        if change.is_unix:
            return True
        elapsed = first.log - self.log
        return elapsed < 0 or is_boot_possible(first.stamp, elapsed / 1e6)


def _agree(lag: int | None, other: int | None) -> bool:
    """Return whether two lags are known and about the same: their messages are on one clock."""
    if lag is None or other is None:
        return False
    return abs(lag - other) <= NEAR


def _streams_ahead(items: Iterable[Item[M]], newest: int) -> set[Any]:
    """Return the streams of a recording that run ahead of the others: a single message may have a damaged time."""
    last: dict[Any, int] = {}
    ahead: set[Any] = set()
    for item in items:
        is_ahead = newest < item.stamp <= newest + LATENESS
        if item.log is None or not is_ahead:
            continue
        if item.stamp > last.get(item.stream, item.stamp):
            ahead.add(item.stream)
        last[item.stream] = item.stamp
    return ahead
