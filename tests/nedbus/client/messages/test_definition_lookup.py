"""Messages that are not built in, read with the definition queried from their publisher."""

from __future__ import annotations

import gc
import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zenoh

import nedbus
from nedbus.client.receiving import layout_lookup
from nedbus.transport import Replies, Session
from nedbus_msgs import Definition, define_msg, field_type, short_hash
from tests.nedbus_msgs.messages.test_messages import write_wheels
from tests.peers.processes import Start
from tests.peers.queryables import answer_queries, reply_with
from tests.waits import DEADLINE, wait_for, wait_for_matching

COUNT = 500


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.parametrize("form", ["models", "rows", "batches"])
def test_message_with_queried_definition_is_read_completely(
    tmp_path: Path, run_nedbus: Start, endpoint: str, bus: nedbus.Bus, form: str
) -> None:
    """No message is lost during the lookup of its definition; models, rows and batches equal the log."""
    log = write_wheels(tmp_path / "rover.ulg", COUNT)
    with bus.subscribe("wheel_encoders", mode="every") as subscription:
        run_nedbus("serve", "-c", endpoint, "--source", f"ulog:{log}?topics=*&speed=max&wait=1")
        read: list[tuple[int, tuple[float, ...]]] = []
        while len(read) < COUNT:
            if form == "batches":
                batch = subscription.receive_batch(DEADLINE)
                assert batch.message.__name__ == "WheelEncoders"
                read += zip(
                    batch.messages["timestamp"].tolist(),
                    map(tuple, batch.messages["wheel_speed"].tolist()),
                    strict=True,
                )
                continue
            message: Any = next(
                iter(subscription) if form == "models" else subscription.rows()
            ).message
            read.append((message.timestamp, message.wheel_speed))
        assert read == [(number + 1, (number, -number)) for number in range(COUNT)]
        assert subscription.counts == nedbus.Counts(received=COUNT)
    [last] = bus.latest("wheel_encoders")
    assert (last.source, last.missing) == ("ulog", frozenset())
    assert dict(last.message)["wheel_angle"] == (0.5, 0.5)
    assert last.address in [
        address for addresses in bus.vehicles().values() for address in addresses
    ]


@pytest.mark.parametrize(
    "answer",
    [
        b"[" * 2000,
        b'{"layouts": 7}',
        {"fields": [{"name": f"f{number}", "type": "float32"} for number in range(100_000)]},
        {
            "fields": [
                {"name": "timestamp", "type": "uint64"},
                {"name": "x", "type": "float32[1025]"},
            ]
        },
        {
            "fields": [
                {"name": "timestamp", "type": "uint64"},
                {"name": "__class__", "type": "uint8"},
            ]
        },
        {
            "fields": [
                {"name": "timestamp", "type": "uint64"},
                {"name": "model_fields", "type": "uint8"},
            ]
        },
        {
            "fields": [
                {"name": "timestamp", "type": "uint64"},
                {"name": "x", "type": "__import__('os')"},
            ]
        },
        {"fields": [{"name": "x", "type": "uint8"}]},
        {"fields": []},
    ],
)
def test_hostile_definition_does_not_affect_other_streams(
    client: nedbus.Bus, bus: nedbus.Bus, zenoh_session: Session, answer: bytes | dict[str, Any]
) -> None:
    """If a peer replies with an invalid definition, only messages with this definition are invalid."""
    identity, fields = "0" * 32, [] if isinstance(answer, bytes) else answer["fields"]
    # use the right hash, if there is one, so that the reply is rejected for another reason
    with suppress(ValueError):
        identity = short_hash("Evil", {each["name"]: field_type(each["type"]) for each in fields})
    payload = (
        answer
        if isinstance(answer, bytes)
        else json.dumps({"layouts": [{"wire": 0, **answer}]}).encode()
    )
    schema = "nedbus/@schema/peer/Evil"
    with (
        answer_queries(zenoh_session, schema, reply_with({schema: payload})),
        client.subscribe("*", mode="every") as subscription,
    ):
        good = bus.publisher("vehicle_attitude", vehicle="1")
        wait_for_matching(zenoh_session, "nedbus/7/evil")
        encoding = f"application/msgpack;px4_msgs/Evil;hash={identity}"
        zenoh_session.put("nedbus/7/evil", msgpack.packb([0, 1, 2]), encoding=encoding)
        good.publish({"timestamp": 5})
        assert subscription.receive(DEADLINE).message == nedbus.VehicleAttitude(timestamp=5)

        def is_rejected() -> bool:
            with suppress(nedbus.NoDataError):
                subscription.receive(0.1)
            return subscription.counts.invalid == 1

        wait_for(is_rejected, what="the invalid message, which has another priority")


def read_once(endpoint: str, topic: str, form: str) -> int:
    """Connect, read the last message in the given form, close, and return its timestamp."""
    with nedbus.connect(endpoint) as reader:
        if form == "latest":
            return int(reader.latest(topic)[0].message.timestamp)
        with reader.subscribe(topic, mode="every") as subscription:
            if form == "models":
                return int(subscription.receive(DEADLINE).message.timestamp)
            return int(subscription.receive_batch(DEADLINE).messages["timestamp"][0])


@pytest.mark.slow
def test_looked_up_definition_is_freed_with_the_bus(endpoint: str, bus: nedbus.Bus) -> None:
    """Closing a bus frees the definitions that it looked up for `latest`, models or batches."""
    definition = define_msg("ComesAndGoes", "uint64 timestamp\nfloat32 comes_and_goes\n")
    publisher = bus.publisher("comes_and_goes", vehicle="1", definition=definition)
    publisher.publish({"timestamp": 1})
    assert [
        read_once(endpoint, "comes_and_goes", form) for form in ("latest", "models", "batches")
    ] == [1, 1, 1]

    def is_freed() -> bool:
        gc.collect()
        found = [
            each
            for each in gc.get_objects()
            if isinstance(each, Definition) and each.name == definition.name
        ]
        return len(found) == 1

    wait_for(is_freed, what="the definitions of closed readers to be freed")


def test_encoding_without_name_and_hash_is_invalid(
    client: nedbus.Bus, zenoh_session: Session, caplog: pytest.LogCaptureFixture
) -> None:
    """A message whose encoding has no message name and hash is invalid, and the log states the reason."""
    with client.subscribe("wheel_encoders") as subscription:
        wait_for_matching(zenoh_session, "nedbus/7/wheel_encoders")
        zenoh_session.put("nedbus/7/wheel_encoders", b"\x91\x00", encoding="text/plain")

        def is_counted() -> bool:
            with pytest.raises(nedbus.NoDataError):
                subscription.receive(0.05)
            return subscription.counts.invalid == 1

        wait_for(is_counted, what="the count of the invalid message")
    assert "the encoding 'text/plain' has no message name and hash" in caplog.text


@pytest.mark.slow
def test_definitions_of_many_topics_are_queried_together(
    client: nedbus.Bus, bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For the last messages of 80 topics that are not built in, a reader waits up to four times for definitions."""
    definitions = [
        define_msg(f"Custom{number}", f"uint64 timestamp\nuint8 a{number}\n")
        for number in range(80)
    ]
    publishers = [
        bus.publisher(f"custom_{n}", vehicle="7", definition=each)
        for n, each in enumerate(definitions)
    ]
    for number, each in enumerate(publishers):
        each.publish({"timestamp": 1, f"a{number}": number})
    waits, wait_for_definitions = list[int](), layout_lookup.wait_for_replies

    def count(queries: Sequence[Replies]) -> Iterator[zenoh.Reply]:
        waits.append(len(queries))
        return wait_for_definitions(queries)

    monkeypatch.setattr(layout_lookup, "wait_for_replies", count)
    assert len(client.latest("*", vehicle="7", timeout=DEADLINE)) == 80
    assert sum(waits) == 80
    assert len(waits) <= 4
