"""Fixtures for tests that look up message definitions."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.waits import DEADLINE, changing_timings


@pytest.fixture(scope="module")
def long_lookup_timeout() -> Iterator[None]:
    """Raise the timeout of definition lookups to the tests' deadline: a message whose lookup times out is invalid."""
    with changing_timings() as timings:
        timings.definition_timeout = DEADLINE
        yield
