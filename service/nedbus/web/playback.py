"""A recording on the page: the messages of a file, and a time that runs, is paused, and can be set."""

from __future__ import annotations

import logging
import threading
import time
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from bokeh.layouts import row
from bokeh.models import Row
from bokeh.models.widgets import Select, Slider, Toggle

from nedbus.client import Monitor, RejectionReport, Sample
from nedbus.errors import InvalidMessageError, NedbusError
from nedbus.log_event import about
from nedbus.sources import ReplaySource, parse_source, source_text_of_file
from nedbus_msgs import DEFAULT, Address, codec_of, upgrade_fields

from .fleet import Fleet
from .stream import is_position

_log = logging.getLogger(__name__)

_MINUTE: Final = 60.0  # s that are shown before the time that is chosen
_SPEEDS: Final[Mapping[str | tuple[Any, str], float]] = {
    "0.5": 0.5, "1": 1.0, "2": 2.0, "5": 5.0, "10": 10.0, "50": 50.0,
}  # fmt: skip


class Recording:
    """All positions of a .ulg or .mcap file, as bytes, in the order of their time; read in a thread of its own.

    Of other messages, which outnumber them, only PX4's time is kept.

    Raises ConfigError and SourceError for a file that cannot be read.
    """

    def __init__(self, path: Path) -> None:
        spec = parse_source(source_text_of_file(path))
        self.name = path.name
        self.dues: list[float] = []
        self.entries: list[tuple[Address, bytes | str | int]] = []
        self._path = str(path)
        self._run = cast("ReplaySource", spec.open_source(vehicle="1")).open()
        for warning in self._run.warnings:
            _log.warning("%s: %s", path, warning, extra=about("damaged", source=self._path, reason=warning))
        threading.Thread(target=self._read, name="nedbus-recording", daemon=True).start()

    @property
    def length(self) -> float:
        """Seconds that have been read so far."""
        return self.dues[-1] if self.dues else 0.0

    def _read(self) -> None:
        try:
            for message in self._run.messages:
                keep = _encode if is_position(message.address) else _time_of
                self.entries.append((message.address, message.error or keep(message.fields)))
                self.dues.append(message.due)
        except NedbusError as exc:
            _log.error("%s", exc, extra=about("damaged", source=self._path, reason=str(exc)))


def _encode(fields: Mapping[str, object]) -> bytes | str:
    """Return a message as bytes, or why it is none."""
    try:
        return codec_of(DEFAULT).encode_fields(upgrade_fields(DEFAULT, fields))
    except InvalidMessageError as exc:
        return exc.reason


def _time_of(fields: Mapping[str, object]) -> int | str:
    """Return PX4's time of a message, or why it is none."""
    return cast("int", fields["timestamp"]) if "timestamp" in fields else "timestamp: Field required"


class _Unread(NamedTuple):
    """A message of which only its time is known."""

    timestamp: int


class Player:
    """One viewer's time in a recording; its fleet is as it was then."""

    def __init__(self, recording: Recording) -> None:
        self.fleet = Fleet()
        self.on_jump: Callable[[], object] = lambda: None
        self._recording = recording
        self._monitor = Monitor()
        self._time, self._next = 0.0, 0
        self._ticked = time.monotonic()
        self._slider = Slider(title="time [s]", start=0, end=1, value=0, step=0.1, sizing_mode="stretch_width")
        self._play = Toggle(label="pause", active=True, width=80)
        self._speed = Select(options=list(_SPEEDS), value="1", width=80)
        self._play.on_change("active", lambda _, __, active: self._play.update(label="pause" if active else "play"))
        self._shown, self._dragged = 0.0, False
        self._slider.on_change("value", lambda _, __, value: self._drag(value))
        self._slider.on_change("value_throttled", lambda _, __, value: self._jump(value))
        self.controls: Row = row(self._play, self._speed, self._slider, sizing_mode="stretch_width")

    def tick(self) -> None:
        """Let the time run on."""
        now = time.monotonic()
        elapsed, self._ticked = now - self._ticked, now
        if self._play.active:
            self._time = min(self._time + elapsed * _SPEEDS.get(str(self._speed.value), 1.0), self._recording.length)
        if not self._dragged:
            self._shown = round(self._time, 1)
            self._slider.update(end=max(1.0, self._recording.length), value=self._shown)
        self._feed(self._time)

    def _drag(self, seconds: float) -> None:
        self._dragged = self._dragged or seconds != self._shown

    def _jump(self, seconds: float) -> None:
        self._dragged = False
        self.fleet.clear()
        self._monitor, self._time = Monitor(), min(max(0.0, seconds), self._recording.length)
        self._next = bisect_left(self._recording.dues, self._time - _MINUTE)
        for halves in range(round(2 * _MINUTE)):  # so that it is known since when a condition holds
            self._feed(max(0.0, self._time - _MINUTE + halves / 2))
        self.on_jump()

    def _feed(self, seconds: float) -> None:
        end = bisect_right(self._recording.dues, seconds)
        for index in range(self._next, end):
            due, (address, payload) = self._recording.dues[index], self._recording.entries[index]
            if isinstance(payload, str):
                self.fleet.reject([RejectionReport(address, payload, round(due * 1e9))])
                continue
            message: Any = _Unread(payload) if isinstance(payload, int) else codec_of(DEFAULT).decode_row(payload)
            sample = Sample(message, address, round(due * 1e9))
            self._monitor.add(sample, received=sample.received)
            self.fleet.add(sample, due)
        self._next = max(self._next, end)
        self.fleet.look(seconds, self._monitor.snapshot(round(seconds * 1e9)))
