"""The status that services answer with, parsed: it comes from the network, perhaps from another version of nedbus."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from pydantic import TypeAdapter, ValidationError

from nedbus.client import Health


@dataclass(frozen=True, slots=True)
class _Stream:
    address: str
    health: Health


_STREAM: Final[TypeAdapter[_Stream]] = TypeAdapter(_Stream)


def sources_of(service: dict[str, object]) -> list[dict[str, object]]:
    """Return the sources in the status of a service."""
    return [source for source in list_of(service, "sources") if isinstance(source, dict)]


def refused_of(service: dict[str, object]) -> list[str]:
    """Return the vehicles of a service that its router refuses, as it says itself."""
    return [vehicle for vehicle in list_of(service, "refused") if isinstance(vehicle, str)]


def streams_of(source: dict[str, object]) -> list[tuple[str, Health]]:
    """Return address and health of each stream in the status of a source; what cannot be parsed is left out."""
    streams = []
    for each in list_of(source, "streams"):
        try:
            stream = _STREAM.validate_python(each)
        except ValidationError:
            continue
        streams.append((stream.address, stream.health))
    return streams


def list_of(status: dict[str, object], name: str) -> list[object]:
    """Return a list in a status; an empty one for anything else."""
    value = status.get(name)
    return value if isinstance(value, list) else []
