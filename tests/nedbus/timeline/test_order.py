"""Order of a file's messages: the vehicle's clock decides, whatever the clock of the recorder does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import given, strategies as st

from nedbus.timeline import SKIPPED_PAUSE, Order, Pace
from nedbus_msgs import Address

STEP = 20_000  # us
PARTS = st.lists(
    st.tuples(
        st.integers(30, 80), st.sampled_from(["pause", "host", "reboot"]), st.integers(-3600, 3600)
    ),
    min_size=1,
    max_size=5,
)


@dataclass
class Message:
    """A message with a timestamp and a log time [us]."""

    timestamp: int
    time: int
    address: Address = Address("1", "vehicle_local_position")  # noqa: RUF009 - immutable
    at: float = 0.0
    error: str | None = None
    logged: Any = "stream"


@given(PARTS)
def test_order_and_duration_are_those_of_the_vehicle(parts: list[tuple[int, str, int]]) -> None:
    """Pauses count, steps of the recorder's clock do not, and a reboot begins with the order of the file."""
    stamp, host, elapsed = 5_000_000, 1_760_000_000_000_000, 0
    messages, times = list[Message](), list[float]()
    for count, change, seconds in parts:
        for _ in range(count):
            messages.append(Message(stamp, stamp + host))
            times.append(elapsed / 1e6)
            stamp, elapsed = stamp + STEP, elapsed + STEP
        pause = abs(seconds) * 1_000_000
        if change == "pause":
            stamp, elapsed = stamp + pause, elapsed + pause
        elif change == "host":
            host += seconds * 1_000_000
        else:  # the vehicle was off for this time, and the recorder's clock ran on
            pause += 5_000_000
            before, stamp = stamp, 1_000_000
            host, elapsed = host + before + pause - stamp, elapsed + pause
    order = Order[Message]()
    found = list(order.arrange(messages))
    assert [each.timestamp for each in found] == [each.timestamp for each in messages]
    assert [each.at for each in found] == pytest.approx(times)
    assert not order.unordered


@pytest.mark.parametrize("host", [0, 7_000_000])
def test_some_messages_have_the_axis_of_all(host: int) -> None:
    """A pass over one topic, which begins later, counts from the first message of the file, whatever the host's clock.

    Its first message is from before the start: the last one of a topic that PX4 rarely publishes.
    """
    whole = Order[Message]()
    list(whole.arrange([Message(stamp, stamp) for stamp in range(5_000_000, 9_000_000, STEP)]))
    own = [
        Message(1_000_000, 8_000_000 + host),
        *(Message(each, each + host) for each in range(8_000_000, 9_000_000, STEP)),
    ]
    order = Order[Message]()
    order.whole = whole.axis
    found = list(order.arrange(own))
    assert [each.at for each in found[1:]] == pytest.approx(
        [(each.timestamp - 5_000_000) / 1e6 for each in found[1:]]
    )
    assert order.duration == pytest.approx(whole.duration)


def test_streams_written_in_batches_are_sorted() -> None:
    """Batches of two streams become one sequence in the order of the timestamps, also around a step of the host."""
    host = [0 if number < 300 else -3_000_000 for number in range(600)]
    stamps = [1_000_000 + number * STEP for number in range(600)]
    streams: list[list[Message]] = [
        [
            Message(stamp, stamp + shift, logged=index)
            for stamp, shift in zip(stamps, host, strict=True)
        ][index::2]
        for index in range(2)
    ]
    messages = [
        each for begin in range(0, 300, 50) for own in streams for each in own[begin : begin + 50]
    ]
    found = [each.timestamp for each in Order[Message]().arrange(messages)]
    assert found == stamps


@pytest.mark.parametrize("back", [1_500_000, 2_500_000])
def test_reboot_to_almost_the_same_time_begins_a_new_boot(back: int) -> None:
    """Times more than 1 s before the last ones are those of a new boot, whose place the recorder's clock shows."""
    first = [5_000_000 + number * STEP for number in range(50)]
    again = [stamp - back + first[-1] - first[0] for stamp in first]
    messages = [Message(stamp, 10**15 + stamp) for stamp in first]
    messages += [Message(stamp, 10**15 + stamp + 20_000_000) for stamp in again]
    order = Order[Message]()
    found = list(order.arrange(messages))
    assert [each.timestamp for each in found] == first + again
    elapsed = (again[0] + 20_000_000 - first[-1]) / 1e6
    assert found[50].at - found[49].at == pytest.approx(elapsed)
    assert order.axis.boots("1") == 2


@pytest.mark.parametrize(("back", "boots"), [(800_000, 1), (1_500_000, 2), (2_500_000, 2)])
def test_log_that_goes_back_by_more_than_a_second_has_a_new_boot(back: int, boots: int) -> None:
    """In a log without log times, times up to a second before the last ones are late, earlier ones of a new boot.

    A log keeps the order of each stream in any case.
    """
    first = [5_000_000 + number * STEP for number in range(200)]
    again = [first[-1] - back + number * STEP for number in range(200)]
    order = Order[Message](has_log_times=False)
    found = list(order.arrange([Message(stamp, stamp) for stamp in (*first, *again)]))
    assert order.axis.boots("1") == boots
    assert [each.timestamp for each in found] == first + again


@pytest.mark.parametrize("rate", [100, 1_000, 2_000, 8_000])
def test_message_that_is_logged_late_is_in_order(rate: int) -> None:
    """PX4 logs a topic with a low rate up to 2 s late, whatever the rate of the others."""
    messages = list[Message]()
    for number in range(11 * rate):
        stamp = 5_000_000 + number * 1_000_000 // rate
        messages.append(Message(stamp, stamp))
        if number and number % (5 * rate) == 0:
            late = stamp - 3_900_000
            messages.append(Message(late, late, logged="slow"))
    found = [*Order[Message](has_log_times=False).arrange(messages)]
    assert [each.timestamp for each in found] == sorted(each.timestamp for each in messages)


def test_message_from_before_a_pause_that_is_logged_after_it_is_in_order() -> None:
    """However long a log pauses, a message may follow that a topic with a low rate sent before the pause."""
    before = [5_000_000 + number * 1_000 for number in range(3_000)]
    after = [stamp + 60_000_000 for stamp in before]
    slow = [before[0], before[-10], after[-1]]
    messages = [Message(stamp, stamp) for stamp in (*before, *after)]
    for stamp, index in zip(slow, (1, len(before) + 1_000, len(messages)), strict=True):
        messages.insert(index, Message(stamp, stamp, logged="slow"))
    found = [*Order[Message](has_log_times=False).arrange(messages)]
    assert [each.timestamp for each in found] == sorted(each.timestamp for each in messages)


@pytest.mark.parametrize("streams", [1, 2, 3, 4])
def test_late_message_right_after_a_pause_is_in_order(streams: int) -> None:
    """After a dropout of 2 s, PX4 logs a first message of some streams, then one of another from before it.

    As in `baro_failure.ulg` of a real PX4 (SITL), whose vehicle_command follows the first vehicle_attitude.
    """
    before = [5_000_000 + number * 4_000 for number in range(500)]
    after = [stamp + 4_000_000 for stamp in before]
    messages = [
        Message(stamp, stamp, logged=f"fast {stream}")
        for stamp in (*before, *after)
        for stream in range(streams)
    ]
    late = before[-1] + 4_000
    for stamp, index in ((before[0], 1), (late, len(before) * streams + streams)):
        messages.insert(index + 1, Message(stamp, stamp, logged="slow"))
    order = Order[Message](has_log_times=False)
    found = [*order.arrange(messages)]
    stamps = [each.timestamp for each in found]
    assert stamps == sorted(stamps)
    assert [each.at for each in found] == [(stamp - stamps[0]) / 1e6 for stamp in stamps]
    assert not order.unordered


@pytest.mark.parametrize("end", range(1, 8))
def test_stream_of_a_log_on_another_clock_has_its_places_in_the_file(end: int) -> None:
    """A stream that is always ahead, as of a receiver with its own clock, is no pause, unless the log ends with it."""
    stamps = [5_000_000 + number * STEP for number in range(500)]
    messages = list[Message]()
    for number, stamp in enumerate(stamps):
        messages.append(Message(stamp, stamp))
        if number % 10 == 9 - end:
            ahead = stamp + 4_000_000_000
            messages.append(Message(ahead, ahead, logged="ahead"))
    order = Order[Message](has_log_times=False)
    assert [*order.arrange(messages)] == messages
    assert order.duration == pytest.approx(9.98)


def test_message_of_a_log_with_a_damaged_timestamp_is_counted() -> None:
    """A single message of a log that is ahead of its own stream, and of the others, keeps its place in the file."""
    stamps = [5_000_000 + number * 4_000 for number in range(2_000)]
    messages = [Message(stamp, stamp, logged=stream) for stamp in stamps for stream in "ab"]
    damaged = Message(40_000_000, 40_000_000, logged="a")
    messages.insert(1_000, damaged)
    order = Order[Message](has_log_times=False)
    found = [*order.arrange(messages)]
    assert found == messages
    assert damaged.at == found[999].at
    assert order.unordered.total() == 1


@pytest.mark.parametrize("has_log_times", [True, False])
def test_last_message_after_a_pause_is_a_pause(*, has_log_times: bool) -> None:
    """A last message up to a day later ends a pause; one on no clock of the vehicle is out of order."""
    for last, duration, unordered in ((90_000_000, 89.0, 0), (10**15, 4.0, 1)):
        stamps = [*range(1_000_000, 6_000_000, 1_000_000), last]
        order = Order[Message](has_log_times=has_log_times)
        times = (
            stamps
            if not has_log_times
            else [1_760_000_000_000_000 + number for number in range(len(stamps))]
        )
        messages = [Message(stamp, time) for stamp, time in zip(stamps, times, strict=True)]
        *_, end = order.arrange(messages)
        assert end.at == pytest.approx(duration)
        assert order.unordered.total() == unordered


@pytest.mark.parametrize(
    ("step", "every"),
    [(10_000_000, 2000), (-10_000_000, 2000), (86_400_000_000, 2000), (100 - STEP, 1)],
    ids=["ahead", "back", "a day", "replay at full speed"],
)
def test_vehicle_that_appears_later_is_placed_beside_the_others(step: int, every: int) -> None:
    """A vehicle that appears after steps of the recorder's clock begins where the others are."""
    host = 1_760_000_000_000_000
    stamps = [1_000_000 + number * STEP for number in range(10_000)]
    messages = [
        Message(stamp, host + number // every * step + stamp) for number, stamp in enumerate(stamps)
    ]
    time = messages[-1].time
    late = [
        Message(700_000_000 + after, time + after, Address("2", "vehicle_local_position"))
        for after in range(0, 5_000_000, STEP)
    ]
    order = Order[Message]()
    list(order.arrange([*messages, *late]))
    expected = (stamps[-1] - stamps[0]) / 1e6
    assert order.axis.seconds_of("2", 700_000_000) == pytest.approx(expected)


def test_damaged_log_time_does_not_place_another_vehicle() -> None:
    """A single message with a wild log time, just before a vehicle appears, is no step of the recorder's clock."""
    host = 1_760_000_000_000_000
    stamps = [1_000_000 + number * STEP for number in range(2000)]
    messages = [Message(stamp, host + stamp) for stamp in stamps]
    messages[-1].time += 86_400_000_000
    late = [
        Message(stamp, host + stamps[-1] + stamp, Address("2", "vehicle_local_position"))
        for stamp in range(STEP, 5_000_000, STEP)
    ]
    order = Order[Message]()
    list(order.arrange([*messages, *late]))
    expected = (stamps[-1] + STEP - stamps[0]) / 1e6
    assert order.axis.seconds_of("2", STEP) == pytest.approx(expected)


def test_pace_alone_shortens_pauses() -> None:
    """A pause of up to a minute is kept; a longer one takes no time, and is counted."""
    pace = Pace(speed=2.0)
    assert [pace.publish_at(at) for at in (0.0, 1.0, 1.0 + SKIPPED_PAUSE, 1000.0, 1001.0)] == [
        0.0,
        0.5,
        30.5,
        30.5,
        31.0,
    ]
    assert pace.skipped == 1


UNIX = 1_710_000_000_000_000  # us


def recorded_at_full_speed(*messages: tuple[str, int]) -> list[Message]:
    """Return messages of streams with these timestamps, which a recorder received 0.1 ms apart."""
    host = 1_760_000_000_000_000
    return [
        Message(stamp, host + 100 * number, logged=stream)
        for number, (stream, stamp) in enumerate(messages)
    ]


def assert_times_are_those_of_the_vehicle(messages: list[Message]) -> None:
    order = Order[Message]()
    found = list(order.arrange(messages))
    first = min(message.timestamp for message in messages)
    assert [message.timestamp for message in found] == sorted(
        message.timestamp for message in messages
    )
    assert [message.at for message in found] == pytest.approx(
        [(each.timestamp - first) / 1e6 for each in found]
    )
    assert order.remarks == []


@pytest.mark.parametrize("epoch", [0, UNIX])
def test_stream_that_appears_late_is_no_reboot(epoch: int) -> None:
    """In the recording of a replay at full speed, a topic that appears seconds late shows no reboot, and is sorted."""
    stamps = [epoch + stamp for stamp in range(1_000_000, 9_000_000, STEP)]
    streams = [(stream, stamp) for stamp in stamps for stream in "ab"]
    late = [("c", stamp) for stamp in stamps]
    assert_times_are_those_of_the_vehicle(recorded_at_full_speed(*streams, *late))


@pytest.mark.parametrize("epoch", [0, UNIX])
def test_stream_that_runs_ahead_is_sorted(epoch: int) -> None:
    """In the recording of a replay at full speed, a topic may run seconds ahead of the others."""
    stamps = [epoch + stamp for stamp in range(1_000_000, 9_000_000, STEP)]
    messages = [(stream, stamp) for stamp in stamps for stream in "ab"]
    ahead = [("c", stamps[100]), ("c", stamps[150]), ("c", stamps[200])]
    assert_times_are_those_of_the_vehicle(
        recorded_at_full_speed(*messages[:20], *ahead, *messages[20:])
    )


def test_single_message_with_a_wild_time_has_its_place_in_the_file() -> None:
    """One message that is far ahead of the others may be damaged: it does not extend the flight."""
    stamps = range(1_000_000, 9_000_000, STEP)
    messages = [(stream, stamp) for stamp in stamps for stream in "ab"]
    order = Order[Message]()
    found = list(
        order.arrange(recorded_at_full_speed(*messages[:20], ("c", 40_000_000), *messages[20:]))
    )
    assert [message.logged for message in found].index("c") == 20
    assert order.duration == pytest.approx(7.98)
