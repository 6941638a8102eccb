"""The names of ROS 2 topics: the pair (namespace, address) <-> topic name."""

from __future__ import annotations

import re
from typing import Final

from nedbus_msgs.model.definition import TOPICS
from nedbus_msgs.topics import Address, get_topic

_PX4_PATH: Final = ("fmu", "out")
_TOPIC = re.compile(r"([a-z][a-z0-9_]*?)(?:_v\d+)?(?:_?(\d{1,3}))?")


def split_ros2_topic(topic: str) -> tuple[str, str, int | None]:
    """Return the namespace, the uORB topic and the instance that the name of a ROS 2 topic stands for.

    `px4_1/fmu/out/estimator_local_position_0` is namespace `px4_1` and instance 0.
    The `_v1` of a versioned topic is ignored.

    Raises AddressError for another name than PX4's.
    """
    *path, name = topic.strip("/").split("/")
    if tuple(path[-2:]) == _PX4_PATH:
        path = path[:-2]
    found = None if name in TOPICS else _TOPIC.fullmatch(name)
    uorb, number = found.groups() if found else (name, None)
    if number is None and get_topic(uorb).instances:
        number = 0
    return "/".join(path), uorb, None if number is None else int(number)


def ros2_topic_of(address: Address, namespace: str) -> str:
    """Return the name of an address's ROS 2 topic, without a leading slash; an empty namespace stands for none."""
    plain = address.instance is None or (address.instance == 0 and get_topic(address.topic).plain_first)
    topic = address.topic if plain else f"{address.topic}_{address.instance}"
    return "/".join(filter(None, (namespace.strip("/"), *_PX4_PATH, topic)))
