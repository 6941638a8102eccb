"""Tables of text that fit the width of a terminal."""

from __future__ import annotations

import os
import shutil
import sys
import textwrap
from collections.abc import Collection, Sequence
from typing import Final

_GAP: Final = 2  # characters between two columns
_LEAST: Final = 10  # characters that a column of text keeps at least


def terminal_width() -> int | None:
    """Return the width of the terminal that stdout is, None if it is none."""
    is_terminal = sys.stdout is not None and sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
    return shutil.get_terminal_size().columns if is_terminal else None


def to_table(
    head: Sequence[str], rows: Sequence[Sequence[str]], *, width: int | None = None, optional: Sequence[str] = ()
) -> str:
    """Return rows in columns: the first and the last one are text, aligned to the left, the others numbers.

    In a `width` that is too small the text is folded, and columns are left out, in the order of `optional`.
    """
    widths = [max(map(len, cells)) for cells in zip(head, *rows, strict=True)]
    kept = _fit(head, widths, width, optional)
    text = {kept[0], kept[-1]}
    lines = []
    for row in [head, *rows]:
        cells = [textwrap.wrap(row[column], widths[column]) or [""] for column in kept]
        for index in range(max(map(len, cells))):
            parts = [
                part.ljust(widths[column]) if column in text else part.rjust(widths[column])
                for column, cell in zip(kept, cells, strict=True)
                for part in [cell[index] if index < len(cell) else ""]
            ]
            lines.append((" " * _GAP).join(parts).rstrip())
    return "\n".join(lines)


def _fit(head: Sequence[str], widths: list[int], width: int | None, optional: Collection[str]) -> list[int]:
    """Return the columns that are shown, and make those of text narrower, so that a line fits."""
    kept = list(range(len(head)))
    if width is None:
        return kept
    text = (0, len(head) - 1)
    least = [min(each, _LEAST) if column in text else each for column, each in enumerate(widths)]
    for name in optional:
        if _sum(least, kept) <= width:
            break
        kept.remove(head.index(name))
    spare = max(0, width - _sum(least, kept))
    for column, share in ((text[0], spare // 2), (text[1], spare), (text[0], spare)):
        left = max(0, width - _sum(least, kept))
        least[column] = min(widths[column], least[column] + min(share, left))
    for column in text:
        widths[column] = least[column]
    return kept


def _sum(widths: Sequence[int], columns: Sequence[int]) -> int:
    return sum(widths[column] for column in columns) + _GAP * (len(columns) - 1)
