"""Lazy imports: commands and scripts load only the packages that they use."""

from __future__ import annotations

from tests.peers.processes import Start


def test_unused_packages_are_not_imported(start: Start) -> None:
    """Commands import only the packages they use, for a fast start.

    `dir(nedbus)` lists all public names without importing Zenoh, for tab completion.
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
