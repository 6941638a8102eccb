"""Zenoh's quality of service: priority on a congested link, and the rates to which streams are thinned."""

from __future__ import annotations

from typing import Final

from zenoh import Priority

from nedbus_msgs import Topic

RATES: Final = (1, 2, 5, 10, 20, 50, 100)
"""Messages a second to which a publisher thins a stream where readers ask for it, each on a key of its own."""


def priority_of(topic: Topic) -> Priority:
    """Return Zenoh's priority of the messages of a topic."""
    return Priority.DATA_HIGH if topic.priority == "data_high" else Priority.DATA
