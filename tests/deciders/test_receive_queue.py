"""The receive queue: what a reader gets that is slower than the data, and what is counted; with samples made by hand.

Samples of Zenoh cannot be made in Python: these have the attributes that are read of one.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import cast

import msgpack
import pytest
import zenoh

import nedbus
from nedbus import Counts, Mode
from nedbus.client.decoder import Decoder
from nedbus.client.layout_lookup import LayoutLookup
from nedbus.client.receive_queue import CAPACITY, ReceiveQueue
from nedbus.transport import RawSample
from nedbus_msgs import decode, decode_row, encode
from tests.conftest import DEADLINE, message

KEY = "nedbus/1/vehicle_local_position"


class Payload(bytes):
    """Zenoh's bytes."""

    def to_bytes(self) -> bytes:
        return bytes(self)


@dataclass
class Raw:
    """What is read of a sample of Zenoh."""

    payload: Payload
    key_expr: str = KEY
    source_info: object = None
    kind: zenoh.SampleKind = field(default_factory=lambda: zenoh.SampleKind.PUT)
    encoding: str = "application/msgpack;px4_msgs/VehicleLocalPosition;source=sim"
    timestamp: object = None


def raw(number: int | None, *, timestamp: int = 1, key: str = KEY, publisher: str = "a") -> RawSample:
    """Return a sample with a publisher's sequence number, None for one without."""
    info = None if number is None else SimpleNamespace(source_sn=number, source_id=publisher)
    return cast("RawSample", Raw(Payload(encode(message(timestamp))), key, info))


def junk(payload: bytes, key: str = KEY) -> RawSample:
    return cast("RawSample", Raw(Payload(payload), key))


def miss(count: int, publisher: str = "a") -> zenoh.ext.Miss:
    return cast("zenoh.ext.Miss", SimpleNamespace(source=publisher, nb=count))


def make_queue(mode: Mode, *, layouts: dict[int, Sequence[str]] | None = None) -> ReceiveQueue:
    return ReceiveQueue(mode, Decoder(LayoutLookup((layouts or {}).get), prefix="nedbus"))


def drain(receive_queue: ReceiveQueue) -> list[nedbus.Sample]:
    taken = []
    while (sample := receive_queue.pop(decode)) is not None:
        taken.append(sample)
    return taken


def test_every_gives_all_in_order_with_their_losses() -> None:
    """Each sample once, in the order of its arrival; a gap in the sequence is told by the sample behind it."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(0), raw(1), raw(5)])
    assert [sample.lost for sample in drain(receive_queue)] == [0, 0, 3]
    assert receive_queue.counts == Counts(received=3, lost=3)


def test_latest_gives_the_newest_of_each_key() -> None:
    """A newer sample of a key takes the place of the one that waits, which is counted as dropped."""
    receive_queue = make_queue("latest")
    other = KEY.replace("/1/", "/2/")
    receive_queue.put([raw(0, timestamp=1), raw(0, key=other, publisher="b"), raw(1, timestamp=2), raw(2, timestamp=3)])
    assert [(sample.vehicle, sample.message.timestamp) for sample in drain(receive_queue)] == [("1", 3), ("2", 1)]
    assert receive_queue.counts == Counts(received=2, dropped=2)


def test_latest_keeps_the_losses_of_what_it_supersedes() -> None:
    """What was lost before a sample that nobody read is told by the one that is read."""
    receive_queue = make_queue("latest")
    receive_queue.put([raw(0)])
    receive_queue.announce_loss(miss(2))
    receive_queue.put([raw(3), raw(4)])
    [sample] = drain(receive_queue)
    assert sample.lost == 2
    assert receive_queue.counts == Counts(received=1, lost=2, dropped=2)


def test_loss_before_an_invalid_sample_is_told_by_the_next() -> None:
    """An invalid sample takes no loss with it."""
    receive_queue = make_queue("every")
    bad = cast("RawSample", Raw(Payload(bytes(244)), KEY, SimpleNamespace(source_sn=3, source_id="a")))
    receive_queue.put([raw(0), bad, raw(4)])
    assert [sample.lost for sample in drain(receive_queue)] == [0, 2]
    assert receive_queue.counts == Counts(received=2, lost=2, invalid=1)


def test_invalid_samples_are_counted_and_logged_once_for_each_key(caplog: pytest.LogCaptureFixture) -> None:
    """Whatever arrives, the good samples come through, and a flood of junk writes one line."""
    receive_queue = make_queue("every")
    wrong_key = raw(None, key="nedbus/*/vehicle_local_position")
    receive_queue.put([junk(b"junk"), junk(b""), junk(bytes(5000)), wrong_key, raw(None, timestamp=7)])
    assert [sample.message.timestamp for sample in drain(receive_queue)] == [7]
    assert receive_queue.counts == Counts(received=1, invalid=4)
    assert len(caplog.messages) == 2


def test_junk_does_not_supersede_a_valid_sample() -> None:
    """What has not the size of our payloads is decoded before it may take a place."""
    receive_queue = make_queue("latest")
    receive_queue.put([raw(0, timestamp=5), junk(b"junk")])
    assert [sample.message.timestamp for sample in drain(receive_queue)] == [5]


def test_unknown_layout_is_looked_up() -> None:
    """A layout that a publisher explains is read by name."""
    receive_queue = make_queue("every", layouts={9: ("timestamp", "brand_new", "x")})
    receive_queue.put([junk(msgpack.packb([9, 4, True, 2.5])), junk(msgpack.packb([8, 4, True, 2.5]))])
    [sample] = drain(receive_queue)
    assert (sample.message.timestamp, sample.message.x) == (4, 2.5)
    assert receive_queue.counts.invalid == 1


def test_unexplained_layout_is_asked_for_again_after_a_while() -> None:
    """Not for every message, and not only once: its publisher may come later."""
    now, asked = [0.0], list[int]()
    lookup = LayoutLookup(asked.append, now=lambda: now[0])
    payload = msgpack.packb([9, 1, 2])
    for now[0] in (0.0, 1.0, 9.0, 11.0, 12.0):
        with pytest.raises(nedbus.UnknownLayoutError):
            lookup.check(payload)
    assert asked == [9, 9]


def test_rows_and_messages_come_from_one_queue() -> None:
    """A reader may change its form at any time."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(0, timestamp=1), raw(1, timestamp=2)])
    row = receive_queue.pop(decode_row)
    assert row is not None
    assert isinstance(row.message, nedbus.Row)
    assert [sample.message.timestamp for sample in drain(receive_queue)] == [2]


def test_batch_tells_announced_losses_once() -> None:
    """Losses come with the next batch, also those that were announced while nothing was queued."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(0)])
    assert receive_queue.pop_batch() is not None
    receive_queue.announce_loss(miss(3))
    assert receive_queue.pop_batch() is None
    receive_queue.put([raw(4), raw(5)])
    batch = receive_queue.pop_batch()
    assert batch is not None
    assert (len(batch), batch.lost) == (2, 3)
    assert receive_queue.counts == Counts(received=3, lost=3)


@pytest.mark.parametrize("ended", [False, True])
def test_pump_waits_for_capacity(ended: bool) -> None:
    """A full queue of mode every holds its pump until the reader has taken half of it, or the queue has ended."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(None)] * CAPACITY)
    waited = threading.Event()

    def pump() -> None:
        receive_queue.wait_for_capacity()
        waited.set()

    thread = threading.Thread(target=pump, daemon=True)
    thread.start()
    if ended:
        receive_queue.end()
    else:
        for _ in range(CAPACITY // 2):
            receive_queue.pop(decode)
    assert waited.wait(DEADLINE)
    thread.join(DEADLINE)


def test_latest_never_waits_for_capacity() -> None:
    """A reader of the newest messages that reads nothing holds nobody back."""
    receive_queue = make_queue("latest")
    receive_queue.put([raw(number) for number in range(10 * CAPACITY)])
    receive_queue.wait_for_capacity()
    assert receive_queue.counts.dropped == 10 * CAPACITY - 1


def test_wait_ends_with_data_with_the_queue_or_with_its_timeout() -> None:
    """Three ends of a wait, told apart."""
    receive_queue = make_queue("every")
    assert not receive_queue.wait(0.0)
    receive_queue.put([raw(0)])
    assert receive_queue.wait(None)
    drain(receive_queue)
    assert not receive_queue.wait(0.0)
    receive_queue.end()
    assert receive_queue.wait(None)


def test_unknown_mode_is_an_error() -> None:
    """A typo in the mode must not become another mode."""
    with pytest.raises(nedbus.AddressError, match="expected one of latest, every"):
        make_queue(cast("Mode", "newest"))
