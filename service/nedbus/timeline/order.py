"""Order of a file's messages on one axis: the vehicle's clock decides, the file's order between its boots.

A message with the log time `log` and the timestamp `stamp` has its place at `base + stamp`. The base of a vehicle is
constant while its clock runs on, whatever the clock of the recorder does. It changes when the vehicle reboots, and when
a synchronized Unix time is set: these begin a new part of the axis, whose place the log time shows.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from statistics import median_low
from typing import Any, Final, Generic, NamedTuple, Protocol, TypeVar

from nedbus_msgs import Address, is_unix_time

from .axis import Axis
from .vehicle_clock import is_boot_possible

_NEAR: Final = 1_000_000  # us; a message this much older or newer than the newest one is usual
# us; a message that arrived later than this is old, and keeps its place in the file
_MAX_LATE: Final = 60_000_000
_MAX_GAP: Final = 30 * 86_400_000_000  # us; a longer pause between two log times is a damaged one
_MAX_LAST: Final = 86_400_000_000  # us; a last message further ahead has a damaged timestamp
_CONFIRM: Final = 20  # messages in a row that show that a clock has changed
_AGREEING: Final = 3  # streams that show together that a clock has gone on
# messages from which the start of a file is determined; PX4 first logs an old one of each topic
_OPENING: Final = 1000
_OPENING_LATER: Final = 100  # messages that determine the start of a vehicle that appears later
_BUFFER: Final = 8192  # messages, within which the streams of a recording may be batched
_PART: Final = 2048  # messages that are sorted and passed on at once
# PX4 queues these: the first ones of a log may be from long before it
_QUEUED: Final = ("log_message", "event")
# changes of the recorder's clock that are kept, to place a vehicle that appears later
_MAX_STEPS: Final = 1000


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


class _Item(NamedTuple, Generic[M]):
    """A message: its stream, its timestamp, 0 without one, its log time, None without one, and its number."""

    message: M
    stream: Any
    stamp: int
    log: int | None
    number: int


_Placed = list[tuple[int, _Item[M]]]


class _Part(NamedTuple):
    """A part of the axis: its base, the log time minus the timestamp, and whether timestamps are Unix times."""

    base: int
    lag: int | None
    is_unix: bool


class _Track(Generic[M]):
    """The messages of one vehicle: their places on the axis, from `begin` on.

    `unordered`: messages, by address, whose timestamps are out of order. `on_part`: called for each new part with its
    first place and timestamp.
    """

    def __init__(self, unordered: Counter[Address], on_part: Callable[[int, int], object]) -> None:
        self.is_open = False  # True from `begin` on
        self.unordered = unordered
        self.changes = 0  # of the vehicle's clock, while it was set to a Unix time
        self._on_part = on_part
        self.base = self.newest = 0
        self.lag: int | None = None
        self.log: int | None = None  # of the newest message
        self.is_unix = False
        self.last: dict[Any, int] = {}  # timestamp by stream
        self.doubtful: list[_Item[M]] = []
        self._previous: _Part | None = None

    def begin(self, first: _Item[M], place: int) -> None:
        """Put the first message of the vehicle's clock in its place."""
        self.base, self.newest = place - first.stamp, first.stamp
        self.lag = None if first.log is None else first.log - first.stamp
        self.log, self.is_unix = first.log, bool(is_unix_time(first.stamp))
        self.is_open = True
        self._on_part(place, first.stamp)

    def add(self, item: _Item[M]) -> _Placed[M]:
        """Return the messages whose places are known now; this one may have to wait for others."""
        if not item.stamp:
            return [(self._place_of_log(item.log), item)]
        newest = self.newest
        place = self._place(item)
        if place is None:
            self.doubtful.append(item)
            return self._decide() if len(self.doubtful) >= _CONFIRM or self._is_set_back() else []
        if self._has_gone_on():
            return [*self._decide(), *self.add(item)]
        earlier = self._outliers(self.doubtful, newest)
        self.doubtful = []
        return [*earlier, (place, item)]

    def end(self) -> _Placed[M]:
        """Return the places of the messages that still wait."""
        found: _Placed[M] = []
        while self.doubtful:
            found += self._decide(is_end=True)
        return found

    def _place(self, item: _Item[M]) -> int | None:
        """Return the place of a message that continues the vehicle's clock, None for a doubtful one."""
        stream = item.stream
        stamp = item.stamp
        log = item.log
        before, distance = self.last.get(stream), stamp - self.newest
        is_back = before is not None and stamp < before
        agrees = log is not None and self.lag is not None and abs(log - stamp - self.lag) <= _NEAR
        if is_back and log is not None and (self.is_unix or not agrees):
            return None  # late, set back, or rebooted
        if not agrees and self._goes_on_like_doubtful(item):
            return None  # the new clock has reached the time of the old one
        if agrees or -_NEAR <= distance <= _NEAR:
            if before is not None and is_back and log is None:
                self.unordered[item.message.address] += 1
                # a log keeps the order of each stream, in which the vehicle wrote it
                return self.base + before
            self._follow(item)
            return self.base + stamp
        is_batched = before is not None and before < stamp <= min(before + _MAX_LATE, self.newest)
        if is_batched and (log is not None or not self.doubtful):
            self.last[stream] = stamp
            return self.base + stamp
        return self._place_before_change(item)

    def _goes_on_like_doubtful(self, item: _Item[M]) -> bool:
        """Return whether the log time of a message runs with that of the doubtful ones."""
        if not self.doubtful:
            return False
        last = self.doubtful[-1]
        if item.log is None or last.log is None:
            return False
        return abs((item.log - item.stamp) - (last.log - last.stamp)) <= _NEAR

    def _place_before_change(self, item: _Item[M]) -> int | None:
        """Return the place of a message from before the last change of the clock, as of a stream in a later batch."""
        previous, log = self._previous, item.log
        if previous is None or previous.lag is None or log is None:
            return None
        if abs(log - item.stamp - previous.lag) > _NEAR:
            return None
        self.last[item.stream] = item.stamp
        return previous.base + item.stamp

    def _follow(self, item: _Item[M]) -> None:
        self.last[item.stream] = item.stamp
        if item.stamp >= self.newest:
            self.newest = item.stamp
            self.log = item.log
        if item.log is not None:
            self.lag = item.log - item.stamp

    def _place_of_log(self, log: int | None) -> int:
        """Return the place of a message without a timestamp."""
        if self.newest or log is None or self.log is None:
            return self.base + self.newest  # the order of the file
        return self.base + max(0, log - self.log)

    def _outliers(self, items: Sequence[_Item[M]], newest: int) -> _Placed[M]:
        """Place messages that do not continue the clock.

        Late and old ones, and those of a stream that runs ahead of the others, have the place of their time; all others
        that of the file.

        A log keeps the order of each stream, in which the vehicle wrote it.

        `newest`: the newest timestamp before them.
        """
        found: _Placed[M] = []
        ahead = _streams_ahead(items, newest)
        for item in items:
            before = self.last.get(item.stream)
            if item.stream in ahead and item.stamp > newest:
                self.last[item.stream] = item.stamp
                found.append((self.base + item.stamp, item))
                continue
            is_same_clock = is_unix_time(item.stamp) == self.is_unix
            is_next = before is None or before < item.stamp
            # a stream may begin with old messages
            is_old = is_next and is_same_clock and item.stamp < newest
            is_late = False
            if item.log is not None and self.lag is not None and before != item.stamp:
                is_late = item.stamp < newest and item.log - item.stamp - self.lag <= _MAX_LATE
            if before is not None and before != item.stamp and not is_old:
                self.unordered[item.message.address] += (
                    item.log is None or abs(item.stamp - before) > _MAX_LATE
                )
            if item.log is None and before is not None and item.stamp < before:
                found.append((self.base + before, item))  # a log keeps the order of each stream
                continue
            if not is_late and item.stamp <= newest:
                self.last[item.stream] = item.stamp
            place = item.stamp if is_late or is_old else newest
            found.append((self.base + place, item))
        return found

    def _has_gone_on(self) -> bool:
        """Return whether several streams went on after the same pause, while others still have earlier messages."""
        ahead = [each for each in self.doubtful if each.stamp > self.newest]
        if len(ahead) < _AGREEING:
            return False
        middle = median_low([each.stamp for each in ahead])
        return (
            len({id(each.stream) for each in ahead if abs(each.stamp - middle) <= _NEAR})
            >= _AGREEING
        )

    def _is_set_back(self) -> bool:
        """Return whether a synchronized clock was set back: a stream goes on from an earlier time."""
        last = self.doubtful[-1]
        if not self.is_unix or last.log is None or last.stamp > self.newest:
            return False
        return any(
            each.stream is last.stream and each.stamp < last.stamp for each in self.doubtful[:-1]
        )

    def _decide(self, *, is_end: bool = False) -> _Placed[M]:
        """Decide on the doubtful messages: those that advance together show where the vehicle's clock is."""
        items, self.doubtful = self.doubtful, []
        middle = median_low([each.stamp for each in items])
        is_ahead, is_unix = middle > self.newest, bool(is_unix_time(middle))
        index = next(
            number
            for number, each in enumerate(items)
            if each.stamp <= middle + _NEAR
            and (each.stamp > self.newest) == is_ahead
            and is_unix_time(each.stamp) == is_unix
        )
        first = items[index]
        if not self._is_possible(items, first, is_ahead=is_ahead, is_unix=is_unix, is_end=is_end):
            return self._outliers(items, self.newest)
        found = self._outliers(items[:index], self.newest)
        elapsed = None if first.log is None or self.log is None else first.log - self.log
        is_known = elapsed is not None and 0 <= elapsed <= _MAX_GAP
        is_pause = is_ahead and is_unix == self.is_unix
        # the log times run on: the clock was set
        if is_pause and is_unix and elapsed is not None and is_known:
            is_pause = first.stamp - self.newest - elapsed <= _NEAR
        if is_pause:
            self.newest, self.log = first.stamp, first.log
            self.lag = None if first.log is None else first.log - first.stamp
        else:
            since_boot = 0 if is_ahead or is_unix or self.is_unix else first.stamp
            gap = elapsed if elapsed is not None and is_known else since_boot
            self.changes += is_unix and self.is_unix
            self._previous = _Part(self.base, self.lag, self.is_unix)
            self.begin(first, self.base + self.newest + gap)
            self.last.clear()
        for each in items[index:]:
            found += self.add(each)
        return found

    def _is_possible(
        self,
        items: Sequence[_Item[M]],
        first: _Item[M],
        *,
        is_ahead: bool,
        is_unix: bool,
        is_end: bool,
    ) -> bool:
        """Return whether the vehicle's clock may have changed to that of these messages."""
        if is_ahead:
            is_same = is_unix == self.is_unix
            return len(items) > 1 or (is_end and is_same and first.stamp - self.newest <= _MAX_LAST)
        return len(items) > 1 and self._may_have_gone_back(items, first, is_unix=is_unix)

    def _may_have_gone_back(
        self, items: Sequence[_Item[M]], first: _Item[M], *, is_unix: bool
    ) -> bool:
        """Return whether the vehicle may have rebooted, or its Unix time may have been set back."""
        set_back = {item.stream for item in items if self.last.get(item.stream, 0) > item.stamp}
        if first.log is None or self.log is None:  # a log: a few streams may have waited in a queue
            return len(set_back) >= min(_AGREEING, len(self.last))
        if is_unix != self.is_unix:
            return True
        if not set_back:  # streams that appear now, which were late
            return False
        if is_unix:
            return True
        elapsed = first.log - self.log
        return elapsed < 0 or is_boot_possible(first.stamp, elapsed / 1e6)


def _unknown(_: str) -> int:
    return 0


class Order(Generic[M]):
    """The messages of one file in order, each with its time on the axis of the file.

    `start_of`: returns when the recording of a vehicle began, on its clock [us], 0 if unknown.
    `has_log_times`: False for a log that has only timestamps: its order is that of the file.

    `whole`: the axis of all messages of the file, if these are only some of them: their axis begins with that one.
    `axis`: the places of the vehicles' clocks. `unordered`: messages whose timestamps are out of order, by address.
    """

    def __init__(
        self, start_of: Callable[[str], int] = _unknown, *, has_log_times: bool = True
    ) -> None:
        self.axis = Axis()
        self.whole: Axis | None = None
        self.unordered: Counter[Address] = Counter()
        self._start_of, self._has_log_times = start_of, has_log_times
        self._zero: int | None = None
        self._place_of_last: int | None = None  # of the messages that were yielded
        self._tracks: dict[str, _Track[M]] = {}
        # numbers of messages, and place minus log time from there
        self._anchors: tuple[list[int], list[int]] = [], []
        # place minus log time of the last message, if it differs
        self._candidate: int | None = None

    @property
    def remarks(self) -> list[str]:
        """What the vehicles' clocks did, so far."""
        found = []
        for name, track in self._tracks.items():
            if track.changes:
                found.append(
                    f"the clock of vehicle {name} was set ({track.changes}); the order of the file decides"
                )
        return found

    @property
    def duration(self) -> float:
        """Seconds from the first message to the last one so far."""
        return 0.0 if self._place_of_last is None else (self._place_of_last - self.axis.zero) / 1e6

    def arrange(self, messages: Iterable[M]) -> Iterator[M]:
        """Yield the messages in order, each with `at`, which does not decrease."""
        waiting: list[tuple[int, int, M]] = []  # place, number, message
        opening: list[_Item[M]] = []
        tracks = self._tracks
        has_log_times = self._has_log_times
        for number, message in enumerate(messages):
            stream, log = message.logged, message.time
            stamp = (
                0 if message.error is not None else message.timestamp or 0 if has_log_times else log
            )
            track = tracks.get(message.address.vehicle) or self._track_of(message.address.vehicle)
            if (
                track.is_open
                and -_NEAR <= stamp - track.newest <= _NEAR
                and not track.doubtful
                and stamp >= track.last.get(stream, 0)
                and (
                    not has_log_times
                    or (track.lag is not None and -_NEAR <= log - stamp - track.lag <= _NEAR)
                )
            ):
                track.last[stream] = stamp
                if stamp > track.newest:
                    track.newest = stamp
                    track.log = log if has_log_times else None
                if has_log_times:
                    track.lag = log - stamp
                waiting.append((track.base + stamp, number, message))
            else:
                item = _Item(message, stream, stamp, log if has_log_times else None, number)
                waiting += self._place(item, opening)
            if len(waiting) >= _BUFFER + _PART:
                waiting.sort()
                yield from self._emit(waiting[:_PART])
                del waiting[:_PART]
        waiting += self._end(opening)
        waiting.sort()
        yield from self._emit(waiting)

    def _track_of(self, vehicle: str) -> _Track[M]:
        def on_part(place: int, stamp: int) -> None:
            self.axis.add(vehicle, place, stamp)

        track = _Track[M](self.unordered, on_part)
        self._tracks[vehicle] = track
        return track

    def _place(self, item: _Item[M], opening: list[_Item[M]]) -> list[tuple[int, int, M]]:
        """Return the messages whose places are known now; those of a new vehicle wait in `opening`."""
        track = self._tracks[item.message.address.vehicle]
        if track.is_open:
            return self._placed(track.add(item))
        opening.append(item)
        enough = _OPENING if self._zero is None else _OPENING_LATER
        if len(opening) < enough:
            return []
        placed = self._placed(self._begin(opening))
        opening.clear()
        return placed

    def _end(self, opening: list[_Item[M]]) -> list[tuple[int, int, M]]:
        """Return the places of the messages that still wait."""
        placed = self._begin(opening)
        for track in self._tracks.values():
            placed += track.end()
        return self._placed(placed)

    def _placed(self, placed: _Placed[M]) -> list[tuple[int, int, M]]:
        self._watch(placed)
        return [(place, item.number, item.message) for place, item in placed]

    def _emit(self, placed: Iterable[tuple[int, int, M]]) -> Iterator[M]:
        """Yield sorted messages with their times on the axis; those from before its zero are at 0."""
        zero = self._zero or 0
        newest = self._place_of_last or zero
        for place, _, message in placed:
            newest = max(newest, place)
            message.at = (newest - zero) / 1e6
            yield message
        self._place_of_last = newest

    def _begin(self, opening: Sequence[_Item[M]]) -> _Placed[M]:
        """Place the first messages of vehicles on the axis; the log times place the vehicles against each other."""
        by_vehicle = defaultdict[str, list[_Item[M]]](list)
        for item in opening:
            by_vehicle[item.message.address.vehicle].append(item)
        firsts = {
            name: _first_of(items, self._start_of(name)) for name, items in by_vehicle.items()
        }
        for name, first in sorted(firsts.items(), key=lambda each: each[1].number):
            time = first.stamp if first.log is None else first.log
            self._tracks[name].begin(first, time + self._offset_at(first.number))
            if not self._anchors[0]:
                self._anchors[0].append(first.number)
                self._anchors[1].append(0)
        if self._zero is None and firsts:
            self._zero = self.axis.zero = self._find_zero()
        placed: _Placed[M] = []
        for item in opening:
            placed += self._tracks[item.message.address.vehicle].add(item)
        return placed

    def _find_zero(self) -> int:
        """Return the place of the first message, or where the axis of all messages of the file begins."""
        tracks = sorted(self._tracks.items(), key=lambda each: each[1].base + each[1].newest)
        if self.whole is not None:
            for name, track in tracks:
                seconds = self.whole.seconds_of(name, track.newest)
                if seconds is not None:
                    return track.base + track.newest - round(seconds * 1e6)
        _, first = tracks[0]
        return first.base + first.newest

    def _offset_at(self, number: int) -> int:
        numbers, offsets = self._anchors
        return offsets[max(0, bisect_right(numbers, number) - 1)] if numbers else 0

    def _watch(self, placed: _Placed[M]) -> None:
        """Follow the clock of the recorder: a change holds if the next message confirms it."""
        numbers, offsets = self._anchors
        for place, item in placed:
            if item.log is None or not item.stamp or not numbers:
                continue
            offset = place - item.log
            if abs(offset - offsets[-1]) <= _NEAR:
                self._candidate = None
            elif self._candidate is None or abs(offset - self._candidate) > _NEAR:
                self._candidate = offset
            else:
                self._candidate = None
                if len(numbers) < _MAX_STEPS:
                    numbers.append(item.number)
                    offsets.append(offset)


def _streams_ahead(items: Iterable[_Item[M]], newest: int) -> set[Any]:
    """Return the streams of a recording that run ahead of the others: a single message may have a damaged time."""
    last: dict[Any, int] = {}
    ahead: set[Any] = set()
    for item in items:
        if item.log is None or not newest < item.stamp <= newest + _MAX_LATE:
            continue
        if item.stream in last and item.stamp > last[item.stream]:
            ahead.add(item.stream)
        last[item.stream] = item.stamp
    return ahead


def _stamp_of(message: Message, stamp: Any) -> int:
    """Return the timestamp of a message, 0 for one that is not decodable."""
    return 0 if message.error is not None or not stamp else int(stamp)


def _first_of(items: Sequence[_Item[M]], start: int) -> _Item[M]:
    """Return the message with which the vehicle's clock begins: not an old one, nor one on another clock.

    `start`: when recording began, by the file's header. Old messages come first and once per stream, so streams that
    advance decide, and a header that contradicts them is on another clock.
    """
    streams: dict[Any, list[_Item[M]]] = defaultdict(list)
    for item in items:
        if item.stamp:
            streams[item.stream].append(item)
    if not streams:
        return items[0]
    current = {
        stream: own
        for stream, own in streams.items()
        if own[0].message.address.topic not in _QUEUED
    }
    streams = current or streams
    for own in streams.values():
        if len(own) > 1 and _is_old(own[0], own[1]):
            del own[0]
    advancing = _advancing(streams.values())
    since_start = _advancing(
        [item for item in own if item.stamp >= start] for own in streams.values()
    )
    if start and since_start:
        advancing = since_start
    if not advancing:
        known = (
            [own[0] for own in streams.values() if own[0].stamp >= start - _NEAR] if start else []
        )
        return min(known or [own[0] for own in streams.values()][:1], key=lambda each: each.stamp)
    groups: list[list[list[_Item[M]]]] = []  # of streams on one clock, whose periods overlap
    end = 0
    for own in sorted(advancing, key=lambda each: each[0].stamp):
        if groups and own[0].stamp <= end + _MAX_LATE:
            groups[-1].append(own)
            end = max(end, own[-1].stamp)
        else:
            groups.append([own])
            end = own[-1].stamp
    together = max(groups, key=lambda group: sum(map(len, group)))
    return min((own[0] for own in together), key=lambda each: each.stamp)


def _advancing(streams: Iterable[list[_Item[M]]]) -> list[list[_Item[M]]]:
    """Return the streams whose timestamps advance."""
    return [own for own in streams if len(own) > 1 and own[0].stamp < own[-1].stamp]


def _is_old(first: _Item[M], second: _Item[M]) -> bool:
    """Return whether the first message of a stream was sent long before its recording began."""
    if first.log is None or second.log is None:
        return False
    if second.log < first.log:
        return False  # the recorder's clock was set back
    return (second.stamp - first.stamp) - (second.log - first.log) > _NEAR
