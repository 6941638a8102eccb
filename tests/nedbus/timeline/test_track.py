"""Places of a vehicle's messages on the axis: clocks that are set, batches across a change, and late messages."""

from __future__ import annotations

import pytest

from nedbus.timeline import Order

from .test_order import STEP, UNIX, Message

HOST = 7_000_000  # us by which the recorder's clock is ahead
STEP_FORWARD = 100_000_000  # us


@pytest.mark.parametrize(("passed", "duration"), [(STEP, 1.98), (STEP_FORWARD, 101.96)])
def test_unix_clock_that_runs_ahead_of_the_recorder_was_set(passed: int, duration: float) -> None:
    """A step of Unix timestamps is a pause if as much log time has passed; else the clock was set, and time runs on."""
    messages = [Message(UNIX + n * STEP, UNIX + n * STEP + HOST) for n in range(50)]
    last = messages[-1]
    for n in range(50):
        stamp = last.timestamp + STEP_FORWARD + n * STEP
        messages.append(Message(stamp, last.time + passed + n * STEP))
    order = Order[Message]()
    assert [*order.arrange(messages)] == messages
    assert order.duration == pytest.approx(duration)
    was_set = "the clock of vehicle 1 was set (1); the order of the file decides"
    assert order.remarks == ([was_set] if passed == STEP else [])


@pytest.mark.parametrize("step", [STEP_FORWARD, -STEP_FORWARD])
def test_batch_from_before_a_change_of_the_clock_keeps_its_place(step: int) -> None:
    """A stream that a recorder writes in a later batch continues on the clock from before it was set."""

    def at(elapsed: int, stream: str, *, is_set: bool) -> Message:
        stamp = UNIX + elapsed + (step if is_set else 0)
        return Message(stamp, UNIX + elapsed + HOST, logged=stream)

    before = [at(n * STEP, stream, is_set=False) for n in range(40) for stream in "ab"]
    batch = [at(n * STEP, "b", is_set=False) for n in range(40, 50)]
    first = [at(n * STEP, "a", is_set=False) for n in range(40, 50)]
    after = [at(n * STEP, "a", is_set=True) for n in range(50, 100)]
    found = [*Order[Message]().arrange([*before, *first, *after, *batch])]
    assert [message.time for message in found] == sorted(message.time for message in found)
    assert found[-50:] == after


def test_late_message_of_a_log_is_counted_and_keeps_the_order_of_its_stream() -> None:
    """In a log without log times, a message up to a second older than the last one of its stream is out of order."""
    stamps = [5_000_000 + n * STEP for n in range(100)]
    late = stamps[49] - 500_000
    messages = [Message(stamp, stamp) for stamp in (*stamps[:50], late, *stamps[50:])]
    order = Order[Message](has_log_times=False)
    found = [*order.arrange(messages)]
    assert found == messages
    assert found[50].at == found[49].at
    assert order.unordered.total() == 1


def test_message_that_was_sent_twice_keeps_its_place_in_a_later_batch() -> None:
    """PX4 may publish two messages of a topic with one timestamp; here their topic arrives after the others."""
    others = [Message(n * STEP, UNIX + n * STEP, logged="a") for n in range(1, 200)]
    arrived = others[-1].time
    stamps = [STEP, 100 * STEP, 100 * STEP, 101 * STEP]
    late = [Message(stamp, arrived, logged="b") for stamp in stamps]
    found = [*Order[Message]().arrange([*others[:20], late[0], *others[20:], *late[1:]])]
    assert [message.timestamp for message in found if message in late] == stamps
    assert [message.timestamp for message in found] == sorted(
        message.timestamp for message in found
    )


def test_later_batch_ends_with_the_boot() -> None:
    """After a reboot, a damaged timestamp that equals one of a batch before it has the place of the file."""
    last = 2000 * STEP
    messages = [Message(n * STEP, UNIX + n * STEP, logged="a") for n in range(1, 2001)]
    batch = [Message(n * STEP, UNIX + last, logged="b") for n in (1, 1000, 1500)]
    messages = [*messages[:20], batch[0], *messages[20:], *batch[1:]]
    for n in range(50, 300):
        log = UNIX + last + n * STEP
        messages += [Message(n * STEP, log, logged="a"), Message(n * STEP, log, logged="b")]
        if n == 200:
            messages.append(Message(1500 * STEP, log, logged="b"))
    order = Order[Message]()
    found = [*order.arrange(messages)]
    damaged = [message for message in found if message.timestamp == 1500 * STEP][-1]
    assert damaged is not found[-1]
    assert order.duration == pytest.approx((last + 299 * STEP - STEP) / 1e6, abs=0.1)


@pytest.mark.parametrize("streams", ["ab", "abc"])
def test_three_streams_that_go_on_together_show_a_pause(streams: str) -> None:
    """The timestamps of two streams may be damaged together; three streams with the same step show a pause."""
    pause = 30_000_000
    messages = [
        Message(n * STEP, UNIX + n * STEP, logged=name) for n in range(1, 40) for name in "abcd"
    ]
    last = messages[-1]
    for name in streams:
        messages.append(Message(last.timestamp + pause, last.time + STEP, logged=name))
    for n in range(1, 10):
        stamp = last.timestamp + n * STEP
        messages.append(Message(stamp, last.time + n * STEP, logged="d"))
    order = Order[Message]()
    [*order.arrange(messages)]
    is_pause = order.duration > pause / 1e6
    assert is_pause == (streams == "abc")
