"""Reboots of a vehicle whose streams have no common order."""

import pytest

from nedbus.timeline import RebootDetector, RebootSign

SECOND = 1_000_000  # us


def first(detector: RebootDetector) -> RebootSign:
    """Add a message of the stream "a" that is 1 s after a boot, 99 s older than the one before it."""
    return detector.add("a", SECOND, before=100 * SECOND, other=99 * SECOND, elapsed=5.0)


@pytest.mark.parametrize("stream", ["a", "b"])
def test_second_message_confirms_a_reboot(stream: str) -> None:
    """One message is no reboot; the next one of this stream, or of another one that went back as well, confirms it."""
    detector = RebootDetector()
    assert first(detector) is RebootSign.FIRST
    before = SECOND if stream == "a" else 98 * SECOND
    sign = detector.add(stream, 2 * SECOND, before=before, other=97 * SECOND, elapsed=1.0)
    assert (sign, detector.before) == (RebootSign.REBOOT, 100 * SECOND)


def test_stream_that_goes_on_had_one_damaged_time() -> None:
    """After a single time far back, the stream goes on as before it: no reboot."""
    detector = RebootDetector()
    first(detector)
    sign = detector.add("a", 101 * SECOND, before=SECOND, other=100 * SECOND, elapsed=1.0)
    assert sign is RebootSign.DAMAGED
    assert first(detector) is RebootSign.FIRST


def test_delayed_message_of_another_stream_decides_nothing() -> None:
    """A message from before a reboot may arrive between the first two of the new boot."""
    detector = RebootDetector()
    first(detector)
    assert (
        detector.add("b", 100 * SECOND, before=99 * SECOND, other=99 * SECOND, elapsed=0.1)
        is RebootSign.NONE
    )
    assert (
        detector.add("a", 2 * SECOND, before=SECOND, other=100 * SECOND, elapsed=1.0)
        is RebootSign.REBOOT
    )


@pytest.mark.parametrize(
    ("time", "other", "elapsed"),
    [(98 * SECOND, 99 * SECOND, 0.1), (SECOND, 2 * SECOND, 5.0), (50 * SECOND, 99 * SECOND, 5.0)],
)
def test_other_steps_back_are_no_reboots(time: int, other: int, elapsed: float) -> None:
    """No reboot: only the message before was later, or the vehicle cannot have been up for that long."""
    detector = RebootDetector()
    assert (
        detector.add("a", time, before=100 * SECOND, other=other, elapsed=elapsed)
        is RebootSign.NONE
    )
