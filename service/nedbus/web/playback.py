"""Playback of recordings: messages and events in memory, and a clock with play, pause and seek."""

import logging
import threading
import time
from bisect import bisect_left, bisect_right
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

from bokeh.models.widgets import Select, Slider, Toggle

from nedbus import Sample
from nedbus.errors import NedbusError
from nedbus.flights import EventReplay, ReplayedMessage
from nedbus.health import RejectionReport, Times
from nedbus.log_event import about
from nedbus.monitoring import Snapshot
from nedbus.vehicle_events import state_at
from nedbus_msgs import BY_TOPIC, DEFAULT, Address, codec_of

from .event_timeline import EventTimeline
from .fleet import Fleet
from .stream import HistorySize, is_position

_log = logging.getLogger(__name__)

_MINUTE: Final = 60.0  # s of history loaded before the playback position
# of a whole flight: 20,000 points are 2.8 hours
_OVERVIEW: Final = HistorySize(points=20_000, step=0.5)
_STATUS_TOPICS: Final = ("vehicle_status", "vehicle_gps_position", "sensor_gps", "battery_status")
_SPEEDS: Final[list[str | tuple[Any, str]]] = ["0.5", "1", "2", "5", "10", "50"]


class Entry(NamedTuple):
    """A message of a recording at `time`, seconds since the first one.

    `content`: the payload of a position or status, the reason of a rejection, else PX4's timestamp.
    """

    time: float
    address: Address
    content: bytes | str | int


class Recording:
    """The messages of one or more files in chronological order, loaded in a background thread.

    `overview`: the whole flight at two points per second; `timeline`: the events, in seconds since the first message.
    `indices`: of the messages of each stream in `entries`.

    Raises ConfigError or SourceError if a file cannot be read.
    """

    def __init__(self, *paths: Path) -> None:
        self.name = ", ".join(path.name for path in paths)
        self.overview = Fleet(long=_OVERVIEW)
        self._replay = EventReplay(paths)
        self.timeline = EventTimeline(self._replay.event_log, times=Times())
        self.entries: list[Entry] = []
        self.indices: dict[Address, list[int]] = {}
        self.is_read = False
        threading.Thread(target=self._read, name="nedbus-recording", daemon=True).start()

    @property
    def length(self) -> float:
        """Duration read so far [s]."""
        if self.entries:
            return self.entries[-1].time
        return 0.0

    def _read(self) -> None:
        replay = self._replay
        try:
            self.timeline.times = replay.times
            for message in replay:
                self._add(message)
            for text in replay.warnings:
                _log.warning("%s", text, extra=about("damaged", source=self.name, reason=text))
        except NedbusError as exc:
            _log.error("%s", exc, extra=about("damaged", source=self.name, reason=str(exc)))
        finally:
            self.is_read = True

    def _add(self, message: ReplayedMessage) -> None:
        address = message.address
        payload = message.payload
        content: bytes | str | int = message.timestamp
        if message.rejected is not None:
            content = message.rejected
        if payload is not None and address.topic in _STATUS_TOPICS:
            content = payload
        if is_position(address):
            if payload is not None:
                content = payload
                row = codec_of(DEFAULT).decode_row(payload)
                sample = Sample(row, address, round(message.at * 1e9))
                self.overview.add(sample, message.at)
            if message.rejected is None and address not in self.indices:
                self.timeline.set_clock(address.vehicle, message.timestamp / 1e6, message.at)
        self.indices.setdefault(address, []).append(len(self.entries))
        self.entries.append(Entry(message.at, address, content))


class Player:
    """Playback of a recording for one viewer; `fleet`: its state at the playback position.

    `on_seek`: called after each seek; `controls`: play button, speed menu and slider.
    """

    def __init__(self, recording: Recording) -> None:
        self.fleet = Fleet(origin=recording.overview.origin)
        self.on_seek: Callable[[], object] = lambda: None
        self.time = 0.0
        self.recording = recording
        self._next = 0
        self._ticked = time.monotonic()
        # last slider value set by the player; differs from the slider's while the user drags it
        self._shown = 0.0
        self._play = Toggle(label="pause", active=True, width=80)
        self._speed = Select(options=_SPEEDS, value="1", width=80)
        self._slider = Slider(
            start=0, end=1, value=0, step=0.1, sizing_mode="stretch_width", show_value=False
        )
        self.controls = self._play, self._speed, self._slider
        self._play.on_change("active", self._label)
        self._slider.on_change("value_throttled", lambda _, __, value: self.seek(value))

    def _label(self, _: str, __: object, is_active: bool) -> None:
        self._play.label = "pause" if is_active else "play"

    def tick(self) -> None:
        """Advance the playback position by the elapsed time."""
        now = time.monotonic()
        elapsed = now - self._ticked
        self._ticked = now
        if self._play.active:
            speed = 1.0
            if self._speed.value in _SPEEDS:
                speed = float(self._speed.value)
            position = self.time + elapsed * speed
            self.time = min(position, self.recording.length)
        if self._slider.value == self._shown:
            self._shown = round(self.time, 1)
            end = max(1.0, self.recording.length)
            self._slider.update(end=end, value=self._shown)
        self._feed()

    def toggle(self, *, pause: bool = False) -> None:
        """Toggle between play and pause; if `pause` is true, only pause."""
        self._play.active = not (pause or self._play.active)

    def seek(self, seconds: float) -> None:
        """Seek to a time, limited to the part read so far, and load the minute before it."""
        self._shown = self._slider.value
        self.fleet.clear()
        self.time = min(max(0.0, seconds), self.recording.length)
        recording = self.recording
        begin = self.time - _MINUTE
        self._next = bisect_left(recording.entries, begin, key=_time_of)
        for index in self._last_before(self._next):
            self._add(index)
        for address, stream in self.fleet.streams.items():
            overview = recording.overview.streams.get(address)
            if stream.valid is None and overview is not None:
                (stream.valid,) = overview.positions_at([self.time])
        self._feed()
        self.on_seek()

    def _last_before(self, index: int) -> list[int]:
        """Return the indices of the last message of each stream before an index, in order."""
        last = []
        for indices in list(self.recording.indices.values()):  # another thread adds streams
            number = bisect_left(indices, index)
            if number:
                last.append(indices[number - 1])
        return sorted(last)

    def _feed(self) -> None:
        """Add the messages up to the playback position, and update the snapshot."""
        end = bisect_right(self.recording.entries, self.time, key=_time_of)
        for index in range(self._next, end):
            self._add(index)
        self._next = max(self._next, end)
        states = {}
        for name, spans in self.recording.timeline.spans.items():
            states[name] = state_at(spans, self.time)
        healths = self.fleet.monitor.snapshot(round(self.time * 1e9))
        self.fleet.update(Snapshot(self.time, healths), states, {})

    def _add(self, index: int) -> None:
        time, address, content = self.recording.entries[index]
        received = round(time * 1e9)
        if isinstance(content, str):
            self.fleet.reject([RejectionReport(address, content, received)])
            return
        message: Any
        if isinstance(content, bytes):
            codec = codec_of(BY_TOPIC[address.topic])
            message = codec.decode_row(content)
        else:
            message = SimpleNamespace(timestamp=content)
        sample = Sample(message, address, received)
        self.fleet.monitor.add(sample, received=received)
        self.fleet.add(sample, time)


def _time_of(entry: Entry) -> float:
    return entry.time
