"""Optional dependencies: what is said where one is missing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from nedbus.errors import ConfigError
from nedbus.extras import needs

COMMIT = "92203c1cde5ea4942f5e8765fc836b8ee62c10d5"
CLONE = "in a clone of nedbus, pip install '.[mcap]'"


@pytest.mark.parametrize(
    ("origin", "command"),
    [
        ({"url": "{here}/my%20clone", "dir_info": {}}, "pip install '{path}/my clone[mcap]'"),
        ({"url": "{here}/my%20clone", "dir_info": {"editable": True}}, "pip install -e '{path}/my clone[mcap]'"),
        ({"url": "{here}/it%27s.whl", "archive_info": {}}, "pip install '{path}/it'\"'\"'s.whl[mcap]'"),
        (
            {"url": "ssh://git@base.lan/ned bus", "vcs_info": {"vcs": "git", "commit_id": COMMIT}},
            f"pip install 'nedbus[mcap] @ git+ssh://git@base.lan/ned%20bus@{COMMIT}'",
        ),
        (
            {"url": "https://base.lan/nedbus-1.whl", "archive_info": {}},
            "pip install 'nedbus[mcap] @ https://base.lan/nedbus-1.whl'",
        ),
        ({"url": "{here}/removed", "dir_info": {}}, CLONE),
        ({"url": None}, CLONE),
        ([], CLONE),
        (None, CLONE),
    ],
    ids=["clone", "editable", "wheel", "repository", "archive", "removed", "damaged", "foreign", "none"],
)
def test_hint_names_the_origin_of_the_installation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, origin: object, command: str
) -> None:
    """An extra is installed from where nedbus came from, ready for a shell, and never by the name alone."""
    (tmp_path / "my clone").mkdir()
    (tmp_path / "it's.whl").touch()
    metadata = tmp_path / "site" / "nedbus-0.1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: nedbus\nVersion: 0.1.0\n")
    if origin is not None:
        (metadata / "direct_url.json").write_text(json.dumps(origin).replace("{here}", tmp_path.as_uri()))
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    with pytest.raises(ConfigError) as caught:
        needs("mcap", "gone")
    assert str(caught.value) == f"gone: not installed: {command.replace('{path}', str(tmp_path))}"


def test_package_that_is_no_extra() -> None:
    """A package of somebody else is installed by its name."""
    with pytest.raises(ConfigError, match=r"^gone: not installed: pip install polars$"):
        needs("polars", "gone")
