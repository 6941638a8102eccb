"""The status of a service, as `nedbus info` shows it and `nedbus/@service/<id>/status` answers it in JSON."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, get_args

from nedbus.client import Health, Histogram, stream_state

State = Literal["starting", "waiting", "running", "retrying", "done", "failed"]
STATES: Final[tuple[State, ...]] = get_args(State)
Role = Literal["router", "client"]


@dataclass(frozen=True, slots=True)
class StreamStatus:
    """The health of one stream that is published."""

    address: str
    health: Health


@dataclass(frozen=True, slots=True)
class SourceStatus:
    """The status of one source.

    `published` and `rejected` count messages since the service started; `done` of `total` is this run's progress.
    `lost`: messages that were lost before they reached a live source, as far as it can count; `reboots` of vehicles.
    `stale`: addresses that a live source published, until nothing arrived for 3 s.
    `not_carried`: messages that vehicles publish and this source has no definition of; `silent`: addresses that they
    announce, and of which nothing arrives while others do.
    `rejections`: how many messages each rule rejected.
    `retries`: how often it failed and was started again; `error`: why it failed last.
    `streams`: the health of each stream that is published, of up to 100 of them.
    """

    source: str
    state: State
    addresses: tuple[str, ...]
    stale: tuple[str, ...]
    published: int
    rejected: int
    rejections: dict[str, int]
    lost: int
    reboots: int
    done: int
    total: int | None
    retries: int
    summary: str
    warnings: tuple[str, ...]
    error: str | None
    streams: tuple[StreamStatus, ...]
    not_carried: tuple[str, ...] = ()
    silent: tuple[str, ...] = ()

    @property
    def ended(self) -> bool:
        """Whether it will publish no more."""
        return self.state in {"done", "failed"}


@dataclass(frozen=True, slots=True)
class SourceMeasures:
    """What is measured of one source, for metrics: its status, all its streams, and how long publishing takes [s]."""

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


@dataclass(frozen=True, slots=True)
class ServiceStatus:
    """The status of a service.

    Times are seconds since the epoch; `host` is the name of its host, or of its container.
    `refused`: vehicles that its router's access rules keep from everybody.
    """

    service: str
    host: str
    version: str
    started: float
    now: float
    role: Role
    endpoints: tuple[str, ...]
    refused: tuple[str, ...]
    sources: tuple[SourceStatus, ...]
