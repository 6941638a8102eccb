"""Streams that `nedbus hz` shows."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import pytest

from nedbus import Bus
from nedbus.cli.commands.hz import _states
from nedbus.health import Monitor, StreamHealth
from nedbus_msgs import Address
from tests.flights.messages import VLP


@pytest.mark.parametrize(("age", "is_shown"), [(59.0, True), (61.0, False)])
def test_gone_stream_is_hidden_after_a_minute(age: float, is_shown: bool) -> None:
    """A stream without a publisher is shown as gone for a minute, and then forgotten."""
    address, forgotten = Address("1", VLP), list[Address]()
    health = replace(StreamHealth(VLP).snapshot(0), age=age)
    monitor = SimpleNamespace(snapshot=lambda: {address: health}, forget=forgotten.append)
    bus = SimpleNamespace(publishers=lambda **_: Counter[Address](), connected=True)
    shown = [state.name for _, _, state in _states(cast("Bus", bus), cast("Monitor", monitor))]
    assert (shown, forgotten) == ((["gone"], []) if is_shown else ([], [address]))
