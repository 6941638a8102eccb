"""The queue between Zenoh and a reader: every sample in order, or the newest of each key. No I/O.

The thread of a ZenohSubscriber puts, the reader's thread takes. Here is decided that a reader is too slow:
`latest` supersedes what was not read yet, and counts it as dropped; `every` lets `wait_for_capacity` hold back.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, get_args

from nedbus.transport import RawSample
from nedbus_msgs import AddressError, Row, decode_row

from .decoder import MAX_KEYS, Decode, Decoder
from .sample import Counts, M_co, Mode, Sample
from .sequence_tracker import SequenceTracker

if TYPE_CHECKING:
    from zenoh.ext import Miss

    from .batch import Batch

CAPACITY: Final = 1024  # samples that are queued for an `every` reader before its pump waits
_MAX_BATCH: Final = 4096  # messages of a batch


class ReceiveQueue:
    """Queue what arrived until it is read, decode it then, and count what became of it."""

    def __init__(self, mode: Mode, decoder: Decoder) -> None:
        if mode not in get_args(Mode):
            raise AddressError("mode", mode, f"one of {', '.join(get_args(Mode))}")
        self.newest_only = mode == "latest"
        self.ended = False
        self.wake: Callable[[], object] = lambda: None
        self._decoder = decoder
        self._lock = threading.Lock()  # for the tracker, the newest samples, and the capacity
        self._capacity = threading.Condition(self._lock)
        self._wakeups: queue.SimpleQueue[None] = queue.SimpleQueue()  # cheaper than a Condition
        self._every: deque[RawSample] = deque()
        self._newest: dict[str, tuple[RawSample, int]] = {}  # with what was lost before it
        self._unreported: dict[str, int] = {}  # losses before a sample that was invalid, by key
        self._tracker = SequenceTracker(queue_drops=self.newest_only)
        self._announcements: deque[Miss] = deque()
        self._received = self._superseded = self._lost_in_batches = 0
        self._full = False  # the pump waits for capacity

    @property
    def counts(self) -> Counts:
        """What became of the messages so far."""
        with self._lock:
            self._apply_announcements()
            dropped = self._superseded + self._tracker.dropped
            return Counts(self._received, self._tracker.lost, dropped, self._decoder.invalid)

    def announce_loss(self, miss: Miss) -> None:
        """Note that messages were lost in transit; called on Zenoh's thread, before the next sample."""
        self._announcements.append(miss)

    def count_invalid(self, count: int) -> None:
        """Count samples that could not be queued."""
        self._decoder.count_invalid(count)

    def put(self, batch: Sequence[RawSample]) -> None:
        """Queue what arrived, in its order; what is not worth queueing is rejected."""
        admitted = self._decoder.admit(batch)
        with self._lock:
            if self.newest_only:
                self._apply_announcements()
                for raw in admitted:
                    self._supersede(raw)
            else:
                self._every.extend(admitted)
        self._wake_reader()

    def end(self) -> None:
        """Let readers know that nothing more comes."""
        with self._lock:
            self.ended = True
            self._capacity.notify_all()
        self._wake_reader()

    def wait(self, timeout: float | None) -> bool:
        """Wait until there is something to read, or the queue has ended; return False after `timeout` seconds."""
        end = None if timeout is None else time.monotonic() + timeout
        while not (self._every or self._newest or self.ended):
            try:
                self._wakeups.get(timeout=None if end is None else max(0.0, end - time.monotonic()))
            except queue.Empty:
                return False
        if self.ended:
            self._wake_reader()  # for other threads that wait
        return True

    def wait_for_capacity(self) -> None:
        """Wait until fewer than 1,024 samples are queued, or the queue has ended."""
        with self._lock:
            self._full = True
            self._capacity.wait_for(lambda: len(self._every) < CAPACITY or self.ended)
            self._full = False

    def pop(self, decode: Decode[M_co]) -> Sample[M_co] | None:
        """Return the next sample, None when nothing is left; what is invalid is counted and left out."""
        while (taken := self._take()) is not None:
            raw, key, lost = taken
            if self._unreported:
                lost += self._unreported.pop(key, 0)
            sample = self._decoder.decode(raw, key, decode, lost=lost)
            if sample is not None:
                self._received += 1
                return sample
            if lost and len(self._unreported) < MAX_KEYS:
                self._unreported[key] = lost
        return None

    def pop_batch(self) -> Batch | None:
        """Return all that is queued, None if that is nothing; what is invalid is counted and left out."""
        from .batch import make_batch

        with self._lock:
            self._apply_announcements()
            raw = [raw for raw, _ in self._newest.values()]
            raw += [self._every.popleft() for _ in range(min(len(self._every), _MAX_BATCH))]
            self._newest.clear()
            self._capacity.notify_all()
            if not self.newest_only:
                self._tracker.skip()  # announced losses are enough here: no single sample reports them
            lost = self._tracker.lost - self._lost_in_batches
        if not raw:
            return None
        keys = [str(each.key_expr) for each in raw]
        batch = make_batch(
            raw,
            keys,
            self._decoder.addresses(keys),
            received=time.time_ns(),
            lost=lost,
            decode=self._decode_row,
        )
        if not len(batch):
            return None
        self._received += len(batch)
        self._lost_in_batches += lost
        return batch

    def _take(self) -> tuple[RawSample, str, int] | None:
        """Take the next sample, its key, and how many were lost before it; several threads may take."""
        with self._lock:
            if self._every:
                raw = self._every.popleft()
                if self._full and len(self._every) <= CAPACITY // 2:
                    self._full = False
                    self._capacity.notify_all()
                self._apply_announcements()
                key = str(raw.key_expr)
                return raw, key, self._follow(key, raw)
            if self._newest:
                key = next(iter(self._newest))
                raw, lost = self._newest.pop(key)
                return raw, key, lost
        return None

    def _decode_row(self, raw: RawSample, key: str) -> Row | None:
        sample = self._decoder.decode(raw, key, decode_row)
        return None if sample is None else sample.message

    def _supersede(self, raw: RawSample) -> None:
        key = str(raw.key_expr)
        lost = self._follow(key, raw)
        waiting = self._newest.get(key)
        if waiting is None and len(self._newest) >= MAX_KEYS:
            self._superseded += 1
            return
        if waiting is not None:
            self._superseded += 1
            lost += waiting[1]
        self._newest[key] = raw, lost

    def _follow(self, key: str, raw: RawSample) -> int:
        """Return how many messages were lost just before this one."""
        info = raw.source_info
        return 0 if info is None else self._tracker.arrived(key, info.source_sn, lambda: str(info.source_id))

    def _apply_announcements(self) -> None:
        while self._announcements:
            miss = self._announcements.popleft()
            self._tracker.announce(str(miss.source), miss.nb)

    def _wake_reader(self) -> None:
        if self._wakeups.empty():
            self._wakeups.put(None)
        self.wake()
