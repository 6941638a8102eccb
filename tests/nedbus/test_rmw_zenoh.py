"""ROS 2 over Zenoh from a program: what a session of a bus declares is listed and parsed by another one."""

from __future__ import annotations

import pytest

import nedbus
from nedbus.errors import ClosedError
from nedbus.rmw_zenoh import (
    PublisherToken,
    TopicKey,
    gid_of_token,
    node_token,
    px4_publishers_key_expr,
    token_keys,
    translate_zenoh_errors,
)
from nedbus_msgs import DEFAULT, dds_type, hash_of, ros2_type
from tests.flights.messages import VLP
from tests.waits import wait_for_router


def test_publisher_of_a_program_is_found_by_its_token(bus: nedbus.Bus) -> None:
    """The token of a publisher of a PX4 message names its node and the key of its messages; that of a node is none."""
    name = ros2_type(DEFAULT)
    key = TopicKey(0, f"fmu/out/{VLP}", dds_type(name), hash_of(DEFAULT.current, name))
    with bus.open_session() as session, bus.open_session() as observer, translate_zenoh_errors():
        zid = str(session.info.zid())
        text = key.token("MP", zid, "my_node", 1)
        tokens = [
            session.liveliness().declare_token(each)
            for each in (node_token(0, zid, "my_node"), text)
        ]
        wait_for_router(session)
        (found,) = token_keys(observer, px4_publishers_key_expr(0), timeout=5.0)
        token = PublisherToken.parse(found)
        assert (token.node, token.key, len(gid_of_token(found))) == ("my_node", key, 16)
        del tokens


def test_error_of_a_closed_session_is_typed(bus: nedbus.Bus) -> None:
    """`translate_zenoh_errors` raises ClosedError for a closed session, as the methods of a bus."""
    session = bus.open_session()
    session.close()
    with pytest.raises(ClosedError), translate_zenoh_errors():
        session.liveliness().declare_token("a")
