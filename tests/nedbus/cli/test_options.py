"""Errors of commands: one line that names the cause, and the traceback with --debug."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
import typer

import nedbus
from nedbus.cli.app import make_app
from tests.peers.command_line import run_command


def fail(*_: object, **__: object) -> None:
    """Fail as the import of truncated bytecode does."""
    raise EOFError("marshal data too short")


@pytest.mark.parametrize(
    "function", ["nedbus.settings.load_settings", "nedbus.cli.output.logs.log_to_stderr"]
)
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


def options(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield every option of every command that takes one value, after the words of its command."""
    for option in command.params:
        if option.param_type_name == "option" and not (option.multiple or option.is_flag):
            yield path, option
    for name, inner in getattr(command, "commands", {}).items():
        yield from options(inner, (*path, name))


@pytest.mark.parametrize(("path", "option"), list(options(typer.main.get_command(make_app()))))
def test_option_given_twice_is_a_usage_error(path: tuple[str, ...], option: Any) -> None:
    """An option that takes one value and is given twice ends every command with 2, and is named."""
    name = option.opts[0]
    ended = run_command(*path, name, "1", name, "2", COLUMNS="200")
    assert ended.exit_code == 2
    assert name in ended.err
    assert "given 2 times, but it takes one value" in ended.err


def test_limit_proposes_count() -> None:
    """For a name that other tools use, the option of like meaning is proposed."""
    ended = run_command("echo", "--limit", "5", COLUMNS="200")
    assert ended.exit_code == 2
    assert "--count" in ended.err
    assert "--wait" not in ended.err


def test_argument_selects_a_vehicle_and_an_instance(endpoint: str, bus: nedbus.Bus) -> None:
    """VEHICLE/TOPIC/INSTANCE, as `nedbus list` prints it, selects one stream; several must agree on both parts."""
    for vehicle in ("1", "2"):
        for instance in (0, 1):
            publisher = bus.publisher("sensor_gps", vehicle=vehicle, instance=instance)
            publisher.publish(nedbus.SensorGps.model_validate({"timestamp": 1}))
    got = run_command("get", "-c", endpoint, "--json", "2/sensor_gps/1")
    assert [json.loads(line)["vehicle"] for line in got.out.splitlines()] == ["2"]
    assert json.loads(got.out)["instance"] == 1
    for other in ("1/sensor_gps/1", "2/sensor_gps/0"):
        ended = run_command("get", "-c", endpoint, "2/sensor_gps/1", other)
        assert ended.exit_code == 2
        assert f"'2/sensor_gps/1' and '{other}' differ in vehicle or instance" in ended.err


def test_flag_may_be_repeated() -> None:
    """A flag says the same when it is given twice."""
    assert run_command("schema", "--layouts", "--layouts").exit_code == 0
