"""Standard output and standard error: printable text alone reaches them, and a closed one is an error of one line."""

from __future__ import annotations

import csv
import errno
import io
import logging
import os
import sys
from collections.abc import Iterable
from contextlib import suppress
from typing import Final

from nedbus.errors import NedbusError
from nedbus.log_event import about

MAX_TEXT: Final = 1000
"""Characters that are shown of an error or a line of the log."""

FOR_PROGRAMS: Final = "for programs"
"""The name of a log handler whose lines are read by a program."""

_MAX_CELL: Final = 120  # characters that are shown of a value that some peer sent
_log = logging.getLogger("nedbus")


def printable(text: str) -> str:
    """Return text whose control characters are spelt out, so that none acts on a terminal; lines stay lines."""
    if text.isascii() and text.replace("\n", "").isprintable():
        return text
    return "".join(
        char if char.isprintable() or char == "\n" else char.encode("unicode_escape").decode() for char in text
    )


def to_text(value: object, limit: int = _MAX_CELL) -> str:
    """Return a peer's text as one line of at most `limit` characters, all of them printable."""
    text = str(value)
    short = text if len(text) <= limit else f"{text[: limit - 3]}..."
    return printable(short.replace("\n", "\\n"))[: 4 * limit]


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: 1 source, 2 sources."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def csv_line(cells: Iterable[object]) -> str:
    """Return a line of CSV, with quotes where they are needed; None is an empty cell."""
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(cells)
    return line.getvalue()


def write(line: str) -> None:
    """Write a line of output, or several, at once.

    Raises BrokenPipeError when its reader is gone, NedbusError when it cannot be written.
    """
    try:
        if sys.stdout is None:
            raise OSError(errno.EBADF, "standard output is closed")
        sys.stdout.write(f"{printable(line)}\n")
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as exc:
        discard_stdout()
        raise NedbusError(f"cannot write: {(exc.strerror or str(exc)).lower()}") from exc


def write_stderr(text: str) -> None:
    """Write a line for a person to stderr, at once, or log it for programs; a closed stderr is no error."""
    if logs_for_programs():
        for line in text.splitlines():
            _log.info("%s", line, extra=about("notice"))
        return
    with suppress(OSError):
        sys.stderr.write(f"{printable(text)}\n")
        sys.stderr.flush()


def logs_for_programs() -> bool:
    """Return whether the log is read by programs: then nothing else is written to stderr."""
    return any(handler.name == FOR_PROGRAMS for handler in logging.getLogger().handlers)


def discard_stdout() -> None:
    """Redirect stdout to the null device, so that flushing it at exit does not fail again."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
