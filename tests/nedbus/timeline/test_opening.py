"""The message with which a vehicle's clock begins in a file."""

from __future__ import annotations

from collections.abc import Iterable

from nedbus.timeline.opening import first_of
from nedbus.timeline.track import Item
from nedbus_msgs import Address

from .test_order import STEP, Message

BEGIN = 50_000_000  # us


def stream_of(topic: str, stamps: Iterable[int], *, log: int | None = None) -> list[Item[Message]]:
    """Return messages of a topic with these timestamps; `log`: the log time of the first one, at 50 Hz."""
    items = []
    for number, stamp in enumerate(stamps):
        logged = None if log is None else log + number * STEP
        items.append(Item(Message(stamp, stamp, Address("1", topic)), topic, stamp, logged, number))
    return items


def steps(begin: int, count: int) -> list[int]:
    return [begin + number * STEP for number in range(count)]


def test_queued_texts_do_not_begin_the_clock() -> None:
    """PX4 queues texts, so the first ones of a log may be from long before it."""
    texts = stream_of("log_message", steps(1_000_000, 5))
    positions = stream_of("vehicle_local_position", steps(BEGIN, 5))
    assert first_of([*texts, *positions], 0) is positions[0]
    assert first_of(texts, 0) is texts[0], "there is nothing else"


def test_clock_of_most_messages_begins() -> None:
    """Streams whose periods are more than a minute apart are on two clocks."""
    few = stream_of("vehicle_attitude", steps(1_000_000, 3))
    most = stream_of("vehicle_local_position", steps(500_000_000, 20))
    assert first_of([*few, *most], 0) is most[0]


def test_first_message_from_before_the_recording_is_left_out() -> None:
    """A recorder first gets the last message of a rarely published topic, which may be old by its timestamp."""
    rare = stream_of("vehicle_status", [1_000_000, BEGIN + STEP, BEGIN + 2 * STEP], log=10**15)
    positions = stream_of("vehicle_local_position", steps(BEGIN, 5), log=10**15)
    assert first_of([*rare, *positions], 0) is positions[0]


def test_header_on_another_clock_does_not_count() -> None:
    """Messages from the start of recording on count; if none is later than the header says, all do."""
    first = stream_of("vehicle_attitude", steps(BEGIN + STEP, 5))
    second = stream_of("vehicle_local_position", steps(BEGIN, 5))
    items = [*first, *second]
    assert first_of(items, BEGIN + STEP) is first[0]
    assert first_of(items, 10**15) is second[0]
