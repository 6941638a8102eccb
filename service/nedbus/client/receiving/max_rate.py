"""Subscription with a maximum rate: last messages first, then the streams downsampled by publishers.

If a publisher does not downsample, a warning is logged; the full rate is never used: it could overload the link.
"""

import logging
import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final

import zenoh

from nedbus import clock
from nedbus.client.io_thread import CallThread
from nedbus.client.protocol import LIVE
from nedbus.client.rate_gate import RateGate, rate_step
from nedbus.errors import NedbusError
from nedbus.log_event import about
from nedbus.samples import Mode
from nedbus.timings import TIMINGS
from nedbus.transport import Publishers, RawSample, Session, VehicleDirectory, send_query
from nedbus_msgs import Address, Selection, check_max_rate, get_topic

from .arrival import Arrival, detach
from .decoder import Decoder
from .inbox import Inbox
from .receiver import Receiver

_log = logging.getLogger(__name__)

_TIMEOUT: Final = 2.0  # s for the queries of last messages
_CHECK: Final = 1.0  # s between checks for publishers that do not downsample
_LAST_POLL: Final = 0.02  # s between polls for last messages
_OVERTAKEN: Final = 2_000_000_000  # ns by which a last message may overtake a downsampled one

# listing publishers may open a session, which would block the I/O thread
_checks = CallThread("nedbus-publishers")


class MaxRateInbox(Inbox):
    """Limit each stream to `max_rate` messages per second (see RateGate); raise ArgumentError unless it is valid.

    Messages omitted to limit the rate count neither as lost nor as dropped.
    """

    def __init__(
        self,
        mode: Mode,
        decoder: Decoder,
        selection: Selection,
        *,
        max_rate: float,
        limit: int | None = None,
    ) -> None:
        check_max_rate(max_rate)
        self.rate = rate_step(max_rate)  # requested from publishers
        key_exprs = selection.rate_key_exprs(self.rate, prefix=decoder.prefix)
        super().__init__(mode, decoder, key_exprs=key_exprs, limit=limit)
        self.selection, self._max_rate = selection, max_rate

    def put_last(self, batch: Sequence[RawSample]) -> None:
        """Queue the last messages of streams that have delivered none yet."""
        last, received = list[Arrival](), clock.utc_ns()
        with self._lock:
            for raw in batch:
                if (arrival := self._admit(raw, received)) is None:
                    continue
                stream = self.streams.open(self._rate_key(arrival.stream.address), self._clock())
                if arrival.payload and stream.gate is None and stream.last_sent == -math.inf:
                    stream.last_sent = _sent(arrival)
                    last.append(detach(arrival, retained=True))
            super()._queue(last)
        self.wake()

    def has_downsampled(self, address: Address) -> bool:
        """Return True if a downsampled message of a stream has arrived."""
        with self._lock:
            stream = self.streams.get(self._rate_key(address))
            return stream is not None and stream.gate is not None

    def _rate_key(self, address: Address) -> str:
        return address.rate_key(self.rate, prefix=self.decoder.prefix)

    def _queue(self, arrivals: list[Arrival]) -> None:
        super()._queue([arrival for arrival in arrivals if self._passes(arrival)])

    def _passes(self, arrival: Arrival) -> bool:
        stream = arrival.stream
        stream.gate = stream.gate or RateGate(self._max_rate)
        passes = not 0 <= stream.last_sent - _sent(arrival) <= _OVERTAKEN
        if self.rate > self._max_rate:  # below the lowest rate of publishers
            passes = passes and stream.gate.passes(time.monotonic_ns())
        if not passes:
            stream.unreported += arrival.lost
        return passes


class MaxRateReceiver(Receiver):
    """Put downsampled and last messages into a MaxRateInbox until closed; `open_session`: as in FleetTokens."""

    def __init__(
        self, session: Session, inbox: MaxRateInbox, open_session: Callable[[], Session]
    ) -> None:
        self._rate_inbox, prefix = inbox, inbox.decoder.prefix
        self._directory = VehicleDirectory.of_fleet(open_session, inbox.selection, prefix=prefix)
        # when a publisher was first seen [s]; infinity once it was checked
        self._since: dict[Address, float] = {}
        self._next_check = 0.0
        _checks.start()
        keys = inbox.selection.key_exprs(prefix=prefix)
        self._last = [send_query(session, key, timeout=_TIMEOUT) for key in keys]
        super().__init__(session, inbox, history=False)
        self._undeclares.append(self._directory.close)
        self.pump()  # last messages bypass the ring, so no reader may block on it

    def _poll(self, now: float) -> float:
        pause = super()._poll(now)
        with suppress(NedbusError, zenoh.ZError):  # the session is closed
            replies = [
                reply.ok for query in self._last for reply in query.poll() if reply.ok is not None
            ]
            # Only from live publishers: a vehicle that has only a stored message is gone.
            if live := [
                raw
                for raw in replies
                if raw.attachment is not None and raw.attachment.to_bytes() == LIVE
            ]:
                self._rate_inbox.put_last(live)
        if now >= self._next_check:
            self._next_check = math.inf
            _checks.put(self._check_publishers)
        return pause if all(query.ended for query in self._last) else min(pause, _LAST_POLL)

    def _check_publishers(self) -> None:
        now, publishers = time.monotonic(), Publishers()
        with suppress(NedbusError, zenoh.ZError):  # the session is closed
            publishers = self._directory.publishers(timeout=0.0)
        regular = (
            address
            for address in publishers
            if (topic := get_topic(address.topic)).rate and not topic.on_change
        )
        # other topics may pause for long
        self._since = {address: self._since.get(address, now) for address in regular}
        due = [
            address
            for address, since in self._since.items()
            if now - since >= TIMINGS.downsampled_timeout
        ]
        self._since.update(dict.fromkeys(due, math.inf))
        if missing := [address for address in due if not self._rate_inbox.has_downsampled(address)]:
            key = missing[0].key(prefix=self._rate_inbox.decoder.prefix)
            more = f" and {len(missing) - 1} more" if missing[1:] else ""
            text = "no downsampled messages of %s%s arrive: subscribe without a maximum rate, or check the access rules"
            _log.warning(text, key, more, extra=about("unsupported"))
        self._next_check = time.monotonic() + _CHECK


def _sent(arrival: Arrival) -> float:
    """Return the time of sending [ns]; infinity without a timestamp."""
    stamp = arrival.raw.timestamp
    return math.inf if stamp is None else stamp.get_time_as_ntp64().as_nanos()
