"""The names of ROS 2 topics: the pair (namespace, address) <-> topic name."""

from __future__ import annotations

import re
from typing import Final

from .errors import AddressError
from .topics import TOPICS, Address

_PX4_PATH: Final = ("fmu", "out")
_TOPIC = re.compile(rf"({'|'.join(sorted(TOPICS, key=len, reverse=True))})(?:_v\d+)?(?:_?(\d{{1,3}}))?")


def split_ros2_topic(topic: str) -> tuple[str, str, int | None]:
    """Return the namespace, the uORB topic and the instance that the name of a ROS 2 topic stands for.

    `px4_1/fmu/out/estimator_local_position_0` is namespace `px4_1` and instance 0.
    The `_v1` of a versioned topic is ignored.

    Raises AddressError for a name that is not one of the four topics.
    """
    *path, name = topic.strip("/").split("/")
    found = _TOPIC.fullmatch(name)
    if found is None:
        raise AddressError("topic", name, f"one of {', '.join(TOPICS)}, perhaps with _0, _1 ... for its instance")
    instance = None if found[2] is None else int(found[2])
    if instance is None and TOPICS[found[1]].instances:
        instance = 0
    if tuple(path[-2:]) == _PX4_PATH:
        path = path[:-2]
    return "/".join(path), found[1], instance


def ros2_topic_of(address: Address, namespace: str) -> str:
    """Return the name of an address's ROS 2 topic, without a leading slash; an empty namespace stands for none."""
    topic = address.topic if address.instance is None else f"{address.topic}_{address.instance}"
    return "/".join(filter(None, (namespace.strip("/"), *_PX4_PATH, topic)))
