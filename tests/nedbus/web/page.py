"""Fixtures for tests of the web page: a simulated fleet, the document of a viewer, and a server in a thread."""

from __future__ import annotations

import json
import queue
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from itertools import count
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any, Final
from urllib.parse import parse_qsl
from xml.etree import ElementTree as ET

import pytest
from bokeh.document import Document
from bokeh.models import ColumnDataSource, Model
from bokeh.models.widgets import Div

import nedbus
from nedbus.client import LogStreamStatus, Sample, describe_stream, stream_state
from nedbus.flights import RecordingWriter
from nedbus.health import Fusion
from nedbus.monitoring import Snapshot
from nedbus.vehicle_events import EventLog
from nedbus.web import PageOptions, serve_live
from nedbus.web.event_timeline import EventTimeline
from nedbus.web.fleet import Fleet, FleetSnapshot, StreamView, VehicleView
from nedbus.web.stream import PageStream
from nedbus.web.viewer import Viewer
from nedbus_msgs import BY_TOPIC, DEFAULT, Address, Provenance, Selection
from nedbus_msgs.arrays import arrays_of
from tests.flights.messages import VALID, VLP, message
from tests.waits import DEADLINE, repeating

WING: Final = Address("wing", VLP)
QUAD: Final = Address("quad", VLP)
NOON: Final = 1_700_000_000.0
"""Seconds since the Unix epoch: 22:13:20 UTC."""


class SimulatedFleet:
    """Everything that a live page shows, without a bus: a fleet, its health and its events, with a fake clock."""

    def __init__(self) -> None:
        self.fleet = Fleet()
        self.monitor = self.fleet.monitor
        self.event_log = EventLog()
        self.timeline = EventTimeline(self.event_log)
        self.time = NOON

    def add(self, address: Address = WING, **fields: object) -> None:
        """Receive a message now; `fields`: of the position, or of the message of another topic."""
        stamp = round((self.time - NOON) * 1e6) + 1_000_000
        other = BY_TOPIC[address.topic]
        if other is DEFAULT:
            given = {
                name: value for name, value in {**VALID, **fields}.items() if value is not None
            }
            received = message(stamp, **given)
        else:
            known = {
                name: value for name, value in fields.items() if name in other.model.model_fields
            }
            received = other.model.model_validate({"timestamp": stamp, **known})
        sample = Sample(received, address, round(self.time * 1e9))
        self.monitor.add(sample, received=sample.received)
        self.event_log.add(address, received, self.time)
        self.fleet.add(sample, self.time)

    def fly(self, seconds: float, *addresses: Address, rate: int = 10, **fields: object) -> None:
        """Receive messages of these addresses for a number of seconds."""
        for _ in range(round(seconds * rate)):
            self.time += 1 / rate
            for address in addresses or (WING,):
                self.add(address, **fields)

    def poll(
        self,
        *,
        alive: list[Address] | None = None,
        link: str = "",
        behind: str = "",
        is_behind: bool = False,
        logs: Mapping[str, LogStreamStatus] = MappingProxyType({}),
        fusion: Mapping[str, Fusion] = MappingProxyType({}),
    ) -> FleetSnapshot:
        """Update the snapshot as the exporter does twice a second."""
        healths = self.monitor.snapshot(round(self.time * 1e9))
        publishers = None if alive is None else Counter(alive)
        arrival = {
            address: stream_state(
                health,
                publishers=None if publishers is None else publishers[address],
                connected=not link,
            ).name
            for address, health in healths.items()
        }
        self.event_log.update(self.time, arrival, link=link, is_behind=is_behind)
        states = {name: self.event_log.state(name, self.time) for name in self.event_log.vehicles}
        self.fleet.update(
            Snapshot(self.time, healths, publishers, link=link, behind=behind), states, logs, fusion
        )
        return self.fleet.snapshot

    def vehicle(self, vehicle: str = "wing", **options: Any) -> VehicleView:
        row = self.poll(**options).vehicle(vehicle)
        assert row is not None
        return row

    def view(self, address: Address = WING, **options: Any) -> StreamView:
        return next(
            view
            for view in self.vehicle(address.vehicle, **options).streams
            if view.address == address
        )

    def stream(self, address: Address = WING) -> PageStream:
        return self.fleet.streams[address]


@pytest.fixture
def sim() -> SimulatedFleet:
    return SimulatedFleet()


def describe(view: StreamView) -> str:
    """Return the state and the flags of a stream, as in its row on the page."""
    return describe_stream(view.health, view.state)


def addresses_of(snapshot: FleetSnapshot) -> list[Address]:
    """Return the addresses of all streams in a snapshot."""
    return sorted(view.address for row in snapshot.vehicles for view in row.streams)


def write_flight(
    folder: Path, topics: Mapping[str, Callable[[float], Mapping[str, object]]], *, seconds: int
) -> Path:
    """Record vehicle "wing" at 10 Hz; `topics`: the fields of each topic as a function of time [s]."""
    file = folder / "flight.mcap"
    with RecordingWriter(file) as writer:
        for time in range(0, seconds * 1_000_000, 100_000):  # µs
            stamps = [1_700_000_000_000_000_000 + 1000 * time]
            for topic, fields in topics.items():
                definition = BY_TOPIC[topic]
                given = {**(VALID if definition is DEFAULT else {}), **fields(time / 1e6)}
                array = arrays_of(definition).of(
                    [definition.model(timestamp=1_000_000 + time, **given)]
                )
                writer.write(
                    array,
                    definition,
                    [(Address("wing", topic), Provenance("sim"))],
                    logged=stamps,
                    published=stamps,
                )
    return file


def models_of(document: Document, kind: type[Model]) -> list[Any]:
    return list(document.select({"type": kind}))


class RenderedPage:
    """The document of a viewer as the user sees it; `query`: the query string of its URL."""

    def __init__(
        self, fleet: Fleet, timeline: EventTimeline, *, query: str = "", **options: Any
    ) -> None:
        self.document = Document()
        arguments = {name: [value.encode()] for name, value in parse_qsl(query.removeprefix("?"))}
        request = SimpleNamespace(request=SimpleNamespace(arguments=arguments))
        self.document._session_context = lambda: request  # type: ignore[assignment]  # the request of a browser
        self.viewer = Viewer(self.document, fleet, timeline, **options)
        self._numbers = count()

    def update(self) -> None:
        """Send all changes to a browser that draws each update."""
        for _ in range(10):
            self.viewer.update()
            self.viewer._drawn.value = str(self.viewer._sent)

    def send(self, action: object, value: object = "") -> None:
        """Send an action, as `actions.js` does on a click or key press."""
        self.send_raw(json.dumps([action, value, next(self._numbers)]))

    def send_raw(self, message: str) -> None:
        """Send any text as the value of the hidden input."""
        self.viewer._message.value = message
        self.update()

    def search(self, text: str) -> None:
        self.viewer._search.value_input = text
        self.update()

    def panel(self, name: str) -> str:
        """Return the HTML of one panel of the page."""
        return next(
            str(div.text) for div in models_of(self.document, Div) if name in div.css_classes
        )

    def elements(self, panel: str, name: str) -> list[ET.Element]:
        """Return the elements of a panel with this tag or CSS class; the panel must be well-formed."""
        root = ET.fromstring(f"<body>{self.panel(panel)}</body>")  # noqa: S314 - written by our templates
        return [each for each in root.iter() if name in (each.tag, *each.get("class", "").split())]

    def texts(self, panel: str, name: str) -> list[str]:
        """Return the text of each of these elements, without markup."""
        return ["".join(each.itertext()) for each in self.elements(panel, name)]

    def table(self, number: int = 0) -> list[list[str]]:
        """Return the cells of each row of a table of streams, without its header."""
        rows = self.elements("more", "table")[number].iter("tr")
        return [["".join(cell.itertext()) for cell in row] for row in rows][1:]

    @property
    def text(self) -> str:
        return "\n".join(str(div.text) for div in models_of(self.document, Div))

    @property
    def chosen(self) -> str | None:
        return self.viewer.chosen

    @property
    def url_query(self) -> str:
        """The query string of the URL in the browser."""
        return str(self.viewer._url.value)

    @property
    def listed(self) -> dict[str, dict[str, str]]:
        """The rows of the list by vehicle, in the order shown."""
        names = "symbol", "vehicle", "text", "since", "mode", "battery", "gps"
        rows = {}
        for each in self.elements("list", "row"):
            if vehicle := each.get("data-with"):
                cells = ("".join(cell.itertext()) for cell in each)
                rows[vehicle] = dict(zip(names, cells, strict=True)) | {
                    "title": each.get("title", ""), "chosen": each.get("aria-current", ""),
                    "grade": each[0].get("class", ""),
                }  # fmt: skip
        return rows

    @property
    def vehicles(self) -> list[str]:
        return list(self.listed)

    @property
    def grades(self) -> dict[str, str]:
        """The grades in the list by vehicle."""
        return {name: row["grade"] for name, row in self.listed.items()}

    @property
    def states(self) -> dict[str, str]:
        """The states in the list by vehicle."""
        return {name: row["text"] for name, row in self.listed.items()}

    @property
    def marks(self) -> dict[str, dict[str, Any]]:
        """The markers on the map by vehicle."""
        return {row["name"]: row for row in self.rows("shape")}

    @property
    def plotted(self) -> dict[str, Any]:
        """The points of the selected vehicle in the plots."""
        return dict(self.viewer._plots.chosen.data)

    @property
    def plot_range(self) -> tuple[float, float]:
        """Begin and end of the plots' time axis [s]."""
        span: Any = self.viewer._plots.range
        return span.start / 1e3, span.end / 1e3

    def rows(self, column: str) -> list[dict[str, Any]]:
        """Return the rows of the first data source that has this column."""
        data = self.source(column).data
        return [dict(zip(data, values, strict=True)) for values in zip(*data.values(), strict=True)]

    def source(self, column: str) -> ColumnDataSource:
        sources: list[ColumnDataSource] = models_of(self.document, ColumnDataSource)
        return next(each for each in sources if column in each.data)


def flying(
    publisher: nedbus.Publisher, fields: Mapping[str, object]
) -> AbstractContextManager[None]:
    """Publish at 50 Hz with the current contents of `fields`."""
    numbers = count(1)
    return repeating(lambda: publisher.publish(message(20_000 * next(numbers), **fields)))


@contextmanager
def in_thread(serve: Callable[[threading.Event, Callable[[str], object]], object]) -> Iterator[str]:
    """Run `serve` in a thread until the context exits; yield the URL of the page."""
    stop = threading.Event()
    urls: queue.SimpleQueue[str] = queue.SimpleQueue()
    server = threading.Thread(target=serve, args=[stop, urls.put])
    server.start()
    try:
        yield urls.get(timeout=DEADLINE)
    finally:
        stop.set()
        server.join(DEADLINE)


@contextmanager
def serving_live(endpoint: str, options: PageOptions | None = None) -> Iterator[str]:
    """Serve the page of live vehicles as `nedbus web` does."""
    with nedbus.connect(endpoint) as bus:

        def serve(stop: threading.Event, on_listening: Callable[[str], object]) -> None:
            page = options or PageOptions("127.0.0.1", 0)
            serve_live(bus, Selection(), page, version="0", stop=stop, on_listening=on_listening)

        with in_thread(serve) as url:
            yield url
