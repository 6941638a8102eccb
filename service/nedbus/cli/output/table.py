"""Tables that fit the width of a terminal, once or redrawn in place; elsewhere they are written as they are."""

from __future__ import annotations

import os
import re
import shutil
import signal
import sys
import textwrap
from collections.abc import Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Final, Self

from .logs import log_to
from .streams import write

if TYPE_CHECKING:
    from rich.live import Live

COLUMN_GAP: Final = "  "
_READABLE: Final = 16  # characters of the last column, for which others are left out
_MAX_ROWS: Final = 50


def terminal_width() -> int | None:
    """Return the width of the terminal that stdout is, None if it is none."""
    is_terminal = sys.stdout is not None and sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
    return shutil.get_terminal_size().columns if is_terminal else None


class _Wrapper(textwrap.TextWrapper):
    """Break lines at spaces, and behind slashes and underscores."""

    wordsep_simple_re = re.compile(r"(\s+|(?<=[/_]))")


def to_table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    width: int | None = None,
    optional: Sequence[str] = (),
    max_rows: int | None = None,
) -> str:
    """Return rows in columns: the first and the last one are text, aligned to the left, the others numbers.

    In a `width` that is too small columns are left out, in the order of `optional`, and then text is wrapped.
    A last line has the number of rows beyond `max_rows`.
    """
    more = 0 if max_rows is None else len(rows) - max_rows
    rows = rows[:max_rows]
    widths = [max(map(len, cells)) for cells in zip(head, *rows, strict=True)]
    kept = list(range(len(head)))
    last = kept[-1]
    if width is not None:
        for omitted in range(len(optional) + 1):
            kept = [column for column, name in enumerate(head) if name not in optional[:omitted]]
            spare = width - sum(widths[column] for column in kept[1:-1]) - len(COLUMN_GAP) * (len(kept) - 1)
            if spare >= widths[0] + min(widths[last], _READABLE):
                break
        widths[last] = min(widths[last], max(spare - widths[0], min(_READABLE, spare // 2)))
        widths[0] = min(widths[0], spare - widths[last])
    lines = []
    for row in (head, *rows):
        cells = [_wrap(row[column], widths[column]) for column in kept]
        for parts in zip_longest(*cells, fillvalue=""):
            padded = (
                part.ljust(widths[column]) if column in {0, last} else part.rjust(widths[column])
                for column, part in zip(kept, parts, strict=True)
            )
            lines.append(COLUMN_GAP.join(padded).rstrip())
    return "\n".join([*lines, f"{more} more"] if more > 0 else lines)


def _wrap(text: str, width: int) -> list[str]:
    return _Wrapper(max(1, width), break_on_hyphens=False).wrap(text) if len(text) > width else [text]


class LiveTable:
    """Show a table again and again; `optional` are the columns that a narrow terminal leaves out, in that order."""

    def __init__(self, head: Sequence[str], optional: Sequence[str]) -> None:
        self._head = head
        self._optional = optional
        self._live: Live | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        if self._live is None:
            return
        try:
            self._live.stop()
        except IndexError:  # a signal came while it started
            self._live.console.show_cursor()

    def show(self, rows: Sequence[Sequence[str]]) -> None:
        """Show these rows, the first 50 at most, and on a terminal no more than it has lines."""
        width = terminal_width()
        height = shutil.get_terminal_size().lines - 1
        for count in range(_MAX_ROWS if width is None else max(1, min(_MAX_ROWS, len(rows), height)), 0, -1):
            text = to_table(self._head, rows, width=width, optional=self._optional, max_rows=count)
            if width is None or text.count("\n") < height:  # else with fewer: rows that are wrapped have several lines
                break
        if width is None:
            write(text)
            return
        from rich.text import Text

        self._start().update(Text(text, no_wrap=True, overflow="crop"), refresh=True)

    def _start(self) -> Live:
        if self._live is None:
            from rich.console import Console
            from rich.live import Live

            # The cursor is hidden from the start to the stop, which a signal must not leave out.
            signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
            self._live = Live(console=Console(), auto_refresh=False, vertical_overflow="crop")
            log_to(self._live.console)
            self._live.start()
        return self._live
