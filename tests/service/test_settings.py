"""Settings: nedbus.toml below the environment below flags; every mistake names its place."""

from __future__ import annotations

from pathlib import Path

import pytest

from nedbus.errors import ConfigError
from nedbus.settings import load_settings


def test_defaults() -> None:
    """Without any setting a client joins loopback."""
    settings = load_settings()
    assert settings.routers == ("tcp/127.0.0.1:7447",)
    assert (settings.prefix, settings.vehicle, settings.source, settings.until_done) == ("nedbus", "1", (), False)


def test_order_is_file_environment_flag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each beats the one before it; None is no flag."""
    file = tmp_path / "other.toml"
    file.write_text('connect = "tcp/file:1"\nprefix = "file"\nvehicle = 5\n')
    assert load_settings(file).connect == ("tcp/file:1",)
    monkeypatch.setenv("NEDBUS_CONNECT", "tcp/env:1, tcp/env:2")
    monkeypatch.setenv("NEDBUS_PREFIX", "env")
    settings = load_settings(file, prefix="flag", connect=None)
    assert (settings.connect, settings.prefix, settings.vehicle) == (("tcp/env:1", "tcp/env:2"), "flag", "5")


def test_file_is_the_named_one_or_the_one_beside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """--config, else NEDBUS_CONFIG, else ./nedbus.toml."""
    for name in ("a", "b", "nedbus"):
        (tmp_path / f"{name}.toml").write_text(f'prefix = "{name}"\n')
    assert load_settings().prefix == "nedbus"
    monkeypatch.setenv("NEDBUS_CONFIG", str(tmp_path / "a.toml"))
    assert load_settings().prefix == "a"
    assert load_settings(tmp_path / "b.toml").prefix == "b"


@pytest.mark.parametrize(
    ("text", "place", "reason"),
    [
        ('connect = ["tcp/a:1"', "line 1, column 21", "Unclosed array"),
        ("vehicle = 1\nx y", "line 2, column 3", "Expected '=' after a key"),
        ("vehicle = 1\n\n  conect = 3", "line 3, column 3", "there is no setting 'conect': choose from connect,"),
        ('listen = ["7447"]', "line 1, column 1", "'7447' is not an endpoint: write PROTOCOL/HOST:PORT"),
        ('prefix = "a//b"', "line 1, column 1", "prefix 'a//b' is not valid"),
        ('vehicle = "a b"', "line 1, column 1", "vehicle 'a b' is not valid"),
        ('until_done = "maybe"', "line 1, column 1", "until_done: "),
        ("[source]\na = 1", "line 1, column 2", "source: "),
    ],
)
def test_mistake_in_the_file_is_found(tmp_path: Path, text: str, place: str, reason: str) -> None:
    """File, line, column, and what to write instead."""
    file = tmp_path / "nedbus.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as info:
        load_settings()
    assert str(info.value).startswith(f"nedbus.toml, {place}: ")
    assert reason in info.value.reason


def test_mistake_in_the_environment_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The variable is the place."""
    monkeypatch.setenv("NEDBUS_LISTEN", "here")
    with pytest.raises(ConfigError, match=r"^NEDBUS_LISTEN: 'here' is not an endpoint"):
        load_settings()


def test_missing_file_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file that was asked for must be there."""
    with pytest.raises(ConfigError, match=r"no\.toml: there is no such file"):
        load_settings(tmp_path / "no.toml")
    monkeypatch.setenv("NEDBUS_CONFIG", "gone.toml")
    with pytest.raises(ConfigError, match=r"gone\.toml: there is no such file"):
        load_settings()
