"""Flights as arrays and data frames: read, align, plot.

Each name imports its module on first use: plots need an extra, and NumPy is slow to import.
"""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

if TYPE_CHECKING:
    from .alignment import align
    from .arrays import addresses_of, array_of, array_warnings, missing_of, open_arrays
    from .plot import STREAM_COLORS, draw, draw_fields
    from .reading import read, read_plotted
else:
    # No submodule may share the name of an export: importing it would replace the export.
    _NAMES = {
        ("", "alignment"): "align",
        ("", "arrays"): "addresses_of array_of array_warnings missing_of open_arrays",
        ("", "reading"): "read read_plotted",
        ("plot", "plot"): "STREAM_COLORS draw draw_fields",
    }
    __getattr__ = lazy_exports(
        __name__, {name: place for place, names in _NAMES.items() for name in names.split()}
    )

__all__ = [
    "STREAM_COLORS", "addresses_of", "align", "array_of", "array_warnings", "draw", "draw_fields", "missing_of", "read",
    "read_plotted",
]  # fmt: skip
