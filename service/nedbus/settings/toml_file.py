"""Read a settings file in TOML, and locate settings in it for error messages."""

import re
import tomllib
from collections.abc import Sequence
from pathlib import Path

from nedbus.errors import ConfigError

Place = tuple[int | None, int | None]
"""Line and column, counted from 1; None if unknown."""


def read_text(path: Path) -> str:
    """Return the text of a file without a byte order mark; raise ConfigError if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as exc:
        raise ConfigError.in_file(path, "not UTF-8 text") from exc
    except OSError as exc:
        raise ConfigError.in_file(path, f"cannot be read: {(exc.strerror or str(exc)).lower()}") from exc


def read_toml(path: Path) -> dict[str, object]:
    """Parse a file; raise ConfigError with line and column."""
    text = read_text(path)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as exc:
        position = re.search(r"\(at line (\d+), column (\d+)\)", str(exc))
        reason = re.sub(r" \(at .*\)", "", str(exc))
        if position is None:  # "at end of document"
            lines = text.splitlines() or [""]
            raise ConfigError.in_file(path, reason, line=len(lines), column=len(lines[-1]) + 1) from exc
        raise ConfigError.in_file(path, reason, line=int(position[1]), column=int(position[2])) from exc


def find_key(text: str, name: str) -> Place:
    """Return line and column of a key or a table, which TOML parsers do not keep."""
    found = re.search(rf"^[ \t]*\[*[ \t]*(\"?{re.escape(name)}\"?)[ \t]*[=.\]]", text, re.MULTILINE)
    if found is None:
        return None, None
    return place_at(text, found.start(1))


def find_source(text: str, sources: Sequence[object], index: int, key: str = "") -> Place:
    """Return line and column of the source with this index, a table or a text in a list, or of one of its options."""
    source = sources[index]
    headers = list(re.finditer(r"^[ \t]*\[\[[ \t]*(source)[ \t]*\]\]", text, re.MULTILINE))
    if not isinstance(source, str) and index < len(headers):
        start = headers[index].start(1)
        end = headers[index + 1].start() if index + 1 < len(headers) else len(text)
        option = re.search(rf"^[ \t]*(\"?{re.escape(key)}\"?)[ \t]*=", text[start:end], re.MULTILINE) if key else None
        return place_at(text, start + option.start(1) if option else start)
    if isinstance(source, str):
        found = [each.start(1) for each in re.finditer(rf"(?<=[\"'])({re.escape(source)})[\"']", text)]
        before = sources[:index].count(source)
        if before < len(found):
            return place_at(text, found[before])
    return find_key(text, "source")


def place_at(text: str, start: int) -> Place:
    """Return line and column of an index into a text; unknown for a negative index, as from `str.find`."""
    if start < 0:
        return None, None
    return text.count("\n", 0, start) + 1, start - text.rfind("\n", 0, start)
