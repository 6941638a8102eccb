"""The schedule of heartbeats, from the counts of the writers, with a fake clock."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import cast

import pytest
import zenoh

from nedbus.client.publishing.writer import HEARTBEAT, Heartbeats, Writer
from nedbus.transport import Session


@dataclass(eq=False)
class FakeWriter:
    """The attributes of a writer that heartbeats use."""

    published: int = 0
    key: str = "key"
    name: str = "ab:7"
    priority: zenoh.Priority | None = None


@dataclass(eq=False)
class Stream:
    """A session with one writer and a clock; `sent` has the time and payload of each heartbeat."""

    now: float = 100.0
    looks: int = 0
    sent: list[tuple[float, bytes]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.writer = cast("Writer", FakeWriter())
        self.heartbeats = Heartbeats(cast("Session", self))
        self.heartbeats.add(self.writer)
        self.next_look = self.now

    def declare_publisher(
        self, key: str, *, congestion_control: zenoh.CongestionControl, priority: object
    ) -> SimpleNamespace:
        assert (key, congestion_control) == ("key/@adv/pub/ab/7/_", zenoh.CongestionControl.DROP)
        return SimpleNamespace(put=lambda payload: self.sent.append((self.now, payload)))

    def wait(self, seconds: float) -> list[float]:
        """Advance the clock; return the times of heartbeats since then."""
        begin, before = self.now, len(self.sent)
        while self.next_look <= begin + seconds:
            self.now = max(self.now, self.next_look)
            self.next_look = self.now + max(0.002, self.heartbeats.send_due(self.now))
            self.looks += 1
        self.now = begin + seconds
        return [time - begin for time, _ in self.sent[before:]]


@pytest.mark.parametrize("rate", [5, 7, 50, 400])
def test_stream_that_goes_on_sends_none(rate: int) -> None:
    """A stream of 5 Hz or more needs no heartbeats, as its next message reveals losses; nor does an unused stream."""
    stream = Stream()
    assert stream.wait(10.0) == []
    for _ in range(20 * rate):
        stream.writer.published += 1
        assert stream.wait(1 / rate) == []


def test_silent_stream_sends_ever_more_rarely() -> None:
    """Heartbeats follow after 0.4 s, then after 0.5, 1 and 2 s, then each 4 s: 900 per hour, with few polls."""
    stream = Stream()
    for _ in range(2):  # a message restarts the schedule
        stream.writer.published += 1
        first, *others = stream.wait(60.0)
        assert 0.4 <= first <= 0.4 + 0.5  # the look that finds the message comes within 0.5 s
        steps = [later - earlier for earlier, later in zip([first, *others], others, strict=False)]
        assert steps == pytest.approx([0.5, 1.0, 2.0] + [4.0] * (len(steps) - 3), abs=0.02)
        assert len(steps) == pytest.approx(3 + 55 / 4, abs=1)
    before = stream.looks
    assert len(stream.wait(3600.0)) == 900
    assert stream.looks - before < 3 * 3600
    for _ in range(50):
        stream.writer.published += 1
        stream.wait(0.1)
    assert stream.wait(HEARTBEAT), "a stream that went on until now is known to be silent sooner"


def test_heartbeat_has_the_number_of_the_last_message() -> None:
    """Zenoh's numbers start at 0, and wrap after 2^32."""
    stream = Stream()
    for published, payload in ((1, b"\0\0\0\0"), (0x0A0B0C0E, b"\x0d\x0c\x0b\x0a"), (2**32, b"\xff" * 4)):
        stream.writer.published = published
        stream.wait(1.0)
        assert stream.sent[-1][1] == payload
    stream.writer.published += 1
    stream.wait(1.0)
    assert stream.sent[-1][1] == b"\0\0\0\0"
    stream.heartbeats.remove(stream.writer)
    assert stream.wait(10.0) == []


def test_many_heartbeats_are_sent_in_turns() -> None:
    """Publishers that fall silent at the same time do not delay the other jobs of a session."""
    stream = Stream()
    writers = [FakeWriter(published=1) for _ in range(1000)]
    for writer in writers:
        stream.heartbeats.add(cast("Writer", writer))
    stream.heartbeats.send_due(0.0)
    assert stream.heartbeats.send_due(0.5) <= 0.0
    assert 0 < len(stream.sent) < 500
    while stream.heartbeats.send_due(0.5) <= 0.0:
        pass
    assert len(stream.sent) == 1000
