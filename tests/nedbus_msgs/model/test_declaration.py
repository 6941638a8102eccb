"""Declarations of topics: the depth of their history."""

from __future__ import annotations

import pytest

from nedbus_msgs import DEFAULT, TOPICS, get_topic

_SECONDS = 20


@pytest.mark.parametrize(
    "name", [name for name, each in TOPICS.items() if each.rate and not each.on_change]
)
@pytest.mark.parametrize("size", [1, 300, 65_535])
def test_history_of_a_topic_with_a_rate_is_20_s(name: str, size: int) -> None:
    """A publisher keeps 20 s of messages at the nominal rate, at least 400, whatever their size."""
    topic = get_topic(name)
    assert topic.kept_for_source(size) == topic.kept == max(400, _SECONDS * topic.rate)


def test_all_position_topics_have_a_history_of_20_s() -> None:
    """All four topics of vehicle_local_position have a rate, so their history does not have the limits of others."""
    kept = {name: topic.kept_for_source(244) for name, topic in DEFAULT.topics.items()}
    assert kept == {
        "vehicle_local_position": 2000,
        "vehicle_local_position_groundtruth": 1000,
        "external_ins_local_position": 1000,
        "estimator_local_position": 400,
    }


@pytest.mark.parametrize("name", ["sensor_combined", "home_position", "failsafe_flags"])
@pytest.mark.parametrize(
    ("size", "kept"), [(1, 50), (5242, 50), (5243, 49), (65_535, 4), (2**18, 1), (2**20, 1)]
)
def test_history_of_a_topic_without_a_rate_is_bounded(name: str, size: int, kept: int) -> None:
    """A source's topic without a nominal rate, or sent on change, keeps 50 messages of up to 256 KiB; a script's 400.

    It keeps the last message whatever its size.
    """
    assert get_topic(name).kept_for_source(size) == kept
    assert get_topic(name).kept == 400
