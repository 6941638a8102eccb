"""A table that is redrawn in place on a terminal, and written anew elsewhere; its size is bounded either way."""

from __future__ import annotations

import shutil
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, Self

from .logs import log_to
from .options import write
from .table import terminal_width, to_table

if TYPE_CHECKING:
    from rich.live import Live

_MAX_ROWS: Final = 50
_MIN_ROWS: Final = 3


class LiveTable:
    """Show a table again and again; `optional` are the columns that a narrow terminal leaves out, in that order."""

    def __init__(self, head: Sequence[str], optional: Sequence[str]) -> None:
        self._head = head
        self._optional = optional
        self._live: Live | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, rows: Sequence[Sequence[str]]) -> None:
        """Show these rows, the first 50 at most, and on a terminal no more than it has lines."""
        width = terminal_width()
        if width is None:
            write(self._table(rows, _MAX_ROWS, None))
            return
        from rich.text import Text

        live = self._live or self._start()
        height = shutil.get_terminal_size().lines - 1
        count = min(_MAX_ROWS, len(rows), height)
        while (text := self._table(rows, count, width)).count("\n") >= height and count > _MIN_ROWS:
            count -= 1
        live.update(Text(text, no_wrap=True, overflow="crop"), refresh=True)

    def _table(self, rows: Sequence[Sequence[str]], count: int, width: int | None) -> str:
        text = to_table(self._head, rows[:count], width=width, optional=self._optional)
        return text if len(rows) <= count else f"{text}\n{len(rows) - count} more"

    def _start(self) -> Live:
        from rich.console import Console
        from rich.live import Live

        console = Console()
        log_to(console)
        # The cursor is hidden from the start to the stop, which a signal must not leave out.
        signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
        with _holding_signals():  # a Live that is half started can be neither used nor stopped
            self._live = Live(console=console, auto_refresh=False)
            self._live.start()
        return self._live


@contextmanager
def _holding_signals() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM have their effect at the end of the block."""
    held: list[int] = []
    handlers = {
        number: signal.signal(number, lambda number, _: held.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    for each in held:
        signal.raise_signal(each)
