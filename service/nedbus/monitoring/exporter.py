"""Metrics exporter for networks without a nedbus service to scrape; needs the extra `metrics`."""

import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict
from typing import Any, Final

from prometheus_client.core import Metric

from nedbus import Bus, Session, clock, limits
from nedbus.errors import NedbusError
from nedbus.health import LogStreamStatus, PositionStatus, RouterState, find_services, query_routers
from nedbus.timings import TIMINGS
from nedbus.vehicle_events import report_of
from nedbus_msgs import Selection

from .http_server import Page
from .metrics import (
    MeasuredStream,
    build_info,
    make_metrics,
    metrics_page,
    stream_metrics,
    vehicle_metrics,
)
from .observer import Observer
from .pages import vehicles_page

_POLL_INTERVAL: Final = 0.5  # s
_SERVICES_INTERVAL: Final = 5.0  # s between queries of services while MAVLink sources publish


class Exporter(Observer):
    """Observer that exports metrics of its streams and vehicles; `pages`: HTTP pages by path."""

    def __init__(self, bus: Bus, selection: Selection, *, version: str) -> None:
        super().__init__(bus, selection)
        self._version = version
        self.pages: Mapping[str, Callable[[], Page]] = {
            "/metrics": lambda: metrics_page(self._metrics()),
            "/healthz": lambda: Page.text("ok"),
            "/readyz": lambda: Page.verdict(self._faults(), "ready"),
            "/vehicles": self._vehicles,
            "/status": lambda: Page.json(self._status()),
        }
        self._routers: list[RouterState] = []
        self.log_streams: Mapping[str, LogStreamStatus] = {}  # by vehicle
        self.positions: Mapping[str, PositionStatus] = {}  # that services send, by vehicle
        self._session: Session | None = None  # for queries

    def run(self, stop: threading.Event) -> None:
        """Run until `stop` is set; raise the error that ended the reader early."""
        with ThreadPoolExecutor(2, thread_name_prefix="nedbus-export") as pool:
            tasks = pool.submit(self._read), pool.submit(self._query_peers, stop)
            for task in tasks:
                task.add_done_callback(lambda _: stop.set())
            try:
                while not stop.wait(_POLL_INTERVAL):
                    self.poll()
            finally:
                stop.set()
                if self._session is not None:
                    self._session.close()  # aborts a query without a reply
                self.subscription.close()
            for task in tasks:
                task.result()

    def _metrics(self) -> Iterator[Metric]:
        """Yield all metrics of the exporter."""
        counts = self.subscription.counts
        streams = list(self._streams())
        reached = [
            (("vehicles",), self.event_log.refused),
            (("streams",), self.monitor.evicted),
            (("keys",), counts.forgotten),
        ]
        sessions = [((router.zid,), router.sessions) for router in self._routers]
        limited = [router for router in self._routers if router.max_sessions is not None]
        yield build_info(self._version)
        yield from make_metrics(
            {
                "nedbus_connected": [((), self._bus.connected)],
                "nedbus_messages_dropped": [((), counts.dropped)],
                "nedbus_messages_invalid": [((), counts.invalid)],
                "nedbus_queue_messages": [((), self.subscription.waiting)],
                "nedbus_limit_reached": reached,
                "nedbus_router_sessions": sessions,
                "nedbus_router_sessions_max": [
                    ((router.zid,), router.max_sessions) for router in limited
                ],
            }
        )
        yield from stream_metrics(streams, messages="nedbus_messages_received")
        yield from vehicle_metrics(self.event_log, streams)

    def _streams(self) -> Iterator[MeasuredStream]:
        """Yield the streams with their latencies."""
        for address, newest in self.monitor.items():
            latencies = self.monitor.latencies(address)
            if latencies is not None:  # else it was evicted in the meantime
                labels = (address.vehicle, address.stream, newest.sample.source or "")
                yield MeasuredStream(labels, newest.health, latencies=latencies)

    def _read(self) -> None:
        for sample in self.subscription.rows():
            self.add(sample)

    def _query_peers(self, stop: threading.Event) -> None:
        """Query routers now and then, and services more often while MAVLink sources publish."""
        due = 0.0
        while not stop.wait(max(0.0, min(_SERVICES_INTERVAL, due - time.monotonic()))):
            if time.monotonic() >= due:
                self._query_routers(stop)
                due = time.monotonic() + TIMINGS.routers_interval
            elif self._session is not None and self._has_mavlink():
                self._query_services(self._session)
        if self._session is not None:
            self._session.close()

    def _query_routers(self, stop: threading.Event) -> None:
        routers = list[RouterState]()
        with suppress(NedbusError):  # the router is full, or the link is down
            if self._session is None:
                # An own session: a large reply (183 kB from a router with 1,000 sessions) would delay messages.
                self._session = self._bus.open_session(timeout=TIMINGS.routers_session)
            if not stop.is_set():
                routers = query_routers(self._session, timeout=TIMINGS.routers_timeout)
        self._routers = routers[: limits.EXPORTED_ROUTERS]

    def _query_services(self, session: Session) -> None:
        with suppress(NedbusError):
            services = find_services(
                session, prefix=self._bus.prefix, timeout=TIMINGS.routers_timeout
            )
            log_streams = dict[str, LogStreamStatus]()
            positions = dict[str, PositionStatus]()
            for service in services:
                for source in service.sources:
                    log_streams |= {log.vehicle: log for log in source.log_streams}
                    positions |= {sent.vehicle: sent for sent in source.positions}
            self.log_streams = log_streams
            self.positions = positions

    def _has_mavlink(self) -> bool:
        sources = (newest.sample.source or "" for newest in self.monitor.values())
        return any(source.startswith("mavlink") for source in sources)

    def _status(self) -> dict[str, Any]:
        streams = dict[str, Any]()
        for address, health in self.monitor.snapshot().items():
            streams[str(address)] = asdict(health)
        counts = asdict(self.subscription.counts)
        return {"connected": self._bus.connected, **counts, "streams": streams}

    def _faults(self) -> list[str]:
        if self._bus.connected:
            return []
        return [f"no router answers at {' or '.join(self._bus.routers)}"]

    def _vehicles(self) -> Page:
        if not self._bus.connected:
            return Page.verdict(self._faults(), "")
        host = socket.gethostname()
        now = clock.steady()
        report = report_of(self.event_log, "export", host, now, within=0.0, to_utc=clock.to_utc())
        return vehicles_page(report)
