"""Optional dependencies: the error for a missing package, and thread safety of the import."""

from __future__ import annotations

import gc

import pytest

from nedbus.errors import ConfigError
from nedbus.extras import import_optional


@pytest.mark.parametrize(
    ("extra", "command"),
    [
        ("mcap", "in a nedbus clone, run pip install -e '.[mcap]'"),
        ("polars", "run pip install polars"),
    ],
)
def test_missing_package_raises_with_install_command(extra: str, command: str) -> None:
    """The error suggests installing from a clone, because another project owns the name nedbus on PyPI."""
    with pytest.raises(ConfigError) as caught:
        import_optional(extra, "gone")
    assert str(caught.value) == f"gone: not installed; {command}"


def test_import_does_not_change_garbage_collection(monkeypatch: pytest.MonkeyPatch) -> None:
    """If another thread disables garbage collection during an import, it stays disabled."""
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
