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
from nedbus.transport import RawSample, entity_name
from nedbus_msgs import AddressError

from .decoder import MAX_KEYS, Arrival, Decode, Decoder
from .questions import Question, Questions
from .sample import Counts, M_co, Mode, Sample
from .sequence_tracker import SequenceTracker
from .wakeups import Wakeups

if TYPE_CHECKING:
    from zenoh.ext import Miss

    from .batch import Batch

_log = logging.getLogger(__name__)

CAPACITY: Final = 65_536
"""Samples that are kept for a reader of mode `every`, some 45 MB; beyond, the oldest are dropped."""

_MAX_BATCH: Final = 4096  # messages of a batch
_FRESH: Final = 1024  # samples that are queued as they are; further ones are going to wait
_MANY: Final = 8  # samples of one key for which a look at all of them together pays


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
        self.wakeups = Wakeups()
        self._name = name
        self._warned = False
        self._decoder = decoder
        self._lock = threading.Lock()
        self._every: deque[Arrival] = deque()
        self._newest: dict[str, Arrival] = {}
        self._unreported: dict[str, int] = {}  # losses before a sample that was invalid, by key
        self._tracker = SequenceTracker()
        self._announcements: deque[Miss] = deque()
        self._questions = Questions(self._tracker)
        self._arrived = self._dropped = self._received = 0

    @property
    def counts(self) -> Counts:
        """What became of the messages so far."""
        with self._lock:
            self._apply_announcements()
            dropped = self._dropped + self._tracker.dropped
            return Counts(self._received, self._tracker.lost, dropped, self._decoder.invalid)

    @property
    def waiting(self) -> int:
        """How many messages wait to be read."""
        return len(self._every) or len(self._newest)

    def announce_loss(self, miss: Miss) -> None:
        """Note that messages were lost in transit; called on Zenoh's thread, before the next sample."""
        self._announcements.append(miss)

    def count_invalid(self, count: int) -> None:
        """Count samples that could not be queued."""
        self._decoder.count_invalid(count)

    def knows(self, publisher: str) -> bool:
        """Return whether anything of this publisher has arrived."""
        with self._lock:
            return self._tracker.has(publisher, 0) is not None

    def put(self, batch: Sequence[RawSample], *, overflowed: bool = False) -> None:
        """Queue all that has arrived, in its order, and reject what is not worth queueing.

        `overflowed`: it comes from a channel that was full, and perhaps dropped something.
        """
        arrivals = self._decoder.admit(batch)
        with self._lock:
            if self._announcements:
                self._apply_announcements()
            self._tracker.queue_drops = overflowed
            self._follow(arrivals)
            self._arrived += len(arrivals)
            if self.newest_only:
                for arrival in arrivals:
                    self._supersede(arrival)
            else:
                overflowed |= self._append(arrivals)
        if overflowed and not self.newest_only and not self._warned:
            self._warned = True
            extra = about("dropped")
            _log.warning("%s: the reader is slower than the data: messages are dropped", self._name, extra=extra)
        if self._questions:
            self._answer(drained=True)

    def ask(self, question: Question) -> None:
        """Answer a publisher's question as soon as it can be answered; called in a thread of its own."""
        with self._lock:
            self._apply_announcements()  # of a stream that has ended nothing else does
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
        if self.ended:
            self.wakeups.wake()  # other threads that wait
        return True

    def pop(self, decode: Decode[M_co]) -> Sample[M_co] | None:
        """Return the next sample, None when nothing is left; what is invalid is counted and left out."""
        while (arrival := self._take()) is not None:
            lost = arrival[3]
            if self._unreported:
                with self._lock:
                    lost += self._unreported.pop(arrival[0].key, 0)
            sample = self._decoder.decode(arrival, decode, lost=lost)
            if sample is not None:
                self._received += 1
                return sample
            with self._lock:
                self._report_later(arrival[0].key, lost)
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
            if self._unreported:
                lost += sum(self._unreported.pop(key, 0) for key in {stream.key for stream, _, _, _ in taken})
        if self._questions:
            self._answer(drained=False)
        if not taken:
            return None
        batch = make_batch(taken, self._decoder, lost=lost)
        if not len(batch):
            with self._lock:
                self._report_later(taken[0][0].key, lost)
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

    def _follow(self, arrivals: list[Arrival]) -> None:
        """Note in each arrival how many messages were lost just before it."""
        tracker = self._tracker
        if len(arrivals) >= _MANY and len({stream for stream, _, _, _ in arrivals}) == 1:
            infos = [raw.source_info for _, _, raw, _ in arrivals]
            numbers = [info.source_sn for info in infos if info is not None]
            if len(numbers) == len(arrivals) and tracker.arrived_in_order(arrivals[0][0].key, numbers):
                return
        for index, (stream, payload, raw, _) in enumerate(arrivals):
            info = raw.source_info
            if info is not None and (lost := tracker.arrived(stream.key, info)):
                arrivals[index] = stream, payload, raw, lost

    def _append(self, arrivals: list[Arrival]) -> bool:
        """Queue all, and return whether older ones had to be dropped."""
        every = self._every
        every.extend(map(self._decoder.keep, arrivals) if len(every) > _FRESH else arrivals)
        drops = len(every) - CAPACITY
        for _ in range(drops):
            stream, _, _, lost = every.popleft()
            self._dropped += 1
            self._report_later(stream.key, lost)
        return drops > 0

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

    def _report_later(self, key: str, lost: int) -> None:
        if lost and len(self._unreported) < MAX_KEYS:
            self._unreported[key] = self._unreported.get(key, 0) + lost

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

    def _apply_announcements(self) -> None:
        while self._announcements:
            miss = self._announcements.popleft()
            self._tracker.announce(entity_name(miss.source), miss.nb)
