"""The states of a source, and what is measured of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, get_args

from nedbus.client import Histogram, SourceStatus, StreamStatus, stream_state

State = Literal["starting", "waiting", "running", "retrying", "done", "failed"]
STATES: Final[tuple[State, ...]] = get_args(State)
Role = Literal["router", "client"]


@dataclass(frozen=True, slots=True)
class SourceMeasures:
    """Measurements of one source, for metrics: its status, all its streams, and the time that publishing takes [s]."""

    status: SourceStatus
    streams: tuple[StreamStatus, ...]
    durations: Histogram

    @property
    def states(self) -> dict[str, str]:
        """The state of each stream by address; silence after the end of the source is no fault."""
        if self.status.ended:
            return {stream.address: "ok" for stream in self.streams}
        published = frozenset(self.status.addresses)
        return {each.address: stream_state(each.health, alive=each.address in published).name for each in self.streams}
