"""The service's replies to queries of its status and events: one key for each vehicle, with what concerns it."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Final

from nedbus import clock, limits
from nedbus.client import QueryServer, ServiceStatus, reply_parts
from nedbus.vehicle_events import ACCOUNT_PARAMETER, AccountReport
from nedbus_msgs import status_key

_FRESH: Final = 0.5  # s; a query for all vehicles of a service asks once for each of them
# A reply is kept for at least this many times as long as it took: a query of a thousand vehicles makes it once.
_REST: Final = 4


class StatusReplies:
    """Reply to queries on the status keys of a service's vehicles.

    `status`, `report`: return the current status, and the report of the last seconds, of all vehicles.
    """

    def __init__(
        self,
        queries: QueryServer,
        service: str,
        *,
        prefix: str,
        status: Callable[[], ServiceStatus],
        report: Callable[[float], AccountReport],
    ) -> None:
        self._queries = queries
        self._service = service
        self._prefix = prefix
        self._make_status, self._make_report = status, report
        self._lock = threading.Lock()
        self._vehicles: set[str] = set()
        # with the time until which it is fresh
        self._status: tuple[float, ServiceStatus] | None = None
        # with that time, and the period it covers
        self._report: tuple[float, float, AccountReport] | None = None

    def add(self, vehicle: str) -> None:
        """Reply for this vehicle, too, until the service ends; do nothing beyond `limits.VEHICLES`."""
        with self._lock:
            if vehicle in self._vehicles or len(self._vehicles) >= limits.VEHICLES:
                return
            self._vehicles.add(vehicle)
        key = status_key(self._service, vehicle=vehicle, prefix=self._prefix)
        self._queries.answer_json(key, partial(self._reply, vehicle))

    def _reply(self, vehicle: str, parameter: Callable[[str], str | None]) -> Iterator[bytes]:
        within = parameter(ACCOUNT_PARAMETER)
        if within is None:
            return self._status_parts(vehicle)
        seconds = 0.0
        with suppress(ValueError):
            seconds = float(within)
        return reply_parts(self._current_report(seconds).about(vehicle))

    def _status_parts(self, vehicle: str) -> Iterator[bytes]:
        """Yield the status of a vehicle; nothing if all sources publish others, as with `sim:?vehicle=2`."""
        status = self._current_status()
        own = status.about(vehicle)
        if own.sources or own.refused or not status.sources:
            yield from reply_parts(replace(own, now=clock.utc()))

    def _current_status(self) -> ServiceStatus:
        known = self._status
        begin = time.monotonic()
        if known is not None and begin < known[0]:
            return known[1]
        status = self._make_status()
        self._status = _fresh_until(begin), status
        return status

    def _current_report(self, within: float) -> AccountReport:
        known = self._report
        begin = time.monotonic()
        if known is not None and known[1] == within and begin < known[0]:
            return known[2]
        report = self._make_report(within)
        self._report = _fresh_until(begin), within, report
        return report


def _fresh_until(begin: float) -> float:
    """Return until when a reply is fresh that was made from `begin` until now."""
    end = time.monotonic()
    return end + max(_FRESH, _REST * (end - begin))
