"""What is on the router beside our prefix: nedbus under another one, and ROS 2's keys that nobody bridges."""

from __future__ import annotations

from collections.abc import Iterator

from .finding import Finding, list_names
from .observation import Observation
from .services import has_source


def check_other_keys(seen: Observation) -> Iterator[Finding]:
    """Yield what is published where readers of this prefix do not look."""
    prefixes = sorted({prefix for key in seen.elsewhere if (prefix := _prefix_of(key))})
    for prefix in prefixes[:5]:
        advice = f"to read them: --prefix {prefix}, or NEDBUS_PREFIX={prefix}; else give their publisher our prefix"
        seen_text = f"messages are published under {prefix}/, and this looks under {seen.prefix}/"
        yield Finding("prefix", prefix, "warning", seen_text, advice)
    if seen.ros2 and not has_source(seen, "px4-zenoh"):
        topics = list_names(sorted({f"/{token.key.topic}" for token in seen.ros2}))
        advice = "'nedbus serve --source px4-zenoh:' bridges them"
        yield Finding("ros2", "", "warning", f"ROS 2 or a PX4 publishes {topics}, and no service bridges it", advice)


def _prefix_of(key: str) -> str:
    """Return the prefix of a key of nedbus: what is before vehicle and topic."""
    vehicle, alive, _ = key.partition("/@alive/")
    before = vehicle.split("/")[: -1 if alive else -2]
    # `<domain>/fmu/out/vehicle_local_position` and the like belong to ROS 2.
    return "" if not before or before[0].isdecimal() else "/".join(before)
