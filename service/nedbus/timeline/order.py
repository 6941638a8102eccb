"""Order of a file's messages on one axis: the vehicle's clock decides, the file's order between its boots.

A message with the log time `log` and the timestamp `stamp` has its place at `base + stamp`. The base of a vehicle is
constant while its clock runs on, whatever the clock of the recorder does. It changes when the vehicle reboots, and when
a synchronized Unix time is set: these begin a new part of the axis, whose place the log time shows.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from operator import itemgetter
from typing import Final, Generic

from nedbus_msgs import Address

from .axis import Axis
from .opening import first_of
from .track import NEAR, Item, M, Placed, Track

# messages from which the start of a file is determined; PX4 first logs an old one of each topic
_OPENING: Final = 1000
_OPENING_LATER: Final = 100  # messages that determine the start of a vehicle that appears later
_BUFFER: Final = 8192  # messages, within which the streams of a recording may be batched
# messages of a log that wait at most; logs have up to 5,000 per second
_LOG_BUFFER: Final = 32_768
_PART: Final = 1024  # messages that are sorted at once, and the least that wait for earlier ones
# us by which a log may have a message later than others; PX4 writes topics with a low rate up to 2 s late
_LATE: Final = 4_000_000

_Waiting = tuple[int, int, M]
"""Place, number and message: a plain tuple, because tuples sort fastest."""


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
        self._start_of = start_of
        self._has_log_times = has_log_times
        self._zero: int | None = None
        self._place_of_last: int | None = None  # of the messages that were yielded
        self._tracks: dict[str, Track[M]] = {}

    @property
    def remarks(self) -> list[str]:
        """What the vehicles' clocks did, so far."""
        remarks = []
        for name, track in self._tracks.items():
            if track.changes:
                remarks.append(
                    f"the clock of vehicle {name} was set ({track.changes}); the order of the file decides"
                )
        return remarks

    @property
    def duration(self) -> float:
        """Seconds from the first message to the last one so far."""
        if self._place_of_last is None:
            return 0.0
        return (self._place_of_last - self.axis.zero) / 1e6

    def arrange(self, messages: Iterable[M]) -> Iterator[M]:
        """Yield the messages in order, each with `at`, which does not decrease."""
        # The path of usual messages is written out here, because each message of a file takes it.
        waiting: list[_Waiting[M]] = []
        opening: list[Item[M]] = []
        tracks = self._tracks
        usual: Track[M] | None = None  # of the last message, if that was usual
        shift = 0  # of the recorder's clock, as of the last usual message
        has_log_times = self._has_log_times
        enough = 2 * _PART
        for number, message in enumerate(messages):
            stream = message.logged
            log = message.time
            if message.error is not None:
                stamp = 0
            elif has_log_times:
                stamp = message.timestamp or 0
            else:
                stamp = log
            track = tracks.get(message.address.vehicle) or self._track_of(message.address.vehicle)
            is_usual = (
                track.is_open
                and -NEAR <= stamp - track.newest <= NEAR
                and not track.doubtful
                and stamp >= track.last.get(stream, 0)
            )
            if is_usual and has_log_times:
                is_usual = track.lag is not None and -NEAR <= log - stamp - track.lag <= NEAR
            if is_usual:
                track.last[stream] = stamp
                if stamp > track.newest:
                    track.newest = stamp
                    track.log = log if has_log_times else None
                if has_log_times:
                    track.lag = log - stamp
                waiting.append((track.base + stamp, number, message))
                usual = track
            else:
                if usual is not None:
                    shift = usual.shift
                    usual = (
                        None  # a log time that has changed counts once the next message confirms it
                    )
                item = Item(message, stream, stamp, log if has_log_times else None, number, shift)
                waiting += self._place(item, opening)
            if len(waiting) >= enough:
                waiting.sort()
                ready = self._count_ready(waiting)
                yield from self._emit(waiting[:ready])
                del waiting[:ready]
                enough = len(waiting) + _PART
        waiting += self._end(opening)
        waiting.sort()
        yield from self._emit(waiting)

    def _track_of(self, vehicle: str) -> Track[M]:
        def on_part(place: int, stamp: int) -> None:
            self.axis.add(vehicle, place, stamp)

        track = Track[M](self.unordered, on_part)
        self._tracks[vehicle] = track
        return track

    def _place(self, item: Item[M], opening: list[Item[M]]) -> list[_Waiting[M]]:
        """Return the messages whose places are known now; those of a new vehicle wait in `opening`."""
        track = self._tracks[item.message.address.vehicle]
        if track.is_open:
            return _places_of(track.add(item))
        opening.append(item)
        enough = _OPENING if self._zero is None else _OPENING_LATER
        if len(opening) < enough:
            return []
        waiting = _places_of(self._begin(opening))
        opening.clear()
        return waiting

    def _end(self, opening: list[Item[M]]) -> list[_Waiting[M]]:
        """Return the places of the messages that still wait."""
        placed = self._begin(opening)
        for track in self._tracks.values():
            placed += track.end()
        return _places_of(placed)

    def _count_ready(self, waiting: Sequence[_Waiting[M]]) -> int:
        """Return how many of these sorted messages no earlier one can follow: in a log, those that are old enough."""
        count = len(waiting)
        if self._has_log_times:
            return max(0, count - _BUFFER)
        newest, _, _ = waiting[-1]
        old = bisect_left(waiting, newest - _LATE, key=itemgetter(0))
        return max(count - _LOG_BUFFER, min(old, count - _PART))

    def _emit(self, placed: Iterable[_Waiting[M]]) -> Iterator[M]:
        """Yield sorted messages with their times on the axis; those from before its zero are at 0."""
        zero = self._zero or 0
        newest = self._place_of_last or zero
        for place, _, message in placed:
            newest = max(newest, place)
            message.at = (newest - zero) / 1e6
            yield message
        self._place_of_last = newest

    def _begin(self, opening: Sequence[Item[M]]) -> list[Placed[M]]:
        """Place the first messages of vehicles on the axis; the log times place the vehicles against each other."""
        by_vehicle = defaultdict[str, list[Item[M]]](list)
        for item in opening:
            by_vehicle[item.message.address.vehicle].append(item)
        firsts = [first_of(items, self._start_of(name)) for name, items in by_vehicle.items()]
        for first in sorted(firsts, key=lambda item: item.number):
            self._begin_track(first)
        if self._zero is None and firsts:
            self._zero = self._find_zero()
            self.axis.zero = self._zero
        placed: list[Placed[M]] = []
        for item in opening:
            track = self._tracks[item.message.address.vehicle]
            placed += track.add(item)
        return placed

    def _begin_track(self, first: Item[M]) -> None:
        time = first.stamp if first.log is None else first.log
        track = self._tracks[first.message.address.vehicle]
        track.begin(first, time + first.shift)

    def _find_zero(self) -> int:
        """Return the place of the first message, or where the axis of all messages of the file begins."""
        tracks = sorted(self._tracks.items(), key=lambda item: item[1].base + item[1].newest)
        if self.whole is not None:
            for name, track in tracks:
                seconds = self.whole.seconds_of(name, track.newest)
                if seconds is not None:
                    return track.base + track.newest - round(seconds * 1e6)
        _, first = tracks[0]
        return first.base + first.newest


def _places_of(placed: Iterable[Placed[M]]) -> list[_Waiting[M]]:
    return [(place, item.number, item.message) for place, item in placed]
