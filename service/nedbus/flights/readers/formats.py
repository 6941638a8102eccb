"""The formats of flight files: detection by content, then by suffix, and the reader of each."""

import re
from collections.abc import Mapping
from pathlib import Path, PurePath
from typing import BinaryIO, Final, NamedTuple

from nedbus.errors import ArgumentError, ConfigError, SourceError
from nedbus.extras import import_optional
from nedbus_msgs import DEFAULT, RELEASES

from .reader import FlightReader, ReadOptions

_UNREADABLE: Final = {
    b"ULogKey": "an encrypted log; decrypt it with PX4's Tools/decrypt_ulog.py and the private key first",
    b"PK\x03\x04": "a zip archive; unpack it first",
    b"\x1f\x8b": "a gzip file; unpack it first",
    b"version https://git-lfs": "a Git LFS pointer instead of the file; fetch the file with 'git lfs pull'",
    b"SQLite format 3": "an SQLite bag; convert it to MCAP with 'ros2 bag convert', storage_id: mcap",
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
SUFFIXES: Final[Mapping[str, str]] = {each.suffix: name for name, each in _FORMATS.items()}
"""The format of a file, and so the kind of source that replays it, by suffix."""


def find_format(path: str | PurePath) -> str | None:
    """Return the format of a flight file by its suffix, "ulog", "mcap" or "tlog", or None; a folder is an MCAP bag."""
    suffix = PurePath(str(path).lower().removesuffix(".zstd")).suffix
    return SUFFIXES.get(suffix) or ("mcap" if Path(path).expanduser().is_dir() else None)


def format_of(path: str | PurePath) -> str:
    """Return the format of a flight file by its content, else by its suffix; raise ConfigError for other files."""
    head = _head_of(Path(path).expanduser())
    known = (name for name, each in _FORMATS.items() if each.magic and head.startswith(each.magic))
    found = next(known, None) or find_format(path)
    if found is None and (reason := _why_unreadable(head)):
        raise SourceError(str(path), reason)
    if found is None:
        raise ConfigError(
            str(path), f"not a flight file; its name must end with {' or '.join(SUFFIXES)}"
        )
    return found


def open_reader(path: Path, options: ReadOptions = ReadOptions()) -> FlightReader:  # noqa: B008 - immutable
    """Open a flight file in the format of its content, else of its suffix.

    Raises SourceError for a file that cannot be read, ConfigError if it is of another kind, or if the package that
    reads it is not installed, ArgumentError for a layout= that the format does not need.
    """
    kind = _FORMATS[format_of(path)]
    if options.layout is not None and kind.extra != "mcap":
        raise ArgumentError(
            "layout", options.layout, f"none, because a {kind.suffix} file defines its own layouts"
        )
    if options.layout not in (known := (None, *RELEASES, *DEFAULT.layouts)):
        raise ArgumentError(
            "layout", options.layout, f"one of {', '.join(dict.fromkeys(map(str, known[1:])))}"
        )
    module = import_optional(kind.extra, f"{__package__}.{kind.module}")
    reader: FlightReader = getattr(module, kind.reader)(path, options)
    return reader


def check_recording(path: Path) -> None:
    """Raise ConfigError unless the name of a recording ends with .mcap."""
    if SUFFIXES.get(path.suffix.lower()) != "mcap":
        raise ConfigError(
            str(path),
            "its name must end with .mcap; for CSV, see nedbus.read in docs/recordings.md",
        )


def open_file(path: Path) -> BinaryIO:
    """Open a file for reading; raise SourceError if that fails, or for a pipe, which cannot be read twice."""
    try:
        if path.is_dir():
            raise SourceError(
                str(path), "not a regular file, but a folder; only a bag of MCAP files can be read"
            )
        if path.exists() and not path.is_file():
            raise SourceError(str(path), "not a regular file; save the data to a file first")
        if path.is_file() and (reason := _why_unreadable(_head_of(path))):
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
        reason = next(
            filter(None, (_why_unreadable(_head_of(each)) for each in sorted(path.glob("*.db3")))),
            "",
        )
        raise SourceError(str(path), reason or "no .mcap file in this folder")
    found.sort(
        key=lambda each: [
            int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", each.name)
        ]
    )
    metadata = path / "metadata.yaml"
    text = metadata.read_text(errors="replace") if metadata.exists() else ""
    listed = re.findall(r"^\s*- (?:\S*/)?([^\s/]+\.mcap)\b", text, re.MULTILINE)
    return found, sorted({*listed} - {each.name.removesuffix(".zstd") for each in found})


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
    known = (
        text
        for first, text in _UNREADABLE.items()
        if head.startswith(first) and bool(head) == bool(first)
    )
    return next(known, "")
