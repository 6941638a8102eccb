"""The queue between Zenoh and a reader: every sample in order, or the newest of each key. No I/O.

Whoever receives puts, the reader's thread takes. Here is decided that a reader is too slow: `latest` supersedes what
was not read yet; `every` keeps 65,536 samples, and drops the oldest beyond. Both are counted, and hold back nobody.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, get_args

from nedbus.log_event import about
from nedbus.transport import RawSample
from nedbus_msgs import AddressError

from .decoder import MAX_KEYS, Arrival, Decode, Decoder
from .follower import Follower
from .publisher_sequence import Hole
from .questions import Question, Questions
from .sample import Counts, M_co, Mode, Sample
from .wakeups import Wakeups

if TYPE_CHECKING:
    from .batch import Batch

_log = logging.getLogger(__name__)

CAPACITY: Final = 65_536
"""Samples that are kept for a reader of mode `every`, some 45 MB; beyond, the oldest are dropped."""

_MAX_BATCH: Final = 4096  # messages of a batch
_FRESH: Final = 1024  # samples that are queued as they are; further ones are going to wait


class ReceiveQueue:
    """Queue what arrived until it is read, decode it then, and count what became of it; `name` is for the log."""

    def __init__(self, mode: Mode, decoder: Decoder, *, name: str = "") -> None:
        if mode not in get_args(Mode):
            raise AddressError("mode", mode, f"one of {', '.join(get_args(Mode))}")
        self.newest_only = mode == "latest"
        self.ended = False
        self.idle = False
        """Set by whoever receives, while it waits and nothing is left to receive."""
        self.unsettled_until = 0.0
        """Monotonic seconds: until then there may be publishers that sent something, and are not known yet."""
        self.drains = 0
        """How often all that had arrived was put."""
        self.wakeups = Wakeups()
        self._name = name
        self._warned = False
        self._decoder = decoder
        self._lock = threading.Lock()
        self._every: deque[Arrival] = deque()
        self._newest: dict[str, Arrival] = {}
        self._follower = Follower(decoder)
        self._questions = Questions(self._follower.tracker)
        self.announce_loss, self.recover = self._follower.announce, self._follower.recover
        self._arrived = self._dropped = self._received = 0

    @property
    def counts(self) -> Counts:
        """What became of the messages so far."""
        with self._lock:
            self._follower.apply_announcements()
            tracker = self._follower.tracker
            dropped = self._dropped + tracker.dropped
            return Counts(self._received, tracker.lost, dropped, self._decoder.invalid, self._follower.discarded)

    @property
    def waiting(self) -> int:
        """How many messages wait to be read."""
        return len(self._every) or len(self._newest)

    def count_invalid(self, count: int) -> None:
        """Count samples that could not be queued."""
        self._decoder.count_invalid(count)

    @property
    def held(self) -> int:
        """The number of messages that wait for those before them."""
        return self._follower.held

    @property
    def incomplete(self) -> bool:
        """Whether something is missing that may still come."""
        return self._follower.incomplete

    def excess(self, total: int, of_key: int) -> list[Hole]:
        """Return what is to be given up so that no more messages wait for those before them; see Follower."""
        with self._lock:
            return self._follower.excess(total, of_key)

    def beat(self, stream: str, publisher: str, number: int, *, begins: bool) -> None:
        """Note that a publisher has sent a message that should have arrived by now; see Follower."""
        unsettled = time.monotonic() < self.unsettled_until
        with self._lock:
            self._follower.beat(stream, publisher, number, begins=begins, unsettled=unsettled)

    def fill(self, hole: Hole, found: Sequence[RawSample]) -> None:
        """Queue what was found of a hole, and what waited for it; what is still missing is lost.

        It takes the place of nothing that is queued: where there is no room for all, the oldest of it are dropped.
        """
        admitted = self._decoder.admit(found)
        with self._lock:
            arrivals = self._follower.fill(hole, admitted)
            beyond = min(len(arrivals), max(0, len(self._every) + len(arrivals) - CAPACITY))
            self._arrived += beyond
            for arrival in arrivals[:beyond]:
                self._drop(arrival)
            self._queue(arrivals[beyond:])
        self._after_put(dropping=beyond > 0, drained=False)

    def put(self, batch: Sequence[RawSample], *, overflowed: bool = False) -> None:
        """Queue all that has arrived, in its order, and reject what is not worth queueing.

        `overflowed`: it comes from a channel that was full, and perhaps dropped something.
        """
        arrivals = self._decoder.admit(batch)
        with self._lock:
            unsettled = time.monotonic() < self.unsettled_until
            self._follower.follow(arrivals, overflowed=overflowed, unsettled=unsettled)
            self.drains += not overflowed
            overflowed |= self._queue(arrivals)
        self._after_put(dropping=overflowed, drained=True)

    def ask(self, question: Question) -> None:
        """Answer a publisher's question as soon as it can be answered; called in a thread of its own."""
        with self._lock:
            self._follower.apply_announcements()  # of a stream that has ended nothing else does
            self._questions.add(question)
        self._answer(drained=self.idle)

    def end(self) -> None:
        """Let readers know that nothing more comes, and publishers that nobody reads any more."""
        self.ended = True
        self._answer(drained=True)
        self.wakeups.wake()

    def wait(self, timeout: float | None) -> bool:
        """Wait until there may be something to read, or the queue has ended; return False after `timeout` seconds."""
        end = None if timeout is None else time.monotonic() + timeout
        while not (self._every or self._newest or self.ended):
            if not self.wakeups.wait(None if end is None else max(0.0, end - time.monotonic())):
                return False
            if timeout is None:
                break
        if self.ended or self.waiting > 1:
            self.wakeups.wake()  # another thread that waits: of all that is put at once only one is woken
        return True

    def pop(self, decode: Decode[M_co]) -> Sample[M_co] | None:
        """Return the next sample, None when nothing is left; what is invalid is counted and left out."""
        while (arrival := self._take()) is not None:
            lost = arrival[3]
            if self._follower.unreported:
                with self._lock:
                    lost += self._follower.unreported.pop(arrival[0].key, 0)
            sample = self._decoder.decode(arrival, decode, lost=lost)
            if sample is not None:
                self._received += 1
                return sample
            with self._lock:
                self._follower.report_later(arrival[0].key, lost)
        return None

    def pop_batch(self) -> Batch | None:
        """Return all that is queued, None if that is nothing; what is invalid is counted and left out."""
        from .batch import make_batch

        with self._lock:
            if self.newest_only:
                taken = list(self._newest.values())
                self._newest.clear()
            else:
                taken = [self._every.popleft() for _ in range(min(len(self._every), _MAX_BATCH))]
            lost = sum(lost for _, _, _, lost in taken)
            if unreported := self._follower.unreported:
                lost += sum(unreported.pop(key, 0) for key in {stream.key for stream, _, _, _ in taken})
        if self._questions:
            self._answer(drained=False)
        if not taken:
            return None
        batch = make_batch(taken, self._decoder, lost=lost)
        if not len(batch):
            with self._lock:
                self._follower.report_later(taken[0][0].key, lost)
            return None
        self._received += len(batch)
        return batch

    def _take(self) -> Arrival | None:
        """Take the next sample; several threads may take."""
        with self._lock:
            if self._every:
                taken = self._every.popleft()
            elif self._newest:
                taken = self._newest.pop(next(iter(self._newest)))
            else:
                return None
        if self._questions:
            self._answer(drained=False)
        return taken

    def _queue(self, arrivals: list[Arrival]) -> bool:
        """Queue all, and return whether older ones had to be dropped."""
        self._arrived += len(arrivals)
        if self.newest_only:
            for arrival in arrivals:
                self._supersede(arrival)
            return False
        every = self._every
        every.extend(map(self._decoder.keep, arrivals) if len(every) > _FRESH else arrivals)
        drops = len(every) - CAPACITY
        for _ in range(drops):
            self._drop(every.popleft())
        return drops > 0

    def _after_put(self, *, dropping: bool, drained: bool) -> None:
        if dropping and not self.newest_only and not self._warned:
            self._warned = True
            extra = about("dropped")
            _log.warning("%s: the reader is slower than the data: messages are dropped", self._name, extra=extra)
        if self._questions:
            self._answer(drained=drained)

    def _drop(self, arrival: Arrival) -> None:
        stream, _, _, lost = arrival
        self._dropped += 1
        self._follower.report_later(stream.key, lost)

    def _supersede(self, arrival: Arrival) -> None:
        key = arrival[0].key
        waiting = self._newest.get(key)
        if waiting is not None:
            self._dropped += 1
            arrival = (*arrival[:3], arrival[3] + waiting[3])
        elif len(self._newest) >= MAX_KEYS:
            self._dropped += 1
            return
        self._newest[key] = arrival

    def _answer(self, *, drained: bool) -> None:
        drained = drained and time.monotonic() >= self.unsettled_until
        with self._lock:
            if self.ended:
                ready = self._questions.take_all()
            else:
                taken = self._arrived - len(self._every)
                ready = self._questions.settle(arrived=self._arrived, taken=taken, drained=drained)
        for question in ready:
            question.reply()
