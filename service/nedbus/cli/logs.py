"""How lines of the log look: date, time, level and text, of which nothing acts on a terminal."""

from __future__ import annotations

import logging
import sys
from typing import TYPE_CHECKING, Final

from .format import MAX_TEXT, printable, to_text

if TYPE_CHECKING:
    from rich.console import Console

_DATE: Final = "%Y-%m-%d %H:%M:%S"


class _PrintableFormatter(logging.Formatter):
    """Format a record as one line of printable characters; with a traceback as several."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the name is that of logging
        record.message = to_text(record.message, MAX_TEXT)
        return super().formatMessage(record)

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


def log_to_stderr(*, debug: bool) -> None:
    """Log to stderr, a line for each record."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_PrintableFormatter("%(asctime)s %(levelname)-7s %(message)s", _DATE))
    logging.basicConfig(handlers=[handler])
    logging.getLogger("nedbus").setLevel(logging.DEBUG if debug else logging.INFO)


def log_to(console: Console) -> None:
    """Log to the terminal on which something is redrawn in place, above it."""
    from rich.logging import RichHandler

    handler = RichHandler(console=console, show_path=False, log_time_format=_DATE)
    handler.setFormatter(_PrintableFormatter("%(message)s"))
    logging.basicConfig(handlers=[handler], force=True)
