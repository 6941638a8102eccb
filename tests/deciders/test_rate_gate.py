"""The rate gate: which messages of a stream pass."""

from __future__ import annotations

import math
from itertools import pairwise

import hypothesis.strategies as st
import pytest
from hypothesis import given

from nedbus.client.qos import RATES
from nedbus.client.rate_gate import RateGate, check_max_rate, rate_step
from nedbus.errors import ConfigError


def passed(rate: float, times: list[float]) -> list[float]:
    """Return which of these times pass, in seconds."""
    gate = RateGate(rate)
    return [now for now in times if gate.passes(round(1e9 * now))]


def stream(rate: float, seconds: float) -> list[float]:
    """Return the times of a steady stream."""
    return [number / rate for number in range(round(rate * seconds))]


def test_steady_stream_passes_evenly() -> None:
    """Of 100 Hz to 5 Hz each 20th message passes, whatever its jitter, and without a drift in an hour."""
    times = [number / 100 + 0.002 * math.sin(number) for number in range(360_000)]
    taken = passed(5, times)
    assert len(taken) == 18_000
    assert {round(100 * (after - before)) for before, after in pairwise(taken)} == {20}


@pytest.mark.parametrize("rate", [0.3, 1, 3, 5, 7, 30, 33, 50, 70, 99, 100])
@pytest.mark.parametrize("source", [100.0, 103.7, 250.0])
def test_mean_is_the_rate(rate: float, source: float) -> None:
    """Where rates divide badly the mean is the one that was asked for, and not the next lower divisor."""
    assert len(passed(rate, stream(source, 1000.0))) == pytest.approx(1000 * rate, abs=2)


@pytest.mark.parametrize("rate", [2, 5, 10])
def test_slower_stream_passes_whole(rate: float) -> None:
    """A stream that is not faster than the rate loses nothing."""
    times = stream(2, 100.0)
    assert passed(rate, times) == times


@given(st.lists(st.floats(-0.09, 0.09), min_size=50, max_size=50))
def test_jitter_costs_one_message(jitter: list[float]) -> None:
    """Of a stream at the very rate that jitters by half a period at most one message is left out."""
    times = [number / 5 + late for number, late in enumerate(jitter)]
    assert len(passed(5, times)) >= len(times) - 1


@given(st.floats(0.1, 200.0), st.lists(st.floats(0.0, 3.0), min_size=1, max_size=200))
def test_never_more_than_the_rate_and_two(rate: float, steps: list[float]) -> None:
    """Whatever comes, in T seconds at most rate x (T + 2.5 ms) + 2 messages pass."""
    now, times = 1000.0, []
    for step in steps:
        now += step
        times.append(now)
    taken = passed(rate, times)
    for first in range(len(taken)):
        for last in range(first, len(taken)):
            assert last - first + 1 <= rate * (taken[last] - taken[first] + 0.0025) * (1 + 1e-6) + 2


def test_clock_that_was_set_back_goes_on() -> None:
    """After a restart with an earlier clock the stream passes at once."""
    gate = RateGate(5)
    times = (10**18, 10**18 + 100_000_000, 5_000_000_000, 5_100_000_000, 5_200_000_000)
    assert [gate.passes(now) for now in times] == [True, False, True, False, True]


def test_step_is_the_greatest_that_is_not_above() -> None:
    """A wish is served by a step of the ladder; below the least of them by that one."""
    assert [rate_step(rate) for rate in RATES] == list(RATES)
    wishes = {0.1: 1, 1.9: 1, 4.99: 2, 7: 5, 30: 20, 99: 50, 1e6: 100}
    assert {wish: rate_step(wish) for wish in wishes} == wishes


@pytest.mark.parametrize("value", [0, -1, -0.0, math.nan, math.inf, "5", True, None])
def test_invalid_rate_is_refused(value: object) -> None:
    """What is no finite number above 0 is a ConfigError, and a ValueError, that names the option."""
    with pytest.raises(ConfigError, match="max_rate") as error:
        check_max_rate(value)
    assert isinstance(error.value, ValueError)
