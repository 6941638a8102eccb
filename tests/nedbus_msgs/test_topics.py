"""Topics, addresses and selections, and their key expressions."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import pytest
import zenoh
from hypothesis import given, strategies as st

from nedbus_msgs import (
    ANY,
    DEFAULT,
    DEFAULT_TOPIC,
    TOPICS,
    Address,
    AddressError,
    Selection,
    ack_key,
    address_of_alive_key,
    check_prefix,
    schema_key,
    status_key,
    topic_of,
)

CHUNK = st.text("ABCXYZabcxyz0189_-", min_size=1, max_size=64)
PREFIXES = st.lists(CHUNK, min_size=1, max_size=3).map("/".join)


@st.composite
def addresses(draw: st.DrawFn) -> Address:
    topic = draw(st.sampled_from(list(TOPICS.values())))
    instance = draw(st.integers(0, 255)) if topic.instances else None
    return Address(draw(CHUNK), topic.name, instance)


def test_vehicle_local_position_has_four_topics() -> None:
    """Only estimator_local_position has instances, and vehicle_local_position is the default."""
    assert DEFAULT_TOPIC == "vehicle_local_position"
    alone = (
        "vehicle_local_position",
        "vehicle_local_position_groundtruth",
        "external_ins_local_position",
    )
    instances = {**dict.fromkeys(alone, False), "estimator_local_position": True}
    assert {name: topic.instances for name, topic in DEFAULT.topics.items()} == instances
    assert list(TOPICS)[:4] == list(instances)


def test_keys_match_the_documentation() -> None:
    """Keys equal the documented strings, on which clients in other languages depend."""
    assert Address("7", "vehicle_local_position").key() == "nedbus/7/vehicle_local_position"
    estimator = Address("7", "estimator_local_position", 2)
    assert estimator.key() == "nedbus/7/estimator_local_position/2"
    assert estimator.key(prefix="fleet/a") == "fleet/a/7/estimator_local_position/2"
    assert estimator.alive_key("1a") == "nedbus/7/@alive/1a/estimator_local_position/2"
    assert estimator.rejected_key() == "nedbus/@rejected/7/estimator_local_position/2"
    assert (
        Selection("estimator_local_position", instance=1).key_exprs()[0]
        == "nedbus/*/estimator_local_position/1"
    )
    assert (
        Selection("estimator_local_position", vehicle="7").key_exprs()[0]
        == "nedbus/7/estimator_local_position/*"
    )
    assert schema_key("VehicleLocalPosition") == "nedbus/@schema/*/VehicleLocalPosition"
    assert schema_key("VehicleStatus", vehicle="7", prefix="a/b") == "a/b/@schema/7/VehicleStatus"
    assert status_key("a-1", vehicle="7") == "nedbus/@service/7/a-1/status"
    assert (
        ack_key(Selection("vehicle_local_position").key_exprs()[0])
        == "nedbus/*/vehicle_local_position/@ack"
    )


def test_selection_of_an_unknown_topic_matches_all_instances() -> None:
    """A topic that is not built in has keys with and without an instance, and a selection matches both."""
    alone, second = Address("7", "wheel_encoders"), Address("7", "wheel_encoders", 1)
    assert (alone.key(), second.key()) == ("nedbus/7/wheel_encoders", "nedbus/7/wheel_encoders/1")
    selection = Selection("wheel_encoders")
    key_expr = zenoh.KeyExpr(selection.key_exprs()[0])
    for address in (alone, second):
        assert Address.from_key(address.key()) == address
        assert selection.matches(address)
        assert key_expr.includes(address.key())


@given(addresses(), PREFIXES)
def test_address_and_key_round_trip(address: Address, prefix: str) -> None:
    """Every address has a valid key, which is parsed to the same address."""
    zenoh.KeyExpr(address.key(prefix=prefix))
    assert Address.from_key(address.key(prefix=prefix), prefix=prefix) == address
    assert address_of_alive_key(address.alive_key("1a", prefix=prefix), prefix=prefix) == address
    with pytest.raises(AddressError):
        address_of_alive_key(address.key(prefix=prefix), prefix=prefix)


@given(st.one_of(st.text(max_size=60), st.lists(st.sampled_from([
    "nedbus", "7", "*", "**", "@alive", "vehicle_local_position", "estimator_local_position", "0", "01", "256", "", "é",
]), max_size=6).map("/".join)))  # fmt: skip
def test_random_key_is_parsed_or_raises_address_error(key: str) -> None:
    """A string is parsed to an address with the same key, or raises AddressError."""
    try:
        assert Address.from_key(key).key() == key
    except AddressError as exc:
        assert str(exc)


@st.composite
def selections(draw: st.DrawFn, near: Address) -> Selection:
    """Return selections that share parts with an address."""
    topic = draw(st.sampled_from([ANY, near.topic, *TOPICS]))
    vehicle = draw(st.sampled_from([ANY, near.vehicle, near.vehicle[:-1] + "Q"]))
    instances = topic != ANY and TOPICS[topic].instances
    return Selection(
        topic, vehicle, draw(st.sampled_from([None, near.instance, 0, 255])) if instances else None
    )


@given(addresses(), PREFIXES, st.data())
def test_selection_matches_what_its_key_expression_includes(
    address: Address, prefix: str, data: st.DataObject
) -> None:
    """A selection matches exactly the addresses whose keys are included in its key expression, as Zenoh decides."""
    selection = data.draw(selections(address))
    key_expr = zenoh.KeyExpr(selection.key_exprs(prefix=prefix)[0])
    assert selection.matches(address) == key_expr.includes(address.key(prefix=prefix))
    acknowledgements = zenoh.KeyExpr(ack_key(str(key_expr)))
    assert acknowledgements.includes(ack_key(address.key(prefix=prefix))) == selection.matches(
        address
    )


@given(addresses(), PREFIXES)
def test_selection_excludes_tokens_rejections_and_acknowledgements(
    address: Address, prefix: str
) -> None:
    """A subscription to all messages does not receive liveliness tokens, rejections or acknowledgements."""
    assert zenoh.KeyExpr(Selection().alive_key_exprs(prefix=prefix)[0]).includes(
        address.alive_key("1a", prefix=prefix)
    )
    key_expr = zenoh.KeyExpr(Selection().key_exprs(prefix=prefix)[0])
    assert not key_expr.intersects(address.alive_key("1a", prefix=prefix))
    assert not key_expr.intersects(address.rejected_key(prefix=prefix))
    assert not key_expr.intersects(ack_key(address.key(prefix=prefix)))


@pytest.mark.parametrize(
    ("vehicle", "topic", "instance", "what"),
    [
        *(
            (vehicle, "vehicle_local_position", None, "vehicle")
            for vehicle in ("", "a/b", "@alive", "*", "x" * 65)
        ),
        ("7", "vehicle_attitud", None, "topic"),
        ("7", "Attitude", None, "topic"),
        ("7", "a" * 65, None, "topic"),
        ("7", "vehicle_attitude", 0, "instance"),
        ("7", "wheel_encoders", 256, "instance"),
        ("7", "vehicle_local_position", 0, "instance"),
        *(("7", "estimator_local_position", instance, "instance") for instance in (None, 256, -1)),
    ],
)
def test_invalid_address_raises(vehicle: str, topic: str, instance: int | None, what: str) -> None:
    """The error names the invalid part, its value and what is expected."""
    with pytest.raises(AddressError, match=rf"{what} .* is not valid: expected"):
        Address(vehicle, topic, instance)


@pytest.mark.parametrize(
    ("topic", "vehicle", "instance", "what"),
    [
        ("vehicle_local_positon", "*", None, "topic"),
        (
            "/fmu/out/vehicle_status_v1",
            "*",
            None,
            "expected vehicle_status, without the ROS 2 prefix",
        ),
        ("in/wheel_encoders", "*", None, "expected wheel_encoders, without the ROS 2 prefix"),
        ("vehicle_local_position", "*", 0, "instance"),
        ("*", "*", 1, "instance"),
        ("vehicle_local_position", "a b", None, "vehicle"),
        *(
            ("estimator_local_position", "*", instance, "instance .* an integer from 0 to 255 for")
            for instance in (-1, 256, True, "0")
        ),
    ],
)
def test_invalid_selection_raises(
    topic: str, vehicle: str, instance: int | None, what: str
) -> None:
    """A misspelled topic or an impossible instance raises, because a subscription to it would receive nothing."""
    with pytest.raises(AddressError, match=what):
        Selection(topic, vehicle, instance)


@pytest.mark.parametrize("prefix", ["", "/", "a/", "a//b", "*", "a/**", "@a", "a b"])
def test_invalid_prefix_raises(prefix: str) -> None:
    """A prefix with an empty chunk, a wildcard, a space or a leading @ raises AddressError."""
    with pytest.raises(AddressError, match="prefix"):
        check_prefix(prefix)


def test_errors_can_be_pickled() -> None:
    """In process pools, errors keep their text and attributes."""
    with pytest.raises(AddressError) as info:
        Address("a b", "vehicle_local_position")
    again = pickle.loads(pickle.dumps(info.value))
    assert (type(again), str(again), again.given) == (AddressError, str(info.value), "a b")


def test_address_of_another_process_is_found() -> None:
    """A pickled address has no hash, which differs between processes; it is hashed anew where it is loaded."""
    address = Address("7", "battery_status", 1)
    data = pickle.dumps(address)
    loaded = pickle.loads(data)
    assert b"hash" not in data
    assert {address: "found"}[loaded] == {loaded: "found"}[copy.deepcopy(address)] == "found"


def test_address_without_instance_sorts_first() -> None:
    """The first instance of a topic that is not built in has no number, and sorts before numbered ones."""
    plain, second, other = (
        Address("1", "logger_status"),
        Address("1", "logger_status", 1),
        Address("1", "event"),
    )
    assert sorted([second, plain, other]) == [other, plain, second]


@pytest.mark.parametrize("message", [3, None, object(), int])
def test_neither_message_nor_topic_raises(message: Any) -> None:
    """What is neither a message class nor the name of a topic is rejected with what is expected."""
    with pytest.raises(AddressError, match="a class that declares TOPICS, or the name of a topic"):
        topic_of(message)
