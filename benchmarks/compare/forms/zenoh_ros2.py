"""zenoh-ros2-sdk: a message of ROS 2 as CDR over Zenoh, with rmw_zenoh's attachment; settings make publishers wait."""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.qos import QosHistoryKind, QosProfile

from benchmarks.compare.case import Case
from benchmarks.compare.fields import FIELDS, TYPES

PACKAGES = ["zenoh-ros2-sdk==0.1.8"]

OVERRIDE = ";".join(
    [
        'mode="client"',  # the default, peer, would bypass the router
        "listen/endpoints=[]",
        "transport/shared_memory/enabled=false",
        # with QoS "reliable" the SDK does not find CongestionControl in zenoh 1.10, and drops messages
        'qos/publication=[{key_exprs: ["**"], config: {congestion_control: "block"}}]',
    ]
)

VALUES = {
    name: np.array(value, np.float32) if type(value) is tuple else value
    for name, value in FIELDS.items()
}


def options(endpoint: str) -> dict[str, Any]:
    """Return the settings that both ends must share."""
    os.environ["ZENOH_CONFIG_OVERRIDE"] = OVERRIDE
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    return {
        "topic": "/fmu/out/vehicle_local_position",
        "msg_type": "px4_msgs/msg/VehicleLocalPosition",
        "msg_definition": "".join(f"{type_name} {name}\n" for name, type_name in TYPES.items()),
        "router_ip": host,
        "router_port": int(port),
        "qos": QosProfile(history_kind=QosHistoryKind.KEEP_ALL),
    }


def compile_codec(end: ROS2Publisher | ROS2Subscriber) -> None:
    """Make rosbags generate its code for the type now, which takes 40 ms, instead of at the first message."""
    store = end.session_mgr.store
    message = store.types[end.msg_type](**VALUES)
    store.deserialize_cdr(store.serialize_cdr(message, end.msg_type), end.msg_type)


@contextmanager
def publish(case: Case) -> Iterator[list[Callable[[int], None]]]:
    publisher = ROS2Publisher(**options(case.endpoint))
    compile_codec(publisher)
    yield [lambda stamp: publisher.publish(**{**VALUES, "timestamp": stamp})]
    publisher.close()


def receive(case: Case, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    done = threading.Event()

    def take(message: Any) -> None:
        if not seen(message.timestamp if message.x else 0):
            done.set()

    subscriber = ROS2Subscriber(callback=take, **options(case.endpoint))
    compile_codec(subscriber)
    ready()
    done.wait()
    subscriber.close()
