"""Definitions and addresses of logged messages, for topics with and without a file in nedbus."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from nedbus_msgs import BY_TOPIC, TOPICS, Address, Definition, define

from .records import Subscription


def definition_of(subscription: Subscription) -> Definition[Any]:
    """Return the definition of a logged message: ours, or one of its format.

    Raises ValueError for a format that cannot be a message.
    """
    known = BY_TOPIC.get(subscription.name)
    if known is not None:
        return known
    name = "".join(part.capitalize() for part in subscription.name.split("_"))
    return _define(name, tuple((field.name, field.kind) for field in subscription.fields))


_define = lru_cache(1024)(define)  # shared by all instances and logs, since codecs are cached per definition


def address_of(vehicle: str, subscription: Subscription) -> Address:
    """Return the address of a logged stream.

    A topic without a file in nedbus has its plain address for the first instance, and the number for others: a stream
    of data does not announce whether another instance will follow.

    Raises AddressError for an invalid vehicle or topic.
    """
    topic = TOPICS.get(subscription.name)
    has_number = topic.instances if topic else subscription.multi_id > 0
    return Address(vehicle, subscription.name, subscription.multi_id if has_number else None)
