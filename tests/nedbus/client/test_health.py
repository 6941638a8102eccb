"""The health of a stream, derived from its messages."""

from __future__ import annotations

import dataclasses
import math
import tracemalloc
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

import nedbus
from nedbus.client import describe_stream, stream_state
from nedbus.health import Health, StreamHealth
from nedbus_msgs import DOUBT_FLAGS
from tests.flights.messages import VALID, VLP, message

SECOND = 1_000_000_000
FLIGHT = Path(__file__).parents[4] / "shared" / "data" / "px4" / "multi_ekf_switch.ulg"
Fields = Mapping[str, object]


def stream_at(
    *times: float,
    boot: float = 0.0,
    every: float = 0.01,
    latency: float | None = None,
    fields: Fields = VALID,
) -> StreamHealth:
    """Return a stream with these arrival times [s]; PX4's timestamps start at `boot` [s]."""
    stream = StreamHealth(VLP)
    for index, arrival in enumerate(times):
        seconds = boot + index * every
        stream.add(
            message(round(seconds * 1e6), **fields),
            received=round(arrival * SECOND),
            latency=latency,
        )
    return stream


def health_at_px4_times(*clock: float) -> Health:
    """Return the health of a stream whose messages have these PX4 timestamps [s]."""
    stream = StreamHealth(VLP)
    for seconds in clock:
        stream.add(message(round(seconds * 1e6)), received=0)
    return stream.snapshot(0)


def test_rate_and_jitter_cover_the_last_second() -> None:
    """Rate and jitter are computed over the last second: here 50 Hz, with intervals of 15 and 25 ms."""
    times = [0.0]
    for index in range(200):
        times.append(times[-1] + (0.1 if index < 10 else 0.015 if index % 2 else 0.025))
    health = stream_at(*times).snapshot(round((times[-1] + 0.5) * SECOND))
    assert health.rate == pytest.approx(50.0, rel=0.02)
    assert health.jitter == pytest.approx(0.005, rel=0.02)
    assert health.nominal == 100.0
    assert health.age == pytest.approx(0.5)
    assert health.messages == 201


def test_health_does_not_depend_on_when_it_is_read() -> None:
    """Messages are measured in batches, but each one at once for readers; at most 32 wait."""
    often, once = StreamHealth(VLP), StreamHealth(VLP)
    for number in range(500):
        for stream in often, once:
            latency = number % 7 / 100
            stream.add(
                message(number * 8000),
                received=number * SECOND // 125,
                latency=latency,
                lost=number % 3,
            )
        assert len(once._waiting) <= 32
        if number in (4, 5):
            assert often.usual_interval == pytest.approx(None if number == 4 else 0.008)
        assert sum(often.latencies.counts) == number + 1
        assert often.snapshot(number * SECOND // 125).messages == number + 1
    first, second = (dataclasses.asdict(stream.snapshot(4 * SECOND)) for stream in (often, once))
    assert first.pop("jitter") == pytest.approx(second.pop("jitter"), abs=1e-12)
    assert first.pop("rate") == pytest.approx(second.pop("rate"))
    assert first.pop("usual_rate") == pytest.approx(second.pop("usual_rate"))
    assert first == second


def test_usual_interval_is_that_of_the_latest_messages() -> None:
    """After 40 intervals of 0.1 s, 7 of 1 s are not usual yet, and 8 are: half of the latest 15."""
    fast = [number / 10 for number in range(41)]
    slow = [4.0 + number for number in range(1, 9)]
    assert stream_at(*fast, *slow[:7]).usual_interval == pytest.approx(0.1)
    assert stream_at(*fast, *slow).usual_interval == pytest.approx(1.0)


def test_slow_streams_are_small() -> None:
    """The health of a stream at 2 Hz takes at most 5 kB, because a fleet has thousands of them."""
    number = 200
    tracemalloc.start()
    try:
        streams = [StreamHealth("vehicle_status") for _ in range(number)]
        for step in range(40):
            for stream in streams:
                fields = {"timestamp": step * 500_000}
                stream.add(fields, received=step * SECOND // 2, latency=0.01 + step / 1e6)
        used, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert streams[0].snapshot(20 * SECOND).usual_interval == 0.5
    assert used / number <= 5000


def test_concurrent_add_does_not_break_a_snapshot() -> None:
    """A snapshot computes the jitter correctly even if another thread adds a message meanwhile."""
    stream = stream_at(0.0, 0.01, 0.02)
    stream._measure()
    window = stream._window
    before = window.intervals

    class LateIntervals(tuple[int, float, float]):
        """Measurements of the intervals during whose reading a message is added to the stream."""

        __slots__ = ()

        def __iter__(self) -> Iterator[float]:
            window.intervals = before
            stream.add(message(30_000), received=SECOND // 50)
            return super().__iter__()

    window.intervals = LateIntervals(before)
    assert stream.snapshot(SECOND // 50).jitter == pytest.approx(0.0)
    assert stream.snapshot(SECOND // 50).messages == 4
    assert window.intervals[0] == 3


def test_latency_of_a_fast_stream_is_that_of_its_newest_messages() -> None:
    """Of more than 1,000 messages in a second, the latency is the median of the newest 1,000."""
    stream = StreamHealth("vehicle_attitude")
    for number in range(1800):
        latency = 0.1 if number < 800 else 0.01
        stream.add({"timestamp": number + 1}, received=number * SECOND // 2000, latency=latency)
    health = stream.snapshot(SECOND)
    assert (health.latency, health.latency_max) == (0.01, 0.01)


def test_silent_stream_has_age_but_no_rate() -> None:
    """A stream that stopped has an age but no rate; before the first message it has neither."""
    health = stream_at(1.0, 1.01, 1.02).snapshot(10 * SECOND)
    assert health.rate is None
    assert health.age == pytest.approx(8.98)
    health = StreamHealth("estimator_local_position").snapshot(SECOND)
    nothing = Health(None, 2.0, None, None, None, None, 0, 0, 0, 0, 0, None, None)
    assert dataclasses.replace(health, resets={}) == nothing
    assert set(health.resets.values()) == {0}


def test_later_snapshot_differs_only_in_ages_and_rate() -> None:
    """Without new messages, only age, reboot age, rate and jitter change; each snapshot has its own dictionaries."""
    stream = stream_at(10.0, 10.5, boot=90.0)
    stream.add(
        message(20_000, xy_reset_counter=3),
        received=11 * SECOND,
        latency=0.5,
        lost=3,
    )
    first = stream.snapshot(12 * SECOND)
    again = dataclasses.asdict(first)
    assert first.flags is not None
    assert first.flags_ever is not None
    for values in first.flags, first.flags_ever, first.resets:
        values.clear()
    changes = {"age": 9.0, "reboot_age": 9.0, "rate": None, "jitter": None}
    assert (first.age, first.reboot_age, first.reboots) == (1.0, 1.0, 1)
    assert first.rate is not None
    assert dataclasses.asdict(stream.snapshot(20 * SECOND)) == again | changes
    assert dataclasses.asdict(stream.snapshot(12 * SECOND)) == again


@pytest.mark.parametrize(
    ("topic", "silence", "state"),
    [
        ("home_position", 3600.0, "ok"),
        ("vehicle_status", 4.0, "stale"),
        ("vehicle_status", 2.0, "ok"),
        ("battery_status", 2.0, "slow"),
    ],
)
def test_on_change_stream_is_stale_only_below_its_minimum_rate(
    topic: str, silence: float, state: str
) -> None:
    """A stream published on change is slow or stale only below its minimum rate, and never has gaps.

    Streams of messages other than positions have neither flags nor resets.
    """
    stream = StreamHealth(topic)
    times = [index / 50 for index in range(500)] + [10.0 + index for index in range(3)]
    for seconds in times:
        stream.add({"timestamp": round(seconds * 1e6)}, received=round(seconds * SECOND))
    health = stream.snapshot(round((times[-1] + silence) * SECOND))
    assert stream_state(health).name == state
    assert (health.gaps > 0) == (topic == "battery_status")
    assert (health.flags, health.resets) == (None, {})


def test_gaps_disorder_and_reboots_are_derived_from_px4_time() -> None:
    """If PX4's time advances by more than three usual intervals, this is a gap.

    A step back is a message out of order if it is shorter than a second, otherwise a reboot.
    """
    clock = [index * 0.1 for index in range(20)]
    clock += [clock[-1] + 1.0 + index * 0.1 for index in range(5)]
    clock += [clock[-1] + 0.2, clock[-1] + 2.0]
    assert health_at_px4_times(*clock).gaps == 2
    health = health_at_px4_times(10.0, 10.1, 10.05, 10.2, 0.5, 0.6)
    assert (health.out_of_order, health.reboots) == (1, 1)


@pytest.mark.parametrize(
    ("counters", "resets", "reboots"),
    [
        ([(10.0, 7), (10.1, 7), (10.2, 8), (10.3, 8), (10.4, 10)], 3, 0),
        ([(10.0, 254), (10.1, 255), (10.2, 0), (10.3, 1)], 3, 0),
        ([(10.0, 5)], 0, 0),
        ([(10.0, 3), (10.1, 4), (0.1, 0), (0.2, 1)], 2, 1),
    ],
    ids=["rising", "wrapping at 255", "reset before the first message", "reboot"],
)
def test_resets_are_counted(counters: list[tuple[float, int]], resets: int, reboots: int) -> None:
    """Increments of a reset counter are counted, including its wrap at 255, from the first message on.

    A reboot clears the counters, which does not count as a reset; later resets are counted.
    """
    stream = StreamHealth(VLP)
    for seconds, counter in counters:
        fields = {"z_reset_counter": counter, "heading_reset_counter": 9}
        stream.add(message(round(seconds * 1e6), **fields), received=0)
    health = stream.snapshot(0)
    assert (health.resets["z"], health.resets["heading"], health.resets["xy"]) == (resets, 0, 0)
    assert health.reboots == reboots


def test_missing_reset_counters_do_not_count_as_zero() -> None:
    """Messages without reset counters, such as converted ones, cause no resets; those meanwhile are counted after."""
    for missing in ("xy_reset_counter", "z_reset_counter"), ():
        stream = StreamHealth(VLP)
        for index, count in enumerate((3, 3, 0, 0, 3, 4)):
            fields: dict[str, object] = {"timestamp": index * 10_000}
            if missing:
                values = dict.fromkeys(missing, count)
                stream.add(
                    message(index * 10_000, **values),
                    received=0,
                    missing=missing if count == 0 else (),
                )
            else:
                fields |= {"xy_reset_counter": count, "z_reset_counter": count} if count else {}
                stream.add(fields, received=0)
        resets = stream.snapshot(0).resets
        assert (resets["xy"], resets["z"], sum(resets.values())) == (1, 1, 2)


def test_lasting_change_of_the_rate_causes_few_gaps() -> None:
    """After a lasting drop of the rate, its intervals are no longer gaps once they are half of the latest 15."""
    clock = [index * 0.02 for index in range(100)]
    clock += [clock[-1] + index * 0.125 for index in range(1, 500)]
    assert health_at_px4_times(*clock).gaps == 8
    assert health_at_px4_times(*clock, clock[-1] + 0.5).gaps == 9


def test_single_wild_time_is_no_reboot() -> None:
    """One message with a wild time counts as out of order; a time that stays back is a reboot."""
    health = health_at_px4_times(100.0, 100.1, 999.0, 100.2, 100.3)
    assert (health.reboots, health.out_of_order) == (0, 1)
    health = health_at_px4_times(100.0, 100.1, 1.0, 1.1, 1.2)
    assert (health.reboots, health.out_of_order) == (1, 0)


def test_time_of_log_messages_reveals_no_reboot() -> None:
    """PX4 queues its log messages, so an old one among newer ones is no reboot."""
    stream = StreamHealth("log_message")
    for seconds in (40, 5, 41):
        stream.add({"timestamp": seconds * 1_000_000}, received=0)
    assert stream.snapshot(0).reboots == 0


def test_flag_shares_are_fractions_of_messages() -> None:
    """`flags` and `flags_ever` are the shares of messages with a flag set, in the last second and since the start."""
    stream = StreamHealth(VLP)
    for index in range(400):
        late = index >= 200
        fields = {"x": 0.0, "y": 0.0, "xy_valid": late, "dead_reckoning": not late}
        stream.add(message(index * 10_000, **fields), received=index * SECOND // 100)
    health = stream.snapshot(4 * SECOND)
    assert health.flags == {**dict.fromkeys(DOUBT_FLAGS, 0.0), "xy_valid": 1.0}
    assert health.flags_ever == {
        **dict.fromkeys(DOUBT_FLAGS, 0.0),
        "xy_valid": 0.5,
        "dead_reckoning": 0.5,
    }


def test_flag_share_ignores_messages_without_the_flag() -> None:
    """The share of a flag is computed over the messages whose source provides the flag."""
    stream = StreamHealth(VLP)
    stream.add(
        message(1, x=0.0, y=0.0, xy_valid=True), received=0, missing={"z_valid", "dead_reckoning"}
    )
    stream.add({"timestamp": 2, "xy_valid": False}, received=1)
    assert stream.snapshot(1).flags == {"xy_valid": 0.5, "v_xy_valid": 0.0, "v_z_valid": 0.0}


def test_latency_covers_the_last_second_and_losses_are_totals() -> None:
    """Latency is the median and maximum of the last second; losses are the total since the start."""
    stream = StreamHealth(VLP)
    for index, latency in enumerate((0.1, 0.2, 0.9)):
        stream.add(message(index), received=index, latency=latency, lost=index)
    health = stream.snapshot(0)
    assert (health.latency, health.latency_max, health.lost) == (0.2, 0.9, 3)


@pytest.mark.slow
def test_usual_rate_reveals_a_slow_stream() -> None:
    """After a minute at 100 Hz, 5 Hz is far below the usual rate, which a burst of recovered messages hardly raises."""
    times = [index * 0.01 for index in range(6000)]
    times += [60.0 + index * 0.0001 for index in range(6000)]
    times += [62.0 + index * 0.01 for index in range(200)]
    times += [64.0 + index * 0.2 for index in range(50)]
    health = stream_at(*times).snapshot(round((times[-1] + 0.1) * SECOND))
    assert health.rate == pytest.approx(5.0, rel=0.05)
    assert health.usual_rate is not None
    assert 50 < health.usual_rate < 120


def test_stale_timeout_is_longer_for_slow_streams() -> None:
    """A stream is stale after 3 s without a message, or after three usual intervals if that is longer."""
    assert stream_at(*(index * 0.01 for index in range(300))).snapshot(0).stale_after == 3.0
    assert stream_at(*(index * 5.0 for index in range(10))).snapshot(
        0
    ).stale_after == pytest.approx(15.0)


def test_rare_topic_without_nominal_rate_is_never_stale() -> None:
    """A topic without a nominal rate becomes stale only if it had at least one message per second."""
    for period, expected in ((0.01, 3.0), (5.0, math.inf)):
        stream = StreamHealth("vehicle_command")
        for index in range(300):
            stream.add(
                message(round(index * period * 1e6)), received=round(index * period * SECOND)
            )
        assert stream.snapshot(0).stale_after == expected
    assert StreamHealth("vehicle_command").snapshot(0).stale_after == math.inf


def custom_stream(*times: float) -> StreamHealth:
    """Return a stream of a topic without a nominal rate, with these times [s]."""
    stream = StreamHealth("vehicle_command_ack")
    for seconds in times:
        stream.add({"timestamp": round(seconds * 1e6)}, received=round(seconds * SECOND))
    return stream


def test_topic_sent_on_change_is_neither_stale_nor_has_gaps() -> None:
    """Without a nominal rate, irregular intervals mean publishing on change, whatever the mean rate is."""
    bursts = [
        burst * 10.0 + index * step
        for burst in range(5)
        for index, step in enumerate((0.0, 0.06, 0.25, 0.5))
    ]
    health = custom_stream(*sorted(bursts)).snapshot(100 * SECOND)
    assert health.on_change
    assert health.stale_after == math.inf
    assert health.gaps == 0
    assert stream_state(health, publishers=1).name == "ok"


def test_periodic_topic_without_nominal_rate_is_stale_despite_a_few_gaps() -> None:
    """At 5 Hz, silence of 20 s is stale, also if two of the last intervals were gaps, which are counted."""
    times = [index * 0.2 for index in range(50)]
    times = [
        seconds
        for seconds in times
        if seconds not in {times[index] for index in (40, 41, 42, 45, 46, 47)}
    ]
    health = custom_stream(*times).snapshot(round((times[-1] + 20) * SECOND))
    assert (health.on_change, health.gaps) == (False, 2)
    assert str(stream_state(health, publishers=1)) == "stale: nothing for 20.0 s"


def test_latency_of_an_old_message_is_not_a_state() -> None:
    """A message that was late when it was sent again, as home_position after a restart, is "slow" for 3 s, then ok."""
    stream = StreamHealth("home_position")
    stream.add({"timestamp": 1}, received=0, latency=1.2)
    assert str(stream_state(stream.snapshot(SECOND))) == "slow: 1.2 s late, or clocks differ"
    assert str(stream_state(stream.snapshot(4 * SECOND))) == "ok"


@pytest.mark.slow
def test_description_mentions_a_reboot_for_a_minute() -> None:
    """A reboot is in the description for a minute; the count and the time since it remain in the health."""
    stream = stream_at(*(index / 100 for index in range(300)), boot=100.0)
    for index in range(7000):
        seconds = 3 + index / 100
        stream.add(
            message(round((1 + index / 100) * 1e6), **VALID), received=round(seconds * SECOND)
        )
        if index == 1000:
            early = stream.snapshot(round(seconds * SECOND))
    later = stream.snapshot(73 * SECOND)
    assert describe_stream(early, stream_state(early)) == "1 reboot"
    assert describe_stream(later, stream_state(later)) == "ok"
    assert later.reboots == 1
    assert later.reboot_age == pytest.approx(70.0)


@pytest.mark.skipif(not FLIGHT.exists(), reason=f"no log of a PX4 in {FLIGHT.parent}")
def test_on_change_topics_of_a_real_flight_are_never_stale() -> None:
    """In a flight of PX4 main, acknowledgements and events come in bursts, with a usual rate above 1 Hz."""
    streams: dict[str, StreamHealth] = {}
    end = 0
    with nedbus.open(FLIGHT) as flight:
        for sample in flight("event", "vehicle_command_ack", "vehicle_magnetometer"):
            stream = streams.setdefault(sample.topic, StreamHealth(sample.topic))
            end = sample.message.timestamp * 1000
            stream.add(sample.message, received=end)
    states = {
        topic: stream_state(stream.snapshot(end + 30 * SECOND)).name
        for topic, stream in streams.items()
    }
    assert states == {"event": "ok", "vehicle_command_ack": "ok", "vehicle_magnetometer": "stale"}


def test_stream_has_the_worst_state_that_applies() -> None:
    """The state of a stream is the worst one that applies; each state except "ok" has a reason."""
    second = [index / 100 for index in range(300)]
    fresh, late = (
        stream_at(*second, latency=latency).snapshot(3 * SECOND) for latency in (0.01, 4.4)
    )
    stream = stream_at(
        *(index * 0.01 for index in range(3000)), *(30.0 + index * 0.2 for index in range(15))
    )
    silent, longer = (stream.snapshot(seconds * SECOND) for seconds in (40, 3 * 3600))
    cases: tuple[tuple[Health, dict[str, Any], str], ...] = (
        (fresh, {}, "ok"),
        (fresh, {"publishers": 1}, "ok"),
        (fresh, {"publishers": 0}, "ok"),  # other languages publish without tokens
        (fresh, {"publishers": 2}, "duplicate: 2 publishers: stop one, or give it another vehicle"),
        (late, {}, "slow: 4.4 s late, or clocks differ"),
        (silent, {"publishers": 1}, "stale: nothing for 7.2 s"),
        (silent, {}, "stale: nothing for 7.2 s"),
        (silent, {"publishers": 0}, "gone: last message 7.2 s ago"),
        (longer, {}, "stale: nothing for 3 h"),
        (silent, {"publishers": 0, "connected": False}, "disconnected: no link"),
    )
    for health, options, text in cases:
        assert str(stream_state(health, **options)) == text
    assert str(stream_state(stream.snapshot(33 * SECOND))).startswith("slow: 5.0 Hz, usually ")
    assert (
        stream_state(fresh).severity > stream_state(late).severity > stream_state(silent).severity
    )


def test_description_lists_state_flags_and_faults() -> None:
    """A description lists state, invalid flags, gaps, out-of-order messages and reboots; without faults it is "ok"."""
    health = stream_at(0.0, 0.01, 0.02).snapshot(SECOND // 10)
    assert describe_stream(health, stream_state(health)) == "ok"
    doubtful = stream_at(
        0.0, 0.01, 0.02, every=-2.0, boot=9.0, fields=VALID | {"xy_valid": False}
    ).snapshot(4 * SECOND)
    assert (
        describe_stream(doubtful, stream_state(doubtful))
        == "stale: nothing for 4.0 s, xy invalid, 2 reboots"
    )
    mixed = stream_at(0.0, 0.01, 0.02, every=-2.0, boot=9.0).snapshot(SECOND // 10)
    assert "reboots" not in describe_stream(mixed, stream_state(mixed, publishers=2)), (
        "two publishers look like reboots"
    )
