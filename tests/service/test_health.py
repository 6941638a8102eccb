"""The health of a stream, from its messages alone."""

from __future__ import annotations

import dataclasses
import time

import pytest

from nedbus import Health, Monitor, Sample, StreamHealth
from nedbus.client import describe_stream, stream_state
from nedbus_msgs import DOUBT_FLAGS, Address, VehicleLocalPosition

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
    assert dataclasses.replace(health, resets={}) == Health(
        None, 2.0, None, None, None, None, 0, 0, 0, 0, 0, None, None
    )
    assert set(health.resets.values()) == {0}


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


def test_usual_rate_shows_a_stream_that_became_slow() -> None:
    """After a minute at 100 Hz, 5 Hz is far below the usual rate; a burst of what was recovered changes it little."""
    times = [index * 0.01 for index in range(6000)]
    times += [60.0 + index * 0.0001 for index in range(6000)]
    times += [62.0 + index * 0.01 for index in range(200)]
    times += [64.0 + index * 0.2 for index in range(50)]
    health = follow(*times).snapshot(round((times[-1] + 0.1) * SECOND))
    assert health.rate == pytest.approx(5.0, rel=0.05)
    assert health.usual_rate is not None
    assert 50 < health.usual_rate < 120


def test_slow_stream_is_stale_later() -> None:
    """3 s without a message are stale, but not of a stream that comes every 5 s."""
    assert follow(*(index * 0.01 for index in range(300))).snapshot(0).stale_after == 3.0
    assert follow(*(index * 5.0 for index in range(10))).snapshot(0).stale_after == pytest.approx(10.0)


def sample(vehicle: str, seconds: float = 0.0) -> Sample:
    return Sample(message(seconds), Address(vehicle, "vehicle_local_position"), received=time.time_ns())


def test_wall_clock_may_be_set_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rate and age are of the monotonic clock: an hour back on the wall clock changes nothing."""
    monitor, now, address = Monitor(), 100 * SECOND, Address("1", "vehicle_local_position")
    monkeypatch.setattr("time.monotonic_ns", lambda: now)
    monkeypatch.setattr("time.time_ns", lambda: 0)
    monitor.add(sample("1"))
    for index in range(300):
        now += SECOND // 100
        if index == 150:
            monkeypatch.setattr("time.time_ns", lambda: -3600 * SECOND)
        monitor.add(sample("1", index / 100))
    assert monitor.snapshot()[address].rate == pytest.approx(100.0)
    now += 7 * SECOND
    health = monitor.snapshot()[address]
    assert health.rate is None
    assert health.age == pytest.approx(7.0)


def test_monitor_is_bounded() -> None:
    """A flood of 20,000 keys leaves 4096 streams, and never takes the place of one that still sends."""
    monitor = Monitor()
    monitor.add(sample("real"))
    for index in range(20_000):
        assert not monitor.add(sample(f"flood-{index}"))
        assert monitor.add(sample("real"))
    assert len(monitor._streams) == 4096
    assert list(monitor.snapshot()) == [Address("real", "vehicle_local_position")]
    monitor.forget(Address("real", "vehicle_local_position"))
    assert not monitor.snapshot()


def late(seconds: float) -> Health:
    """Return the health of a stream at 100 Hz that comes so late."""
    stream = StreamHealth("vehicle_local_position")
    for index in range(300):
        stream.add(message(index / 100), received=index * SECOND // 100, latency=seconds)
    return stream.snapshot(3 * SECOND)


def test_states_have_reasons() -> None:
    """The worst state wins, and each but "ok" has its reason; the clock is the test's."""
    fresh = late(0.01)
    assert str(stream_state(fresh)) == "ok"
    assert str(stream_state(fresh, alive=True)) == "ok"
    assert str(stream_state(fresh, alive=False)) == "ok"  # other languages publish without tokens
    assert str(stream_state(late(4.4))) == "slow: 4.4 s late, or clocks differ"
    stream = follow(*(index * 0.01 for index in range(3000)), *(30.0 + index * 0.2 for index in range(15)))
    assert str(stream_state(stream.snapshot(33 * SECOND))).startswith("slow: 5.0 Hz, usually ")
    silent = stream.snapshot(40 * SECOND)
    assert str(stream_state(silent, alive=True)) == "stale: nothing for 7.2 s"
    assert str(stream_state(silent)) == "stale: nothing for 7.2 s"
    assert str(stream_state(silent, alive=False)) == "gone: last message 7.2 s ago"
    assert str(stream_state(silent, alive=False, connected=False)) == "disconnected: no link"
    assert stream_state(fresh).severity > stream_state(late(4.4)).severity > stream_state(silent).severity


def test_description_has_state_flags_and_events() -> None:
    """What is shown in a table: state, flags, then gaps, disorder and reboots; "ok" when there is nothing to say."""
    valid = dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"), True)
    health = follow(0.0, 0.01, 0.02, **valid).snapshot(SECOND // 10)
    assert describe_stream(health, stream_state(health)) == "ok"
    doubtful = follow(0.0, 0.01, 0.02, every=-2.0, boot=9.0, **{**valid, "xy_valid": False}).snapshot(4 * SECOND)
    state = stream_state(doubtful)
    assert describe_stream(doubtful, state) == "stale: nothing for 4.0 s, xy invalid, 2 reboots"
