"""A recording on the page: the messages of a file, what happened in it, and a time that runs, is paused, and is set."""

from __future__ import annotations

import logging
import threading
import time
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from bokeh.models.widgets import Select, Slider, Toggle

from nedbus.client import Monitor, RejectionReport, Sample
from nedbus.errors import NedbusError
from nedbus.events import Account, Times, state_at
from nedbus.log_event import about
from nedbus.sources import (
    KEPT_OF_FILE,
    ReplaySource,
    SourceMessage,
    follow,
    parse_source,
    source_text_of_file,
    times_of,
)
from nedbus_msgs import BY_TOPIC, Address, codec_of

from .chronicle import Chronicle, to_elapsed
from .fleet import Fleet, last_place
from .stream import is_position

_log = logging.getLogger(__name__)

_MINUTE: Final = 60.0  # s that are shown before the time that is chosen
_WHOLE: Final = 20_000, 0.5  # points of a whole flight, and s between two of them
_KEPT: Final = ("VehicleStatus", "SensorGps", "BatteryStatus")  # messages whose values the page shows
_SPEEDS: Final[Mapping[str | tuple[Any, str], float]] = {
    "0.5": 0.5, "1": 1.0, "2": 2.0, "5": 5.0, "10": 10.0, "50": 50.0,
}  # fmt: skip


class Recording:
    """All positions of a .ulg or .mcap file, as bytes, in the order of their time; read in a thread of its own.

    Of most other messages, which outnumber them, only PX4's time is kept. `whole`: the flight at two points a second;
    `account`: what happened, whose clock is seconds since the first message; `chronicle`: how the page tells it.

    Raises ConfigError and SourceError for a file that cannot be read.
    """

    def __init__(self, path: Path) -> None:
        spec = parse_source(source_text_of_file(path))
        self.name = path.name
        self.whole = Fleet(long=_WHOLE)
        self.account = Account(KEPT_OF_FILE)
        self.chronicle = Chronicle(self.account, times=Times())
        self.dues: list[float] = []
        self.entries: list[tuple[Address, bytes | str | int]] = []
        self.is_read = False
        self._path = path
        self._places: dict[Address, list[int]] = {}  # of each stream in `entries`
        self._run = cast("ReplaySource", spec.open_source(vehicle="1")).open()
        for warning in self._run.warnings:
            _log.warning("%s: %s", path, warning, extra=about("damaged", source=str(path), reason=warning))
        threading.Thread(target=self._read, name="nedbus-recording", daemon=True).start()

    @property
    def length(self) -> float:
        """Seconds that have been read so far."""
        return self.dues[-1] if self.dues else 0.0

    def before(self, index: int) -> list[int]:
        """Return the last entry of each stream before this one, in order."""
        found = (places[at - 1] for places in list(self._places.values()) if (at := bisect_left(places, index)))
        return sorted(found)

    def _read(self) -> None:
        try:
            self.chronicle.times = times_of(self._path, self._run.addresses)
            for message, reason, payload in follow(self._run.messages, self.account):
                self._add(message, reason, payload)
        except NedbusError as exc:
            _log.error("%s", exc, extra=about("damaged", source=str(self._path), reason=str(exc)))
        finally:
            self.is_read = True

    def _add(self, message: SourceMessage, reason: str | None, payload: bytes | None) -> None:
        address, stamp = message.address, cast("int", message.fields.get("timestamp", 0))
        definition = BY_TOPIC.get(address.topic)
        kept: bytes | str | int = stamp if reason is None else reason
        if payload is not None and definition is not None and (is_position(address) or definition.name in _KEPT):
            kept = payload
            if is_position(address):
                row = codec_of(definition).decode_row(payload)
                self.whole.add(Sample(row, address, round(message.due * 1e9)), message.due)
        offset = self.chronicle.times.offsets.get(address.vehicle)
        if self.chronicle.start is None and reason is None and offset is not None:
            self.chronicle.start = stamp / 1e6 + offset - message.due
        self._places.setdefault(address, []).append(len(self.entries))
        self.entries.append((address, kept))
        self.dues.append(message.due)


class _Unread(NamedTuple):
    """A message of which only its time is known."""

    timestamp: int


class Player:
    """One viewer's time in a recording; its fleet is as it was then."""

    def __init__(self, recording: Recording) -> None:
        self.fleet = Fleet(origin=recording.whole.origin)
        self.on_jump: Callable[[], object] = lambda: None
        self.time = 0.0
        self._recording = recording
        self._monitor = Monitor()
        self._next = 0
        self._ticked = time.monotonic()
        self._slider = Slider(start=0, end=1, value=0, step=0.1, sizing_mode="stretch_width", show_value=False)
        self._play = Toggle(label="pause", active=True, width=80)
        self._speed = Select(options=list(_SPEEDS), value="1", width=80)
        self._play.on_change("active", lambda _, __, active: self._play.update(label="pause" if active else "play"))
        self._shown, self._dragged = 0.0, False
        self._slider.on_change("value", lambda _, __, value: self._drag(value))
        self._slider.on_change("value_throttled", lambda _, __, value: self.jump(value))
        self.controls: Sequence[Any] = (self._play, self._speed, self._slider)

    @property
    def length(self) -> float:
        """Seconds of the recording."""
        return self._recording.length

    def tick(self) -> None:
        """Let the time run on."""
        now = time.monotonic()
        elapsed, self._ticked = now - self._ticked, now
        if self._play.active:
            self.time = min(self.time + elapsed * _SPEEDS.get(str(self._speed.value), 1.0), self.length)
        if not self._dragged:
            self._shown = round(self.time, 1)
            self._slider.update(end=max(1.0, self.length), value=self._shown)
        self._feed(self.time)

    def clock(self, seconds: float) -> str:
        """Return a time of the recording in words: UTC where the recording tells it, and since its start."""
        elapsed = to_elapsed(seconds)
        if self._recording.chronicle.start is None:
            return elapsed
        return f"{self._recording.chronicle.moment(seconds)} UTC, {elapsed}"

    def pause(self) -> None:
        """Stay at this time."""
        self._play.active = False

    def has(self, seconds: float) -> bool:
        """Return whether this time was read already, or will not come."""
        return self._recording.is_read or seconds <= self.length

    def toggle(self) -> None:
        """Pause, or play on."""
        self._play.active = not self._play.active

    def jump(self, seconds: float) -> None:
        """Set the time, as far as the recording has it, with the minute before it."""
        self._dragged = False
        self.fleet.clear()
        self._monitor, self.time = Monitor(), min(max(0.0, seconds), self.length)
        self._next = bisect_left(self._recording.dues, self.time - _MINUTE)
        for index in self._recording.before(self._next):  # what was known of streams that are silent by then
            self._show(index)
        for address, stream in self.fleet.streams.items():
            whole = self._recording.whole.streams.get(address)
            if stream.valid is None and whole is not None:
                stream.valid = last_place(whole, self.time)
        self._feed(self.time)
        self.on_jump()

    def _drag(self, seconds: float) -> None:
        self._dragged = self._dragged or seconds != self._shown

    def _feed(self, seconds: float) -> None:
        end = bisect_right(self._recording.dues, seconds)
        for index in range(self._next, end):
            self._show(index)
        self._next = max(self._next, end)
        states = {name: state_at(spans, seconds) for name, spans in self._recording.chronicle.spans.items()}
        self.fleet.look(seconds, self._monitor.snapshot(round(seconds * 1e9)), states)

    def _show(self, index: int) -> None:
        due, (address, payload) = self._recording.dues[index], self._recording.entries[index]
        if isinstance(payload, str):
            self.fleet.reject([RejectionReport(address, payload, round(due * 1e9))])
            return
        message: Any = _Unread(payload) if isinstance(payload, int) else None
        if isinstance(payload, bytes):
            message = codec_of(BY_TOPIC[address.topic]).decode_row(payload)
        sample = Sample(message, address, round(due * 1e9))
        self._monitor.add(sample, received=sample.received)
        self.fleet.add(sample, due)
