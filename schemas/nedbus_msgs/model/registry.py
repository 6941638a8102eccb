"""The messages that this version knows, and their topics: whatever has a file in `nedbus_msgs.messages`."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

from .declaration import Topic
from .definition import Definition

_messages: Final[dict[str, Definition[Any]]] = {}
_topics: Final[dict[str, Topic]] = {}
_by_topic: Final[dict[str, Definition[Any]]] = {}

MESSAGES: Final[Mapping[str, Definition[Any]]] = MappingProxyType(_messages)
"""The definitions by name of the message."""
TOPICS: Final[Mapping[str, Topic]] = MappingProxyType(_topics)
"""The topics of all messages by name."""
BY_TOPIC: Final[Mapping[str, Definition[Any]]] = MappingProxyType(_by_topic)
"""The definition of the messages on each topic."""


def register(definition: Definition[Any]) -> None:
    """Make a message known; raise ValueError if another one has its name or one of its topics."""
    taken = [name for name in definition.topics if name in _topics] + [definition.name] * (definition.name in _messages)
    if taken:
        raise ValueError(f"{definition.name}: there is a message with {', '.join(taken)} already")
    _messages[definition.name] = definition
    for topic in definition.topics.values():
        _topics[topic.name], _by_topic[topic.name] = topic, definition
