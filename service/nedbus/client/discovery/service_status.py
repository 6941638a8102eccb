"""The status of a service, as `nedbus info` shows it and `nedbus/@service/<id>/status` answers it in JSON."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

from pydantic import TypeAdapter, ValidationError, ValidatorFunctionWrapHandler, field_validator
from pydantic_core import PydanticUseDefault

from nedbus.client.health.stream_health import Health


@dataclass(frozen=True, slots=True)
class StreamStatus:
    """The health of one stream that is published."""

    address: str
    health: Health


class _FromPeer:
    """Fields of an answer from the network: an invalid value becomes the default, and invalid rows are left out."""

    __slots__ = ()

    @field_validator("*", mode="wrap")
    @classmethod
    def _replace_invalid(cls, value: object, validate: ValidatorFunctionWrapHandler) -> object:
        with suppress(ValidationError):
            return validate(value)
        rows: list[object] = []
        for row in value if isinstance(value, list) else ():
            with suppress(ValidationError):
                rows.extend(validate([row]))
        if not rows:
            raise PydanticUseDefault
        return tuple(rows)


@dataclass(frozen=True, slots=True)
class SourceStatus(_FromPeer):
    """The status of one source.

    `state`: starting, waiting, running, retrying, done or failed; empty if the service does not say.
    `published` and `rejected` count messages since the service started; `done` of `total` is this run's progress.
    `lost`: messages that were lost before they reached a live source, as far as it can count; `reboots` of vehicles.
    `stale`: addresses that a live source published, until nothing arrived for 3 s.
    `not_carried`: messages that vehicles publish and this source has no definition of; `silent`: addresses that they
    announce, and of which nothing arrives while others do.
    `rejections`: the number of messages that each rule rejected.
    `retries`: restarts after a failure; `error`: the reason of the last failure.
    `streams`: the health of each stream that is published, of up to 100 of them.
    """

    source: str = ""
    state: str = ""
    addresses: tuple[str, ...] = ()
    stale: tuple[str, ...] = ()
    published: int = 0
    rejected: int = 0
    rejections: dict[str, int] = field(default_factory=dict)
    lost: int = 0
    reboots: int = 0
    done: int = 0
    total: int | None = None
    retries: int = 0
    summary: str = ""
    warnings: tuple[str, ...] = ()
    error: str | None = None
    streams: tuple[StreamStatus, ...] = ()
    not_carried: tuple[str, ...] = ()
    silent: tuple[str, ...] = ()

    @property
    def ended(self) -> bool:
        """True once it will publish no more."""
        return self.state in {"done", "failed"}


@dataclass(frozen=True, slots=True)
class ServiceStatus(_FromPeer):
    """The status of a service, from `bus.services()`.

    `service` is its id; `host` the name of its host, or of its container; `role` "router" or "client".
    Times are seconds since the epoch by its clock.
    `refused`: vehicles that its router's access rules keep from all readers.
    Of a peer's answer, which may be of any version, what is absent or invalid has its default.
    """

    service: str = ""
    host: str = ""
    version: str = ""
    started: float = 0.0
    now: float | None = None
    role: str = ""
    endpoints: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    sources: tuple[SourceStatus, ...] = ()


_STATUS: Final = TypeAdapter(ServiceStatus)


def parse_status(content: object) -> ServiceStatus | None:
    """Return the status in a peer's answer, None if it is none."""
    return _STATUS.validate_python(content) if isinstance(content, dict) else None
