"""Streams that `nedbus hz` shows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import pytest

from nedbus import Bus
from nedbus.cli.commands import hz
from nedbus.cli.commands.hz import _Stream, _streams
from nedbus.client import StreamState
from nedbus.health import Monitor, StreamHealth
from nedbus_msgs import Address
from tests.flights.messages import VLP
from tests.peers.command_line import run_command


@pytest.mark.parametrize(("age", "is_shown"), [(59.0, True), (61.0, False)])
def test_gone_stream_is_hidden_after_a_minute(age: float, is_shown: bool) -> None:
    """A stream without a publisher is shown as gone for a minute, and then forgotten."""
    address, forgotten = Address("1", VLP), list[Address]()
    health = replace(StreamHealth(VLP).snapshot(0), age=age)
    monitor = SimpleNamespace(snapshot=lambda: {address: health}, forget=forgotten.append)
    bus = SimpleNamespace(publishers=lambda **_: Counter[Address](), connected=True)
    shown = [stream.state.name for stream in _streams(cast("Bus", bus), cast("Monitor", monitor))]
    assert (shown, forgotten) == ((["gone"], []) if is_shown else ([], [address]))


def test_stream_that_was_hidden_is_written_when_it_returns(
    monkeypatch: pytest.MonkeyPatch, endpoint: str
) -> None:
    """What was written of a stream is forgotten with the stream, so --json shows a stream that returns."""
    address, health = Address("1", VLP), StreamHealth(VLP).snapshot(0)
    stream = _Stream(address, health, StreamState("ok"))
    rows = iter([[stream], [stream], []] * 2)

    def show_each(*_: object, each_second: Callable[[], None], **__: object) -> None:
        for _second in range(6):
            each_second()

    monkeypatch.setattr(hz, "_streams", lambda *_: next(rows))
    monkeypatch.setattr(hz, "follow", show_each)
    assert run_command("hz", "-c", endpoint, "--json").out.count(VLP) == 2


def test_worst_streams_come_first() -> None:
    """Streams are ordered by state; in one state those with a fault, such as a gap, come before the sound ones."""
    address, health = Address("1", VLP), StreamHealth(VLP).snapshot(0)
    sound = _Stream(address, health, StreamState("ok"))
    faulty = _Stream(address, replace(health, gaps=1), StreamState("ok"))
    stale = _Stream(address, health, StreamState("stale", "no message"))
    assert sorted([sound, faulty, stale], key=_Stream.rank) == [stale, faulty, sound]
