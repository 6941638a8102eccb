"""Times of events as text."""

import pytest

from nedbus.vehicle_events import Event, Times


@pytest.mark.parametrize(
    ("boots", "text"),
    [
        ((8.0, 12.0), "from 8.000 to 12.000 s since boot (4.0 s)"),
        ((14.444, 0.736), "from 14.444 to 0.736 s since boot, after a reboot (4.0 s)"),
    ],
)
def test_period_across_a_reboot_says_so(boots: tuple[float, float], text: str) -> None:
    """A fault that ends after the next boot ends at an earlier time since boot."""
    begin, end = (
        Event("1", "silent", "begin", "bad", "silent", time, boot)
        for time, boot in zip((20.0, 24.0), boots, strict=True)
    )
    assert Times().period(begin, end, 4.0) == text
