"""The comparison of the public API with the last release detects changes that break scripts."""

from __future__ import annotations

import pytest

import nedbus

pytest.importorskip("griffe")  # part of the dependency group `dev`

from .api_baseline import BASELINE, compatible_range, describe_api, find_breakages

API = "class nedbus:\n    class Bus:\n        def get(self, topic: str, *, timeout: float = 1.0) -> int: ...\n"


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("def get(", "def fetch(", "nedbus.Bus.get: Public object was removed"),
        (", *, timeout: float = 1.0", "", "nedbus.Bus.get: Parameter was removed (timeout)"),
        (" = 1.0", "", "nedbus.Bus.get: Parameter is now required"),
        ("*, ", "", ""),
        ("topic: str, ", "topic: str, more: int = 0, ", ""),
        ("        def get", "        name: str\n        def get", ""),
        ("class Bus", "class Buses", "nedbus.Bus: Public object was removed"),
    ],
)
def test_breaking_api_change_is_detected(old: str, new: str, found: str) -> None:
    changes = [*find_breakages(API, API.replace(old, new))]
    assert len(changes) == bool(found)
    assert not found or changes[0].startswith(found)


@pytest.mark.process  # Griffe calls git
def test_public_api_is_compatible_with_last_release() -> None:
    """Every public name, parameter and default of the last release still exists; a release renews the baseline."""
    old = BASELINE.read_text()
    version = old.split(maxsplit=3)[2].rstrip(",")
    if compatible_range(version) == compatible_range(nedbus.__version__):
        assert [*find_breakages(old, describe_api())] == []


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [("0.1.0", "0.1.9", True), ("0.1.0", "0.2.0", False), ("1.0.0", "1.9.0", True)],
)
def test_compatible_versions_share_a_range(one: str, other: str, same: bool) -> None:
    assert (compatible_range(one) == compatible_range(other)) is same
