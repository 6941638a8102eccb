"""What a viewer is sent: only what is different."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from bokeh.models import ColumnDataSource


def replace(source: ColumnDataSource, rows: Sequence[Sequence[Any]]) -> None:
    """Send the cells that are different, or all when there are more or fewer rows; values in the order of columns."""
    names = source.column_names
    columns = [list(column) for column in zip(*rows, strict=True)] or [[] for _ in names]
    old = source.data
    if len(old[names[0]]) != len(rows):
        source.data = dict(zip(names, columns, strict=True))
        return
    patches = {
        name: [
            (index, new)
            for index, (was, new) in enumerate(zip(old[name], values, strict=True))
            if was != new and repr(was) != repr(new)  # NaN is different from itself
        ]
        for name, values in zip(names, columns, strict=True)
    }
    patches = {name: patch for name, patch in patches.items() if patch}
    if patches:
        source.patch(patches)
