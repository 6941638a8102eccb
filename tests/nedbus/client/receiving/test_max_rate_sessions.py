"""A subscription with a maximum rate, through a real router: arrivals, bytes on the link, and counts.

Publishers downsample by a fake clock, at 10 ms per message, whatever the speed of the machine.
"""

from __future__ import annotations

import math
import time
from contextlib import closing, suppress
from typing import Any

import pytest
import zenoh

import nedbus
from nedbus import Mode
from nedbus.client.publishing.downsampler import Downsampler
from nedbus.client.rate_gate import rate_step
from nedbus.timings import Timings
from nedbus.transport import Session
from nedbus_msgs import RATE, Address, AddressError, Selection
from tests.flights.local_position import encode
from tests.flights.messages import VLP, message
from tests.nedbus.client.downsampling import MS, Clock, Link, clock, is_wanted, publish, take_last, wait_for_demand
from tests.nedbus.client.numbered import is_read, take, wait_for_subscriber
from tests.peers.processes import Start
from tests.peers.queryables import answer_queries, reply_with
from tests.waits import DEADLINE, wait_for

__all__ = ["Clock", "clock", "publish", "take", "wait_for_demand"]  # for others that thin

BOTH: list[Mode] = ["latest", "every"]


@pytest.mark.parametrize("mode", BOTH)
@pytest.mark.parametrize("max_rate", [1, 7.5, 20, 99])
def test_exact_rate_arrives(client: nedbus.Bus, bus: nedbus.Bus, clock: Clock, mode: Mode, max_rate: float) -> None:
    """Of 10 s at 100 Hz, 10 times the rate arrive, evenly spaced, after the last message; the rest is not lost."""
    step = rate_step(max_rate)
    publisher = bus.publisher(VLP, vehicle="7")
    publisher.publish(message(0))
    subscription = client.subscribe(VLP, mode=mode, max_rate=max_rate)
    take_last(publisher, subscription)
    timestamps = []
    for first in range(1, 1001, 100 // step):  # no more at once than a reader of mode "latest" can take one by one
        publish(publisher, clock, first, 100 // step)
        timestamps += take(subscription, 1)
    assert timestamps == list(range(1, 1001, 100 // step))
    assert subscription.counts == nedbus.Counts(received=1 + 10 * step)


def test_invalid_rate_is_refused(client: nedbus.Bus) -> None:
    """An invalid rate is an ArgumentError that names it, with either client."""
    with pytest.raises(nedbus.ArgumentError, match="max_rate 0 is not valid: expected messages per second"):
        client.subscribe(max_rate=0)
    with pytest.raises(nedbus.ArgumentError, match="max_rate nan is not valid"):
        client.subscribe_to(Selection(VLP), max_rate=math.nan)


def test_every_topic_and_vehicle(bus: nedbus.Bus, clock: Clock) -> None:
    """Each stream of a selection is downsampled separately, with its address and instance."""
    addresses = [Address("1", VLP), Address("2", VLP), Address("2", "estimator_local_position", 3)]
    publishers = [bus.publisher(each.topic, vehicle=each.vehicle, instance=each.instance) for each in addresses]
    for publisher in publishers:
        publisher.publish(message(0))
    with bus.subscribe("*", mode="every", max_rate=10) as subscription:
        for publisher in publishers:
            take_last(publisher, subscription)
        for timestamp in range(1, 101):
            clock.now += 10 * MS
            for publisher in publishers:
                publisher.publish(message(timestamp))
        taken = [subscription.receive(DEADLINE) for _ in range(30)]
    for address in addresses:
        assert [each.message.timestamp for each in taken if each.address == address] == list(range(1, 101, 10))


def test_messages_arrive_as_they_were(bus: nedbus.Bus, clock: Clock) -> None:
    """Payload, source, missing fields and time of sending are those of the original stream."""
    publisher = bus.publisher(VLP, vehicle="7", source="ins")
    with bus.subscribe(VLP, mode="every") as whole, bus.subscribe(VLP, mode="every", max_rate=5) as downsampled:
        wait_for_demand(publisher)
        wait_for_subscriber(publisher)
        clock.now += 10 * MS
        publisher.publish({"timestamp": 5, "x": 0.1})
        one, other = whole.receive(DEADLINE), downsampled.receive(DEADLINE)
    assert (one.message, one.address, one.sent) == (other.message, other.address, other.sent)
    assert (other.source, other.missing) == (one.source, one.missing) == ("ins", one.missing)
    assert "y" in other.missing


def test_array_is_downsampled(bus: nedbus.Bus, clock: Clock) -> None:
    """publish_many is downsampled too: messages sent at once count as one moment."""
    publisher = bus.publisher(VLP, vehicle="7")
    publisher.publish(message(0))
    with bus.subscribe(VLP, mode="every", max_rate=5) as subscription:
        take_last(publisher, subscription)
        array = nedbus.to_array([message(timestamp) for timestamp in range(1, 101)])
        publisher.publish_many(array)
        clock.now += 200 * MS
        publisher.publish_many(array)
        assert take(subscription, 2) == [1, 1]


def thinned_by(zenoh_session: Session) -> list[str]:
    """Return the declared downsampled streams, by their liveliness tokens."""
    return [str(reply.ok.key_expr) for reply in zenoh_session.liveliness().get("nedbus/**/@rate/*") if reply.ok]


def test_nothing_is_declared_without_readers(bus: nedbus.Bus, zenoh_session: Session, clock: Clock) -> None:
    """Downsampled streams are declared for their readers only, and withdrawn a minute after the last one."""
    publisher, other = (bus.publisher(VLP, vehicle=vehicle) for vehicle in "78")
    subscription = bus.subscribe(VLP, mode="every")
    wait_for_subscriber(publisher)
    publish(publisher, clock, 1, 10)
    assert take(subscription, 10) == list(range(1, 11))
    assert thinned_by(zenoh_session) == []
    for _ in range(2):
        with bus.subscribe(VLP, vehicle="7", mode="every", max_rate=5):
            wait_for_demand(publisher)
            publish(publisher, clock, 11, 2)
            publish(other, clock, 11, 2)
            wait_for(lambda: thinned_by(zenoh_session) == [f"{publisher.key}/@rate/5"], what="the downsampled stream")
        wait_for(lambda: not is_wanted(publisher), what="the end of the demand")
        publish(publisher, clock, 13, 3000)
        assert thinned_by(zenoh_session)

        def withdraws() -> bool:
            clock.now += 61_000 * MS
            publish(publisher, clock, 4000, 1)
            return not thinned_by(zenoh_session)

        wait_for(withdraws, what="the end of the downsampled stream")


def test_listener_ends_with_the_last_publisher_of_a_vehicle(bus: nedbus.Bus, clock: Clock) -> None:
    """Closed publishers leave no declarations, and a new one of the same vehicle is downsampled again."""
    first = bus.publisher(VLP, vehicle="8")
    first.publish(message(0))
    with bus.subscribe(VLP, mode="every", max_rate=5) as subscription:
        take_last(first, subscription)
        first.close()
        for start in (1000, 1):  # a vehicle that restarts: its timestamps start again
            with bus.publisher(VLP, vehicle="7") as publisher:
                wait_for_demand(publisher)
                publish(publisher, clock, start, 100)
                assert take(subscription, 5) == list(range(start, start + 100, 20))
            assert not bus._publishers._matched  # not visible from outside
        assert subscription.counts == nedbus.Counts(received=11)


def test_storage_is_no_vehicle(bus: nedbus.Bus, zenoh_session: Session, clock: Clock) -> None:
    """A subscription starts with the last messages of publishers, not with those of a storage."""
    stored = reply_with({f"nedbus/8/{VLP}": encode(message(99))}, timestamp=zenoh_session.new_timestamp())
    publisher = bus.publisher(VLP, vehicle="7")
    publisher.publish(message(1))
    with answer_queries(zenoh_session, f"nedbus/*/{VLP}", stored), bus.subscribe(VLP, max_rate=5) as subscription:
        assert subscription.receive(DEADLINE).vehicle == "7"
        wait_for_demand(publisher)
        publish(publisher, clock, 2, 1)
        assert subscription.receive(DEADLINE).vehicle == "7"


def publish_over_a_break(
    publisher: nedbus.Publisher, subscription: nedbus.Subscription[Any], clock: Clock, link: Link, seconds: int
) -> list[nedbus.Sample[Any]]:
    """Publish 1 s of 100 Hz, the rest while the link is down and after; return all that arrived until a later one."""
    take_last(publisher, subscription)
    taken = []
    for first in range(1, 101, 20):
        publish(publisher, clock, first, 20)
        taken.append(subscription.receive(DEADLINE))
    link.cut()
    wait_for(lambda: not is_wanted(publisher), what="the end of the link")
    last = 100 + 100 * seconds
    publish(publisher, clock, 101, last - 100)
    link.broken = False
    wait_for_demand(publisher)
    end = last

    def publish_one_and_take() -> bool:
        nonlocal end
        end += 1
        publish(publisher, clock, end, 1)
        with suppress(nedbus.NoDataError):
            taken.append(subscription.receive(0.01))
        return bool(taken[-1].message.timestamp > last)

    wait_for(publish_one_and_take, what="a message from after the break")
    return taken


@pytest.mark.parametrize(("mode", "seconds"), [("every", 10), ("every", 40), ("latest", 10)])
def test_broken_link(endpoint: str, bus: nedbus.Bus, clock: Clock, mode: Mode, seconds: int) -> None:
    """Losses of a downsampled stream are recovered in mode "every" for 20 s after a broken link; others are counted."""
    publisher = bus.publisher(VLP, vehicle="7")
    publisher.publish(message(0))
    with (
        closing(Link(endpoint)) as link,
        nedbus.connect(link.endpoint) as other,
        other.subscribe(VLP, mode=mode, max_rate=5) as subscription,
    ):
        taken = publish_over_a_break(publisher, subscription, clock, link, seconds)
        counts = subscription.counts
    timestamps = [sample.message.timestamp for sample in taken]
    sent = list(range(1, timestamps[-1] + 1, 20))
    assert set(timestamps) <= set(sent)
    assert timestamps == sorted(set(timestamps))
    lost = len(sent) - len(timestamps)
    assert sum(sample.lost for sample in taken) == lost
    assert counts == nedbus.Counts(received=1 + len(timestamps), lost=lost)
    if mode == "latest":
        assert lost >= 5 * seconds - 1
    else:
        assert lost == 0 if seconds == 10 else lost > 0


def test_lossless_publisher_does_not_wait(endpoint: str, bus: nedbus.Bus) -> None:
    """A replay at full speed does not wait for a downsampling reader that does not read, nor sends it more."""
    publisher = bus.publisher(VLP, vehicle="7", lossless=True)
    with nedbus.connect(endpoint) as other, other.subscribe(VLP, mode="every", max_rate=1) as subscription:
        wait_for_demand(publisher)
        start = time.monotonic()

        def reads_downsampled() -> bool:
            publisher.publish(message(0))
            return bool(subscription.waiting)

        wait_for(reads_downsampled, what="the first message")
        for timestamp in range(1, 10_001):
            publisher.publish(message(timestamp))
        assert publisher.flush(DEADLINE)
        seconds = time.monotonic() - start
        assert subscription.waiting <= seconds + 2


@pytest.mark.parametrize(("mode", "thin"), [("latest", "reader"), ("every", "vehicle")])
def test_thin_link_carries_the_requested_rate(endpoint: str, clock: Clock, mode: Mode, thin: str) -> None:
    """5 Hz of a 100 Hz stream take less than 5 kB/s of a link, at the reader's or the vehicle's end."""
    with closing(Link(endpoint)) as link:
        near, far = (link.endpoint, endpoint) if thin == "reader" else (endpoint, link.endpoint)
        with nedbus.connect(far) as vehicle, nedbus.connect(near) as reader:
            publisher = vehicle.publisher(VLP, vehicle="7")
            publisher.publish(message(0))
            subscription = reader.subscribe(VLP, mode=mode, max_rate=5)
            take_last(publisher, subscription)
            carried = link.carried
            timestamps = []
            for first in range(1, 1001, 20):
                publish(publisher, clock, first, 20)
                timestamps += take(subscription, 1)
            assert timestamps == list(range(1, 1001, 20))
            assert link.carried - carried < 10 * 5000  # 10 s at 100 Hz
            assert subscription.counts == nedbus.Counts(received=1 + 50)


def test_publisher_that_does_not_downsample_is_named(
    endpoint: str,
    bus: nedbus.Bus,
    clock: Clock,
    monkeypatch: pytest.MonkeyPatch,
    *,
    timings: Timings,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A stream that is not downsampled does not arrive, which is logged once; no stream is read at full rate."""
    put, cannot = Downsampler.put, []
    monkeypatch.setattr(Downsampler, "put", lambda self, *args: None if self in cannot else put(self, *args))
    publishers = [bus.publisher(VLP, vehicle=vehicle) for vehicle in ("7", "8")]
    cannot.append(publishers[1]._downsampler)
    with nedbus.connect(endpoint) as other, other.subscribe(VLP, mode="every", max_rate=10) as subscription:
        wait_for_demand(publishers[0])
        for publisher in publishers:
            publish(publisher, clock, 1, 20)
        assert take(subscription, 2) == [1, 11]
        assert not any(map(is_read, publishers))
        with pytest.raises(nedbus.NoDataError, match="/@rate/10 within"):
            subscription.receive(timeout=0.0)
        timings.downsampled_timeout = 0.0
        wait_for(lambda: "not downsampled" in caplog.text, what="the warning")
        assert caplog.text.count("1 streams are not received") == caplog.text.count(publishers[1].key) == 1
        assert subscription.counts == nedbus.Counts(received=2)


def test_echo(run_nedbus: Start, endpoint: str, bus: nedbus.Bus, clock: Clock) -> None:
    """`nedbus echo --max-rate 5` prints every 20th message of 100 Hz."""
    publisher = bus.publisher(VLP, vehicle="7")
    publisher.publish(message(0))
    echo = run_nedbus("echo", "-c", endpoint, "--max-rate", "5", "--every", "--csv", "--field", "timestamp", "-n", "51")
    wait_for(lambda: len(echo.out.splitlines()) > 1, what="the last message")
    wait_for_demand(publisher)
    publish(publisher, clock, 1, 1000)
    assert echo.wait() == 0, echo.err
    head, *rows = echo.out.splitlines()
    column = head.split(",").index("timestamp")
    assert [int(row.split(",")[column]) for row in rows] == [0, *range(1, 1001, 20)]
    assert echo.err == "51 received, 0 lost, 0 dropped, 0 invalid\n"


def test_rate_keys() -> None:
    """The key of a downsampled stream is the key of the stream, a chunk that no wildcard matches, and the rate."""
    address = Address("7", "estimator_local_position", 1)
    assert address.rate_key(5) == "nedbus/7/estimator_local_position/1/@rate/5"
    assert Address.from_key(address.rate_key(5).partition(RATE)[0]) == address
    assert Selection().rate_key_expr(5) == "nedbus/*/**/@rate/5"
    assert Selection(VLP, "7").rate_key_expr("*", prefix="a/b") == f"a/b/7/{VLP}/@rate/*"
    assert Selection(VLP, "7").alive_key_expr(prefix="a/b") == f"a/b/7/@alive/*/{VLP}"
    assert Selection().alive_key_expr() == "nedbus/*/@alive/*/**"
    assert Selection("estimator_local_position").alive_key_expr() == "nedbus/*/@alive/*/estimator_local_position/*"
    assert not zenoh.KeyExpr("nedbus/**").intersects(address.rate_key(5))
    assert zenoh.KeyExpr(Selection().rate_key_expr(5)).intersects(address.rate_key(5))
    with pytest.raises(AddressError):
        Address.from_key(address.rate_key(5))
