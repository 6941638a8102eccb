"""The fuzz targets accept their seeds, which reach the code behind the parsers."""

from __future__ import annotations

import pytest

from fuzz.parsers import PARSERS
from fuzz.seeds import SEEDS


@pytest.mark.parametrize("name", PARSERS)
def test_seeds_are_parsed(name: str) -> None:
    """Each seed passes its target, and most are parsed to messages, so that mutations start from valid inputs."""
    results = [PARSERS[name](seed) for seed in SEEDS[name]()]
    assert sum(result > 0 for result in results) > len(results) / 3


@pytest.mark.parametrize("name", PARSERS)
@pytest.mark.parametrize("data", [b"", b"\0", b"\xff" * 64])
def test_empty_and_constant_inputs_are_accepted(name: str, data: bytes) -> None:
    PARSERS[name](data)
