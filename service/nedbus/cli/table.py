"""Tables of text that fit the width of a terminal."""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Collection, Iterator, Sequence
from typing import Final

_CHUNK: Final = re.compile(r"[^/]+/*|/+")
_WORD: Final = re.compile(r"[^/_?&=,:.-]+[/_?&=,:.-]*|[/_?&=,:.-]+")
_BREAKS: Final = (re.compile(r"\s*\S+\s*"), _CHUNK, _WORD)
_GAP: Final = 2  # characters between two columns
_LEAST: Final = 10  # characters that a column of text keeps at least
_READABLE: Final = 16  # characters of the last column, for which others are left out


def terminal_width() -> int | None:
    """Return the width of the terminal that stdout is, None if it is none."""
    is_terminal = sys.stdout is not None and sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
    return shutil.get_terminal_size().columns if is_terminal else None


def to_table(
    head: Sequence[str], rows: Sequence[Sequence[str]], *, width: int | None = None, optional: Sequence[str] = ()
) -> str:
    """Return rows in columns: the first and the last one are text, aligned to the left, the others numbers.

    In a `width` that is too small columns are left out, in the order of `optional`, and then text is folded: at
    spaces, else at slashes, else at underscores and the like, and within a word only where it alone is too long.
    """
    widths = [max(map(len, cells)) for cells in zip(head, *rows, strict=True)]
    kept = _fit(head, rows, widths, width, optional)
    text = {kept[0], kept[-1]}
    lines = []
    for row in [head, *rows]:
        cells = [_fold(row[column], widths[column]) for column in kept]
        for index in range(max(map(len, cells))):
            parts = [
                part.ljust(widths[column]) if column in text else part.rjust(widths[column])
                for column, cell in zip(kept, cells, strict=True)
                for part in [cell[index] if index < len(cell) else ""]
            ]
            lines.append((" " * _GAP).join(parts).rstrip())
    return "\n".join(lines)


def _fit(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    widths: list[int],
    width: int | None,
    optional: Collection[str],
) -> list[int]:
    """Return the columns that are shown, and make those of text narrower, so that a line fits."""
    kept = list(range(len(head)))
    if width is None:
        return kept
    last = len(head) - 1
    needed = [column for column in kept if head[column] not in optional]
    names = [row[0] for row in (head, *rows)]
    least = [*widths]
    for first, text in (
        (widths[0], _READABLE),
        (_longest(_CHUNK, names), _READABLE),
        (_longest(_WORD, names), _LEAST),
        (_LEAST, _LEAST),
    ):
        least[0], least[last] = min(widths[0], first), min(widths[last], text)
        if _sum(least, needed) <= width:
            break
    for name in optional:
        if _sum(least, kept) <= width:
            break
        kept.remove(head.index(name))
    for column, share in ((last, _READABLE), (0, widths[0]), (last, widths[last])):
        spare = max(0, width - _sum(least, kept))
        least[column] = min(widths[column], max(least[column], share), least[column] + spare)
    widths[:] = least
    return kept


def _fold(text: str, width: int) -> list[str]:
    """Return the lines of a cell."""
    lines = [""]
    for part in _parts(text, width, _BREAKS):
        if len(lines[-1]) + len(part.rstrip()) <= width:
            lines[-1] += part
        else:
            lines.append(part)
    return [line.rstrip() for line in lines]


def _parts(text: str, width: int, breaks: Sequence[re.Pattern[str]]) -> Iterator[str]:
    """Yield a text in parts that fit, cut at the first kind of break that is fine enough, else anywhere."""
    if not breaks:
        yield from (text[start : start + width] for start in range(0, len(text), width))
        return
    for part in breaks[0].findall(text):
        if len(part.rstrip()) <= width:
            yield part
        else:
            yield from _parts(part, width, breaks[1:])


def _longest(part: re.Pattern[str], names: Sequence[str]) -> int:
    return max((len(each) for name in names for each in part.findall(name)), default=0)


def _sum(widths: Sequence[int], columns: Sequence[int]) -> int:
    return sum(widths[column] for column in columns) + _GAP * (len(columns) - 1)
