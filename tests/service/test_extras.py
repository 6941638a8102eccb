"""Optional dependencies: the hint where one is missing."""

from __future__ import annotations

import pytest

from nedbus.errors import ConfigError
from nedbus.extras import needs


@pytest.mark.parametrize(
    ("extra", "hint"), [("mcap", r"in a clone of nedbus, pip install '\.\[mcap\]'"), ("polars", "pip install polars")]
)
def test_hint_names_what_to_install(extra: str, hint: str) -> None:
    """An extra is installed from a clone, never by the name alone; a package of another project by its name."""
    with pytest.raises(ConfigError, match=rf"^gone: not installed: {hint}$"):
        needs(extra, "gone")
