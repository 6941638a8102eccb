"""A subscription to the messages that services reject; peers are untrusted."""

import json
from dataclasses import dataclass
from itertools import islice

import zenoh

from nedbus import clock, limits
from nedbus.errors import AddressError
from nedbus.transport import Session, translate_zenoh_errors
from nedbus_msgs import REJECTED, Address

from .closing import Finalizer


@dataclass(frozen=True, slots=True)
class RejectionReport:
    """A message that a service rejected.

    `reason`: untrusted text from the service, at most 300 characters.
    `received`: time at which the report arrived, ns since the epoch.
    """

    address: Address
    reason: str
    received: int


class Rejections:
    """A subscription to rejection reports; get one from `bus.rejections()`.

    It closes with the bus, or when it is garbage-collected.
    """

    def __init__(self, session: Session, *, prefix: str, owner: object) -> None:
        self._prefix, self._owner = prefix, owner  # the owner keeps the bus open
        with translate_zenoh_errors():
            subscriber = session.declare_subscriber(
                f"{prefix}{REJECTED}/**", zenoh.handlers.RingChannel(limits.UNREAD_REPORTS)
            )
        self._handler = subscriber.handler
        self._finalizer = Finalizer(self, subscriber.undeclare)

    def take(self) -> list[RejectionReport]:
        """Return the reports received since the last call, at most 250, without waiting."""
        with translate_zenoh_errors():
            samples = list(islice(iter(self._handler.try_recv, None), limits.UNREAD_REPORTS))
        reports: list[RejectionReport] = []
        for sample in samples:
            try:
                address = Address.from_key(str(sample.key_expr), prefix=self._prefix + REJECTED)
                content = None
                if len(sample.payload) <= limits.REPORT_BYTES:
                    content = json.loads(sample.payload.to_bytes())
            except (AddressError, ValueError, RecursionError):
                continue
            if isinstance(content, dict) and (reason := content.get("reason")):
                reports.append(
                    RejectionReport(address, str(reason)[: limits.PEER_TEXT], clock.utc_ns())
                )
        return reports

    def close(self) -> None:
        """End the subscription. Idempotent."""
        self._finalizer.close_now()
