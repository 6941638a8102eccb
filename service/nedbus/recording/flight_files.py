"""Flight files: formats by suffix, opening, and selection of streams."""

import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path, PurePath
from typing import BinaryIO, Final

from nedbus.errors import AddressError, ConfigError, SourceError
from nedbus_msgs import Address, Selection

SUFFIXES: Final[Mapping[str, str]] = {".ulg": "ulog", ".mcap": "mcap", ".tlog": "tlog"}
"""The type of source that replays a file, by suffix."""

_MAX_NAMED: Final = 10  # addresses listed in an error
_UNREADABLE: Final = {
    b"ULogKey": "an encrypted log; decrypt it with PX4's Tools/decrypt_ulog.py and the private key first",
    b"PK\x03\x04": "a zip archive; unpack it first",
    b"\x1f\x8b": "a gzip file; unpack it first",
    b"version https://git-lfs": "a Git LFS pointer instead of the file; fetch the file with 'git lfs pull'",
    b"SQLite format 3": "an SQLite bag; convert it to MCAP with 'ros2 bag convert', storage_id: mcap",
    b"": "an empty file; copy it again, or look for another log of this flight",
}  # by first bytes


def find_format(path: str | PurePath) -> str | None:
    """Return the format of a flight file by its suffix, "ulog", "mcap" or "tlog", or None; a folder is an MCAP bag."""
    suffix = PurePath(str(path).lower().removesuffix(".zstd")).suffix
    return SUFFIXES.get(suffix) or ("mcap" if Path(path).expanduser().is_dir() else None)


def format_of(path: str | PurePath) -> str:
    """Return the format of a flight file; raise ConfigError for another suffix."""
    found = find_format(path)
    if found is None:
        reason = _why_unreadable(Path(path).expanduser())
        raise ConfigError(str(path), reason or f"not a flight file; its name must end with {' or '.join(SUFFIXES)}")
    return found


def check_recording(path: Path) -> None:
    """Raise ConfigError unless the name of a recording ends with .mcap."""
    if SUFFIXES.get(path.suffix.lower()) != "mcap":
        raise ConfigError(str(path), "its name must end with .mcap; for CSV, see nedbus.read in docs/recordings.md")


def open_flight(path: Path) -> BinaryIO:
    """Open a file for reading; raise SourceError if that fails, or for a pipe, which cannot be read twice."""
    try:
        if path.exists() and not path.is_file():
            raise SourceError(str(path), "not a regular file; save the data to a file first")
        if reason := _why_unreadable(path):
            raise SourceError(str(path), reason)
        return path.open("rb")
    except OSError as exc:
        raise SourceError(str(path.absolute()), (exc.strerror or str(exc)).lower()) from exc


def recording_files(path: Path) -> tuple[list[Path], list[str]]:
    """Return the MCAP files of a recording or bag in order, and the missing ones; raise SourceError if it has none."""
    if not path.is_dir():
        return [path], []
    found = [each for each in path.iterdir() if each.is_file() and find_format(each) == "mcap"]
    if not found:
        reason = next(filter(None, map(_why_unreadable, sorted(path.glob("*.db3")))), "")
        raise SourceError(str(path), reason or "no .mcap file in this folder")
    found.sort(key=lambda each: [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", each.name)])
    metadata = path / "metadata.yaml"
    text = metadata.read_text(errors="replace") if metadata.exists() else ""
    listed = re.findall(r"^\s*- (?:\S*/)?([^\s/]+\.mcap)\b", text, re.MULTILINE)
    return found, sorted({*listed} - {each.name.removesuffix(".zstd") for each in found})


def _why_unreadable(path: Path) -> str:
    """Return why a file is not a flight file, and the remedy; "" if it may be one, or does not exist."""
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        head = file.read(32)
    known = (text for first, text in _UNREADABLE.items() if head.startswith(first) and bool(head) == bool(first))
    return next(known, "")


def distinct_names(flights: Sequence[tuple[Path, Collection[str]]]) -> list[dict[str, str]]:
    """Map the vehicles of each file to unique names; a vehicle that is in several files is named after its file."""
    counts = Counter(vehicle for _, vehicles in flights for vehicle in vehicles)
    taken, found = set(counts), []
    for path, vehicles in flights:
        base = re.sub(r"[^A-Za-z0-9_-]", "_", path.name.partition(".")[0])[:60] or "flight"
        names = {}
        for vehicle in sorted(vehicles):
            free = (each for each in (base, *(f"{base}_{number}" for number in range(2, 999))) if each not in taken)
            names[vehicle] = vehicle if counts[vehicle] == 1 else next(free)
            taken.add(names[vehicle])
        found.append(names)
    return found


def matching(path: Path, addresses: Sequence[Address], selection: Selection) -> list[Address]:
    """Return the selected addresses of a file; raise AddressError if there are none."""
    topic, vehicle = selection.topic, selection.vehicle
    steps = {"vehicle": Selection(vehicle=vehicle), "topic": Selection(topic, vehicle), "instance": selection}
    for part, step in steps.items():
        if not any(map(step.matches, addresses)):
            expected = f"one of {_list(addresses)}"
            raise AddressError(part, getattr(selection, part), expected, problem=f"is not in {path}")
    return list(filter(selection.matches, addresses))


def single_match(path: Path, addresses: Sequence[Address], selection: Selection) -> list[Address]:
    """Return a list with the selected address of a file; raise AddressError unless exactly one matches.

    The first instance of a topic that only the file defines has no instance number: the topic alone selects it.
    """
    found = matching(path, addresses, selection)
    plain = [address for address in found if address.instance is None]
    found = plain if len(plain) == 1 and len({(each.vehicle, each.topic) for each in found}) == 1 else found
    lacking = [part for part in ("topic", "vehicle", "instance") if len({getattr(each, part) for each in found}) > 1]
    if lacking:
        problem = f"one stream of {path}, but several match; set {' and '.join(lacking)} to one of {_list(found)}"
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
