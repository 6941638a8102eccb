"""The network side of a maximum rate: ask for last messages, and check that the publishers downsample.

If a publisher does not downsample, a warning is logged; the full rate is never used: it could overload the link.
"""

import logging
import math
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.client.io_thread import CallThread, Job
from nedbus.client.protocol import LIVE
from nedbus.errors import NedbusError
from nedbus.log_event import about
from nedbus.timings import TIMINGS
from nedbus.transport import (
    Publishers,
    RawSample,
    Session,
    VehicleDirectory,
    send_query,
    translate_zenoh_errors,
)
from nedbus_msgs import Address, get_topic

from .inbox import Inbox
from .throttle import Throttle

_log = logging.getLogger(__name__)

_TIMEOUT: Final = 2.0  # s for the queries of last messages
_CHECK: Final = 1.0  # s between checks for publishers that do not downsample
_LAST_POLL: Final = 0.02  # s between polls for last messages

# listing publishers may open a session, which would block the I/O thread
_checks = CallThread("nedbus-publishers")


class Downsampled:
    """The last messages and the publishers of a throttled inbox, until closed; `open_session`: as in FleetTokens."""

    def __init__(
        self,
        session: Session,
        inbox: Inbox,
        throttle: Throttle,
        *,
        prefix: str,
        open_session: Callable[[], Session],
    ) -> None:
        self._inbox = inbox
        self._prefix = prefix
        selection = throttle.selection
        self._directory = VehicleDirectory.of_fleet(open_session, selection, prefix=prefix)
        # when a publisher was first seen [s]; infinity once it was checked
        self._since: dict[Address, float] = {}
        self._next_check = 0.0
        _checks.start()
        with translate_zenoh_errors():
            self._queries = [
                send_query(session, key, timeout=_TIMEOUT)
                for key in selection.key_exprs(prefix=prefix)
            ]
        self._job = Job(self._poll)

    def close(self) -> None:
        """Stop asking. Idempotent."""
        self._job.end()
        self._directory.close()

    def _poll(self, now: float) -> float:
        with suppress(NedbusError, zenoh.ZError):  # the session is closed
            self._put_last_messages()
        if now >= self._next_check:
            self._next_check = math.inf
            _checks.put(self._check_publishers)
        if all(query.ended for query in self._queries):
            return _CHECK
        return _LAST_POLL

    def _put_last_messages(self) -> None:
        last = []
        for query in self._queries:
            for reply in query.poll():
                if reply.ok is not None and _is_live(reply.ok):
                    last.append(reply.ok)
        if last:
            self._inbox.put_last(last)

    def _check_publishers(self) -> None:
        now = time.monotonic()
        publishers = Publishers()
        with suppress(NedbusError, zenoh.ZError):  # the session is closed
            publishers = self._directory.publishers(timeout=0.0)
        self._since = {
            address: self._since.get(address, now) for address in publishers if _is_regular(address)
        }
        missing = []
        for address, since in self._since.items():
            if now - since < TIMINGS.downsampled_timeout:
                continue
            self._since[address] = math.inf
            if not self._inbox.has_downsampled(address):
                missing.append(address)
        if missing:
            self._warn(missing)
        self._next_check = time.monotonic() + _CHECK

    def _warn(self, missing: list[Address]) -> None:
        key = missing[0].key(prefix=self._prefix)
        more = ""
        if len(missing) > 1:
            more = f" and {len(missing) - 1} more"
        text = "no downsampled messages of %s%s arrive: subscribe without a maximum rate, or check the access rules"
        _log.warning(text, key, more, extra=about("unsupported"))


def _is_live(sample: RawSample) -> bool:
    """Return True for a last message of a live publisher; a vehicle that has only a stored message is gone."""
    return sample.attachment is not None and sample.attachment.to_bytes() == LIVE


def _is_regular(address: Address) -> bool:
    """Return True for a stream with a steady rate; other topics may pause for long."""
    topic = get_topic(address.topic)
    return bool(topic.rate) and not topic.on_change
