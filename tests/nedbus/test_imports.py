"""Imports: a command and a script load only the packages that they use."""

from __future__ import annotations

from tests.peers.processes import Start


def test_what_is_not_used_is_not_loaded(start: Start) -> None:
    """A command is there at once: what it does not need is not imported.

    dir() of a fresh import has all public names, and loads only the contract, so that a plain REPL completes them.
    """
    program = """
import sys
def absent(names):
    assert not set(names.split()) & set(sys.modules), names
sys.argv = ["nedbus", "--version"]
from nedbus.cli import main
main()
absent("pydantic zenoh typer")
import nedbus, rlcompleter
shown = dir(nedbus)
assert {*nedbus.__all__, "VehicleAttitude", "frames", "__version__"} <= {*shown} and not {"cli", "_MODULES"} & {*shown}
absent("zenoh")
assert rlcompleter.Completer(globals()).complete("nedbus.connect_", 0).startswith("nedbus.connect_async")
absent("numpy typer rich cryptography")
import nedbus.cli.app
absent("numpy rich.progress cryptography")
"""
    process = start("-c", program, fresh=True)
    assert process.wait() == 0, process.err
