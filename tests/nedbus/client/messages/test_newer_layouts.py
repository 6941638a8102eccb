"""Fleets of two releases: newer layouts of built-in messages are read with the fields that their hash identifies."""

from __future__ import annotations

import json
from collections.abc import Mapping
from itertools import islice
from typing import Final

import msgpack
import pytest
import zenoh

import nedbus
from nedbus import Counts
from nedbus.client.protocol import LIVE
from nedbus.transport import Session
from nedbus_msgs import field_type, short_hash
from tests.flights.local_position import ENCODING, encode, next_release
from tests.flights.messages import VLP, message
from tests.nedbus.client.numbered import receive_timestamps, wait_for_subscriber
from tests.peers.queryables import answer_queries, reply_with
from tests.waits import DEADLINE, repeating, wait_for_matching

NAME, KEY, SCHEMA = (
    "VehicleLocalPosition",
    f"nedbus/1/{VLP}",
    "nedbus/@schema/1/VehicleLocalPosition",
)
FIELDS: Final = {"timestamp": "uint64", "brand_new": "bool", "x": "float32"}
PAYLOAD: Final = msgpack.packb([9, 4, True, 2.5])
"""A message with FIELDS, as layout 9."""

pytestmark = pytest.mark.usefixtures("long_lookup_timeout")


def hash_of_fields(fields: Mapping[str, str]) -> str:
    return short_hash(NAME, {name: field_type(kind) for name, kind in fields.items()})


ENCODING_WITH_HASH: Final = f"{ENCODING};hash={hash_of_fields(FIELDS)}"


def schema(fields: Mapping[str, str], **claims: object) -> bytes:
    """Return the reply of a publisher with these fields."""
    layout = {
        "name": "9.9",
        "wire": 9,
        "fields": [{"name": name, "type": kind} for name, kind in fields.items()],
    }
    return json.dumps({"layouts": [layout], **claims}).encode()


@pytest.mark.parametrize("form", ["models", "rows", "batches"])
def test_reader_of_an_older_release_reads_a_newer_publisher(
    endpoint: str, bus: nedbus.Bus, form: str
) -> None:
    """A reader gets the fields that it knows from a publisher whose layout of a built-in message is newer."""
    publisher = bus.publisher(VLP, vehicle="1", definition=next_release())
    sent = {"timestamp": 5, "xy_valid": True, "x": 1.0, "y": 2.0, "brand_new": 9.0}
    with nedbus.connect(endpoint) as reader, reader.subscribe(mode="every") as subscription:
        wait_for_subscriber(publisher)
        # messages that arrive before the lookup is done are invalid
        with repeating(lambda: publisher.publish(sent)):
            receive_timestamps(subscription, 1)
        invalid = subscription.counts.invalid
        publisher.publish(sent | {"timestamp": 6})
        found = [(0, 0.0, 0.0)]
        while found[-1][0] != 6:
            if form == "batches":
                found += (
                    subscription.receive_batch(DEADLINE).messages[["timestamp", "x", "y"]].tolist()
                )
            else:
                read = next(subscription if form == "models" else subscription.rows()).message
                found.append((read.timestamp, read.x, read.y))
        assert set(found[1:]) <= {(5, 1.0, 2.0), (6, 1.0, 2.0)}
        assert subscription.counts.invalid == invalid
        assert [(each.message.timestamp, each.message.y) for each in reader.latest()] == [(6, 2.0)]


def test_reply_with_swapped_fields_is_ignored(client: nedbus.Bus, zenoh_session: Session) -> None:
    """A peer that answers first, swaps x and y, and claims the right hash, does not change what a reader sees."""
    honest = {"timestamp": "uint64", "x": "float32", "y": "float32"}
    lie = {"timestamp": "uint64", "y": "float32", "x": "float32"}
    claim = schema(lie, hash=hash_of_fields(honest))

    def answer(query: zenoh.Query) -> None:
        with query:
            for payload in (claim, schema(honest)):
                query.reply(SCHEMA, payload)

    encoding, peer = (
        f"{ENCODING};hash={hash_of_fields(honest)}",
        "nedbus/@schema/peer/VehicleLocalPosition",
    )
    with (
        answer_queries(zenoh_session, peer, reply_with({peer: claim})),
        answer_queries(zenoh_session, SCHEMA, answer),
        client.subscribe(mode="every") as subscription,
    ):
        wait_for_matching(zenoh_session, KEY)
        with repeating(
            lambda: zenoh_session.put(KEY, msgpack.packb([9, 4, 1.0, 2.0]), encoding=encoding)
        ):
            found = list(islice(subscription, 40))
    assert {(sample.message.x, sample.message.y) for sample in found} == {(1.0, 2.0)}


def test_newer_layout_without_hash_is_invalid(
    client: nedbus.Bus, zenoh_session: Session, caplog: pytest.LogCaptureFixture
) -> None:
    """A newer layout without a hash is invalid, whatever peers reply; the reason is logged once."""
    queries: list[object] = []
    with (
        answer_queries(zenoh_session, SCHEMA, queries.append),
        client.subscribe(mode="every") as subscription,
    ):
        wait_for_matching(zenoh_session, KEY)
        for encoding in (
            ENCODING,
            f"{ENCODING};hash=no",
            ENCODING_WITH_HASH.replace(NAME, "Other"),
        ):
            zenoh_session.put(KEY, PAYLOAD, encoding=encoding)
        zenoh_session.put(KEY, encode(message(5)))
        assert receive_timestamps(subscription, 1) == [5]
        assert subscription.counts == Counts(received=1, invalid=3)
    assert [text.partition("(")[2] for text in caplog.messages] == [
        f"not a message: unknown layout 9, and the encoding {ENCODING!r} has no message name and hash)"
    ]
    assert queries == []


def test_newer_layout_is_looked_up_once(
    client: nedbus.Bus, zenoh_session: Session, caplog: pytest.LogCaptureFixture
) -> None:
    """An unknown layout is looked up once, and its unknown fields are logged once.

    Messages that arrive before the reply are invalid.
    """
    reply, queries = reply_with({SCHEMA: schema(FIELDS)}), list[object]()

    def count(query: zenoh.Query) -> None:
        queries.append(query)
        reply(query)

    subscription = client.subscribe(mode="every")
    wait_for_matching(zenoh_session, KEY)
    with (
        answer_queries(zenoh_session, SCHEMA, count),
        repeating(lambda: zenoh_session.put(KEY, PAYLOAD, encoding=ENCODING_WITH_HASH)),
    ):
        taken = list(islice(subscription, 2))
    assert [(sample.message.timestamp, sample.message.x) for sample in taken] == [
        (4, 2.5),
        (4, 2.5),
    ]
    assert subscription.counts.invalid > 0
    assert len(queries) == 1
    logged = [text for text in caplog.messages if "ignored fields" in text]
    assert logged == [
        "a layout of VehicleLocalPosition is newer than this reader; ignored fields: brand_new"
    ]


@pytest.mark.parametrize("stored", [False, True])
@pytest.mark.parametrize("answering", ["1", "other"])
def test_last_message_of_a_newer_layout_is_read(
    client: nedbus.Bus, zenoh_session: Session, *, stored: bool, answering: str
) -> None:
    """`latest` waits for the lookup of a newer layout, which another vehicle answers if its own is gone."""
    key, options = f"nedbus/@schema/{answering}/{NAME}", {} if stored else {"attachment": LIVE}
    last = reply_with({KEY: PAYLOAD}, encoding=ENCODING_WITH_HASH, **options)
    with (
        answer_queries(zenoh_session, key, reply_with({key: schema(FIELDS)})),
        answer_queries(zenoh_session, KEY, last),
    ):
        found = client.latest(timeout=DEADLINE)
    assert [(each.message.timestamp, each.message.x, each.stored) for each in found] == [
        (4, 2.5, stored)
    ]


@pytest.mark.parametrize(
    "answer",
    [b"no json", b"[]", b'{"layouts": 3}', b'{"layouts": [{"wire": 9, "fields": [1, 2]}]}'],
)
def test_messages_of_a_malformed_layout_are_invalid(
    bus: nedbus.Bus, zenoh_session: Session, answer: bytes
) -> None:
    """If the reply to a layout lookup is malformed, messages of that layout count as invalid."""
    with answer_queries(zenoh_session, SCHEMA, reply_with({SCHEMA: answer})):
        subscription = bus.subscribe(VLP, mode="every")
        wait_for_matching(zenoh_session, KEY)
        zenoh_session.put(KEY, PAYLOAD, encoding=ENCODING_WITH_HASH)
        zenoh_session.put(KEY, encode(message(2)))
        assert receive_timestamps(subscription, 1) == [2]
        assert subscription.counts.invalid == 1
