"""Order and pace of a flight: messages by log time, due times without pauses and without outliers."""

from collections.abc import Callable, Iterable, Iterator
from heapq import heappop, heappush
from typing import Final, TypeVar

from nedbus.samples import SourceMessage

MAX_GAP: Final = 60_000_000
"""Longest pause of a replay [us]; a longer one, or a damaged time, is skipped."""

_MAX_STEP: Final = 1_000_000  # us; a longer step must be confirmed by the next message
_REORDER_BUFFER: Final = 8192  # messages
_T = TypeVar("_T")


class Clock:
    """Replay clock: follows the times of messages from the one of `start` on, and ignores outliers [us].

    `start`: called at the first message.
    `max_behind`: consecutive messages more than MAX_GAP behind the clock, after which it is set back.
    `gaps`: number of steps that were too long, and skipped. `stray`: the last message, if its time is an outlier.
    """

    def __init__(self, start: Callable[[], int] = int, *, max_behind: int = 1) -> None:
        self.gaps = 0
        self.stray: object = None
        self._max_behind, self._start = max_behind, start
        self._now = self._due = self._behind = 0  # us; messages
        self._is_running = False

    def pace(self, messages: Iterable[_T], time_of: Callable[[_T], int]) -> Iterator[tuple[int, _T]]:
        """Yield the due time [us since the start] of each message; due times never decrease."""
        held: tuple[int, _T] | None = None
        for message in messages:
            time = time_of(message)
            self._now = self._now or self._start()
            if held is not None:
                if time >= held[0] - _MAX_STEP:
                    self._follow(held[0])
                yield self._due, held[1]
                held = None
            step = time - self._now
            if step > _MAX_STEP:
                held = time, message
                continue
            if step >= 0 and self._is_running:
                self._due, self._now, self._behind = self._due + step, time, 0
            else:
                self._follow(time)
            yield self._due, message
        if held is not None:
            if held[0] <= self._now + MAX_GAP:
                self._follow(held[0])
            elif self._is_running:
                self.stray = held[1]
            yield self._due, held[1]

    def _follow(self, time: int) -> None:
        """Advance to a time; go back only if the clock is far ahead of many consecutive messages."""
        step = time - self._now
        self._behind = self._behind + 1 if step < -MAX_GAP else 0
        if step < 0 and self._behind < self._max_behind:
            return
        if step > MAX_GAP and self._is_running:
            self.gaps += 1
        elif self._is_running:
            self._due += max(0, step)
        self._now, self._is_running = time, True


def sort_by_time(messages: Iterable[SourceMessage]) -> Iterator[SourceMessage]:
    """Sort messages by log time, because writers batch them by stream; flush if the time goes back by over MAX_GAP."""
    waiting: list[tuple[int, int, SourceMessage]] = []
    newest = 0
    for number, message in enumerate(messages):
        if message.time < newest - MAX_GAP:
            while waiting:
                yield heappop(waiting)[2]
            newest = 0
        newest = max(newest, message.time)
        heappush(waiting, (message.time, number, message))
        if len(waiting) > _REORDER_BUFFER:
            yield heappop(waiting)[2]
    while waiting:
        yield heappop(waiting)[2]
