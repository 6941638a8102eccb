"""Downsampled copies of a stream, one per rate in RATES, published while they have subscribers.

`<key>/@rate/5` carries up to 5 messages per second of `<key>`, with its own sequence numbers and history cache.
Each vehicle has one matching listener for all rates; once it is matched, each stream declares its own listeners.
"""

import threading
import time
from contextlib import suppress
from functools import partial
from time import monotonic
from typing import Final

import zenoh

from nedbus.client.rate_gate import RATES, RateGate
from nedbus.transport import Session, translate_zenoh_errors
from nedbus_msgs import ANY, Address, Topic, get_topic

from .group import Outgoing
from .writer import Heartbeats, Writer

# s between checks whether any downsampled stream of a vehicle has subscribers
_CHECK: Final = 0.02
# ns for which an unmatched writer is kept, so readers that return after an outage recover and count what they missed
_LINGER: Final = 600_000_000_000


class MatchingListener:
    """Matching status of a key expression, from a publisher that never publishes. Thread-safe.

    `matched`: the status at the last call of `is_matched`. `next_check`: monotonic time before which publishers that
    share an unmatched listener do not ask again [s].
    """

    def __init__(self, session: Session, key_expr: str) -> None:
        with translate_zenoh_errors():
            self._probe = session.declare_publisher(key_expr)
            try:  # the listener reports the current status first
                self._listener = self._probe.declare_matching_listener(
                    zenoh.handlers.RingChannel(1)
                )
            except BaseException:
                self._probe.undeclare()
                raise
        self.matched = False
        self.next_check = 0.0
        # all publishers of a vehicle share one listener; reentrant for signal handlers
        self._lock = threading.RLock()
        self._try_recv = self._listener.handler.try_recv

    def is_matched(self) -> bool:
        """Return True if there are subscribers, according to Zenoh's latest report."""
        with self._lock:
            try:
                if (status := self._try_recv()) is not None:
                    self.matched = status.matching
            except zenoh.ZError:  # closed
                self.matched = False
            return self.matched

    def close(self) -> None:
        """Undeclare the listener and its publisher."""
        with suppress(zenoh.ZError):  # the session is already closed
            self._listener.undeclare()
            self._probe.undeclare()


class Downsampler:
    """Publisher of the downsampled copies of one address; not thread-safe.

    `listener`: matched by subscribers of any downsampled stream of the vehicle.
    `address_listener`: matched by subscribers of this address; None until `listener` was matched. Before that, `put`
    has nothing to do until `next_check` of the listener, unless that is known to be matched.
    """

    def __init__(
        self, heartbeats: Heartbeats, address: Address, *, prefix: str, listener: MatchingListener
    ) -> None:
        self.vehicle_listener, self._heartbeats = listener, heartbeats
        self._key = partial(address.rate_key, prefix=prefix)
        self._topic = get_topic(address.topic)
        self.address_listener: MatchingListener | None = None
        self._streams: list[_Stream] = []

    def put(self, message: Outgoing) -> None:
        """Publish a message at all matched rates for which it is due; never waits for a reader."""
        if self.address_listener is None:
            if not self.vehicle_listener.is_matched():
                self.vehicle_listener.next_check = monotonic() + _CHECK
                return
            self.address_listener = MatchingListener(self._heartbeats.session, self._key(ANY))
        # not the message's timestamp: a replay at 10 times the speed would exceed the rate
        now = time.monotonic_ns()
        is_matched = self.address_listener.is_matched()
        if is_matched and not self._streams:
            self._streams = [
                _Stream(self._heartbeats, self._key(rate), rate, self._topic) for rate in RATES
            ]
        for stream in self._streams:
            if is_matched or stream.writer is not None:
                stream.put(now, message)

    def close(self) -> None:
        """Undeclare all streams and listeners."""
        for stream in self._streams:
            stream.close()
        if self.address_listener is not None:
            self.address_listener.close()


class _Stream:
    """The stream of one rate; its writer exists while the stream has subscribers, and for ten minutes afterwards."""

    def __init__(self, heartbeats: Heartbeats, key: str, rate: int, topic: Topic) -> None:
        self.writer: Writer | None = None
        self._listener = MatchingListener(heartbeats.session, key)
        self._open = partial(Writer, heartbeats, key, topic, cache=20 * rate)  # 20 s
        self._rate, self._gate = rate, RateGate(rate)
        self._matched_at = 0

    def put(self, now: int, message: Outgoing) -> None:
        if self._listener.is_matched():
            self._matched_at = now
            if self.writer is None:
                self.writer, self._gate = self._open(), RateGate(self._rate)
        if self.writer is not None and now - self._matched_at > _LINGER:
            self.writer.close()
            self.writer = None
        if self.writer is not None and self._gate.passes(now):
            self.writer.put((message,))  # if unmatched, this only fills the history cache

    def close(self) -> None:
        if self.writer is not None:
            self.writer.close()
        self._listener.close()
