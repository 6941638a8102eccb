"""Columns of a flight: records that are decoded with NumPy."""

from __future__ import annotations

import numpy as np

from nedbus_msgs import MESSAGES
from nedbus_msgs.arrays import arrays_of


def test_integers_of_every_layout_fit_into_the_array() -> None:
    """Columns are copied without a check of their range, because no layout has a wider integer than the newest one."""
    for definition in MESSAGES.values():
        array = arrays_of(definition).absent(0)
        for layout in definition.layouts.values():
            for name, old in definition.plan(tuple(layout.types)).names.items():
                target = array.dtype[name].base
                if target.kind in "iu":
                    logged = np.dtype(layout.types[old].base)
                    assert np.can_cast(logged, target), (definition.name, layout.name, name)
