"""Fixtures of tests that read messages without a file."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from nedbus.client.receiving import layout_lookup
from tests.waits import DEADLINE


@pytest.fixture(scope="module")
def patient_lookups() -> Iterator[None]:
    """Let readers wait for definitions until the deadline: a message whose lookup takes too long is invalid."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(layout_lookup, "_TIMEOUT", 2 * DEADLINE)
        patch.setattr(layout_lookup, "_PATIENCE", DEADLINE)
        yield
