"""An exporter: metrics of all that a reader receives, for networks where no service of ours serves metrics.

Needs the extra `metrics`.
"""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict
from typing import Any, Final

from prometheus_client.core import Metric

from nedbus.client import Bus, Monitor, Sample
from nedbus.errors import NedbusError
from nedbus.events import Account, report_of
from nedbus.transport import RouterState, Session, ask_routers
from nedbus_msgs import Address, Selection

from .http_server import Page
from .metrics import (
    MAX_STREAMS,
    Stream,
    build_info,
    is_switched_off,
    make_metrics,
    metrics_page,
    stream_metrics,
    vehicle_metrics,
)
from .observer import Observer, Sight
from .pages import vehicles_page

_LOOK_PERIOD: Final = 0.5  # s between two looks at all vehicles
_MAX_SOURCES: Final = 4 * MAX_STREAMS  # addresses whose source is remembered
_MAX_ROUTERS: Final = 16  # that are shown: any peer may claim to be one
_ROUTERS_PERIOD: Final = 10.0  # s between two queries of all routers; longer where the answers are large:
_MAX_ROUTERS_PERIOD: Final = 60.0
_SESSIONS_PER_SECOND: Final = 20  # 3.7 kB: a router's answer has 183 bytes for each of its sessions
_ROUTERS_TIMEOUT: Final = 5.0  # s for all answers, over a slow link perhaps
_SESSION_TIMEOUT: Final = 1.0  # s


class Exporter:
    """Read all that a selection matches, and make pages of it.

    `watch` gets each sample as well, and `on_look` the sight of all vehicles twice a second.
    """

    def __init__(
        self,
        bus: Bus,
        selection: Selection,
        *,
        version: str,
        watch: Callable[[Sample[Any]], object] = lambda _: None,
        on_look: Callable[[Sight], object] = lambda _: None,
    ) -> None:
        self._bus = bus
        self._watch, self._on_look = watch, on_look
        self._version = version
        self._subscription = bus.subscribe_to(selection, mode="every")
        self._monitor = Monitor()
        self._observer = Observer(bus, selection)
        self._routers: list[RouterState] = []
        self._session: Session | None = None  # for the queries of routers
        self._sources: dict[Address, str] = {}
        self._lock = threading.Lock()  # a stream is not in the monitor for a moment while a sample is added

    def run(self, stop: threading.Event) -> None:
        """Read until `stop` is set; raise the error that ends the reader before."""
        with ThreadPoolExecutor(2, thread_name_prefix="nedbus-export") as pool:
            tasks = pool.submit(self._read), pool.submit(self._ask_routers, stop)
            for task in tasks:
                task.add_done_callback(lambda _: stop.set())
            try:
                while not stop.wait(_LOOK_PERIOD):
                    self._look()
            finally:
                stop.set()
                with self._lock:
                    session = self._session
                if session is not None:
                    session.close()  # which ends a query that a router does not answer
                self._subscription.close()
            for task in tasks:
                task.result()

    @property
    def account(self) -> Account:
        """The account of what happened."""
        return self._observer.account

    @property
    def pages(self) -> Mapping[str, Callable[[], Page]]:
        """The pages by path."""
        return {
            "/metrics": lambda: metrics_page(self._metrics()),
            "/healthz": lambda: Page.text("ok"),
            "/readyz": lambda: Page.verdict(self._faults(), "ready"),
            "/vehicles": self._vehicles,
            "/status": self._status,
        }

    def _metrics(self) -> Iterator[Metric]:
        """Yield all metrics."""
        counts, streams = self._subscription.counts, self._streams()
        rooms = [((each.zid,), each.max_sessions) for each in self._routers if each.max_sessions is not None]
        yield build_info(self._version)
        yield from make_metrics({
            "nedbus_connected": [((), self._bus.connected)],
            "nedbus_messages_dropped": [((), counts.dropped)],
            "nedbus_messages_invalid": [((), counts.invalid)],
            "nedbus_queue_messages": [((), self._subscription.waiting)],
            "nedbus_router_sessions": [((state.zid,), state.sessions) for state in self._routers],
            "nedbus_router_sessions_max": rooms,
        })  # fmt: skip
        yield from stream_metrics(streams, messages="nedbus_messages_received")
        yield from vehicle_metrics(self.account, streams)

    def _streams(self) -> list[Stream]:
        """Return all streams, the first seen first, so that the same ones keep labels of their own."""
        with self._lock:
            healths = sorted(self._monitor.snapshot().items(), key=lambda item: item[0] not in self._sources)
            latencies = {address: self._monitor.latencies(address) for address, _ in healths}
        silent = {address for address, health in healths if is_switched_off(health)}
        if silent:  # asking may wait for the router, and the reader must not
            silent.difference_update(*self._bus.vehicles().values())
        return [
            Stream(
                address.vehicle, address.stream, self._sources.get(address, ""), health, address not in silent,
                latencies[address],
            )
            for address, health in healths
        ]  # fmt: skip

    def _read(self) -> None:
        for sample in self._subscription.rows():
            with self._lock:
                self._monitor.add(sample)
                if sample.address in self._sources or len(self._sources) < _MAX_SOURCES:
                    self._sources[sample.address] = sample.source or ""
            self._observer.add(sample)
            self._watch(sample)

    def _ask_routers(self, stop: threading.Event) -> None:
        """Ask all routers for their sessions every 10 s, less often where there are more than 200, until `stop` is set.

        In a session of its own: the answer of a router with 1,000 sessions, 183 kB, does not hold up messages.
        """
        while not stop.is_set():
            states: list[RouterState] = []
            with suppress(NedbusError):  # no room for this session, a broken link: then nothing is known
                if self._session is None:
                    self._open_session(stop)
                if self._session is not None:
                    states = ask_routers(self._session, timeout=_ROUTERS_TIMEOUT)
            self._routers = states[:_MAX_ROUTERS]
            period = sum(state.sessions for state in states) / _SESSIONS_PER_SECOND
            stop.wait(min(_MAX_ROUTERS_PERIOD, max(_ROUTERS_PERIOD, period)))

    def _open_session(self, stop: threading.Event) -> None:
        session = self._bus.open_session(timeout=_SESSION_TIMEOUT)
        with self._lock:
            if not stop.is_set():  # else `run` has looked for a session to close already
                self._session = session
                return
        session.close()

    def _look(self) -> None:
        with self._lock:
            healths = self._monitor.snapshot()
        dropped, waiting = self._subscription.counts.dropped, self._subscription.waiting
        self._on_look(self._observer.look(healths, dropped=dropped, waiting=waiting))

    def _faults(self) -> list[str]:
        return [] if self._bus.connected else [f"no router answers at {' or '.join(self._bus.routers)}"]

    def _vehicles(self) -> Page:
        if not self._bus.connected:
            return Page.verdict(self._faults(), "")
        return vehicles_page(report_of(self.account, "export", socket.gethostname(), time.time(), within=0.0))

    def _status(self) -> Page:
        with self._lock:
            streams = {str(address): asdict(health) for address, health in self._monitor.snapshot().items()}
        status = {"connected": self._bus.connected, **asdict(self._subscription.counts), "streams": streams}
        return Page(200, "application/json", json.dumps(status, indent=2).encode())
