"""A subscription with a maximum rate, through a real router: messages, bytes on the link, and counts.

Publishers use a fake clock, 10 ms per message, so the speed of the machine does not matter.
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
from tests.nedbus.client.downsampling import (
    MS,
    Clock,
    Link,
    clock,
    has_downsampling_reader,
    publish,
    take_last,
    wait_for_downsampling_reader,
)
from tests.nedbus.client.numbered import has_subscriber, receive_timestamps, wait_for_subscriber
from tests.peers.processes import Start
from tests.peers.queryables import answer_queries, reply_with
from tests.waits import DEADLINE, wait_for

__all__ = ["clock"]  # a fixture

BOTH: list[Mode] = ["latest", "every"]


@pytest.mark.parametrize("mode", BOTH)
@pytest.mark.parametrize("max_rate", [1, 7.5, 20, 99])
def test_requested_rate_is_received(
    client: nedbus.Bus, bus: nedbus.Bus, clock: Clock, mode: Mode, max_rate: float
) -> None:
    """A 100 Hz stream arrives evenly at the requested rate for 10 s; omitted messages do not count as lost."""
    step = rate_step(max_rate)
    publisher = bus.publisher(VLP, vehicle="7")
    publisher.publish(message(0))
    subscription = client.subscribe(VLP, mode=mode, max_rate=max_rate)
    take_last(publisher, subscription)
    timestamps = []
    for first in range(1, 1001, 100 // step):  # one message per step, so mode "latest" drops none
        publish(publisher, clock, first, 100 // step)
        timestamps += receive_timestamps(subscription, 1)
    assert timestamps == list(range(1, 1001, 100 // step))
    assert subscription.counts == nedbus.Counts(received=1 + 10 * step)


def test_invalid_max_rate_raises(client: nedbus.Bus) -> None:
    """Both clients raise ArgumentError for an invalid `max_rate`."""
    with pytest.raises(
        nedbus.ArgumentError, match="max_rate 0 is not valid: expected messages per second"
    ):
        client.subscribe(max_rate=0)
    with pytest.raises(nedbus.ArgumentError, match="max_rate nan is not valid"):
        client.subscribe(VLP, max_rate=math.nan)


def test_each_stream_is_downsampled_separately(bus: nedbus.Bus, clock: Clock) -> None:
    """Each stream of a selection is downsampled separately and keeps its address and instance."""
    addresses = [Address("1", VLP), Address("2", VLP), Address("2", "estimator_local_position", 3)]
    publishers = [
        bus.publisher(each.topic, vehicle=each.vehicle, instance=each.instance)
        for each in addresses
    ]
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
        assert [each.message.timestamp for each in taken if each.address == address] == list(
            range(1, 101, 10)
        )


def test_downsampled_messages_are_unchanged(bus: nedbus.Bus, clock: Clock) -> None:
    """Downsampled messages have the payload, source, missing fields and time of sending of the original stream."""
    publisher = bus.publisher(VLP, vehicle="7", source="ins")
    with (
        bus.subscribe(VLP, mode="every") as full,
        bus.subscribe(VLP, mode="every", max_rate=5) as downsampled,
    ):
        wait_for_downsampling_reader(publisher)
        wait_for_subscriber(publisher)
        clock.now += 10 * MS
        publisher.publish({"timestamp": 5, "x": 0.1})
        one, other = full.receive(DEADLINE), downsampled.receive(DEADLINE)
    assert (one.message, one.address, one.sent) == (other.message, other.address, other.sent)
    assert (other.source, other.missing) == (one.source, one.missing) == ("ins", one.missing)
    assert "y" in other.missing


def test_publish_many_is_downsampled(bus: nedbus.Bus, clock: Clock) -> None:
    """Each `publish_many` call passes one message, because it sends all its messages at the same clock time."""
    publisher = bus.publisher(VLP, vehicle="7")
    publisher.publish(message(0))
    with bus.subscribe(VLP, mode="every", max_rate=5) as subscription:
        take_last(publisher, subscription)
        array = nedbus.to_array([message(timestamp) for timestamp in range(1, 101)])
        publisher.publish_many(array)
        clock.now += 200 * MS
        publisher.publish_many(array)
        assert receive_timestamps(subscription, 2) == [1, 1]


def downsampled_streams(zenoh_session: Session) -> list[str]:
    """Return the declared downsampled streams, by their liveliness tokens."""
    return [
        str(reply.ok.key_expr)
        for reply in zenoh_session.liveliness().get("nedbus/**/@rate/*")
        if reply.ok
    ]


@pytest.mark.slow
def test_downsampled_streams_are_declared_only_while_they_have_readers(
    bus: nedbus.Bus, zenoh_session: Session, clock: Clock
) -> None:
    """Downsampled streams are declared once they have readers, and undeclared a minute after the last one closed."""
    publisher, other = (bus.publisher(VLP, vehicle=vehicle) for vehicle in "78")
    subscription = bus.subscribe(VLP, mode="every")
    wait_for_subscriber(publisher)
    publish(publisher, clock, 1, 10)
    assert receive_timestamps(subscription, 10) == list(range(1, 11))
    assert downsampled_streams(zenoh_session) == []
    for _ in range(2):
        with bus.subscribe(VLP, vehicle="7", mode="every", max_rate=5):
            wait_for_downsampling_reader(publisher)
            publish(publisher, clock, 11, 2)
            publish(other, clock, 11, 2)
            wait_for(
                lambda: downsampled_streams(zenoh_session) == [f"{publisher.key}/@rate/5"],
                what="the downsampled stream",
            )
        wait_for(lambda: not has_downsampling_reader(publisher), what="the reader to leave")
        publish(publisher, clock, 13, 3000)
        assert downsampled_streams(zenoh_session)

        def are_undeclared() -> bool:
            clock.now += 61_000 * MS
            publish(publisher, clock, 4000, 1)
            return not downsampled_streams(zenoh_session)

        wait_for(are_undeclared, what="the end of the downsampled stream")


def test_closed_publishers_leave_no_listeners(bus: nedbus.Bus, clock: Clock) -> None:
    """Closing the last publisher of a vehicle undeclares its listener; a new publisher is downsampled again."""
    first = bus.publisher(VLP, vehicle="8")
    first.publish(message(0))
    with bus.subscribe(VLP, mode="every", max_rate=5) as subscription:
        take_last(first, subscription)
        first.close()
        for start in (1000, 1):  # a restart resets timestamps
            with bus.publisher(VLP, vehicle="7") as publisher:
                wait_for_downsampling_reader(publisher)
                publish(publisher, clock, start, 100)
                assert receive_timestamps(subscription, 5) == list(range(start, start + 100, 20))
            assert not bus._publishers._rate_listeners  # no public API shows listeners
        assert subscription.counts == nedbus.Counts(received=11)


def test_last_messages_of_a_storage_are_ignored(
    bus: nedbus.Bus, zenoh_session: Session, clock: Clock
) -> None:
    """A subscription with a maximum rate starts with the last messages of publishers, not of a storage."""
    stored = reply_with(
        {f"nedbus/8/{VLP}": encode(message(99))}, timestamp=zenoh_session.new_timestamp()
    )
    publisher = bus.publisher(VLP, vehicle="7")
    publisher.publish(message(1))
    with (
        answer_queries(zenoh_session, f"nedbus/*/{VLP}", stored),
        bus.subscribe(VLP, max_rate=5) as subscription,
    ):
        assert subscription.receive(DEADLINE).vehicle == "7"
        wait_for_downsampling_reader(publisher)
        publish(publisher, clock, 2, 1)
        assert subscription.receive(DEADLINE).vehicle == "7"


def publish_across_outage(
    publisher: nedbus.Publisher,
    subscription: nedbus.Subscription[Any],
    clock: Clock,
    link: Link,
    seconds: int,
) -> list[nedbus.Sample[Any]]:
    """Publish at 100 Hz for 1 s, then for `seconds` in an outage; return the samples up to the first one after it."""
    take_last(publisher, subscription)
    taken = []
    for first in range(1, 101, 20):
        publish(publisher, clock, first, 20)
        taken.append(subscription.receive(DEADLINE))
    link.cut()
    wait_for(lambda: not has_downsampling_reader(publisher), what="the end of the link")
    last = 100 + 100 * seconds
    publish(publisher, clock, 101, last - 100)
    link.broken = False
    wait_for_downsampling_reader(publisher)
    end = last

    def publish_and_receive() -> bool:
        nonlocal end
        end += 1
        publish(publisher, clock, end, 1)
        with suppress(nedbus.NoDataError):
            taken.append(subscription.receive(0.01))
        return bool(taken[-1].message.timestamp > last)

    wait_for(publish_and_receive, what="a message from after the outage")
    return taken


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "seconds"), [("every", 10), ("every", 40), ("latest", 10)])
def test_losses_in_an_outage_of_up_to_20_s_are_recovered(
    endpoint: str, bus: nedbus.Bus, clock: Clock, mode: Mode, seconds: int
) -> None:
    """In mode "every", losses of a downsampled stream in an outage of up to 20 s are recovered.

    Losses in a longer outage, or in mode "latest", are counted.
    """
    publisher = bus.publisher(VLP, vehicle="7")
    publisher.publish(message(0))
    with (
        closing(Link(endpoint)) as link,
        nedbus.connect(link.endpoint) as other,
        other.subscribe(VLP, mode=mode, max_rate=5) as subscription,
    ):
        taken = publish_across_outage(publisher, subscription, clock, link, seconds)
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


@pytest.mark.slow
def test_lossless_publisher_does_not_wait_for_downsampling_reader(
    endpoint: str, bus: nedbus.Bus
) -> None:
    """A lossless publisher neither waits for a reader of a downsampled stream nor exceeds the rate of that stream."""
    publisher = bus.publisher(VLP, vehicle="7", lossless=True)
    with (
        nedbus.connect(endpoint) as other,
        other.subscribe(VLP, mode="every", max_rate=1) as subscription,
    ):
        wait_for_downsampling_reader(publisher)
        start = time.monotonic()

        def has_arrived() -> bool:
            publisher.publish(message(0))
            return bool(subscription.waiting)

        wait_for(has_arrived, what="the first message")
        for timestamp in range(1, 10_001):
            publisher.publish(message(timestamp))
        assert publisher.flush(DEADLINE)
        seconds = time.monotonic() - start
        assert subscription.waiting <= seconds + 2


@pytest.mark.parametrize(("mode", "slow_end"), [("latest", "reader"), ("every", "vehicle")])
def test_slow_link_carries_only_the_requested_rate(
    endpoint: str, clock: Clock, mode: Mode, slow_end: str
) -> None:
    """With `max_rate=5`, a 100 Hz stream needs less than 5 kB/s on the reader's link and on the vehicle's link."""
    with closing(Link(endpoint)) as link:
        near, far = (link.endpoint, endpoint) if slow_end == "reader" else (endpoint, link.endpoint)
        with nedbus.connect(far) as vehicle, nedbus.connect(near) as reader:
            publisher = vehicle.publisher(VLP, vehicle="7")
            publisher.publish(message(0))
            subscription = reader.subscribe(VLP, mode=mode, max_rate=5)
            take_last(publisher, subscription)
            carried = link.carried
            timestamps = []
            for first in range(1, 1001, 20):
                publish(publisher, clock, first, 20)
                timestamps += receive_timestamps(subscription, 1)
            assert timestamps == list(range(1, 1001, 20))
            assert link.carried - carried < 10 * 5000  # 10 s at 100 Hz
            assert subscription.counts == nedbus.Counts(received=1 + 50)


@pytest.mark.slow
def test_stream_that_is_not_downsampled_is_logged_once(
    endpoint: str,
    bus: nedbus.Bus,
    clock: Clock,
    monkeypatch: pytest.MonkeyPatch,
    *,
    timings: Timings,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A stream that its publisher does not downsample is not received, not even at full rate; this is logged once."""
    put, disabled = Downsampler.put, []
    monkeypatch.setattr(
        Downsampler, "put", lambda self, *args: None if self in disabled else put(self, *args)
    )
    publishers = [bus.publisher(VLP, vehicle=vehicle) for vehicle in ("7", "8")]
    disabled.append(publishers[1]._downsampler)
    for publisher in publishers:
        publisher.publish(message(0))
    with (
        nedbus.connect(endpoint) as other,
        other.subscribe(VLP, mode="every", max_rate=10) as subscription,
    ):
        assert receive_timestamps(subscription, 1) == [0]
        take_last(publishers[0], subscription)
        for publisher in publishers:
            publish(publisher, clock, 1, 20)
        assert receive_timestamps(subscription, 2) == [1, 11]
        assert not any(map(has_subscriber, publishers))
        with pytest.raises(nedbus.NoDataError, match="/@rate/10 within"):
            subscription.receive(timeout=0.0)
        timings.downsampled_timeout = 0.0
        wait_for(lambda: "no downsampled messages" in caplog.text, what="the warning")
        assert (
            caplog.text.count(f"of {publishers[1].key} arrive")
            == caplog.text.count(publishers[1].key)
            == 1
        )
        assert subscription.counts == nedbus.Counts(received=4)


@pytest.mark.long
def test_vehicle_with_too_many_tokens_hides_no_stream_without_downsampling(
    endpoint: str,
    bus: nedbus.Bus,
    zenoh_session: Session,
    clock: Clock,
    *,
    timings: Timings,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """2,000 liveliness tokens of one vehicle neither delay the messages of others nor hide that some do not arrive.

    The tokens are listed on another session, without the vehicle that has too many.
    """
    keys = [f"nedbus/flood/@alive/{each:x}/{VLP}" for each in range(2000)]
    tokens = [zenoh_session.liveliness().declare_token(each) for each in keys]
    tokens.append(zenoh_session.liveliness().declare_token(f"nedbus/8/@alive/1/{VLP}"))
    publisher = bus.publisher(VLP, vehicle="7")
    publisher.publish(message(0))
    timings.slow_list, timings.downsampled_timeout = 0.1, math.inf
    with (
        nedbus.connect(endpoint) as other,
        other.subscribe(VLP, mode="every", max_rate=10) as subscription,
    ):
        take_last(publisher, subscription)
        publish(publisher, clock, 1, 20)
        assert receive_timestamps(subscription, 2) == [1, 11]
        wait_for(
            lambda: "the streams of 'flood' are not listed" in caplog.text, what="the exclusion"
        )
        timings.downsampled_timeout = 0.0
        wait_for(lambda: "no downsampled messages" in caplog.text, what="the warning")
    assert f"no downsampled messages of nedbus/8/{VLP} arrive" in caplog.text


@pytest.mark.slow
def test_echo_prints_downsampled_messages(
    run_nedbus: Start, endpoint: str, bus: nedbus.Bus, clock: Clock
) -> None:
    """`nedbus echo --max-rate 5` prints every 20th message of a 100 Hz stream."""
    publisher = bus.publisher(VLP, vehicle="7")
    publisher.publish(message(0))
    echo = run_nedbus(
        "echo",
        "-c",
        endpoint,
        "--max-rate",
        "5",
        "--every",
        "--csv",
        "--field",
        "timestamp",
        "-n",
        "51",
    )
    wait_for(lambda: len(echo.out.splitlines()) > 1, what="the last message")
    wait_for_downsampling_reader(publisher)
    publish(publisher, clock, 1, 1000)
    assert echo.wait() == 0, echo.err
    head, *rows = echo.out.splitlines()
    column = head.split(",").index("timestamp")
    assert [int(row.split(",")[column]) for row in rows] == [0, *range(1, 1001, 20)]
    assert echo.err == "51 received, 0 lost, 0 dropped, 0 invalid\n"


def test_key_of_a_downsampled_stream_ends_with_its_rate() -> None:
    """The key of a downsampled stream consists of the stream's key, a chunk that no wildcard matches, and the rate."""
    address = Address("7", "estimator_local_position", 1)
    assert address.rate_key(5) == "nedbus/7/estimator_local_position/1/@rate/5"
    assert Address.from_key(address.rate_key(5).partition(RATE)[0]) == address
    assert Selection().rate_key_exprs(5)[0] == "nedbus/*/**/@rate/5"
    assert Selection(VLP, "7").rate_key_exprs("*", prefix="a/b")[0] == f"a/b/7/{VLP}/@rate/*"
    assert Selection(VLP, "7").alive_key_exprs(prefix="a/b")[0] == f"a/b/7/@alive/*/{VLP}"
    assert Selection().alive_key_exprs()[0] == "nedbus/*/@alive/*/**"
    assert (
        Selection("estimator_local_position").alive_key_exprs()[0]
        == "nedbus/*/@alive/*/estimator_local_position/*"
    )
    assert not zenoh.KeyExpr("nedbus/**").intersects(address.rate_key(5))
    assert zenoh.KeyExpr(Selection().rate_key_exprs(5)[0]).intersects(address.rate_key(5))
    with pytest.raises(AddressError):
        Address.from_key(address.rate_key(5))
