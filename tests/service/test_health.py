"""The health of a stream, from its messages alone."""

from __future__ import annotations

import pytest

from nedbus import Health, StreamHealth
from nedbus_msgs import DOUBT_FLAGS, VehicleLocalPosition

SECOND = 1_000_000_000


def follow(*times: float, boot: float = 0.0, every: float = 0.01, **flags: bool) -> StreamHealth:
    """Return a stream that came at these times [s], of PX4's times from `boot` on."""
    stream = StreamHealth("vehicle_local_position")
    for index, came in enumerate(times):
        stream.add(message(boot + index * every, **flags), received=round(came * SECOND))
    return stream


def message(seconds: float, **flags: bool) -> VehicleLocalPosition:
    zeros = dict.fromkeys(("x", "y", "z", "vx", "vy", "vz"), 0.0)
    return VehicleLocalPosition.model_validate({"timestamp": round(seconds * 1e6), **zeros, **flags})


def test_rate_and_jitter_are_of_the_last_second() -> None:
    """50 Hz with steps of 15 and 25 ms; what was before the last full second does not count."""
    times = [0.0]
    for index in range(200):
        times.append(times[-1] + (0.1 if index < 10 else 0.015 if index % 2 else 0.025))
    health = follow(*times).snapshot(round((times[-1] + 0.5) * SECOND))
    assert health.rate == pytest.approx(50.0, rel=0.02)
    assert health.jitter == pytest.approx(0.005, rel=0.02)
    assert health.nominal == 100.0
    assert health.age == pytest.approx(0.5)
    assert health.messages == 201


def test_silence_has_no_rate() -> None:
    """A stream that stopped has an age, and no rate."""
    health = follow(1.0, 1.01, 1.02).snapshot(10 * SECOND)
    assert health.rate is None
    assert health.age == pytest.approx(8.98)


def test_stream_without_messages_has_no_measures() -> None:
    """Before the first message there is nothing to measure."""
    health = StreamHealth("estimator_local_position").snapshot(SECOND)
    assert health == Health(None, 2.0, None, None, None, None, 0, 0, 0, 0, 0, None, None)


def test_gaps_are_of_px4s_own_time() -> None:
    """A step of more than three usual ones is a gap, whenever it arrives, and does not become the usual one."""
    stream = StreamHealth("vehicle_local_position")
    clock = [index * 0.1 for index in range(20)]
    clock += [clock[-1] + 1.0 + index * 0.1 for index in range(5)]
    clock += [clock[-1] + 0.2, clock[-1] + 2.0]
    for index, seconds in enumerate(clock):
        stream.add(message(seconds), received=index)
    assert stream.snapshot(0).gaps == 2


def test_disorder_and_reboot_are_told_apart() -> None:
    """Back by a little is disorder; back by more than a second is a vehicle that started again."""
    stream = StreamHealth("vehicle_local_position")
    for index, seconds in enumerate((10.0, 10.1, 10.05, 10.2, 0.5, 0.6)):
        stream.add(message(seconds), received=index)
    health = stream.snapshot(0)
    assert (health.out_of_order, health.reboots) == (1, 1)


def test_flags_are_shares() -> None:
    """The share of the last second, and of all time."""
    stream = StreamHealth("vehicle_local_position")
    for index in range(400):
        late = index >= 200
        stream.add(message(index / 100, xy_valid=late, dead_reckoning=not late), received=index * SECOND // 100)
    health = stream.snapshot(4 * SECOND)
    assert health.flags == {**dict.fromkeys(DOUBT_FLAGS, 0.0), "xy_valid": 1.0}
    assert health.flags_ever == {**dict.fromkeys(DOUBT_FLAGS, 0.0), "xy_valid": 0.5, "dead_reckoning": 0.5}


def test_latency_and_loss() -> None:
    """The median and the worst latency of the second, and all losses."""
    stream = StreamHealth("vehicle_local_position")
    for index, latency in enumerate((0.1, 0.2, 0.9)):
        stream.add(message(index), received=index, latency=latency, lost=index)
    health = stream.snapshot(0)
    assert (health.latency, health.latency_max, health.lost) == (0.2, 0.9, 3)
