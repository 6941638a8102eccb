"""Publish and receive messages with consecutive timestamps, and wait until a publisher has a subscriber."""

from __future__ import annotations

from functools import partial
from typing import Any, cast

import numpy as np
import zenoh

import nedbus
from nedbus_msgs.arrays import MessageArray, to_array
from tests.flights.messages import message
from tests.waits import DEADLINE, wait_for


def numbered(count: int, *, first: int = 1) -> MessageArray:
    """Return `count` messages, with the timestamps `first`, `first + 1`, ..."""
    messages: MessageArray = np.repeat(to_array([message()]), count)
    messages["timestamp"] = np.arange(first, first + count)
    return messages


def publish(publisher: nedbus.Publisher, *timestamps: int) -> None:
    """Publish a message with each of these timestamps."""
    for timestamp in timestamps:
        publisher.publish(message(timestamp))


def has_subscriber(publisher: nedbus.Publisher) -> bool:
    """Return True if a publisher has a matching subscriber."""
    # the status depends on the session
    probe = publisher._writer.session.declare_publisher(publisher.key)
    status = cast("zenoh.MatchingStatus", probe.matching_status)
    probe.undeclare()
    return status.matching


def wait_for_subscriber(publisher: nedbus.Publisher) -> None:
    """Wait until a publisher has a matching subscriber, which would miss messages published earlier."""
    wait_for(partial(has_subscriber, publisher), what=f"a subscriber of {publisher.key}")


def receive_timestamps(subscription: nedbus.Subscription[Any], count: int) -> list[int]:
    """Receive `count` messages and return their timestamps."""
    return [subscription.receive(DEADLINE).message.timestamp for _ in range(count)]
