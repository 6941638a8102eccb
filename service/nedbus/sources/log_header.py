"""Expected duration of the header of PX4's ULog stream, from the round trip of the link; does not need pymavlink."""

from typing import Final

# messages of a header with PX4's default topics: 410 with PX4 1.17, 468 with 1.18
DEFAULT_COUNT: Final = 470
# messages of a header without topics: parameters and their defaults, and event metadata
FIXED_COUNT: Final = 230
COUNT_PER_TOPIC: Final = 2.5  # 2.4 were measured with 16 and 22 topics, 1.8 with 101
PROCESSING: Final = 0.004  # s that PX4 needs for a message, in addition to the round trip


def expected_header(round_trip: float, topics: int | None = None) -> float:
    """Return the expected duration [s] of a header with this number of topics; None for PX4's default topics."""
    count = DEFAULT_COUNT if topics is None else FIXED_COUNT + topics * COUNT_PER_TOPIC
    return count * (round_trip + PROCESSING)
