"""The topic table, and the pair address <-> key expression."""

from __future__ import annotations

import pickle

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from nedbus_msgs import (
    TOPICS,
    Address,
    AddressError,
    address_of_alive_key,
    alive_selection,
    check_prefix,
    schema_key,
    selection,
    status_key,
    taken_key,
)

CHUNK = st.text("ABCXYZabcxyz0189_-", min_size=1, max_size=64)
PREFIXES = st.lists(CHUNK, min_size=1, max_size=3).map("/".join)


@st.composite
def addresses(draw: st.DrawFn) -> Address:
    topic = draw(st.sampled_from(list(TOPICS.values())))
    instance = draw(st.integers(0, 255)) if topic.instances else None
    return Address(draw(CHUNK), topic.name, instance)


def test_topics_are_px4s_four() -> None:
    """The four uORB topics of VehicleLocalPosition; only the estimators' has instances."""
    assert {name: topic.instances for name, topic in TOPICS.items()} == {
        "vehicle_local_position": False,
        "vehicle_local_position_groundtruth": False,
        "external_ins_local_position": False,
        "estimator_local_position": True,
    }


def test_keys_are_as_documented() -> None:
    """These strings are the contract with clients in any language."""
    assert Address("7", "vehicle_local_position").key() == "nedbus/7/vehicle_local_position"
    estimator = Address("7", "estimator_local_position", 2)
    assert estimator.key() == "nedbus/7/estimator_local_position/2"
    assert estimator.key(prefix="fleet/a") == "fleet/a/7/estimator_local_position/2"
    assert estimator.alive_key() == "nedbus/7/@alive/estimator_local_position/2"
    assert estimator.rejected_key() == "nedbus/@rejected/7/estimator_local_position/2"
    assert schema_key() == "nedbus/@schema/VehicleLocalPosition"
    assert status_key("a-1") == "nedbus/@service/a-1/status"
    assert taken_key(selection("vehicle_local_position")) == "nedbus/*/vehicle_local_position/@taken"


@given(addresses(), PREFIXES)
def test_address_and_key_round_trip(address: Address, prefix: str) -> None:
    """Every address has a valid key, and the key gives the address back."""
    zenoh.KeyExpr(address.key(prefix=prefix))
    assert Address.from_key(address.key(prefix=prefix), prefix=prefix) == address
    assert address_of_alive_key(address.alive_key(prefix=prefix), prefix=prefix) == address


@given(st.one_of(st.text(max_size=60), st.lists(st.sampled_from([
    "nedbus", "7", "*", "**", "@alive", "vehicle_local_position", "estimator_local_position", "0", "01", "256", "", "é",
]), max_size=6).map("/".join)))  # fmt: skip
def test_any_key_gives_an_address_or_the_one_error(key: str) -> None:
    """No string makes anything but an address that gives the same key, or an AddressError."""
    try:
        assert Address.from_key(key).key() == key
    except AddressError as exc:
        assert str(exc)


@given(addresses(), PREFIXES)
def test_selection_matches_its_addresses_only(address: Address, prefix: str) -> None:
    """A selection by topic, vehicle and instance matches the address, and none of its neighbours."""
    key = address.key(prefix=prefix)
    for topic in ("*", address.topic):
        for vehicle in ("*", address.vehicle):
            chosen = selection(topic, vehicle=vehicle, prefix=prefix)
            assert zenoh.KeyExpr(chosen).includes(key)
            assert zenoh.KeyExpr(taken_key(chosen)).includes(taken_key(key))
    other = zenoh.KeyExpr(selection(address.topic, vehicle=f"{address.vehicle[:-1]}~"[:-1] + "Q", prefix=prefix))
    assert address.vehicle.endswith("Q") or not other.intersects(key)
    assert zenoh.KeyExpr(alive_selection(prefix=prefix)).includes(address.alive_key(prefix=prefix))
    assert not zenoh.KeyExpr(selection(prefix=prefix)).intersects(address.alive_key(prefix=prefix))
    assert not zenoh.KeyExpr(selection(prefix=prefix)).intersects(address.rejected_key(prefix=prefix))
    assert not zenoh.KeyExpr(selection(prefix=prefix)).intersects(taken_key(key))


def test_selection_of_an_instance() -> None:
    """One estimator of all vehicles, or all of one."""
    assert selection("estimator_local_position", instance=1) == "nedbus/*/estimator_local_position/1"
    assert selection("estimator_local_position", vehicle="7") == "nedbus/7/estimator_local_position/*"


@pytest.mark.parametrize(
    ("vehicle", "topic", "instance", "what"),
    [
        ("", "vehicle_local_position", None, "vehicle"),
        ("a/b", "vehicle_local_position", None, "vehicle"),
        ("@alive", "vehicle_local_position", None, "vehicle"),
        ("*", "vehicle_local_position", None, "vehicle"),
        ("x" * 65, "vehicle_local_position", None, "vehicle"),
        ("7", "vehicle_attitude", None, "topic"),
        ("7", "vehicle_local_position", 0, "instance"),
        ("7", "estimator_local_position", None, "instance"),
        ("7", "estimator_local_position", 256, "instance"),
        ("7", "estimator_local_position", -1, "instance"),
    ],
)
def test_impossible_address_is_refused(vehicle: str, topic: str, instance: int | None, what: str) -> None:
    """The error names what is wrong, what was given and what is expected."""
    with pytest.raises(AddressError, match=rf"{what} .* is not valid: expected"):
        Address(vehicle, topic, instance)


def test_impossible_selection_is_refused() -> None:
    """A typo in a topic must not become a subscription that stays silent."""
    for arguments in (("vehicle_local_positon", "*", None), ("vehicle_local_position", "*", 0), ("*", "*", 1)):
        with pytest.raises(AddressError):
            selection(arguments[0], vehicle=arguments[1], instance=arguments[2])
    with pytest.raises(AddressError):
        selection(vehicle="a b")


@pytest.mark.parametrize("prefix", ["", "/", "a/", "a//b", "*", "a/**", "@a", "a b"])
def test_impossible_prefix_is_refused(prefix: str) -> None:
    """Prefixes are plain chunks."""
    with pytest.raises(AddressError, match="prefix"):
        check_prefix(prefix)


@pytest.mark.parametrize("instance", [-1, 256, True, "0"])
def test_impossible_instance_is_refused_in_a_selection(instance: int) -> None:
    """What cannot be published cannot be subscribed to either."""
    with pytest.raises(AddressError, match="instance"):
        selection("estimator_local_position", instance=instance)


def test_alive_key_must_be_one() -> None:
    """A data key is no liveliness token."""
    with pytest.raises(AddressError):
        address_of_alive_key("nedbus/7/vehicle_local_position")


def test_errors_can_be_pickled() -> None:
    """Errors cross process pools with their text and their facts."""
    with pytest.raises(AddressError) as info:
        Address("a b", "vehicle_local_position")
    again = pickle.loads(pickle.dumps(info.value))
    assert (type(again), str(again), again.given) == (AddressError, str(info.value), "a b")
