"""The vehicles of a flight: their names, their files and their UTC."""

from pathlib import Path

from nedbus.timeline import UtcOffset
from nedbus_msgs import DEFAULT_TOPIC, Address

from .flight import Flight
from .merge import no_utc


def vehicles_of(flight: Flight) -> list[str]:
    """Return the vehicles of a flight, file by file; one that is in several files is named after its file."""
    vehicles = list[str]()
    for reader, names in zip(flight._readers, flight._names, strict=True):
        own = sorted({address.vehicle for address in reader.definitions})
        vehicles += [names.get(vehicle, vehicle) for vehicle in own]
    return vehicles


def path_of(flight: Flight, vehicle: str) -> Path:
    """Return the file of a vehicle of a flight."""
    number, _ = flight._find(Address(vehicle, DEFAULT_TOPIC))
    return flight._paths[number]


def require_utc(flight: Flight, vehicle: str) -> UtcOffset:
    """Return the UTC offset of a vehicle of a flight; raise SourceError if it is unknown."""
    utc = flight._utc_by_name[vehicle]
    if isinstance(utc, str):
        raise no_utc(path_of(flight, vehicle), utc)
    return utc


def utc_offset_of(flight: Flight, vehicle: str) -> UtcOffset | None:
    """Return the UTC offset of a vehicle of a flight; None if it is unknown."""
    utc = flight._utc_by_name[vehicle]
    if isinstance(utc, str):
        return None
    return utc
