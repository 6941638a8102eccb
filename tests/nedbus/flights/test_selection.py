"""Selection of the streams of a flight."""

from __future__ import annotations

import struct
from pathlib import Path

import nedbus
from tests.flights.ulogs import UlogWriter


def test_topic_that_only_the_file_defines_means_its_first_instance(tmp_path: Path) -> None:
    """Its first instance has no number, so the topic alone selects it; a number selects another one."""
    writer = UlogWriter()
    writer.put("F", b"own_topic:uint64_t timestamp;int32_t value;")
    for instance in (0, 1):
        writer.put("A", struct.pack("<BH", instance, instance) + b"own_topic")
        writer.put("D", struct.pack("<HQi", instance, 1_000_000, 10 + instance))
    path = writer.write(tmp_path / "a.ulg")
    assert nedbus.read(path, "own_topic")["value"].tolist() == [10]
    assert nedbus.read(path, "own_topic", instance=1)["value"].tolist() == [11]
