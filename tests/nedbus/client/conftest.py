"""Fixtures of tests that read messages without a file."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.waits import DEADLINE, changing_timings


@pytest.fixture(scope="module")
def patient_lookups() -> Iterator[None]:
    """Let readers wait for definitions until the deadline: a message whose lookup takes too long is invalid."""
    with changing_timings() as timings:
        timings.definition_timeout = DEADLINE
        yield
