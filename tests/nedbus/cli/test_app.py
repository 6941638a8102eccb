"""The list of commands, which imports none of them."""

from __future__ import annotations

from importlib import import_module
from inspect import getdoc

import pytest
import typer

from nedbus.cli.app import _COMMANDS, make_app


@pytest.mark.parametrize("name", _COMMANDS)
def test_summary_is_the_first_sentence_of_the_docstring(name: str) -> None:
    """The list of commands shows the same text as the help of each command."""
    commands = import_module(f"nedbus.cli.commands.{_COMMANDS[name].module}")
    function = getattr(commands, name, None) or getattr(commands, f"{name}_")
    text = function.info.help if isinstance(function, typer.Typer) else getdoc(function)
    assert (text or "").split("\n\n")[0] == _COMMANDS[name].summary


def test_only_given_commands_are_imported() -> None:
    """The application lists all commands, and has the options of those in the arguments."""
    listed = {each.name: each.callback for each in make_app(["why", "--help"]).registered_commands}
    assert {*listed, "pki"} == {*_COMMANDS}
    assert [
        name for name, callback in listed.items() if callback.__module__ != "nedbus.cli.app"
    ] == ["why"]
