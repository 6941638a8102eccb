"""The schedule of heartbeats after the last message, with a fake clock."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import cast

import pytest
import zenoh

from nedbus.client.publishing import writer
from nedbus.client.publishing.writer import HEARTBEAT, Heartbeats, Writer
from nedbus.transport import Session
from tests.waits import DEADLINE


@dataclass(eq=False)
class FakeWriter:
    """A fake writer with the attributes that Heartbeats uses."""

    published: int = 0
    key: str = "key"
    name: str = "ab:7"
    priority: zenoh.Priority | None = None
    last_put: float = 0.0
    is_silent: bool = True
    silent_since: float = 0.0
    sent_heartbeats: int = 0
    heartbeat_due: float = math.inf


class Stream:
    """A fake session with one writer and a fake clock; `sent` has the time and payload of each heartbeat."""

    def __init__(self) -> None:
        self.now, self.calls, self.due = 100.0, 0, math.inf
        self.sent: list[tuple[float, bytes]] = []
        self.writer = FakeWriter()
        self.heartbeats = Heartbeats(cast("Session", self))
        self.heartbeats.writers.add(cast("Writer", self.writer))

        self.on_sent: Callable[[], object] = lambda: None

    def put(
        self,
        key: str,
        payload: bytes,
        *,
        congestion_control: zenoh.CongestionControl,
        priority: object,
    ) -> None:
        """Record a heartbeat; called like `Session.put`."""
        assert (key, congestion_control) == ("key/@adv/pub/ab/7/_", zenoh.CongestionControl.DROP)
        self.sent.append((self.now, payload))
        self.on_sent()

    def make_job(self, _: Callable[[float], float]) -> SimpleNamespace:
        return SimpleNamespace(wake=lambda at: setattr(self, "due", min(self.due, at)))

    def publish(self, published: int | None = None) -> None:
        self.writer.published = self.writer.published + 1 if published is None else published
        self.writer.last_put = self.now
        if self.writer.is_silent:
            self.heartbeats.resume(cast("Writer", self.writer))

    def wait(self, seconds: float) -> list[float]:
        """Advance the clock by `seconds`; return when heartbeats were sent meanwhile, as seconds since the call."""
        begin, before = self.now, len(self.sent)
        while self.due <= begin + seconds:
            self.now = max(self.now, self.due)
            self.due = math.inf
            self.due = min(self.due, self.now + max(0.002, self.heartbeats.send_due(self.now)))
            self.calls += 1
        self.now = begin + seconds
        return [time - begin for time, _ in self.sent[before:]]


@pytest.fixture
def stream(monkeypatch: pytest.MonkeyPatch) -> Stream:
    """Return a stream without messages."""
    stream = Stream()
    monkeypatch.setattr(writer, "Job", stream.make_job)
    return stream


@pytest.mark.parametrize("rate", [5, 7, 50, 400])
def test_busy_stream_sends_no_heartbeats(stream: Stream, rate: int) -> None:
    """A stream of 5 Hz or more sends no heartbeats, because its next message reveals losses.

    A stream without messages sends none either.
    """
    assert stream.wait(10.0) == []
    for _ in range(20 * rate):
        stream.publish()
        assert stream.wait(1 / rate) == []
    assert stream.calls < 20 / 0.15, "the job is called too often"


def test_heartbeats_of_a_silent_stream_back_off(stream: Stream) -> None:
    """Heartbeats follow a message after 0.4 s, then at intervals of 0.5, 1 and 2 s, then every 4 s.

    The job is called only once per heartbeat. A message restarts the schedule.
    """
    for _ in range(2):
        stream.publish()
        first, *others = stream.wait(60.0)
        assert first == pytest.approx(0.4)
        steps = [later - earlier for earlier, later in zip([first, *others], others, strict=False)]
        assert steps == pytest.approx([0.5, 1.0, 2.0] + [4.0] * (len(steps) - 3))
        assert len(steps) == pytest.approx(3 + 55 / 4, abs=1)
    before = stream.calls
    assert len(stream.wait(3600.0)) == 900
    assert stream.calls - before == 900
    for _ in range(50):
        stream.publish()
        stream.wait(0.1)
    assert stream.wait(HEARTBEAT), "no heartbeat in time after a busy period"


def test_message_during_a_heartbeat_restarts_the_schedule(stream: Stream) -> None:
    """A message published while a heartbeat is being sent is followed by its own first heartbeat in time."""
    stream.publish()

    def publish_during_heartbeat() -> None:
        stream.on_sent = lambda: None
        stream.publish()

    stream.on_sent = publish_during_heartbeat
    first, second, *_ = stream.wait(5.0)
    assert first == pytest.approx(0.4)
    assert second - first <= HEARTBEAT
    assert [payload[0] for _, payload in stream.sent[:2]] == [0, 1]
    stream.publish()
    assert stream.wait(HEARTBEAT)


def test_heartbeat_carries_the_last_sequence_number(stream: Stream) -> None:
    """A heartbeat carries the sequence number of the last message; numbers start at 0 and wrap at 2^32."""
    for published, payload in (
        (1, b"\0\0\0\0"),
        (0x0A0B0C0E, b"\x0d\x0c\x0b\x0a"),
        (2**32, b"\xff" * 4),
    ):
        stream.publish(published)
        stream.wait(1.0)
        assert stream.sent[-1][1] == payload
    stream.publish()
    stream.wait(1.0)
    assert stream.sent[-1][1] == b"\0\0\0\0"
    stream.heartbeats.writers.remove(cast("Writer", stream.writer))
    assert stream.wait(10.0) == []


def test_many_heartbeats_are_sent_in_batches(stream: Stream) -> None:
    """Heartbeats of many publishers that fall silent at once do not delay other jobs of the process."""
    writers = [FakeWriter(published=1, last_put=0.1) for _ in range(1000)]
    for each in writers:
        stream.heartbeats.writers.add(cast("Writer", each))
        stream.heartbeats.resume(cast("Writer", each))
    assert stream.heartbeats.send_due(0.4) > 0.0
    assert stream.heartbeats.send_due(0.5) <= 0.0
    assert 0 < len(stream.sent) < 500
    while stream.heartbeats.send_due(0.5) <= 0.0:
        pass
    assert len(stream.sent) == 1000


def test_first_messages_on_two_threads_create_one_job(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two threads that put the first messages of a bus at the same time share a job, which `close` ends."""
    created, ended = list[str](), list[str]()
    is_creating, is_second_ready = threading.Event(), threading.Event()

    def make_job(_: Callable[[float], float]) -> SimpleNamespace:
        created.append("job")
        is_creating.set()
        assert is_second_ready.wait(DEADLINE)
        return SimpleNamespace(wake=lambda _: None, end=lambda: ended.append("job"))

    monkeypatch.setattr(writer, "Job", make_job)
    heartbeats = Heartbeats(cast("Session", None))
    first, second = (
        threading.Thread(target=heartbeats.resume, args=(FakeWriter(),)) for _ in range(2)
    )
    first.start()
    assert is_creating.wait(DEADLINE)
    second.start()
    is_second_ready.set()
    first.join()
    second.join()
    heartbeats.close()
    # a message that another thread puts after `close`
    heartbeats.resume(cast("Writer", FakeWriter()))
    assert (created, ended) == (["job"], ["job"])
