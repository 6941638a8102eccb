"""The definition of a message by class, name or topic."""

from typing import Final

from typing_extensions import TypeVar

from .messages.vehicle_local_position import VehicleLocalPosition
from .model.declaration import DEFAULT_TOPIC
from .model.definition import BY_TOPIC, MESSAGES, Definition
from .model.message import Message

M = TypeVar("M", bound=Message, default=VehicleLocalPosition)


def definition_of(message: type[M] | str) -> Definition[M]:
    """Return the definition of a message by class, name or topic; raise KeyError if it is unknown."""
    if isinstance(message, str):
        return MESSAGES[message] if message in MESSAGES else BY_TOPIC[message]
    return message.DEFINITION


DEFAULT: Final[Definition[VehicleLocalPosition]] = definition_of(DEFAULT_TOPIC)
"""The default message of functions that take one."""
