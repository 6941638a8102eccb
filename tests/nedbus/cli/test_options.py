"""Errors of commands: one line that names the cause, and the traceback with --debug."""

from __future__ import annotations

import pytest

from tests.peers.command_line import run_command


def fail(*_: object, **__: object) -> None:
    """Fail as the import of truncated bytecode does."""
    raise EOFError("marshal data too short")


@pytest.mark.parametrize("function", ["nedbus.settings.load_settings", "nedbus.cli.output.logs.log_to_stderr"])
def test_end_of_data_names_the_cause(monkeypatch: pytest.MonkeyPatch, function: str) -> None:
    """An EOFError, as of truncated bytecode, is one line with a remedy."""
    monkeypatch.setattr(function, fail)
    ended = run_command("health")
    assert ended.exit_code == 1
    assert ended.err.startswith("nedbus: unexpected end of data (marshal data too short): ")
    assert "delete all __pycache__ folders" in ended.err
    assert len(ended.err.splitlines()) == 1


def test_end_of_data_with_debug_shows_the_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    """With --debug, an EOFError shows where it was raised."""
    monkeypatch.setattr("nedbus.settings.load_settings", fail)
    ended = run_command("--debug", "health")
    assert ended.exit_code == 1
    assert "in fail\n" in ended.err
    assert "EOFError: marshal data too short" in ended.err
    assert "Aborted" not in ended.err
