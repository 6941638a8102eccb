"""Playback of recordings: messages and events in memory, and a clock with play, pause and seek."""

import logging
import threading
import time
from bisect import bisect_left, bisect_right
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

from bokeh.models.widgets import Select, Slider, Toggle

from nedbus import Sample, limits
from nedbus.errors import NedbusError
from nedbus.flights import EVENT_OPTIONS, follow_flight, open_messages, times_of
from nedbus.health import RejectionReport, Times
from nedbus.log_event import about
from nedbus.monitoring import Snapshot
from nedbus.vehicle_events import EventLog, state_at
from nedbus_msgs import BY_TOPIC, DEFAULT, Address, codec_of

from .event_timeline import EventTimeline
from .fleet import Fleet
from .stream import is_position

_log = logging.getLogger(__name__)

_MINUTE: Final = 60.0  # s of history loaded before the playback position
# maximum number of points of a whole flight, and s between two points
_OVERVIEW: Final = 20_000, 0.5
_STATUS_TOPICS: Final = ("vehicle_status", "vehicle_gps_position", "sensor_gps", "battery_status")
_SPEEDS: Final[list[str | tuple[Any, str]]] = ["0.5", "1", "2", "5", "10", "50"]


class Recording:
    """The messages of one or more files in chronological order, loaded in a background thread.

    `overview`: the whole flight at two points per second; `timeline`: the events, in seconds since the first message.
    `entries`: the address of each message, with its payload (positions and status topics), the reason if it was
    rejected, or only PX4's timestamp (other topics). `dues`: time of each message since the first one [s].

    Raises ConfigError or SourceError if a file cannot be read.
    """

    def __init__(self, *paths: Path) -> None:
        self.name = ", ".join(path.name for path in paths)
        self.overview = Fleet(long=_OVERVIEW)
        self.timeline = EventTimeline(EventLog(limits.FILE_EVENTS), times=Times())
        self.dues: list[float] = []
        self.entries: list[tuple[Address, bytes | str | int]] = []
        self.is_read = False
        self._flight = open_messages(paths, EVENT_OPTIONS)
        self.indices: dict[Address, list[int]] = {}  # in `entries`, by stream
        threading.Thread(target=self._read, name="nedbus-recording", daemon=True).start()

    @property
    def length(self) -> float:
        """Duration read so far [s]."""
        return self.dues[-1] if self.dues else 0.0

    def _read(self) -> None:
        flight, event_log = self._flight, self.timeline.event_log
        try:
            self.timeline.times = times_of(flight)
            for message, reason, payload in follow_flight(flight, event_log):
                address, stamp = message.address, message.timestamp or 0
                entry: bytes | str | int = stamp if reason is None else reason
                if payload is not None and (
                    is_position(address) or address.topic in _STATUS_TOPICS
                ):
                    entry = payload
                    if is_position(address):
                        row = codec_of(DEFAULT).decode_row(payload)
                        self.overview.add(Sample(row, address, round(message.at * 1e9)), message.at)
                if reason is None and address not in self.indices and is_position(address):
                    self.timeline.set_clock(address.vehicle, stamp / 1e6, message.at)
                self.indices.setdefault(address, []).append(len(self.entries))
                self.entries.append((address, entry))
                self.dues.append(message.at)
            for warning in flight.warnings:
                _log.warning(
                    "%s", warning, extra=about("damaged", source=self.name, reason=warning)
                )
        except NedbusError as exc:
            _log.error("%s", exc, extra=about("damaged", source=self.name, reason=str(exc)))
        finally:
            self.is_read = True


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
        self._play.on_change(
            "active", lambda _, __, active: self._play.update(label="pause" if active else "play")
        )
        self._slider.on_change("value_throttled", lambda _, __, value: self.seek(value))

    def tick(self) -> None:
        """Advance the playback position by the elapsed time."""
        now = time.monotonic()
        elapsed, self._ticked = now - self._ticked, now
        if self._play.active:
            speed = float(self._speed.value) if self._speed.value in _SPEEDS else 1.0
            self.time = min(self.time + elapsed * speed, self.recording.length)
        if self._slider.value == self._shown:
            self._shown = round(self.time, 1)
            self._slider.update(end=max(1.0, self.recording.length), value=self._shown)
        self._feed()

    def toggle(self, *, pause: bool = False) -> None:
        """Toggle between play and pause; if `pause` is true, only pause."""
        self._play.active = not (pause or self._play.active)

    def seek(self, seconds: float) -> None:
        """Seek to a time, limited to the part read so far, and load the minute before it."""
        self._shown = self._slider.value
        self.fleet.clear()
        self.time = min(max(0.0, seconds), self.recording.length)
        self._next = bisect_left(self.recording.dues, self.time - _MINUTE)
        indices = list(self.recording.indices.values())
        silent = (known[at - 1] for known in indices if (at := bisect_left(known, self._next)))
        for index in sorted(silent):  # the last message of each stream before this minute
            self._add(index)
        for address, stream in self.fleet.streams.items():
            overview = self.recording.overview.streams.get(address)
            if stream.valid is None and overview is not None:
                (stream.valid,) = overview.positions_at([self.time])
        self._feed()
        self.on_seek()

    def _feed(self) -> None:
        end = bisect_right(self.recording.dues, self.time)
        for index in range(self._next, end):
            self._add(index)
        self._next = max(self._next, end)
        states = {
            name: state_at(spans, self.time)
            for name, spans in self.recording.timeline.spans.items()
        }
        self.fleet.update(
            Snapshot(self.time, self.fleet.monitor.snapshot(round(self.time * 1e9))), states, {}
        )

    def _add(self, index: int) -> None:
        due, (address, entry) = self.recording.dues[index], self.recording.entries[index]
        received = round(due * 1e9)
        if isinstance(entry, str):
            self.fleet.reject([RejectionReport(address, entry, received)])
            return
        message: Any = SimpleNamespace(timestamp=entry)
        if isinstance(entry, bytes):
            message = codec_of(BY_TOPIC[address.topic]).decode_row(entry)
        sample = Sample(message, address, received)
        self.fleet.monitor.add(sample, received=received)
        self.fleet.add(sample, due)
