"""Writing to stdout and stderr: printable characters only; a closed stdout causes a one-line error."""

import csv
import errno
import io
import logging
import os
import sys
from collections.abc import Iterable
from contextlib import suppress
from typing import Final

from nedbus import limits
from nedbus.errors import NedbusError, system_reason
from nedbus.log_event import about

# name of the log handler if the log is read by a program: JSON, or the journal
STRUCTURED: Final = "structured"
# As listed by OWASP, with the wide forms of Japanese input.
_FORMULA_STARTS: Final = (
    "=",
    "+",
    "-",
    "@",
    "\t",
    "\r",
    "\n",
    "\uff1d",
    "\uff0b",
    "\uff0d",
    "\uff20",
)
_log = logging.getLogger("nedbus")


def printable(text: str) -> str:
    """Escape control characters, except newlines, to keep them from the terminal."""
    if text.isascii() and text.replace("\n", "").isprintable():
        return text
    return "".join(
        char if char.isprintable() or char == "\n" else char.encode("unicode_escape").decode()
        for char in text
    )


def to_text(value: object, limit: int = limits.CELL_TEXT) -> str:
    """Return text from a peer as one printable line, truncated to `limit` characters before they are escaped."""
    text = str(value)
    if len(text) <= limit:
        short = text
    else:
        short = f"{text[: limit - 3]}..."
    return printable(short.replace("\n", "\\n"))[: 4 * limit]


def csv_line(cells: Iterable[object]) -> str:
    """Format cells as a line of CSV, quoted where necessary; None is an empty cell.

    Text that a spreadsheet would evaluate as a formula is preceded by an apostrophe.
    """
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(map(_as_cell, cells))
    return line.getvalue()


def _as_cell(value: object) -> object:
    """Return a cell that a spreadsheet does not evaluate: the text may come from a vehicle."""
    if not isinstance(value, str) or not value.startswith(_FORMULA_STARTS):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value  # a formatted number, such as -0.52


def write(line: str) -> None:
    """Write one or more lines to stdout and flush it.

    Raises BrokenPipeError if the reader has gone, NedbusError for other failures.
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
        raise NedbusError(f"cannot write to stdout: {system_reason(exc)}") from exc


def write_stderr(text: str) -> None:
    """Write a notice to stderr, or log it if the log is structured; a closed stderr is ignored."""
    if is_log_structured():
        for line in text.splitlines():
            _log.info("%s", line, extra=about("notice"))
        return
    with suppress(OSError):
        sys.stderr.write(f"{printable(text)}\n")
        sys.stderr.flush()


def is_log_structured() -> bool:
    """Return True if the log is JSON or goes to the journal; then stderr must contain nothing else."""
    return any(handler.name == STRUCTURED for handler in logging.getLogger().handlers)


def discard_stdout() -> None:
    """Redirect stdout to /dev/null: otherwise the flush at exit would fail again."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
