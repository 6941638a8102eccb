"""An exporter: a reader of every message that shows what it sees, where no service of ours serves metrics.

Needs the extra `metrics`.
"""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from typing import Any, Final

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from nedbus.client import Bus, Monitor, Sample
from nedbus.events import Account, report_of
from nedbus_msgs import Address, Selection

from .exposition import build_info, metrics_page
from .families import MAX_STREAMS, Stream, is_switched_off, stream_families, vehicle_families
from .http_server import Page
from .observer import Observer, Sight
from .pages import vehicles_page
from .router_watch import RouterWatch

_LOOK: Final = 0.5  # s between two looks at all vehicles
_MAX_SOURCES: Final = 4 * MAX_STREAMS  # that are remembered
_RECEIVED: Final = "nedbus_messages_received", "Messages that arrived here, were valid and were read"


class Exporter(Collector):
    """Read all that a selection matches, and make pages of what was seen.

    `watch` gets each sample as well, and `on_look` what is seen of all vehicles twice a second.
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
        self._subscription = bus.subscribe(
            selection.topic, vehicle=selection.vehicle, instance=selection.instance, mode="every"
        )
        self._monitor = Monitor()
        self._observer = Observer(bus, selection)
        self._routers = RouterWatch(bus)
        self._sources: dict[Address, str] = {}
        self._lock = threading.Lock()  # a stream is not in the monitor for a moment while a sample is added

    def run(self, stop: threading.Event) -> None:
        """Read until `stop` is set; raise what ends the reader before."""
        with ThreadPoolExecutor(2, thread_name_prefix="nedbus-export") as pool:
            reading = pool.submit(self._read)
            reading.add_done_callback(lambda _: stop.set())
            asking = pool.submit(self._routers.run, stop)
            asking.add_done_callback(lambda _: stop.set())
            try:
                while not stop.wait(_LOOK):
                    self._look()
            finally:
                stop.set()
                self._routers.close()
                self._subscription.close()
            reading.result()
            asking.result()

    @property
    def account(self) -> Account:
        """The account of what happened."""
        return self._observer.account

    @property
    def pages(self) -> Mapping[str, Callable[[], Page]]:
        """The pages by path."""
        return {
            "/metrics": lambda: metrics_page(self),
            "/healthz": lambda: Page.text("ok"),
            "/readyz": self._ready,
            "/vehicles": self._vehicles,
            "/status": self._status,
        }

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics."""
        yield build_info(self._version)
        yield GaugeMetricFamily("nedbus_connected", "1 while there is a link to a router", value=self._bus.connected)
        counts = self._subscription.counts
        yield CounterMetricFamily(
            "nedbus_messages_dropped", "Messages for which the exporter was too slow", counts.dropped
        )
        yield CounterMetricFamily("nedbus_messages_invalid", "Payloads that were no valid message", counts.invalid)
        yield GaugeMetricFamily(
            "nedbus_queue_messages", "Messages that wait to be read", value=self._subscription.waiting
        )
        yield from self._router_families()
        streams = self._streams()
        yield from stream_families(streams, messages=_RECEIVED)
        yield from vehicle_families(self.account, streams)

    def _router_families(self) -> Iterator[Metric]:
        sessions = GaugeMetricFamily(
            "nedbus_router_sessions", "Zenoh sessions at a router of the network, by its id", labels=["router"]
        )
        room = GaugeMetricFamily("nedbus_router_sessions_max", "Sessions that a router accepts", labels=["router"])
        for state in self._routers.states:
            sessions.add_metric([state.zid], state.sessions)
            if state.max_sessions is not None:
                room.add_metric([state.zid], state.max_sessions)
        yield from (sessions, room)

    def _streams(self) -> list[Stream]:
        """Return all streams, those that were seen first first: which ones have labels of their own does not change."""
        with self._lock:
            healths = sorted(self._monitor.snapshot().items(), key=lambda item: item[0] not in self._sources)
            latencies = {address: self._monitor.latencies(address) for address, _ in healths}
        silent = {address for address, health in healths if is_switched_off(health)}
        if silent:  # asking may wait for the router, and the reader must not
            silent.difference_update(*self._bus.vehicles().values())
        return [
            Stream(
                address.vehicle,
                str(address).partition("/")[2],
                self._sources.get(address, ""),
                health,
                active=address not in silent,
                latencies=latencies[address],
            )
            for address, health in healths
        ]

    def _read(self) -> None:
        for sample in self._subscription.rows():
            with self._lock:
                self._monitor.add(sample)
                if sample.address in self._sources or len(self._sources) < _MAX_SOURCES:
                    self._sources[sample.address] = sample.source or ""
            self._observer.add(sample)
            self._watch(sample)

    def _look(self) -> None:
        with self._lock:
            healths = self._monitor.snapshot()
        dropped, waiting = self._subscription.counts.dropped, self._subscription.waiting
        self._on_look(self._observer.look(healths, dropped=dropped, waiting=waiting))

    def _vehicles(self) -> Page:
        if not self._bus.connected:
            return self._ready()
        return vehicles_page(report_of(self.account, "export", socket.gethostname(), time.time(), within=0.0))

    def _ready(self) -> Page:
        if self._bus.connected:
            return Page.text("ready")
        return Page.text(f"no router answers at {' or '.join(self._bus.routers)}", status=503)

    def _status(self) -> Page:
        with self._lock:
            streams = {str(address): asdict(health) for address, health in self._monitor.snapshot().items()}
        status = {"connected": self._bus.connected, **asdict(self._subscription.counts), "streams": streams}
        return Page(200, "application/json", json.dumps(status, indent=2).encode())
