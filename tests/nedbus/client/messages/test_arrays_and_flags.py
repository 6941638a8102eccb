"""Messages other than positions, through a real router: one with arrays, and one with flags and instances."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Iterator
from contextlib import closing
from itertools import islice
from typing import Any, Final

import numpy as np
import pytest

import nedbus
from nedbus import Counts
from nedbus.cli.output.samples import to_line
from nedbus.client.receiving import Receiver
from nedbus.transport import open_client
from nedbus_msgs import BY_TOPIC, Address, Definition, Message, Row, codec_of, define, field_type
from nedbus_msgs.arrays import MessageArray, arrays_of
from tests.flights.local_position import encode
from tests.flights.messages import VLP, message
from tests.nedbus.client.downsampling import MS, Clock, clock, wait_for_downsampling_reader
from tests.nedbus.client.lossy import LossyQueue
from tests.nedbus.client.numbered import receive_timestamps, wait_for_subscriber
from tests.peers.command_line import run_command
from tests.peers.processes import Start
from tests.waits import DEADLINE, wait_for, wait_for_matching

__all__ = ["clock"]  # a fixture

ATTITUDE: Final = Address("7", "vehicle_attitude")
FLAGS: Final = Address("7", "estimator_status_flags", 1)
BOTH: Final = pytest.mark.parametrize("address", [ATTITUDE, FLAGS], ids=["attitude", "flags"])


def definition_of(address: Address) -> Definition[Any]:
    return BY_TOPIC[address.topic]


def make(address: Address, number: int) -> Message:
    """Return a message with values derived from its timestamp; some fields are not provided."""
    half = number / 20
    fields: dict[str, object] = {
        "q": (math.cos(half), 0.0, 0.0, math.sin(half)),
        "delta_q_reset": (1, 0, math.nan, -0.0),
    }
    if address == FLAGS:
        fields = {
            "control_status_changes": 2**32 - number - 1,
            "cs_in_air": number % 2 == 0,
            "fs_bad_hdg": True,
        }
    made: Message = definition_of(address).model.model_validate({"timestamp": number, **fields})
    return made


def array_of(address: Address, numbers: range) -> MessageArray:
    return arrays_of(definition_of(address)).of([make(address, number) for number in numbers])


def publisher_of(bus: nedbus.Bus, address: Address, **options: Any) -> nedbus.Publisher:
    return bus.publisher(
        address.topic, vehicle=address.vehicle, instance=address.instance, **options
    )


@pytest.fixture
def subscription(endpoint: str) -> Iterator[nedbus.Subscription[Any]]:
    """Subscribe to all topics. Request this fixture before `bus`: otherwise it closes first, and `bus` waits 5 s."""
    with nedbus.connect(endpoint) as other, other.subscribe("*", mode="every") as subscription:
        yield subscription


@BOTH
def test_message_arrives_unchanged(client: nedbus.Bus, bus: nedbus.Bus, address: Address) -> None:
    """`receive` and `latest` return the message as an instance of its model, bit for bit, and list missing fields."""
    publisher, sent = publisher_of(bus, address, source="ins"), make(address, 5)
    publisher.publish(make(address, 4))
    subscription = client.subscribe(address.topic, mode="every")
    assert receive_timestamps(subscription, 1) == [4]
    wait_for_subscriber(publisher)
    publisher.publish(sent)
    sample = subscription.receive(DEADLINE)
    wait_for(lambda: client.latest(address.topic)[0].message == sent, what="the last message")
    for each in (sample, *client.latest(address.topic), *client.latest("*", vehicle="7")):
        assert type(each.message) is definition_of(address).model
        assert encode(each.message) == encode(sent)
        assert (each.address, each.source) == (address, "ins")
        assert each.missing == definition_of(address).all_fields - sent.model_fields_set
    assert client.latest() == []


@BOTH
def test_publishing_an_invalid_message_raises(bus: nedbus.Bus, address: Address) -> None:
    """An invalid field raises an error that names it, and another message type raises TypeError. Nothing is sent."""
    publisher = publisher_of(bus, address)
    wrong = {"q": (1.0, 0.0, 0.0)} if address == ATTITUDE else {"cs_in_air": 1}
    with pytest.raises(nedbus.InvalidMessageError, match=next(iter(wrong))):
        publisher.publish({"timestamp": 1, **wrong})
    with pytest.raises(
        TypeError, match=f"carries {definition_of(address).name}: .*, not VehicleLocalPosition"
    ):
        publisher.publish(message(1))
    assert publisher.published == 0


@BOTH
def test_rows_and_batches_are_complete(
    subscription: nedbus.Subscription[Any], bus: nedbus.Bus, address: Address
) -> None:
    """Messages published as rows and as an array are read as rows and batches, bit for bit, in order and complete."""
    publisher, sent = publisher_of(bus, address, lossless=True), array_of(address, range(1, 301))
    wait_for_subscriber(publisher)
    for number in range(1, 301):
        publisher.publish_row(tuple(make(address, number).__dict__.values()))
    rows = [sample.message for sample in islice(subscription.rows(), 300)]
    assert all(isinstance(row, Row) for row in rows)
    assert np.array([tuple(row) for row in rows], sent.dtype).tobytes() == sent.tobytes()
    publisher.publish_many(sent)
    batches, taken = subscription.batches(), list[MessageArray]()
    while sum(map(len, taken)) < len(sent):
        batch = next(batches)
        assert (batch.message.DEFINITION, batch.addresses) == (definition_of(address), (address,))
        taken.append(batch.of(address))
    assert np.concatenate(taken).tobytes() == sent.tobytes()
    assert subscription.counts == Counts(received=2 * len(sent))


def test_batch_has_one_message_type(
    subscription: nedbus.Subscription[Any], bus: nedbus.Bus
) -> None:
    """Messages of several types are read in batches; each batch has one type, and may have several addresses."""
    addresses = [ATTITUDE, FLAGS, Address("7", VLP), Address("8", "vehicle_attitude")]
    publishers = {address: publisher_of(bus, address) for address in addresses}
    for publisher in publishers.values():
        wait_for_subscriber(publisher)
    for number in range(1, 101):
        for address, publisher in publishers.items():
            publisher.publish(message(number) if address.topic == VLP else make(address, number))
    taken: dict[Address, list[int]] = {address: [] for address in addresses}
    for batch in subscription.batches():
        assert batch.messages.dtype == arrays_of(batch.message.DEFINITION).dtype
        for address in batch.addresses:
            assert definition_of(address) is batch.message.DEFINITION
            taken[address] += batch.of(address)["timestamp"].tolist()
        if sum(map(len, taken.values())) == 400:
            break
    assert set(map(tuple, taken.values())) == {tuple(range(1, 101))}


@BOTH
def test_max_rate_downsamples(
    client: nedbus.Bus, bus: nedbus.Bus, clock: Clock, address: Address
) -> None:
    """With `max_rate=10`, one second of a 100 Hz stream yields ten messages, evenly spaced and unchanged."""
    publisher = publisher_of(bus, address)
    publisher.publish(make(address, 0))
    subscription = client.subscribe(address.topic, mode="every", max_rate=10)
    assert receive_timestamps(subscription, 1) == [0]
    wait_for_downsampling_reader(publisher)
    for number in range(1, 101):
        clock.now += 10 * MS
        publisher.publish(make(address, number))
    assert [subscription.receive(DEADLINE).message for _ in range(10)] == [
        make(address, number) for number in range(1, 101, 10)
    ]


@BOTH
def test_lost_messages_are_recovered(endpoint: str, bus: nedbus.Bus, address: Address) -> None:
    """A reader in mode `every` gets lost messages from the publisher's history cache, in order."""
    publisher, queue = publisher_of(bus, address), LossyQueue(address.key())
    queue.missing = {1, 2, 3, 6}
    with closing(open_client([endpoint], timeout=DEADLINE)) as session:
        receiver = Receiver(session, queue)
        with nedbus.Subscription[Any](receiver, queue, owner=None) as subscription:
            wait_for_matching(bus._session, address.key())
            for number in range(10):
                publisher.publish(make(address, number))
            received = [subscription.receive(DEADLINE).message for _ in range(10)]
            assert received == [make(address, number) for number in range(10)]
            assert subscription.counts == Counts(received=10)


def test_commands_print_arrays(endpoint: str, bus: nedbus.Bus) -> None:
    """Arrays are printed with nine significant digits, in CSV as a column per element, in JSON as lists.

    JSON has no NaN, so it is printed as a string.
    """
    with publisher_of(bus, ATTITUDE) as publisher:
        publisher.publish(make(ATTITUDE, 2))
        wait_for(lambda: bus.latest(ATTITUDE.topic), what="the message")
        got = run_command("get", "-c", endpoint, ATTITUDE.topic, "--field", "q,delta_q_reset")
        assert got.out.splitlines()[1:] == [
            "  q: 0.995004177 0 0 0.099833414", "  delta_q_reset: 1 0 nan -0", "---"
        ]  # fmt: skip
        lines = run_command(
            "echo", "-c", endpoint, str(ATTITUDE), "--csv", "--once"
        ).out.splitlines()
        (row,) = csv.DictReader(lines)
        assert row["q[0]"] == "0.995004177"
        assert row["delta_q_reset[2]"] == "nan"
        shown = json.loads(
            run_command("echo", "-c", endpoint, ATTITUDE.topic, "--json", "--once").out
        )
        assert shown["message"]["delta_q_reset"] == [1.0, 0.0, "NaN", 0.0]
        assert shown["missing"] == ["quat_reset_counter", "timestamp_sample"]
        assert str(ATTITUDE) in run_command("list", "-c", endpoint).out
        assert json.loads(run_command("schema", ATTITUDE.topic).out)["title"] == "VehicleAttitude"


def test_schema_of_unknown_topic_is_queried_from_its_publisher(
    endpoint: str, bus: nedbus.Bus
) -> None:
    """`nedbus schema` queries a definition that is not built in, by topic or message; others are usage errors."""
    definition = define(
        "WheelEncoders",
        [("timestamp", field_type("uint64")), ("wheel_speed", field_type("float32[2]"))],
    )
    with bus._publishers.publisher(Address("7", "wheel_encoders"), definition) as publisher:
        publisher.publish({"timestamp": 1})
        wait_for(lambda: bus.latest("wheel_encoders"), what="the message")
        shown = json.loads(run_command("schema", "wheel_encoders", "-c", endpoint).out)
        assert shown["description"] == "A message defined at run time."
        assert list(shown["properties"]) == ["timestamp", "wheel_speed"]
        assert json.loads(run_command("schema", "WheelEncoders", "-c", endpoint).out) == shown
    for wrong in ("wheel_encoders_b", "WheelEncoders", "*"):
        ended = run_command("schema", wrong, "-c", endpoint)
        assert (ended.exit_code, ended.out) == (2, "")
        assert (
            "and no such message or topic is published: known messages are VehicleLocalPosition, "
            in ended.err
        )


def test_custom_message_is_published(client: nedbus.Bus, endpoint: str) -> None:
    """A message defined by a .msg text is published, its ranges are checked, and readers query the definition.

    An unknown topic without a definition raises AddressError.
    """
    text = "uint64 timestamp\nfloat32 range # [m] [@range 0, 100]\nuint8 beacon\n"
    definition = nedbus.define_msg("RangeBeacon", text)
    with (
        nedbus.connect(endpoint) as reader,
        reader.subscribe("range_beacon", vehicle="mine") as subscription,
    ):
        publisher = client.publisher("range_beacon", vehicle="mine", definition=definition)
        publisher.publish({"timestamp": 5, "range": 2.5, "beacon": 3})
        assert dict(subscription.receive(DEADLINE).message) == {
            "timestamp": 5,
            "range": 2.5,
            "beacon": 3,
        }
        with pytest.raises(nedbus.InvalidMessageError, match="range"):
            publisher.publish({"timestamp": 6, "range": 200.0, "beacon": 3})
    with pytest.raises(
        nedbus.AddressError, match=r"expected a definition from nedbus\.define_msg, or one of "
    ):
        client.publisher("other_beacon", vehicle="mine")


@pytest.mark.parametrize("topic", [None, "vehicle_attitude_groundtruth"])
def test_class_selects_its_topic(client: nedbus.Bus, bus: nedbus.Bus, topic: str | None) -> None:
    """For `subscribe` and `latest`, a class selects its first topic, unless `topic` names another of its topics."""
    chosen, options = topic or ATTITUDE.topic, dict[str, Any](topic=topic) if topic else {}
    for number, each in enumerate(
        ["vehicle_attitude", "vehicle_attitude_groundtruth", "estimator_attitude"]
    ):
        instance = 0 if each == "estimator_attitude" else None
        bus.publisher(each, vehicle="7", instance=instance).publish(make(ATTITUDE, number))
    wait_for(lambda: client.latest("*") and len(client.latest("*")) == 3, what="the messages")
    sample = client.subscribe(nedbus.VehicleAttitude, **options).receive(DEADLINE)
    [last] = client.latest(nedbus.VehicleAttitude, **options)
    assert (sample.topic, sample.message, last.message) == (chosen, last.message, sample.message)


def test_class_without_the_topic_raises(client: nedbus.Bus) -> None:
    """A topic of another message, or a class without topics, raises an error with the valid choices."""
    undeclared = nedbus.define_msg("RangeBeacon", "uint64 timestamp\n").model
    for call in (client.subscribe, client.latest):
        with pytest.raises(
            nedbus.AddressError, match="expected one of VehicleAttitude: vehicle_attitude, "
        ):
            call(nedbus.VehicleAttitude, topic=VLP)
        for without in (undeclared, Message):
            with pytest.raises(
                nedbus.AddressError, match=f"'{without.__name__}' .* TOPICS, or the name of a topic"
            ):
                call(without)


CUSTOM_CLASS = """
import signal, sys, nedbus
from nedbus_msgs.model.px4_types import Float32x2, field

class WheelSpeeds(nedbus.Message):
    "Speeds of a rover's wheels."

    TOPICS = (nedbus.Topic("wheel_speeds", 50.0, "a rover"),)
    speed: Float32x2 = field("Speeds [rad/s]")

with nedbus.connect(sys.argv[1]) as bus, bus.publisher("wheel_speeds", vehicle=1) as publisher:
    publisher.publish(WheelSpeeds(timestamp=1, speed=(2.0, 3.0)))
    with nedbus.connect(sys.argv[1]) as reader:
        received = reader.subscribe(WheelSpeeds).receive(30).message, reader.latest(WheelSpeeds)[0].message
    for message in received:
        print(repr(message), flush=True)
    signal.pause()
"""


@pytest.mark.slow
@pytest.mark.process
def test_custom_class_is_received(start: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """A message of a custom class is received as that class; readers without the class receive the same fields."""
    process = start("-c", CUSTOM_CLASS, endpoint)
    wait_for(lambda: process.out.count("\n") == 2 or process.err, what="the script")
    assert process.out == 2 * "WheelSpeeds(timestamp=1, speed=(2.0, 3.0))\n", process.err
    assert dict(bus.subscribe("wheel_speeds").receive(DEADLINE).message) == {
        "timestamp": 1,
        "speed": (2.0, 3.0),
    }


def test_echo_line_has_losses_before_fields() -> None:
    """A terminal cuts long lines at the end, so the status of a sample comes before its fields."""
    sample = nedbus.Sample(make(FLAGS, 2), FLAGS, received=1, lost=3)
    numbers = "[3 lost]  control_status_changes 4294967293"
    assert re.fullmatch(
        rf"{re.escape(numbers)}  cs_in_air  fs_bad_hdg  \(\d\d flags False\)",
        to_line(sample).split(" s  ")[1],
    )


def test_payload_of_another_message_is_invalid(bus: nedbus.Bus) -> None:
    """A payload of another message on the key counts as invalid."""
    with bus.subscribe(ATTITUDE.topic, mode="every") as subscription:
        session = bus._session
        session.put(ATTITUDE.key(), encode(message(1)))
        session.put(
            ATTITUDE.key(),
            encode(make(ATTITUDE, 2)),
            encoding=f"application/msgpack;{definition_of(ATTITUDE).name}",
        )
        assert subscription.receive(DEADLINE).message == make(ATTITUDE, 2)
        assert subscription.counts.invalid == 1
        assert len(encode(make(ATTITUDE, 2))) == codec_of(definition_of(ATTITUDE)).size
