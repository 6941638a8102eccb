"""What a viewer is sent: only what is different."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bokeh.models import ColumnDataSource


def replace(source: ColumnDataSource, rows: Mapping[str, list[Any]]) -> bool:
    """Send the cells that are different, or all when there are more or fewer rows; return whether there were any."""
    old = source.data
    name = next(iter(rows))
    if len(old[name]) != len(rows[name]):
        source.data = dict(rows)
        return True
    patches = {
        name: [
            (index, new)
            for index, (was, new) in enumerate(zip(old[name], values, strict=True))
            if was != new and repr(was) != repr(new)  # NaN is different from itself
        ]
        for name, values in rows.items()
    }
    patches = {name: patch for name, patch in patches.items() if patch}
    if patches:
        source.patch(patches)
    return bool(patches)
