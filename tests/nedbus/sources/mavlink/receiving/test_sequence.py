"""Losses between numbered packets: late and repeated ones, restarts of the counter, and random numbers."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from nedbus.mavlink.log_reassembly import Reassembly
from nedbus.mavlink.sequence import REPEATED, PacketRate, SequenceCounter
from tests.peers.px4_log_stream import STREAMS, datagrams, stream_message

HEADER = b"ULog\x01\x12\x35\x01" + bytes(20)


def test_reordered_and_duplicate_messages_do_not_count_as_lost() -> None:
    """Datagrams that arrive out of order, or twice, do not count as lost."""
    counter = SequenceCounter()
    arrivals = [
        (10, 0.0),
        (12, 0.2),
        (11, 0.2),
        (13, 0.3),
        (13, 0.3),
        (14, 0.4),
        (100, 3.0),
        (200, 5.9),
        (0, 8.0),
    ]
    found = [counter.add(sequence, 100.0 + seconds) for sequence, seconds in arrivals]
    assert found == [0, 1, -1, 0, 0, 0, 85, 0, 0]


def test_loss_that_the_rate_explains_is_counted() -> None:
    """A link with 100 messages/s that is cut for 1 s loses 100 messages."""
    counter = SequenceCounter()
    assert sum(counter.add(number % 256, number / 100) for number in range(1000)) == 0
    assert counter.add(1100 % 256, 11.0) == 100


def test_jump_that_the_rate_cannot_explain_is_a_restart() -> None:
    """At 10 messages/s, 100 messages cannot be lost within 0.1 s: the sender's counter restarted."""
    counter = SequenceCounter()
    for number in range(200):
        counter.add(number % 256, number / 10)
    assert counter.add(44, 20.0) == 0
    assert counter.add(46, 20.2) == 1


def test_random_sequence_numbers_lose_little() -> None:
    """460 messages with random sequence numbers do not count as more lost messages than were sent."""
    rng, counter, reassembly = random.Random(1), SequenceCounter(), Reassembly()
    reassembly.add(0, len(HEADER), 0, HEADER, 0.0)
    lost = lost_data = 0
    for number in range(460):
        lost = max(0, lost + counter.add(rng.randrange(256), number / 20))
        lost_data += reassembly.add(rng.randrange(2**16), 4, 0, b"data", number / 20).lost
    assert lost < 460
    assert lost_data < 2 * 460


@pytest.mark.logs
@pytest.mark.slow
@pytest.mark.skipif(
    not STREAMS.exists(), reason=f"no recordings of a PX4's ULog stream in {STREAMS}"
)
@pytest.mark.parametrize(("path", "lost", "lost_data"), [
    # MAVLink's sequence is unknown after the cut
    (STREAMS.parent / "link_cut_20s_in_flight.bin.gz", 21, 1475),
    (STREAMS.parent / "foreign_stop_in_flight.bin.gz", 0, 0),
    (STREAMS / "ulog_stream_lossy1.bin.gz", 607, 237),
    (STREAMS / "ulog_stream_session.bin.gz", 84, 615 + 3433),  # a reader that paused for 5 s
], ids=lambda each: getattr(each, "name", ""))  # fmt: skip
def test_losses_of_recorded_links(path: Path, lost: int, lost_data: int) -> None:
    """Losses of a real PX4 (SITL) at the recorded times are counted in full: no gap is taken for a restart."""
    counter, reassembly, found, found_data = SequenceCounter(), Reassembly(), 0, 0
    for seconds, from_vehicle, frame in datagrams(path):
        if from_vehicle and frame[6] == 1:
            found += counter.add(frame[4], seconds)
            if message := stream_message(frame):
                content = message.sequence, len(message.data), message.offset, message.data
                found_data += reassembly.add(*content, seconds).lost
    assert (found, found_data) == (lost, lost_data)


def test_gap_of_more_than_65536_messages_is_counted_in_full() -> None:
    """After a long cut, time and rate show how often the sequence number has wrapped."""
    reassembly, rate = Reassembly(), 700.0
    reassembly.add(0, len(HEADER), 0, HEADER, 0.0)
    for number in range(1, 7001):
        assert not reassembly.add(number, 4, 0, b"data", number / rate).lost
    resumed = 7000 + 70_000
    assert reassembly.add(resumed % 2**16, 4, 0, b"data", resumed / rate).lost == 69_999
    assert reassembly.add((resumed + 1) % 2**16, 4, 0, b"data", (resumed + 1) / rate).lost == 0


def test_rate_forgets_the_past() -> None:
    """The rate is that of the last seconds."""
    rate = PacketRate()
    for number in range(1000):
        rate.add(float(number))
    for number in range(4000):
        rate.add(1000 + number / 100)
    assert 80 < rate.expected(1041.0 - 0.01) < 110


def two_links(late: float, *, offset: int, loss: float) -> list[tuple[float, int, int]]:
    """Return times, sequence numbers and links of 20 s: 61 packets/s, the second link `late` seconds late.

    `offset`: first number on the second link. `loss`: share of the packets that the first link loses after 2 s.
    """
    rng = random.Random(5)
    packets = []
    for link, delay, first in ((0, 0.0, 0), (1, late, offset)):
        number = first
        for burst in range(400):
            for place in range(4 if burst % 20 == 0 else 3):
                is_lost = link == 0 and burst > 40 and rng.random() < loss
                if not is_lost:
                    packets.append((100 + 0.05 * burst + delay + 1e-4 * place, number % 256, link))
                number += 1
    return sorted(packets)


@pytest.mark.parametrize("offset", [0, 1, 7, 16, 100, 200, 255])
@pytest.mark.parametrize("late", [0.01, 0.3, 1.5, 3.0, 4.0, 5.0])
def test_second_link_loses_nothing(late: float, offset: int) -> None:
    """Two modems of one vehicle number their packets on their own: those of the second are no losses."""
    counter = SequenceCounter()
    assert (
        sum(counter.add(number, now) for now, number, _ in two_links(late, offset=offset, loss=0.0))
        == 0
    )


@pytest.mark.parametrize("late", [0.3, 1.5, 3.0, 5.0])
def test_losses_of_the_first_link_are_counted_beside_a_second_one(late: float) -> None:
    """All packets that the first link loses count, and no packet is taken for one of the other link."""
    counter, lost, links = SequenceCounter(), 0, {0: set[int](), 1: set[int]()}
    packets = two_links(late, offset=0, loss=0.02)
    missing = 2 * 1220 - len(packets)
    for now, number, link in packets:
        lost += counter.add(number, now)
        if 100 + late + 5 < now < 120:  # both send
            links[link].add(counter.link)
    assert lost == missing > 10
    assert len(links[0]) == 1
    assert links[0].isdisjoint(links[1])


def test_packet_that_came_twice_is_marked() -> None:
    """A sender that counts its packets sends no number twice; one that does not count is never marked."""
    counter = SequenceCounter()
    links = []
    for number in (10, 11, 11, 12):
        counter.add(number, 100.0)
        links.append(counter.link)
    assert links == [0, 0, REPEATED, 0]
    counter = SequenceCounter()
    for _ in range(3):
        counter.add(0, 100.0)
        assert counter.link == 0


@pytest.mark.parametrize("behind", range(1, 9))
def test_late_copy_is_marked(behind: int) -> None:
    """A copy of a packet that up to eight others of its link overtook is neither a restart nor another link."""
    counter = SequenceCounter()
    for number in range(100):
        assert counter.add(number, 100 + number / 100) == 0
    assert counter.add(99 - behind, 101.0) == 0
    assert counter.link == REPEATED
    assert counter.add(100, 101.0) == 0
    assert counter.link == 0


ORDERS = {
    "one packet overtakes two": [*range(200), 202, 200, 201, *range(203, 600)],
    "two swap": [*range(200), 201, 200, *range(202, 600)],
    "a block overtakes a block": [*range(200), *range(206, 212), *range(200, 206), *range(212, 600)],
    "two blocks alternate": [*range(200), 205, 200, 206, 201, 202, 207, 203, 204, *range(208, 600)],
    "the first of a block comes late": [*range(200), 205, 201, 202, 200, 203, 204, *range(206, 600)],
    "a block around 255": [*range(250), *range(258, 262), *range(250, 258), *range(262, 600)],
    "one packet in ten": [k + (2 if k % 10 == 4 else -1 if k % 10 in (5, 6) else 0) for k in range(600)],
}  # fmt: skip


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS)
def test_overtaken_packets_are_of_the_same_link(order: list[int]) -> None:
    """Packets of one link that arrive in another order are neither lost nor those of a second link."""
    counter, lost = SequenceCounter(), 0
    assert sorted(order) == list(range(600))
    for place, number in enumerate(order):
        lost += counter.add(number % 256, 100 + place / 100)
        assert counter.link == 0
    assert lost == 0


@pytest.mark.parametrize("loss", [0.0, 0.02])
def test_shuffled_blocks_are_of_the_same_link(loss: float) -> None:
    """Blocks of up to 16 packets in random order, with losses: all are of one link, and the losses are counted."""
    rng, kept, shuffled = random.Random(7), list[int](), list[int]()
    for number in range(6000):
        if number < 50 or rng.random() >= loss:
            kept.append(number)
    while kept:
        size = rng.choice([1, 1, 1, 1, 3, 8, 16])
        block = kept[:size]
        del kept[:size]
        if len(shuffled) > 50:
            rng.shuffle(block)
        shuffled += block
    counter, lost = SequenceCounter(), 0
    for place, number in enumerate(shuffled):
        lost += counter.add(number % 256, 100 + place / 100)
        assert counter.link == 0
    assert lost == pytest.approx(6000 - len(shuffled), abs=6000 * 0.005)


def test_second_link_a_few_packets_ahead_is_told_apart() -> None:
    """A second link that numbers its packets from 5 more: as soon as a number comes twice, it is a link of its own."""
    counter, links = SequenceCounter(), {0: set[int](), 1: set[int]()}
    for number in range(300):
        assert counter.add(number % 256, 100 + number / 100) == 0
    lost = 0
    for number in range(300, 900):
        for link, offset in ((0, 0), (1, 5)):
            lost += counter.add((number + offset) % 256, 100 + number / 100 + 0.001 * link)
            if number > 320:
                links[link].add(counter.link)
    assert lost == 0
    assert [len(each) for each in links.values()] == [1, 1]
    assert links[0].isdisjoint(links[1])


def test_packets_after_a_gap_that_is_never_filled_are_of_the_same_link() -> None:
    """If packets of an overtaken block are lost, the link goes on behind the block, and 200 packets are no new link."""
    order = [*range(200), 206, 200, 201, *range(207, 800)]
    counter, lost = SequenceCounter(), 0
    for place, number in enumerate(order):
        lost += counter.add(number % 256, 100 + place / 100)
        assert counter.link == 0
    assert lost == 4
