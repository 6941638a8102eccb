"""Flight files: format by suffix, opening, and selection of streams."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePath
from typing import BinaryIO, Final

from nedbus.errors import AddressError, ConfigError, SourceError
from nedbus_msgs import Address, Selection

SUFFIXES: Final[Mapping[str, str]] = {".ulg": "ulog", ".mcap": "mcap"}
"""The source type that replays a file, by suffix."""

_MAX_NAMED: Final = 10  # addresses listed in an error


def format_of(path: str | PurePath) -> str:
    """Return the format of a flight file, "ulog" or "mcap"; raise ConfigError for another suffix."""
    found = SUFFIXES.get(PurePath(path).suffix.lower())
    if found is None:
        raise ConfigError(str(path), f"not a flight file: its name must end with {' or '.join(SUFFIXES)}")
    return found


def check_recording(path: Path) -> None:
    """Raise ConfigError unless the name of a recording ends with .mcap."""
    if SUFFIXES.get(path.suffix.lower()) != "mcap":
        raise ConfigError(str(path), "not a recording: its name must end with .mcap")


def open_flight(path: Path) -> BinaryIO:
    """Open a file for reading; raise SourceError if that fails, and for a pipe or folder: a flight is read twice."""
    try:
        if path.exists() and not path.is_file():
            raise SourceError(str(path), "not a regular file: save the data to a file first")
        return path.open("rb")
    except OSError as exc:
        raise SourceError(str(path), (exc.strerror or str(exc)).lower()) from exc


def matching(path: Path, addresses: Sequence[Address], selection: Selection) -> list[Address]:
    """Return the selected addresses of a file; raise AddressError if there are none."""
    topic, vehicle = selection.topic, selection.vehicle
    steps = {"vehicle": Selection(vehicle=vehicle), "topic": Selection(topic, vehicle), "instance": selection}
    for part, step in steps.items():
        if not any(map(step.matches, addresses)):
            expected = f"one in {path}, which has {_list(addresses)}"
            raise AddressError(part, getattr(selection, part), expected)
    return list(filter(selection.matches, addresses))


def single_match(path: Path, addresses: Sequence[Address], selection: Selection) -> list[Address]:
    """Return the single selected address of a file; raise AddressError if there is none or more than one.

    Of a topic without a file in nedbus, the first instance has the plain address, and is the one that a topic selects.
    """
    found = matching(path, addresses, selection)
    plain = [address for address in found if address.instance is None]
    found = plain if len(plain) == 1 and len({(each.vehicle, each.topic) for each in found}) == 1 else found
    lacking = [part for part in ("topic", "vehicle", "instance") if len({getattr(each, part) for each in found}) > 1]
    if lacking:
        problem = f"one stream of {path}, but several match: set {' and '.join(lacking)} to one of {_list(found)}"
        raise AddressError(lacking[0], getattr(selection, lacking[0]), problem)
    return found


def require_one_vehicle(where: Path | str, addresses: Iterable[Address], vehicle: str) -> None:
    """Raise AddressError if these addresses, selected by `vehicle`, belong to several vehicles."""
    vehicles = sorted({address.vehicle for address in addresses})
    if len(vehicles) > 1:
        raise AddressError("vehicle", vehicle, f"one vehicle of {where}: {', '.join(vehicles[:_MAX_NAMED])}")


def _list(addresses: Sequence[Address]) -> str:
    more = len(addresses) - _MAX_NAMED
    return ", ".join(map(str, addresses[:_MAX_NAMED])) + (f" and {more} more" if more > 0 else "")
