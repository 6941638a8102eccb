"""Publish, subscribe and query through a real router: the blocking and the asyncio client behave the same."""

from __future__ import annotations

import asyncio
import copy
import datetime as dt
import json
import logging
import math
import pickle
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import asdict
from functools import partial
from typing import cast

import pytest
import zenoh

import nedbus
from nedbus import Mode
from nedbus.client import StreamHealth
from nedbus.timings import Timings
from nedbus.transport import Session, fleet_tokens, liveliness, open_router
from nedbus.transport.queries import Replies
from nedbus_msgs import DEFAULT, Address
from tests.flights.local_position import encode
from tests.flights.messages import VLP, message
from tests.nedbus.client.downsampling import Link, wait_for_downsampling_reader
from tests.nedbus.client.numbered import publish, receive_timestamps, wait_for_subscriber
from tests.peers.ports import free_endpoint
from tests.peers.queryables import answer_queries, reply_with
from tests.waits import DEADLINE, wait_for

BOTH: list[Mode] = ["latest", "every"]
SCHEMA = "nedbus/@schema/peer/VehicleLocalPosition"


@pytest.mark.parametrize("mode", BOTH)
def test_message_arrives_unchanged(client: nedbus.Bus, bus: nedbus.Bus, mode: Mode) -> None:
    """A published message arrives as its type, bit for bit, with its address and the times of sending and reception."""
    publisher = bus.publisher("estimator_local_position", vehicle=7, instance=1)
    sent = message(5, x=0.1, ref_lat=47.397742123456789, vxy_max=math.inf, delta_xy=(1.0, math.nan))
    subscription = client.subscribe("*", mode=mode)
    publisher.publish(sent)
    sample = subscription.receive(DEADLINE)
    assert encode(sample.message) == encode(sent)
    assert sample.address == Address("7", "estimator_local_position", 1)
    assert (sample.vehicle, sample.topic, sample.instance, sample.lost) == (
        "7",
        "estimator_local_position",
        1,
        0,
    )
    assert sample.sent is not None
    assert abs(sample.received - time.time_ns()) < 60e9
    assert sample.latency is not None


@pytest.mark.parametrize("max_rate", [None, 50])
@pytest.mark.parametrize("mode", BOTH)
def test_sample_published_before_the_subscription_is_retained(
    client: nedbus.Bus, bus: nedbus.Bus, mode: Mode, max_rate: float | None
) -> None:
    """`retained` is True for a sample published before the subscription or read by `latest`, even after pickling."""
    publisher = bus.publisher(VLP, vehicle="1")
    publish(publisher, 1)
    subscription = client.subscribe(mode=mode, max_rate=max_rate)
    first = subscription.receive(DEADLINE)
    wait_for_subscriber(publisher) if max_rate is None else wait_for_downsampling_reader(publisher)
    publish(publisher, 2)
    second = subscription.receive(DEADLINE)
    assert [(each.message.timestamp, each.retained) for each in (first, second)] == [
        (1, True),
        (2, False),
    ]
    assert pickle.loads(pickle.dumps(first)).retained
    assert [each.retained for each in client.latest()] == [True]


@pytest.mark.parametrize("mode", BOTH)
def test_latency_does_not_include_the_time_until_reading(
    client: nedbus.Bus, bus: nedbus.Bus, mode: Mode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`received` is the time at which a sample left Zenoh's ring: a script that reads late does not add latency."""
    subscription, publisher = client.subscribe(mode=mode), bus.publisher(VLP, vehicle="1")
    with suppress(nedbus.NoDataError):
        # opens the subscription, and starts the thread that drains the ring
        subscription.receive(0.01)
    wait_for_subscriber(publisher)
    publish(publisher, 1)
    wait_for(lambda: subscription.waiting, what="the message")
    arrived = time.time_ns()
    monkeypatch.setattr("nedbus.clock.utc_ns", lambda: arrived + 3600 * 10**9)
    sample = subscription.receive(DEADLINE)
    assert sample.received <= arrived
    assert sample.latency == (sample.received - (sample.sent or 0)) / 1e9


@pytest.mark.slow
def test_single_message_reaches_the_next_subscriber(bus: nedbus.Bus, endpoint: str) -> None:
    """The router knows a publisher before its first message; otherwise one new reader in 300 would miss the message."""
    with nedbus.connect(endpoint) as other:
        for vehicle in range(100):
            publish(bus.publisher(VLP, vehicle=vehicle), 1)
            assert receive_timestamps(other.subscribe(vehicle=vehicle), 1) == [1]


def test_topic_vehicle_and_instance_select_streams(client: nedbus.Bus, bus: nedbus.Bus) -> None:
    """Topic, vehicle (name or MAVLink system id) and instance select streams; the default is the position estimate.

    The default excludes the ground truth and the estimates of single EKFs. A subscription starts with the last
    message of each key, even if publishing has stopped.
    """
    for vehicle in ("1", "2"):
        for topic in reversed(tuple(DEFAULT.topics.values())):
            for instance in (0, 1) if topic.instances else (None,):
                publish(bus.publisher(topic.name, vehicle=vehicle, instance=instance), 1)
    wait_for(lambda: len(client.latest("*")) == 10, what="all last messages")
    for arguments, options, addresses in (
        ([], {}, [f"1/{VLP}", f"2/{VLP}"]),
        ([], {"vehicle": 2}, [f"2/{VLP}"]),
        (
            ["estimator_local_position"],
            {"vehicle": "2"},
            [f"2/estimator_local_position/{each}" for each in (0, 1)],
        ),
        (
            ["estimator_local_position"],
            {"instance": 1},
            [f"{each}/estimator_local_position/1" for each in (1, 2)],
        ),
        (["*"], {"vehicle": 3}, []),
    ):
        assert [str(sample.address) for sample in client.latest(*arguments, **options)] == addresses
        subscription = client.subscribe(*arguments, **options)
        assert sorted(str(subscription.receive(DEADLINE).address) for _ in addresses) == addresses
        with pytest.raises(nedbus.NoDataError):
            subscription.receive(0.05)


def test_queries_without_publishers_return_nothing(client: nedbus.Bus) -> None:
    """Without publishers, queries return empty results and no error."""
    assert client.latest("*") == []
    assert client.vehicles() == {}
    assert client.services() == []


def has_vehicles(bus: nedbus.Bus, count: int) -> bool:
    return len(bus.vehicles()) == count


def test_vehicles_appear_and_disappear(
    client: nedbus.Bus, endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Vehicles appear when their liveliness tokens are declared, and disappear when their publishers close.

    The bus never queries all tokens, because such a query would load all clients of the router.
    """
    queried: list[str] = []

    def record_query(session: Session, key_expr: str, *, timeout: float) -> Replies:
        queried.extend([key_expr] if "*" in key_expr else [])
        return original(session, key_expr, timeout=timeout)

    original = liveliness.query_tokens
    monkeypatch.setattr(liveliness, "query_tokens", record_query)
    monkeypatch.setattr(fleet_tokens, "query_tokens", record_query)
    with nedbus.connect(endpoint) as other:
        for count, vehicle in enumerate("789", 1):
            other.publisher("estimator_local_position", vehicle=vehicle, instance=2)
            wait_for(partial(has_vehicles, client, count), what=f"vehicle {vehicle}")
        other.publisher(VLP, vehicle="7")
        wait_for(lambda: len(client.vehicles()["7"]) == 2, what="another address")
        assert client.vehicles()["7"] == [
            Address("7", "estimator_local_position", 2),
            Address("7", VLP),
        ]
    wait_for(lambda: not client.vehicles(), what="the vehicles to disappear")
    assert not queried


def test_other_prefixes_are_those_of_other_publishers(endpoint: str, bus: nedbus.Bus) -> None:
    """`other_prefixes` names the prefixes of publishers, but not that of the bus."""
    bus.publisher(VLP, vehicle="1")
    with nedbus.connect(endpoint, prefix="fleet/north") as other:
        other.publisher(VLP, vehicle="1")
        assert bus.other_prefixes() == ["fleet/north"]
        assert other.other_prefixes() == ["nedbus"]


def test_vehicles_are_listed_again_after_an_overflow(
    endpoint: str, bus: nedbus.Bus, zenoh_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If too many tokens change between calls, all are listed again: the list is complete, without closed vehicles."""
    monkeypatch.setattr("nedbus.limits.TOKEN_CHANGES", 20)
    gone = zenoh_session.liveliness().declare_token(f"nedbus/gone/@alive/1a/{VLP}")
    kept = zenoh_session.liveliness().declare_token(f"nedbus/kept/@alive/1a/{VLP}")
    wait_for(lambda: sorted(bus.vehicles()) == ["gone", "kept"], what="the first vehicles")
    gone.undeclare()
    for number in range(12):
        zenoh_session.liveliness().declare_token(
            f"nedbus/gone-{number}/@alive/1a/{VLP}"
        ).undeclare()
    tokens = [
        zenoh_session.liveliness().declare_token(f"nedbus/{number}/@alive/1a/{VLP}")
        for number in range(12)
    ]
    tokens.append(kept)
    with nedbus.connect(endpoint) as other:
        wait_for(partial(has_vehicles, other, len(tokens)), what="all vehicles on another bus")
    wait_for(partial(has_vehicles, bus, len(tokens)), what="all vehicles")


def test_truncated_list_of_vehicles_is_incomplete_and_logged(
    endpoint: str,
    bus: nedbus.Bus,
    monkeypatch: pytest.MonkeyPatch,
    timings: Timings,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A list of vehicles truncated at the limit is incomplete and logged once; it is complete once all vehicles fit."""
    monkeypatch.setattr("nedbus.limits.REPLIES", 2)
    timings.tokens_retry = 0.0
    publishers = [bus.publisher(VLP, vehicle=str(number)) for number in range(3)]
    with nedbus.connect(endpoint) as other:
        wait_for(
            lambda: other.vehicles() and "more than 2 liveliness tokens" in caplog.text,
            what="a warning",
        )
        assert len(other.vehicles()) == 2
        assert not other.vehicles().complete
        next(each for each in publishers if str(each.address.vehicle) in other.vehicles()).close()
        wait_for(
            lambda: len(vehicles := other.vehicles()) == 2 and vehicles.complete,
            what="the third vehicle",
        )
    assert caplog.text.count("liveliness tokens") == 1


@pytest.mark.slow
def test_list_of_vehicles_is_incomplete_on_timeout(
    endpoint: str, bus: nedbus.Bus, caplog: pytest.LogCaptureFixture
) -> None:
    """On timeout, `vehicles` returns an incomplete list and logs this once; a later call returns the complete list."""
    publishers = [bus.publisher(VLP, vehicle=str(number)) for number in range(3)]
    with closing(Link(endpoint)) as link, nedbus.connect(link.endpoint) as other:
        link.flows.clear()
        for _ in range(2):
            vehicles = other.vehicles(timeout=0.05)
            assert (vehicles, vehicles.complete) == ({}, False)
            assert not other.publishers(timeout=0.0).complete
        assert caplog.text.count("the router listed only 0 streams within 0.05 s") == 1
        link.flows.set()
        wait_for(lambda: other.vehicles().complete, what="the end of the list")
        assert len(other.vehicles()) == len(publishers)


def test_list_of_vehicles_is_incomplete_without_a_router() -> None:
    """Without a router, the list of vehicles is incomplete."""
    where = free_endpoint()
    router = open_router(listen=(where,))
    with nedbus.connect(where) as bus:
        assert bus.vehicles().complete
        router.close()
        wait_for(lambda: not bus.connected, what="the end of the link")
        assert not bus.vehicles().complete


@pytest.mark.slow
def test_replies_beyond_channel_capacity_do_not_block(endpoint: str) -> None:
    """More replies than a Zenoh channel holds (256) block neither the bus that sends them nor another one."""
    with nedbus.connect(endpoint) as one, nedbus.connect(endpoint) as other:
        for number in range(300):
            publish(one.publisher(VLP, vehicle=str(number)), 1)
        for each in (one, other):
            wait_for(partial(has_vehicles, each, 300), what="300 vehicles")
            assert len(each.latest()) == 300


def count_replies(zenoh_session: Session, key: str) -> int:
    """Return the number of replies to a plain Zenoh get."""
    return sum(reply.ok is not None for reply in zenoh_session.get(key))


def test_two_processes_of_one_vehicle_both_reply(
    bus: nedbus.Bus, endpoint: str, zenoh_session: Session
) -> None:
    """All publishers reply to a plain Zenoh get, even if two processes publish the same vehicle."""
    with nedbus.connect(endpoint) as other:
        for each, topic in ((bus, VLP), (other, "external_ins_local_position")):
            publish(each.publisher(topic, vehicle="1"), 1)
        for topic in (VLP, "external_ins_local_position"):
            wait_for(partial(count_replies, zenoh_session, f"nedbus/1/{topic}"), what=topic)


def test_exception_in_a_reply_does_not_end_the_reply_thread(
    bus: nedbus.Bus, zenoh_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After an exception while replying to one query, the reply thread still answers the next query."""
    publisher = bus.publisher(VLP, vehicle="1")
    publish(publisher, 1)
    wait_for(partial(count_replies, zenoh_session, publisher.key), what="a reply")
    with monkeypatch.context() as patched:
        patched.setattr(nedbus.Publisher, "last", property(lambda _: 1 / 0), raising=False)
        assert count_replies(zenoh_session, publisher.key) == 0
    assert count_replies(zenoh_session, publisher.key) == 1


def test_latest_prefers_a_live_message_to_a_stored_one(
    client: nedbus.Bus, bus: nedbus.Bus, zenoh_session: Session
) -> None:
    """`latest` returns the message of a live publisher, even if a storage has one with a later timestamp."""
    later = zenoh.Timestamp(dt.datetime.now(dt.UTC) + dt.timedelta(hours=1), b"\x07")
    stored = {f"nedbus/{vehicle}/{VLP}": encode(message(99)) for vehicle in "12"}
    publish(bus.publisher(VLP, vehicle="1"), 1)

    def found() -> list[tuple[str, int, bool]]:
        return [
            (sample.vehicle, sample.message.timestamp, sample.stored) for sample in client.latest()
        ]

    with answer_queries(zenoh_session, f"nedbus/*/{VLP}", reply_with(stored, timestamp=later)):
        wait_for(
            lambda: found() == [("1", 1, False), ("2", 99, True)],
            what="a live and a stored message",
        )


def reply_with_statuses(answers: Mapping[str, bytes]) -> Callable[[zenoh.Query], None]:
    """Return a handler that replies to each query for services with all payloads in `answers`, keyed by service id."""
    return reply_with(
        {f"nedbus/@service/1/{name}/status": payload for name, payload in answers.items()}
    )


def test_malformed_status_is_ignored(
    client: nedbus.Bus, zenoh_session: Session, caplog: pytest.LogCaptureFixture
) -> None:
    """Replies that are not JSON, or too deeply nested, are ignored and logged in one line."""
    junk = {"evil": b"[" * 2000, **{f"{'x' * 30_000}{number}": b"junk" for number in range(20)}}
    with answer_queries(zenoh_session, "nedbus/@service/**/status", reply_with_statuses(junk)):
        assert client.services() == []
    warned = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert [
        text.endswith(": ignored a reply that is not JSON") and len(text) < 1000 for text in warned
    ] == [True]


def test_memory_for_parsed_status_is_bounded(
    bus: nedbus.Bus,
    zenoh_session: Session,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Parsed JSON may need 30 times its length: replies beyond the memory limit, here 4 MiB, are ignored and logged."""
    monkeypatch.setattr("nedbus.limits.REPLY_MEMORY", 2**22, raising=False)
    large = b'{"a": [' + 8_000 * b"{}," + b"0]}"
    many = {**{f"evil{number}": large for number in range(20)}, "honest": b'{"host": "honest"}'}
    with answer_queries(zenoh_session, "nedbus/@service/**/status", reply_with_statuses(many)):
        services = bus.services(timeout=DEADLINE)
    assert len(services) == 3
    assert "honest" in [each.service for each in services]
    assert "over the memory limit (18 in total)" in caplog.text


def test_status_of_hostile_or_newer_service_is_sanitized(
    client: nedbus.Bus, zenoh_session: Session
) -> None:
    """The id of a status is taken from its key, unknown fields are ignored, and invalid values and rows dropped."""
    sources = [
        5,
        {
            "source": "sim:",
            "state": "new",
            "published": [],
            "addresses": ["1/x", 5],
            "streams": [{}],
            "z": 1,
        },
    ]
    content = {
        "service": "forged",
        "host": "here",
        "now": 10**400,
        "version": [1],
        "sources": sources,
        "shape": {"of": "it"},
    }
    with answer_queries(
        zenoh_session,
        "nedbus/@service/**/status",
        reply_with_statuses({"a": json.dumps(content).encode(), "b": b"[5]"}),
    ):
        [status] = client.services()
    assert status == nedbus.health.ServiceStatus(
        service="a",
        vehicle="1",
        host="here",
        sources=(nedbus.health.SourceStatus(source="sim:", state="new", addresses=("1/x",)),),
    )


def test_bytes_of_replies_are_bounded(
    bus: nedbus.Bus,
    zenoh_session: Session,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The bytes of replies to one query are bounded, and the number of ignored replies is logged."""
    monkeypatch.setattr("nedbus.limits.QUERY_BYTES", 10_500)
    status = b'{"a": "' + 950 * b"x" + b'"}'
    many = {f"evil{number:02}": status for number in range(50)}
    with answer_queries(zenoh_session, "nedbus/@service/**/status", reply_with_statuses(many)):
        assert len(bus.services(timeout=DEADLINE)) == 10
    text = "dropped 40 of 50 replies beyond the limits of a query, so the result is incomplete"
    assert f"nedbus/@service/**/status: {text}" in caplog.messages


@pytest.mark.parametrize("key", ["nedbus/@service/x{}/status", "nedbus/@service/1/x{}/status"])
def test_flood_of_statuses_hides_no_other_vehicle(
    bus: nedbus.Bus, zenoh_session: Session, monkeypatch: pytest.MonkeyPatch, *, key: str
) -> None:
    """Statuses on keys of one vehicle, or on those without a vehicle, use up the limits without hiding vehicle 2."""
    monkeypatch.setattr("nedbus.limits.REPLIES", 40)
    own = json.dumps(
        {"host": "h", "refused": ["3"], "sources": [{"warnings": ["x" * 500]}]}
    ).encode()
    flood = {key.format(number): b"{}" for number in range(100)}
    answers = {**flood, "nedbus/@service/2/own/status": own}
    with answer_queries(zenoh_session, "nedbus/@service/**/status", reply_with(answers)):
        services = bus.services(timeout=DEADLINE)
    assert len(services) == 40
    [status] = [each for each in services if each.vehicle == "2"]
    assert status.refused == ("3",)
    assert status in services[:2]  # what shows only some shows it


def test_memory_for_replies_is_taken_from_the_largest_vehicle(
    bus: nedbus.Bus, zenoh_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Statuses of vehicle 1 that fill the memory for parsed replies, and arrive first, leave that of vehicle 2."""
    monkeypatch.setattr("nedbus.limits.REPLY_MEMORY", 2**14)
    flood = {f"nedbus/@service/1/x{number}/status": b'{"host": "h"}' for number in range(200)}
    answers = {**flood, "nedbus/@service/2/own/status": b'{"host": "honest"}'}
    with answer_queries(zenoh_session, "nedbus/@service/**/status", reply_with(answers)):
        services = bus.services(timeout=DEADLINE)
    assert 1 < len(services) < 200
    assert "honest" in [each.host for each in services]


def test_refusal_of_a_vehicle_reports_nothing_else_about_it(
    bus: nedbus.Bus, zenoh_session: Session
) -> None:
    """A status of vehicle 1 that says it is refused as vehicle 2 has its streams, but no links of vehicle 2."""
    health = asdict(StreamHealth(VLP).snapshot())
    sources = [
        {"source": "a", "addresses": [f"1/{VLP}", f"2/{VLP}"], "stale": ["2/x"], "silent": ["2/x"],
         "streams": [{"address": f"{each}/{VLP}", "health": health} for each in (1, 2, 3)],
         "log_streams": [{"vehicle": "2"}], "positions": [{"vehicle": "2"}]},
        {"source": "b", "addresses": [f"2/{VLP}"]}, {"source": "c", "addresses": [f"3/{VLP}"]},
    ]  # fmt: skip
    status = json.dumps({"refused": ["2"], "sources": sources}).encode()
    key = "nedbus/@service/1/x/status"
    with answer_queries(zenoh_session, key, reply_with({key: status})):
        [found] = bus.services(timeout=DEADLINE)
    first, second = found.sources
    assert (first.addresses, second.addresses) == ((f"1/{VLP}", f"2/{VLP}"), (f"2/{VLP}",))
    assert [each.address for each in first.streams] == [f"1/{VLP}", f"2/{VLP}"]
    assert [each.address for each in found.own_streams] == [f"1/{VLP}"]
    assert (first.stale, first.silent, first.log_streams, first.positions) == ((), (), (), ())


def test_vehicle_with_many_streams_hides_no_other(
    client: nedbus.Bus,
    bus: nedbus.Bus,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Beyond the limits of a query for last messages, the vehicle with the most loses some; no other vehicle does."""
    for instance in range(20):
        bus.publisher("estimator_local_position", vehicle="loud", instance=instance).publish(
            {"timestamp": 1}
        )
    for vehicle in ("a", "z"):
        bus.publisher(VLP, vehicle=vehicle).publish({"timestamp": 1})
    wait_for(lambda: len(bus.publishers()) == 22, what="the publishers")
    monkeypatch.setattr("nedbus.limits.REPLIES", 5)
    assert [sample.vehicle for sample in client.latest("*")] == ["a", "loud", "loud", "loud", "z"]
    assert "nedbus/*/**: dropped 17 of 22 replies" in caplog.text


def test_published_fields_are_validated(client: nedbus.Bus, bus: nedbus.Bus) -> None:
    """A dict of fields is published if it is valid; otherwise `publish` raises and sends nothing."""
    publisher = client.publisher(VLP, vehicle="1")
    publisher.publish({"timestamp": 4, "x": 1.0})
    wait_for(lambda: [sample.message.x for sample in bus.latest()] == [1.0], what="the message")
    with pytest.raises(ValueError, match="xy_valid"):
        publisher.publish({"timestamp": 5, "xy_valid": True})
    [last] = bus.latest(VLP)
    assert (last.message.timestamp, last.sent is None) == (4, False)
    assert publisher.published == 1


def test_default_timestamp_is_the_time_since_boot(client: nedbus.Bus, bus: nedbus.Bus) -> None:
    """The default timestamp is the time since boot [us], as in PX4's messages, and does not count as missing."""
    publisher, before = client.publisher(VLP, vehicle="1"), time.monotonic_ns() // 1000
    publisher.publish({"x": 2.0})
    wait_for(bus.latest, what="the message")
    [last] = bus.latest()
    assert before <= last.message.timestamp <= time.monotonic_ns() // 1000
    assert "timestamp" not in last.missing


def test_second_publisher_of_an_address_raises(client: nedbus.Bus) -> None:
    """A second publisher of an address raises AddressInUseError, because it would mix two flights."""
    publisher = client.publisher(VLP, vehicle="1")
    with pytest.raises(nedbus.errors.AddressInUseError, match="this process already publishes 1/"):
        client.publisher(VLP, vehicle="1")
    publish(publisher, 1)


def test_concurrent_publishers_of_an_address_raise(
    bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If two threads open a publisher for the same address at the same time, exactly one of them raises."""
    both = threading.Barrier(2)

    def create_together(*arguments: object, **options: object) -> nedbus.Publisher:
        with suppress(threading.BrokenBarrierError):
            both.wait(0.2)
        return nedbus.Publisher(*arguments, **options)  # type: ignore[arg-type] # passed on unchanged

    monkeypatch.setattr("nedbus.client.publishing.publisher_registry.Publisher", create_together)
    with ThreadPoolExecutor(2) as pool:
        made = [pool.submit(bus.publisher, VLP, vehicle="1") for _ in range(2)]
    assert sorted(each.exception() is None for each in made) == [False, True]


def test_invalid_topic_vehicle_instance_or_mode_raises(client: nedbus.Bus) -> None:
    """An invalid topic, vehicle, instance or mode raises ValueError immediately, instead of subscribing to nothing."""
    with pytest.raises(nedbus.AddressError, match="vehicle_local_positon"):
        client.subscribe("vehicle_local_positon")
    with pytest.raises(
        nedbus.ArgumentError, match="mode 'newest' is not valid: expected one of latest, ev"
    ) as error:
        client.subscribe("*", mode=cast("Mode", "newest"))
    assert isinstance(error.value, ValueError)
    assert isinstance(error.value, nedbus.NedbusError)
    assert not isinstance(error.value, nedbus.AddressError)
    with pytest.raises(nedbus.AddressError, match="vehicle"):
        client.latest(vehicle="a/b")
    with pytest.raises(nedbus.AddressError, match=r"vehicle \['1'\] .* a list of names"):
        client.subscribe(vehicle=[["1"]])  # type: ignore[list-item] # the mistake under test
    with pytest.raises(nedbus.AddressError, match="instance"):
        client.publisher("estimator_local_position", vehicle="1")


def test_several_vehicles_are_selected_by_a_list(client: nedbus.Bus) -> None:
    """`vehicle=["a", 2]` selects these vehicles in `subscribe` and `latest`, with either client."""
    for vehicle in ("a", "2", "c"):
        publish(client.publisher(VLP, vehicle=vehicle), 1)
    assert sorted(sample.vehicle for sample in client.latest(vehicle=["a", 2])) == ["2", "a"]
    with client.subscribe(vehicle=["a", 2], mode="every") as subscription:
        assert {subscription.receive(30).vehicle for _ in range(2)} == {"a", "2"}


def test_prefixes_separate_fleets(endpoint: str) -> None:
    """Fleets with different prefixes on one router do not see each other."""
    with (
        nedbus.connect(endpoint, prefix="fleet/a") as one,
        nedbus.connect(endpoint, prefix="fleet/b") as two,
    ):
        publish(one.publisher(VLP, vehicle="1"), 1)
        assert [sample.vehicle for sample in one.latest("*")] == ["1"]
        assert list(one.vehicles()) == ["1"]
        assert two.latest("*") == []
        assert two.vehicles() == {}


def test_receive_raises_no_data_error_on_timeout(client: nedbus.Bus) -> None:
    """On timeout `receive` raises NoDataError, a TimeoutError whose text names the key and a remedy."""
    subscription = client.subscribe(VLP, vehicle="9")
    with pytest.raises(TimeoutError, match=rf"nedbus/9/{VLP} within 0\.05 s.*nedbus list") as info:
        subscription.receive(0.05)
    assert isinstance(info.value, nedbus.NoDataError)


@pytest.mark.parametrize("timeout", [0.0, -1.0, float("inf")])
def test_zero_negative_and_infinite_timeouts_are_valid(bus: nedbus.Bus, timeout: float) -> None:
    """Queries and `receive` accept zero, negative and infinite timeouts."""
    publish(bus.publisher(VLP, vehicle="1"), 1)
    bus.latest("*", timeout=timeout)
    bus.vehicles(timeout=timeout)
    subscription = bus.subscribe()
    taken: list[nedbus.Sample] = []

    def receive() -> list[nedbus.Sample]:
        with suppress(nedbus.NoDataError):
            taken.append(subscription.receive(timeout))
        return taken

    wait_for(receive, what="the message")
    assert taken[0].message.timestamp == 1


def test_async_reader_yields_to_other_tasks(endpoint: str, bus: nedbus.Bus) -> None:
    """A reader that always finds a sample still yields to the event loop."""
    publisher = bus.publisher(VLP, vehicle="1")

    async def scenario() -> int:
        turns = 0

        async def count_turns() -> None:
            nonlocal turns
            while True:
                turns += 1
                await asyncio.sleep(0)

        async with (
            nedbus.connect_async(endpoint) as other,
            other.subscribe(VLP, mode="every") as subscription,
        ):
            await asyncio.to_thread(wait_for_subscriber, publisher)
            publish(publisher, *range(1, 1001))
            counter = asyncio.create_task(count_turns())
            taken = 0
            async for _ in subscription:
                taken += 1
                if taken == 900:
                    break
            counter.cancel()
        return turns

    assert asyncio.run(scenario()) > 5


def test_async_receive_timeout_loses_no_sample(endpoint: str, bus: nedbus.Bus) -> None:
    """A receive that times out does not lose a sample."""
    publisher = bus.publisher(VLP, vehicle="1")
    publish(publisher, 1)

    async def scenario() -> list[int]:
        taken: list[int] = []
        async with (
            nedbus.connect_async(endpoint) as other,
            other.subscribe(VLP, mode="every") as subscription,
        ):
            taken.append((await subscription.receive(DEADLINE)).message.timestamp)
            publish(publisher, *range(2, 641))
            while taken[-1] != 640:
                with suppress(nedbus.NoDataError):
                    taken.append((await subscription.receive(0.0001)).message.timestamp)
        return taken

    assert asyncio.run(scenario()) == list(range(1, 641))


@pytest.mark.parametrize("mode", BOTH)
def test_threads_reading_one_subscription_share_its_messages(bus: nedbus.Bus, mode: Mode) -> None:
    """Each message goes to exactly one of several reading threads, in either mode."""
    publisher = bus.publisher(VLP, vehicle="1")
    subscription = bus.subscribe(mode=mode)
    wait_for_subscriber(publisher)
    taken: list[int] = []

    def read() -> None:
        taken.extend(sample.message.timestamp for sample in subscription)

    threads = [threading.Thread(target=read) for _ in range(4)]
    for thread in threads:
        thread.start()
    publish(publisher, *range(1, 2001))
    wait_for(lambda: 2000 in taken, what="the last message")
    if mode == "every":
        wait_for(lambda: len(taken) == 2000, what="all other messages")
    subscription.close()
    for thread in threads:
        thread.join(DEADLINE)
        assert not thread.is_alive()
    assert len(taken) == len(set(taken)) == subscription.counts.received


@pytest.mark.parametrize(
    "copied", [copy.copy, copy.deepcopy, lambda sample: pickle.loads(pickle.dumps(sample))]
)
def test_sample_can_be_copied_pickled_and_hashed(
    bus: nedbus.Bus, copied: Callable[[object], nedbus.Sample]
) -> None:
    """A copied or pickled sample equals the original, has the same hash, and keeps its exact time of sending."""
    bus.publisher(VLP, vehicle="1", source="test").publish(message(1, x=math.nan))
    sample = bus.subscribe().receive(DEADLINE)
    again = copied(sample)
    assert again == sample
    assert (again.sent, again.source, again.missing) == (sample.sent, "test", sample.missing)
    assert len({sample, again}) == 1
    assert again != nedbus.Sample(sample.message, sample.address, sample.received)
