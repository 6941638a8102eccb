"""Groups of messages in quick succession, which a lossless publisher hands to Zenoh together."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any, cast

import pytest

import nedbus
from nedbus import limits
from nedbus.client.publishing import group
from nedbus.client.publishing.group import Group, Outgoing
from nedbus.client.publishing.writer import Heartbeats, Writer
from tests.flights.messages import VLP, message
from tests.nedbus.client.numbered import receive_timestamps, wait_for_subscriber
from tests.waits import DEADLINE, wait_for

QUICK = 0.0001  # s between two messages of a quick succession


class Clock:
    """A group with a fake clock, and the sizes of what it put."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.sizes, self.numbers = 100.0, list[int](), list[int]()
        monkeypatch.setattr(group, "monotonic", lambda: self.now)
        self.writer = SimpleNamespace(published=0)
        self.group = Group(
            cast("Writer", self.writer),
            self.put,
            cast("Heartbeats", SimpleNamespace(watch=self.watch)),
        )

    def watch(self, watched: Group) -> bool:
        watched.is_watched = True
        return True

    def put(self, messages: Sequence[Outgoing]) -> None:
        self.sizes.append(len(messages))
        self.numbers += [int(payload) for payload, *_ in messages]
        self.writer.published += len(messages)

    def publish(self, count: int, *, pause: float, room: int = 1000) -> None:
        for _ in range(count):
            self.now += pause
            payload = str(self.group.published).encode()
            if self.group.add(cast("Outgoing", (payload, None, ""))):
                self.group.hand_over()
                self.group.begin(room)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def test_paced_messages_are_put_at_once(clock: Clock) -> None:
    """A message that does not follow another within 0.2 ms is put at once, with those still held back."""
    clock.publish(50, pause=0.001)
    assert clock.sizes == [1] * 50
    clock.publish(20, pause=QUICK)
    held = len(clock.group)
    assert held > 0
    clock.publish(1, pause=0.001)
    assert clock.sizes[-1] == held + 1
    assert not clock.group
    assert clock.numbers == list(range(71))


def test_quick_succession_forms_groups_after_its_first_messages(clock: Clock) -> None:
    """The first 16 messages of a quick succession are put at once, the following ones in groups of 64."""
    clock.publish(16 + 3 * limits.GROUP_MESSAGES, pause=QUICK)
    assert clock.sizes == [1] * 16 + [limits.GROUP_MESSAGES] * 3
    assert clock.numbers == list(range(16 + 3 * limits.GROUP_MESSAGES))


def test_pause_ends_a_quick_succession(clock: Clock) -> None:
    """After a pause, the first 16 messages of the next quick succession are put at once again."""
    clock.publish(16 + limits.GROUP_MESSAGES, pause=QUICK)
    clock.publish(1, pause=1.0)
    clock.publish(15 + limits.GROUP_MESSAGES, pause=QUICK)
    assert clock.sizes == ([1] * 16 + [limits.GROUP_MESSAGES]) * 2


@pytest.mark.parametrize(("room", "size"), [(37, 37), (1, 1), (0, 1), (-5, 1)])
def test_group_ends_where_flow_control_is_due(clock: Clock, room: int, size: int) -> None:
    """A group has no more messages than flow control allows until it is due, but at least one."""
    clock.publish(16 + 2 * size, pause=QUICK, room=room)
    assert clock.sizes[16:] == [size] * 2


def test_group_is_complete_though_its_messages_were_handed_over(clock: Clock) -> None:
    """Flow control is asked after 64 messages even if the I/O thread hands over each group before it is complete."""
    clock.publish(16, pause=QUICK)
    complete = list[bool]()
    for number in range(limits.GROUP_MESSAGES):
        clock.now += QUICK
        complete.append(clock.group.add(cast("Outgoing", (str(number).encode(), None, ""))))
        if number % 10 == 9:
            clock.group.try_hand_over()
    assert complete == [False] * (limits.GROUP_MESSAGES - 1) + [True]


def test_signal_handler_leaves_the_interrupted_group_to_its_thread(clock: Clock) -> None:
    """A handler that publishes or closes while messages are put adds none twice, and the order is kept."""
    clock.publish(16 + 10, pause=QUICK)
    put = clock.group._put

    def interrupt(messages: Sequence[Outgoing]) -> None:
        if len(clock.group) == 10:
            clock.publish(1, pause=1.0)  # at once, as in a handler
            clock.group.hand_over()
        put(messages)

    clock.group._put = interrupt
    clock.group.hand_over()
    assert clock.numbers == list(range(27))
    assert clock.group.published == 27


def test_flush_waits_for_the_thread_that_is_putting(clock: Clock) -> None:
    """`hand_over` returns after all messages have been put, also those that another thread is putting."""
    clock.publish(16 + 10, pause=QUICK)
    put, began, may_end = clock.group._put, threading.Event(), threading.Event()

    def wait(messages: Sequence[Outgoing]) -> None:
        began.set()
        assert may_end.wait(DEADLINE)
        put(messages)

    clock.group._put = wait
    calls = clock.group.try_hand_over, clock.group.hand_over
    threads = [threading.Thread(target=call, daemon=True) for call in calls]
    threads[0].start()
    assert began.wait(DEADLINE)
    clock.group.try_hand_over()  # does not wait
    threads[1].start()
    threads[1].join(0.05)
    assert threads[1].is_alive()
    may_end.set()
    for thread in threads:
        thread.join(DEADLINE)
    assert clock.numbers == list(range(26))


def test_messages_that_cannot_be_put_do_not_count_as_published(clock: Clock) -> None:
    """If the bus closes, messages that were held back are discarded, and `published` does not count them."""
    clock.publish(16 + 10, pause=QUICK)
    assert clock.group.published == 26

    def fail(_: Sequence[Outgoing]) -> None:
        raise nedbus.ClosedError

    clock.group._put = fail
    with pytest.raises(nedbus.ClosedError):
        clock.group.hand_over()
    assert clock.group.published == 16


def test_interrupted_group_continues_after_the_last_message_put(clock: Clock) -> None:
    """After a Ctrl-C within a group, the messages that were not put remain, in order."""
    clock.publish(16 + 10, pause=QUICK)
    put = clock.group._put

    def interrupt(messages: Sequence[Outgoing]) -> None:
        put(messages[:4])
        raise KeyboardInterrupt

    clock.group._put = interrupt
    with pytest.raises(KeyboardInterrupt):
        clock.group.hand_over()
    assert clock.group.published == 26
    clock.group._put = put
    clock.group.hand_over()
    assert clock.numbers == list(range(26))


@pytest.fixture
def publisher(bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch) -> Iterator[nedbus.Publisher]:
    """Open a lossless publisher for which every succession is quick."""
    monkeypatch.setattr(group, "_QUICK", DEADLINE)
    with bus.publisher(VLP, vehicle="1", lossless=True) as opened:
        yield opened


def publish(publisher: nedbus.Publisher, first: int, count: int) -> None:
    for number in range(first, first + count):
        publisher.publish(message(number))


def test_message_arrives_though_no_other_follows(
    bus: nedbus.Bus, publisher: nedbus.Publisher
) -> None:
    """The messages of an incomplete group are handed over in time, again after a pause, without a flush."""
    with bus.subscribe(VLP, vehicle="1", mode="every") as subscription:
        wait_for_subscriber(publisher)
        for first in range(1, 200, 50):
            publish(publisher, first, 50)
            assert publisher.published == first + 49
            assert receive_timestamps(subscription, 50) == list(range(first, first + 50))


def test_order_is_kept_while_another_thread_hands_over(
    bus: nedbus.Bus, publisher: nedbus.Publisher
) -> None:
    """Messages keep their order, and none is lost, while the I/O thread and others hand over groups at any time."""
    count, ended = 1500, threading.Event()  # fewer than the window of flow control
    opened = cast("Any", publisher)._group

    def hand_over() -> None:
        while not ended.is_set():
            opened.hand_over()

    threads = [threading.Thread(target=hand_over, daemon=True) for _ in range(2)]
    with bus.subscribe(VLP, vehicle="1", mode="every") as subscription:
        wait_for_subscriber(publisher)
        for thread in threads:
            thread.start()
        try:
            publish(publisher, 1, count)
            assert receive_timestamps(subscription, count) == list(range(1, count + 1))
        finally:
            ended.set()
            for thread in threads:
                thread.join(DEADLINE)
        assert subscription.counts.lost == 0


@pytest.mark.parametrize("closing", ["publisher", "bus", "flush"])
def test_closing_hands_over_what_is_held_back(
    bus: nedbus.Bus, endpoint: str, monkeypatch: pytest.MonkeyPatch, closing: str
) -> None:
    """`close` of publisher and bus, even without waiting for readers, and `flush` hand over an incomplete group."""
    monkeypatch.setattr(group, "_QUICK", DEADLINE)
    monkeypatch.setattr(Heartbeats, "_run", lambda *_: 60.0)  # no timer
    other = nedbus.connect(endpoint)
    publisher = other.publisher(VLP, vehicle="1", lossless=True)
    with bus.subscribe(VLP, vehicle="1", mode="every") as subscription:
        wait_for_subscriber(publisher)
        publish(publisher, 1, 30)
        assert len(cast("Any", publisher)._group) == 14
        close = {"publisher": lambda: publisher.close(0.0), "bus": lambda: other.close(0.0)}
        close.get(closing, publisher.flush)()
        assert receive_timestamps(subscription, 30) == list(range(1, 31))


@pytest.mark.slow
def test_ctrl_c_in_zenoh_repeats_no_message(
    bus: nedbus.Bus, publisher: nedbus.Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A Ctrl-C that arrives while Zenoh takes a message is raised after it: the message counts, and is put once."""
    writer = cast("Any", publisher)._writer
    zenoh_put = writer._publisher.put
    with bus.subscribe(VLP, vehicle="1", mode="every") as subscription:
        wait_for_subscriber(publisher)
        publish(publisher, 1, 30)

        def put(*arguments: object, **options: object) -> None:
            zenoh_put(*arguments, **options)
            # another one puts a group that takes long
            if threading.current_thread() is threading.main_thread():
                monkeypatch.undo()
                raise KeyboardInterrupt

        monkeypatch.setattr(writer, "_publisher", SimpleNamespace(put=put))
        with pytest.raises(KeyboardInterrupt):
            publish(publisher, 31, 100 * limits.GROUP_MESSAGES)
        published = publisher.published
        assert publisher.flush(DEADLINE)
        assert publisher.published == published
        assert receive_timestamps(subscription, published) == list(range(1, published + 1))
        assert subscription.counts == nedbus.Counts(received=published)


def test_signal_handler_may_flush_while_flow_control_is_asked(publisher: nedbus.Publisher) -> None:
    """A signal handler that flushes or closes a publisher does not wait for a lock of the call that it interrupts."""
    publish(publisher, 1, 30)

    def flush() -> None:
        with cast("Any", publisher)._flow_control._lock:
            publisher.flush(0.0)

    handler = threading.Thread(target=flush, daemon=True)
    handler.start()
    handler.join(DEADLINE)
    assert not handler.is_alive()


def test_publish_raises_at_once_after_the_bus_is_closed(
    publisher: nedbus.Publisher, bus: nedbus.Bus
) -> None:
    """Once another thread has closed the bus, the next message raises, however quickly it follows the last one."""
    publish(publisher, 1, 30)
    bus.close(0.0)
    with pytest.raises(nedbus.ClosedError):
        publish(publisher, 31, 1)
    assert publisher.published == 30


def test_idle_publisher_costs_no_polls(publisher: nedbus.Publisher) -> None:
    """Once nothing is held back, the I/O thread no longer polls the group."""
    publish(publisher, 1, 30)
    heartbeats = cast("Any", publisher)._writer._heartbeats
    wait_for(lambda: not heartbeats._groups, what="the end of the polls")
    publish(publisher, 31, 30)
    wait_for(lambda: not cast("Any", publisher)._group, what="an empty group")
