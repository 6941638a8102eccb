"""Reports of rejected messages: what services on this network did not publish, and why. No report is trusted."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from typing import Final

import zenoh

from nedbus.transport import Session, while_open
from nedbus_msgs import Address, AddressError, address_of_rejected_key, rejected_key_expr

from .closing import Finalizer

_CHANNEL: Final = 1000  # reports that wait; beyond, the oldest are dropped
_MAX_REPORT: Final = 2**16  # bytes of a report that is read
_MAX_TEXT: Final = 300  # characters that are kept of a reason


@dataclass(frozen=True, slots=True)
class RejectionReport:
    """A message that a service rejected.

    `received`: when the report arrived here, ns since the epoch.
    `reason`: the service's words, at most 300 characters: a peer wrote them, and may have written anything.
    """

    address: Address
    reason: str
    received: int


class Rejections:
    """The reports that arrive; get one from `bus.rejections()`.

    It is closed when it is no longer referenced, and with the bus.
    """

    def __init__(self, session: Session, *, prefix: str, owner: object) -> None:
        self._prefix = prefix
        self._owner = owner  # the bus stays open for as long as somebody may read
        channel: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(_CHANNEL)
        with while_open():
            subscriber = session.declare_subscriber(rejected_key_expr(prefix=prefix), channel)
        self._handler: zenoh.Handler[zenoh.Sample] = subscriber.handler
        self._finalizer = Finalizer(self, subscriber.undeclare)

    def take(self) -> list[RejectionReport]:
        """Return the reports that have arrived since the last call, at most 1000, without waiting."""
        reports = []
        with while_open():
            while (sample := self._handler.try_recv()) is not None:
                report = self._read(sample)
                if report is not None:
                    reports.append(report)
        return reports

    def close(self) -> None:
        """Follow them no more; a second call does nothing."""
        self._finalizer.close_now()

    def _read(self, sample: zenoh.Sample) -> RejectionReport | None:
        try:
            address = address_of_rejected_key(str(sample.key_expr), prefix=self._prefix)
            content = json.loads(sample.payload.to_bytes()) if len(sample.payload) <= _MAX_REPORT else None
        except (AddressError, ValueError, RecursionError):
            return None
        reason = content.get("reason") if isinstance(content, dict) else None
        return RejectionReport(address, str(reason)[:_MAX_TEXT], time.time_ns()) if reason else None
