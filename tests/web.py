"""The page in the browser, for tests: a fleet with a clock, what a viewer is shown, and its server in a thread."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from itertools import count
from pathlib import Path
from typing import Any, Final

import pytest
from bokeh.document import Document
from bokeh.models import ColumnDataSource, Model
from bokeh.models.widgets import Div

import nedbus
from nedbus.client import Monitor, Sample
from nedbus.recording import RecordingWriter
from nedbus.web import Where, serve_live
from nedbus.web.fleet import Fleet, Line, Picture
from nedbus.web.stream import Stream
from nedbus.web.viewer import Viewer
from nedbus_msgs import BY_TOPIC, DEFAULT, Address, Provenance, Selection
from nedbus_msgs.codecs.arrays import arrays_of
from tests.messages import VALID, VLP, message
from tests.waits import DEADLINE, repeating

WING: Final = Address("wing", VLP)
QUAD: Final = Address("quad", VLP)
NOON: Final = 1_700_000_000.0  # s since the epoch


class Sky:
    """A fleet and its health, at a time that the test sets."""

    def __init__(self) -> None:
        self.fleet = Fleet()
        self.monitor = Monitor()
        self.time = NOON

    def add(self, address: Address = WING, **fields: object) -> None:
        """Receive a message now."""
        stamp = round((self.time - NOON) * 1e6) + 1_000_000
        fields = {name: value for name, value in {**VALID, **fields}.items() if value is not None}
        other = BY_TOPIC[address.topic]
        heard = message(stamp, **fields) if other is DEFAULT else other.model.model_validate({"timestamp": stamp})
        sample = Sample(heard, address, round(self.time * 1e9))
        self.monitor.add(sample, received=sample.received)
        self.fleet.add(sample, self.time)

    def fly(self, seconds: float, *addresses: Address, rate: int = 10, **fields: object) -> None:
        """Receive messages for a while."""
        for _ in range(round(seconds * rate)):
            self.time += 1 / rate
            for address in addresses or (WING,):
                self.add(address, **fields)

    def look(self, **known: Any) -> Picture:
        return self.fleet.look(self.time, self.monitor.snapshot(round(self.time * 1e9)), **known)

    def line(self, address: Address = WING, **known: Any) -> Line:
        return next(line for line in self.look(**known).lines if line.address == address)

    def stream(self, address: Address = WING) -> Stream:
        return self.fleet.streams[address]


@pytest.fixture
def sky() -> Sky:
    return Sky()


def write_flight(folder: Path, topics: Mapping[str, Callable[[float], Mapping[str, object]]], *, seconds: int) -> Path:
    """Record vehicle "wing" at 10 Hz, with the fields that each topic has then."""
    file = folder / "flight.mcap"
    with RecordingWriter(file) as writer:
        for time in range(0, seconds * 1_000_000, 100_000):  # µs
            stamps = [1_700_000_000_000_000_000 + 1000 * time]
            for topic, fields in topics.items():
                definition = BY_TOPIC[topic]
                given = {**(VALID if definition is DEFAULT else {}), **fields(time / 1e6)}
                array = arrays_of(definition).of([definition.model(timestamp=1_000_000 + time, **given)])
                writer.write(
                    array, definition, [(Address("wing", topic), Provenance("sim"))], logged=stamps, published=stamps
                )
    return file


def models_of(document: Document, kind: type[Model]) -> list[Any]:
    return list(document.select({"type": kind}))


class Shown:
    """What a viewer's document shows, as a person reads it."""

    def __init__(self, fleet: Fleet, **options: Any) -> None:
        self.document = Document()
        self._viewer = Viewer(self.document, fleet, **options)

    def update(self) -> None:
        """Send all that is new."""
        for _ in range(10):
            self._viewer.update()

    @property
    def text(self) -> str:
        return "\n".join(str(div.text) for div in models_of(self.document, Div))

    @property
    def chosen(self) -> Address | None:
        return self._viewer.chosen

    @property
    def vehicles(self) -> list[str]:
        """The vehicles of the table, in its order."""
        return [row["vehicle"] for row in self.rows("what is wrong")]

    @property
    def states(self) -> dict[str, str]:
        """The states in the table by vehicle, where each has one stream."""
        return {row["vehicle"]: row["state"] for row in self.rows("what is wrong")}

    @property
    def marks(self) -> dict[str, dict[str, Any]]:
        """The markers on the map by their labels."""
        return {row["label"]: row for row in self.rows("shape")}

    def rows(self, column: str) -> list[dict[str, Any]]:
        """Return the rows of what has a column of this name."""
        data = self.source(column).data
        return [dict(zip(data, values, strict=True)) for values in zip(*data.values(), strict=True)]

    def source(self, column: str) -> ColumnDataSource:
        sources: list[ColumnDataSource] = models_of(self.document, ColumnDataSource)
        return next(each for each in sources if column in each.data)


def flying(publisher: nedbus.Publisher, fields: Mapping[str, object]) -> AbstractContextManager[None]:
    """Publish fifty times a second, whatever the fields are then."""
    numbers = count(1)
    return repeating(lambda: publisher.publish(message(20_000 * next(numbers), **fields)))


@contextmanager
def in_thread(serve: Callable[[threading.Event, Callable[[str], object]], object]) -> Iterator[str]:
    """Run what serves a page until an event is set, and give its address."""
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
def serving_live(endpoint: str, where: Where | None = None) -> Iterator[str]:
    """Serve the page of live vehicles, as `nedbus web` does."""
    with nedbus.connect(endpoint) as bus:

        def serve(stop: threading.Event, tell: Callable[[str], object]) -> None:
            serve_live(bus, Selection(), where or Where("127.0.0.1", 0), version="0", stop=stop, tell=tell)

        with in_thread(serve) as url:
            yield url
