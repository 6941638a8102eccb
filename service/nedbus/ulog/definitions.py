"""Streams of logged messages: address, definition and decoding, for topics with and without a file in nedbus."""

from functools import lru_cache
from typing import Any

from nedbus_msgs import BY_TOPIC, TOPICS, Address, FieldType, define

from .records import Subscription


class LoggedStream:
    """The messages of one subscription: their address, their definition, and the decoding of their payloads.

    The definition is that of nedbus, or one of the log's format.
    A topic without a file in nedbus has its plain address for the first instance, and the number for others: a stream
    of data does not announce whether another instance will follow.

    Raises ValueError for a format that cannot be a message, AddressError for an invalid vehicle or topic.
    """

    def __init__(self, vehicle: str, subscription: Subscription) -> None:
        topic, layout = subscription.name, subscription.layout
        self.subscription = subscription
        self.names = tuple(field.name for field in layout.fields)
        """Its fields in the log."""
        self.definition = BY_TOPIC.get(topic) or _define(
            "".join(part.capitalize() for part in topic.split("_")),
            tuple((field.name, field.kind) for field in layout.fields),
        )
        has_number = TOPICS[topic].instances if topic in TOPICS else subscription.multi_id > 0
        self.address = Address(vehicle, topic, subscription.multi_id if has_number else None)
        self.converted: dict[str, FieldType] = {}
        """Fields that the message has with another type, such as an int32 of PX4 1.9 that is a uint8: that type."""
        for name, kind, _ in layout.fields:
            known = self.definition.known_types.get(name, {kind})
            if kind not in known:
                self.converted[name] = self.definition.types.get(name) or next(iter(known))
        self.unfit: dict[str, str] = {}
        """By the name of a field, where it was left out for the first time because its value does not fit."""

    def decode(self, payload: bytes) -> dict[str, Any]:
        """Return the fields of a message, without those whose value does not fit their type."""
        fields = self.subscription.layout.decode(payload)
        for name, kind in self.converted.items():
            value = fields.pop(name)
            fitted = kind.fit(value)
            if fitted is not None:
                fields[name] = fitted
            elif name not in self.unfit:
                topic = self.subscription.name
                self.unfit[name] = f"{topic}: left out {name} where it is not a {kind}, such as {value!r:.60}"
        return fields


_define = lru_cache(256)(define)  # shared by all instances and logs, since codecs are cached per definition
