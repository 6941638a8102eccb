"""Tables, printed once or redrawn in place; fitted to the width of a terminal, else complete."""

import io
import os
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Final, Literal

from nedbus import limits

from .streams import write

COLUMN_GAP: Final = "  "
# optional columns are removed to make the last one this wide
_LAST_WIDTH: Final = len("disconnected: no link")
_MIN_LAST_WIDTH: Final = 16  # the first column is folded to make the last one this wide
_UNLIMITED: Final = 10_000  # width if stdout is not a terminal

Rows = Sequence[Sequence[str]]


def terminal_width() -> int | None:
    """Return the width of the terminal; None if stdout is not a terminal."""
    if sys.stdout is None or not sys.stdout.isatty() or os.environ.get("TERM") == "dumb":
        return None
    return shutil.get_terminal_size().columns


def fold(head: str, text: str) -> str:
    """Return `head` and `text`; on a terminal, `text` is wrapped and indented by the length of `head`."""
    width = terminal_width()
    if width is None:
        return head + text
    return textwrap.fill(
        text, width, initial_indent=head, subsequent_indent=" " * len(head), break_on_hyphens=False
    )


def fit_columns(widths: Mapping[str, int], optional: Sequence[str], width: int) -> list[str]:
    """Return the columns that fit into `width`; those of `optional` are removed in this order until they do."""
    kept = list(widths)
    for name in optional:
        if _width_of(kept, widths) <= width:
            break
        if name in kept:
            kept.remove(name)
    return kept


def _width_of(columns: Sequence[str], widths: Mapping[str, int]) -> int:
    text = sum(widths[name] for name in columns)
    gaps = len(COLUMN_GAP) * (len(columns) - 1)
    return text + gaps


def to_table(
    head: Sequence[str], rows: Rows, *, optional: Sequence[str] = (), max_rows: int | None = None
) -> str:
    """Format rows as a table: the first and the last column are text, aligned left, the others numbers.

    On a narrow terminal columns of `optional` are removed in this order; after that, text is folded.
    The last line shows the number of rows beyond `max_rows`.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    shown = rows[:max_rows]
    width = terminal_width() or _UNLIMITED
    first = head[0]
    last = head[-1]
    widths: dict[str, int] = {}
    for index, name in enumerate(head):
        cells = [row[index] for row in shown]
        widths[name] = max(map(len, [name, *cells]))
    widths[last] = min(widths[last], _LAST_WIDTH)
    kept = fit_columns(widths, optional, width)
    widths[last] = min(widths[last], _MIN_LAST_WIDTH)
    folded = {last}
    if _width_of(kept, widths) > width:
        folded.add(first)
    table = Table(box=None, pad_edge=False, padding=(0, len(COLUMN_GAP), 0, 0), header_style="")
    for name in kept:
        justify: Literal["left", "right"] = "right"
        if name in (first, last):
            justify = "left"
        table.add_column(name, justify=justify, no_wrap=name not in folded, overflow="fold")
    for row in shown:
        by_name = dict(zip(head, row, strict=True))
        table.add_row(*(Text(by_name[name]) for name in kept))
    drawn = io.StringIO()
    Console(file=drawn, width=width, color_system=None).print(table)
    lines = [line.rstrip() for line in drawn.getvalue().splitlines()]
    hidden = len(rows) - len(shown)
    if hidden:
        lines.append(f"{hidden} more")
    return "\n".join(lines)


@contextmanager
def live_table(head: Sequence[str], optional: Sequence[str]) -> Iterator[Callable[[Rows], None]]:
    """Yield a function that prints rows; on a terminal, each call redraws the table in place, below the log lines."""
    if terminal_width() is None:

        def print_table(rows: Rows) -> None:
            write(to_table(head, rows, optional=optional, max_rows=limits.LIVE_ROWS))

        yield print_table
        return
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    def show(rows: Rows) -> None:
        # minus header and the line "N more"
        most = max(1, min(limits.LIVE_ROWS, shutil.get_terminal_size().lines - 3))
        text = to_table(head, rows, optional=optional, max_rows=most)
        live.update(Text(text, no_wrap=True, overflow="crop"), refresh=True)

    console = Console()
    live = Live(
        console=console,
        auto_refresh=False,
        vertical_overflow="crop",
        redirect_stderr=sys.stderr.isatty(),
    )
    try:
        with live:
            yield show
    finally:
        console.show_cursor()  # a signal may have arrived while the cursor was being hidden


@contextmanager
def show_progress() -> Iterator[Callable[[str, int | None, int | None], None]]:
    """Yield a function that shows a label, the number done and the total; it does nothing without a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    progress = Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=24),
        console=Console(stderr=True),
        transient=True,
        disable=not sys.stderr.isatty(),
    )
    with progress:
        task = progress.add_task("", total=None)

        def show(text: str, done: int | None, total: int | None) -> None:
            progress.update(task, description=text, completed=done or 0, total=total)

        yield show
