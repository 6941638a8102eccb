"""Optional dependencies: the error where one is missing."""

from __future__ import annotations

import gc

import pytest

from nedbus.errors import ConfigError
from nedbus.extras import import_optional


@pytest.mark.parametrize(
    ("extra", "command"),
    [("mcap", "in a clone of nedbus, pip install '.[mcap]'"), ("polars", "pip install polars")],
)
def test_missing_package_is_named_with_its_cure(extra: str, command: str) -> None:
    """An extra is never installed by the name of nedbus alone, which is not ours on PyPI; another package is."""
    with pytest.raises(ConfigError) as caught:
        import_optional(extra, "gone")
    assert str(caught.value) == f"gone: not installed: {command}"


def test_import_leaves_garbage_collection_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that turns garbage collection off while a module is imported, in another thread, finds it off."""
    seen = list[bool]()

    def import_slowly(_: str) -> None:
        seen.append(gc.isenabled())
        gc.disable()

    monkeypatch.setattr("nedbus.extras.import_module", import_slowly)
    try:
        import_optional("web", "slow")
        assert (seen, gc.isenabled()) == ([True], False)
    finally:
        gc.enable()
