"""Reassembly that counts messages over all streams."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from nedbus.sources.mavlink.log_reassembly import Chunk, Reassembly, Verdict


class CountingReassembly(Reassembly):
    """Count messages per verdict, and also lost messages, delivered bytes and bytes skipped after a gap."""

    def __init__(self) -> None:
        super().__init__()
        self.counts = Counter[Verdict]()
        self.lost = self.bytes = self.skipped = 0

    def add(self, sequence: int, length: int, first_message_offset: int, data: Sequence[int]) -> Chunk:
        """Add the next message and count the result."""
        chunk = super().add(sequence, length, first_message_offset, data)
        self.counts[chunk.verdict] += 1
        self.lost += chunk.lost
        self.bytes += len(chunk.data)
        if chunk.verdict in ("delivered", "unsynchronised"):
            self.skipped += length - len(chunk.data)
        return chunk
