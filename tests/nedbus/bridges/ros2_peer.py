"""ROS 2 node based on zenoh-ros2-sdk, for a subprocess: `talk` publishes rows, `listen` prints received messages.

It is independent of nedbus: the JSON file named by its second argument has the type definition and the rows.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

os.environ["ZENOH_CONFIG_OVERRIDE"] = (
    # A peer, like every ROS 2 node with rmw_zenoh; BLOCK, because the test publishes without a pause.
    'transport/shared_memory/enabled=false;qos/publication=[{key_exprs: ["**"], config: {congestion_control: "block"}}]'
)

from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.discovery import get_topic_names_and_types

TYPE = "px4_msgs/msg/VehicleLocalPosition"
PAIRS = ("delta_xy", "delta_vxy")


def talk(topic: str, definition: str, rows: list[dict[str, Any]], **options: Any) -> None:
    """Wait for a subscriber, then publish each row."""
    publisher = ROS2Publisher(topic=topic, msg_type=TYPE, msg_definition=definition, **options)
    while not publisher.pub.matching_status.matching:
        time.sleep(0.01)
    for row in rows:
        publisher.publish(
            **{name: np.array(v, np.float32) if name in PAIRS else v for name, v in row.items()}
        )
    threading.Event().wait()  # until the parent process kills this one


def listen(topic: str, definition: str, rows: list[dict[str, Any]], **options: Any) -> None:
    """Print as many messages as there are rows, then the topics that ROS 2 lists."""
    done = threading.Event()
    left = len(rows)

    def on_message(message: Any) -> None:
        nonlocal left
        if not left:
            return
        fields = {name: getattr(message, name) for name in rows[0]}
        write({name: value.tolist() if name in PAIRS else value for name, value in fields.items()})
        left -= 1
        if not left:
            done.set()

    subscriber = ROS2Subscriber(
        topic=topic, msg_type=TYPE, msg_definition=definition, callback=on_message, **options
    )
    done.wait()
    options.pop("type_hash", None)
    write(get_topic_names_and_types(**options))
    subscriber.close()


def write(value: object) -> None:
    sys.stdout.write(f"{json.dumps(value)}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    role, given = sys.argv[1:]
    {"talk": talk, "listen": listen}[role](**json.loads(Path(given).read_text()))
    os._exit(0)  # the SDK never closes its session, which would keep the process alive
