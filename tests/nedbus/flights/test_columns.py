"""Columns of a flight: records that are decoded with NumPy."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

import nedbus
from nedbus_msgs import MESSAGES
from nedbus_msgs.arrays import arrays_of
from tests.flights.messages import VLP, message
from tests.flights.ulogs import UlogWriter


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


def test_messages_of_two_subscriptions_are_in_the_order_of_the_file(tmp_path: Path) -> None:
    """A log may subscribe to a topic again, and write the messages of both in turn."""
    writer = UlogWriter()
    writer.define([VLP])
    writer.add(VLP, message(1_000_000))
    writer.put("A", struct.pack("<BH", 0, 1) + VLP.encode())
    for stamp, number in ((2_000_000, 1), (3_000_000, 1), (4_000_000, 0), (5_000_000, 1)):
        writer._ids[VLP, 0] = number
        writer.add(VLP, message(stamp))
    read = nedbus.read(writer.write(tmp_path / "a.ulg"))
    assert (read["timestamp"] // 1_000_000).tolist() == [1, 2, 3, 4, 5]
