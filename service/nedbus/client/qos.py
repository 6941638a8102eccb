"""Zenoh's quality of service for each topic: priority on a congested link, size of the publisher's cache, thinning."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from zenoh import Priority


@dataclass(frozen=True, slots=True)
class TopicQos:
    """How one topic is published.

    `priority`: on a congested link, messages of a higher priority go first.
    `cache`: messages that a publisher keeps for readers that missed some, about 20 s at the topic's full rate.
    """

    priority: Priority
    cache: int


TOPIC_QOS: Final[Mapping[str, TopicQos]] = {
    "vehicle_local_position": TopicQos(Priority.DATA_HIGH, 2000),
    "vehicle_local_position_groundtruth": TopicQos(Priority.DATA, 1000),
    "external_ins_local_position": TopicQos(Priority.DATA, 2000),
    "estimator_local_position": TopicQos(Priority.DATA, 400),
}

RATES: Final = (1, 2, 5, 10, 20, 50, 100)
"""Messages a second to which a publisher thins a stream where readers ask for it, each on a key of its own."""
