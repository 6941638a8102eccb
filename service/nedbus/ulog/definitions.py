"""Definitions and addresses of logged messages, for topics with and without a file in nedbus."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from nedbus_msgs import BY_TOPIC, TOPICS, Address, Definition, FieldType, define

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


_define = lru_cache(256)(define)  # shared by all instances and logs, since codecs are cached per definition


class Fitting:
    """Conversion of logged fields of another type than the message has, such as an int32 of PX4 1.9 that is a uint8."""

    def __init__(self, definition: Definition[Any], subscription: Subscription) -> None:
        self.types: dict[str, FieldType] = {}
        """The type of the message, by the name of the field."""
        self.unfit: dict[str, str] = {}
        """By the name of a field, where it was left out for the first time."""
        self._topic = subscription.name
        for name, kind, _ in subscription.fields:
            known = definition.known_types.get(name, {kind})
            if kind not in known:
                self.types[name] = definition.types.get(name) or next(iter(known))

    def apply(self, fields: dict[str, Any]) -> None:
        """Convert the fields of a message in place; drop those whose value does not fit."""
        for name, kind in self.types.items():
            value = fields.pop(name)
            fitted = kind.fit(value)
            if fitted is not None:
                fields[name] = fitted
            elif name not in self.unfit:
                self.unfit[name] = f"{self._topic}: left out {name} where it is not a {kind}, such as {value!r:.60}"


def address_of(vehicle: str, subscription: Subscription) -> Address:
    """Return the address of a logged stream.

    A topic without a file in nedbus has its plain address for the first instance, and the number for others: a stream
    of data does not announce whether another instance will follow.

    Raises AddressError for an invalid vehicle or topic.
    """
    topic = TOPICS.get(subscription.name)
    has_number = topic.instances if topic else subscription.multi_id > 0
    return Address(vehicle, subscription.name, subscription.multi_id if has_number else None)
