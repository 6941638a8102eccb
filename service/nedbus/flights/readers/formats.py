"""The formats of flight files: detection by content, then by suffix, and the reader of each."""

import re
from collections.abc import Mapping
from pathlib import Path, PurePath
from typing import BinaryIO, Final, NamedTuple

from nedbus.errors import ArgumentError, ConfigError, SourceError, system_reason
from nedbus.extras import import_optional
from nedbus_msgs import DEFAULT, RELEASES

from .reader import FlightReader, ReadOptions

_SQLITE: Final = b"SQLite format 3"
_UNREADABLE: Final = {
    b"ULogKey": "an encrypted log; decrypt it with PX4's Tools/decrypt_ulog.py and the private key first",
    b"PK\x03\x04": "a zip archive; unpack it first",
    b"\x1f\x8b": "a gzip file; unpack it first",
    b"version https://git-lfs": "a Git LFS pointer instead of the file; fetch the file with 'git lfs pull'",
    _SQLITE: "an SQLite bag; convert it to MCAP with 'ros2 bag convert', storage_id: mcap",
    b"": "an empty file; copy it again, or look for another log of this flight",
}  # by first bytes


class _Format(NamedTuple):
    """A format: the suffix of its files, their first bytes, and its reader, with the extra that this requires."""

    suffix: str
    magic: tuple[bytes, ...]
    module: str
    reader: str
    extra: str = ""


_FORMATS: Final[Mapping[str, _Format]] = {
    "ulog": _Format(".ulg", (b"ULog\x01\x12\x35",), "ulog", "UlogReader"),
    "mcap": _Format(".mcap", (b"\x89MCAP0\r\n",), "mcap", "McapReader", "mcap"),
    "tlog": _Format(".tlog", (), "tlog", "TlogReader", "mavlink"),
}
SUFFIXES: Final[Mapping[str, str]] = {known.suffix: name for name, known in _FORMATS.items()}
"""The format of a file, and so the kind of source that replays it, by suffix."""


def find_format(path: str | PurePath) -> str | None:
    """Return the format of a flight file by its suffix, "ulog", "mcap" or "tlog", or None; a folder is an MCAP bag."""
    suffix = PurePath(str(path).lower().removesuffix(".zstd")).suffix
    if suffix in SUFFIXES:
        return SUFFIXES[suffix]
    return "mcap" if Path(path).expanduser().is_dir() else None


def format_of(path: str | PurePath) -> str:
    """Return the format of a flight file by its content, else by its suffix; raise ConfigError for other files."""
    head = _head_of(Path(path).expanduser())
    for name, known in _FORMATS.items():
        if known.magic and head.startswith(known.magic):
            return name
    by_suffix = find_format(path)
    if by_suffix is not None:
        return by_suffix
    reason = _why_unreadable(head)
    if not reason and str(path).lower().endswith(".db3.zstd"):
        reason = _UNREADABLE[_SQLITE]
    if reason:
        raise SourceError(str(path), reason)
    suffixes = " or ".join(SUFFIXES)
    raise ConfigError(str(path), f"not a flight file; its name must end with {suffixes}")


def open_reader(path: Path, options: ReadOptions = ReadOptions()) -> FlightReader:  # noqa: B008 - immutable
    """Open a flight file in the format of its content, else of its suffix.

    Raises SourceError for a file that cannot be read, ConfigError if it is of another kind, or if the package that
    reads it is not installed, ArgumentError for a layout= that the format does not need.
    """
    kind = _FORMATS[format_of(path)]
    if options.layout is not None:
        _check_layout(options.layout, kind)
    module = import_optional(kind.extra, f"{__package__}.{kind.module}")
    reader: FlightReader = getattr(module, kind.reader)(path, options)
    return reader


def _check_layout(layout: str, kind: _Format) -> None:
    if kind.extra != "mcap":
        expected = f"none, because a {kind.suffix} file defines its own layouts"
        raise ArgumentError("layout", layout, expected)
    known = [str(name) for name in (*RELEASES, *DEFAULT.layouts)]
    if layout not in known:
        raise ArgumentError("layout", layout, f"one of {', '.join(dict.fromkeys(known))}")


def check_recording(path: Path) -> None:
    """Raise ConfigError unless the name of a recording ends with .mcap."""
    if SUFFIXES.get(path.suffix.lower()) != "mcap":
        problem = "its name must end with .mcap; for CSV, see nedbus.read in docs/recordings.md"
        raise ConfigError(str(path), problem)


def open_file(path: Path) -> BinaryIO:
    """Open a file for reading; raise SourceError if that fails, or for a pipe, which cannot be read twice."""
    try:
        problem = ""
        if path.is_dir():
            problem = "not a regular file, but a folder; only a bag of MCAP files can be read"
        elif path.is_file():
            problem = _why_unreadable(_head_of(path))
        elif path.exists():
            problem = "not a regular file; save the data to a file first"
        if problem:
            raise SourceError(str(path), problem)
        return path.open("rb")
    except OSError as exc:
        raise SourceError(str(path.absolute()), system_reason(exc)) from exc


def recording_files(path: Path) -> tuple[list[Path], list[str]]:
    """Return the MCAP files of a recording or bag in order, and the missing ones; raise SourceError if it has none."""
    if not path.is_dir():
        return [path], []
    files = [file for file in path.iterdir() if file.is_file() and find_format(file) == "mcap"]
    if not files:
        raise SourceError(str(path), _why_no_recording(path))
    files.sort(key=_natural_order)
    metadata = path / "metadata.yaml"
    text = metadata.read_text(errors="replace") if metadata.exists() else ""
    listed = re.findall(r"^\s*- (?:\S*/)?([^\s/]+\.mcap)\b", text, re.MULTILINE)
    present = {file.name.removesuffix(".zstd") for file in files}
    return files, sorted({*listed} - present)


def _why_no_recording(folder: Path) -> str:
    """Return why a folder has no MCAP file."""
    for bag in sorted(folder.glob("*.db3")):
        reason = _why_unreadable(_head_of(bag))
        if reason:
            return reason
    if any(folder.glob("*.db3.zstd")):
        return _UNREADABLE[_SQLITE]
    return "no .mcap file in this folder"


def _natural_order(path: Path) -> list[int | str]:
    """Return a sort key that puts flight_2 before flight_10."""
    parts = re.split(r"(\d+)", path.name)
    return [int(part) if part.isdecimal() else part for part in parts]


def _head_of(path: Path) -> bytes:
    """Return the first bytes of a regular file; b"?" if it is none, or cannot be read."""
    try:
        if not path.is_file():
            return b"?"
        with path.open("rb") as file:
            return file.read(32)
    except OSError:
        return b"?"


def _why_unreadable(head: bytes) -> str:
    """Return why a file with these first bytes is not a flight file, and the remedy; "" if it may be one."""
    if not head:
        return _UNREADABLE[b""]
    for first, text in _UNREADABLE.items():
        if first and head.startswith(first):
            return text
    return ""
