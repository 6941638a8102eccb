"""Several files on one UTC axis, with distinct names of vehicles."""

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from heapq import merge
from operator import attrgetter
from pathlib import Path

from nedbus.errors import ArgumentError, SourceError
from nedbus.samples import SourceMessage
from nedbus_msgs import Address

from .readers import FlightReader

Names = Mapping[str, str]
"""The name of each vehicle of a file among several files, by its own name."""


def merge_messages(
    readers: Sequence[FlightReader],
    names: Sequence[Names],
    offsets: Sequence[float],
    on_end: Callable[[Names], object],
) -> Iterator[SourceMessage]:
    """Return the messages of several files in chronological order, on one axis.

    `offsets`: the time on that axis at which the axis of each file begins [s]. `on_end`: called when a file has ended.
    """
    shifted = (_shift(*file, on_end) for file in zip(readers, names, offsets, strict=True))
    return merge(*shifted, key=attrgetter("at"))


def _shift(
    reader: FlightReader, names: Names, offset: float, on_end: Callable[[Names], object]
) -> Iterator[SourceMessage]:
    for message in reader.messages():
        message.at += offset
        message.address = renamed(message.address, names)
        yield message
    on_end(names)


def no_utc(path: Path, reason: str) -> SourceError:
    """Return the error for one of several files without UTC."""
    text = reason or "no message contains UTC"
    return SourceError(str(path), f"{text}, which merging several files requires; read it alone")


def require_files(paths: Sequence[Path]) -> Sequence[Path]:
    """Return the paths of flights; raise ArgumentError if there are none."""
    if not paths:
        raise ArgumentError("path", list(paths), "at least one .ulg, .mcap or .tlog file")
    return paths


def renamed(address: Address, names: Names) -> Address:
    """Return an address with the name that its vehicle has among several files."""
    name = names.get(address.vehicle, address.vehicle)
    if name == address.vehicle:
        return address
    return Address(name, address.topic, address.instance)


def distinct_names(flights: Sequence[tuple[Path, Collection[str]]]) -> list[dict[str, str]]:
    """Map the vehicles of each file to unique names; a vehicle that is in several files is named after its file."""
    counts: Counter[str] = Counter()
    for _, vehicles in flights:
        counts.update(vehicles)
    taken = set(counts)
    names_of_files = []
    for path, vehicles in flights:
        names = {}
        for vehicle in sorted(vehicles):
            name = vehicle
            if counts[vehicle] > 1:
                name = _free_name(path, taken)
            names[vehicle] = name
            taken.add(name)
        names_of_files.append(names)
    return names_of_files


def _free_name(path: Path, taken: Collection[str]) -> str:
    """Return a name after a file that no vehicle has."""
    stem = path.name.partition(".")[0]
    base = re.sub(r"[^A-Za-z0-9_-]", "_", stem)[:60] or "flight"
    name = base
    number = 1
    while name in taken:
        number += 1
        name = f"{base}_{number}"
    return name
