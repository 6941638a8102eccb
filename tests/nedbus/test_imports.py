"""Lazy imports: commands and scripts load only the packages that they use."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.flights.ulogs import write_log
from tests.peers.processes import Start


@pytest.mark.slow
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
"""
    process = start("-c", program, fresh=True)
    assert process.wait() == 0, process.err


def test_list_of_commands_imports_no_command(start: Start) -> None:
    """`nedbus --help`, and `nedbus` alone, load no message, no setting and no session."""
    program = """
import sys
from nedbus.cli import run_command
for arguments in ["--help"], []:
    sys.argv = ["nedbus", *arguments]
    try:
        run_command()
    except SystemExit:
        pass
    assert not {"pydantic", "nedbus_msgs", "zenoh", "numpy", "nedbus.settings"} & set(sys.modules), arguments
"""
    process = start("-c", program, fresh=True)
    assert process.wait() == 0, process.err


@pytest.mark.slow
def test_connecting_imports_no_analysis(start: Start, endpoint: str) -> None:
    """`nedbus.connect` needs neither the analysis of events, nor arrays, nor asyncio, nor OpenSSL.

    No validator of Pydantic is compiled: Pydantic first looks for plugins, in all installed packages.
    """
    program = f"""
import sys
import nedbus
with nedbus.connect({endpoint!r}):
    pass
unused = {{"numpy", "nedbus.vehicle_events", "nedbus.flights", "nedbus.pki", "asyncio", "ssl", "typer", "rich"}}
unused.add("pydantic.plugin._loader")
assert not unused & set(sys.modules), unused & set(sys.modules)
"""
    process = start("-c", program, fresh=True)
    assert process.wait() == 0, process.err


@pytest.mark.slow
def test_service_imports_no_receiver(start: Start) -> None:
    """A service of a simulator loads no readers of messages, files or events, and compiles no validator."""
    program = """
import sys
import nedbus.cli.commands.serve
from nedbus.daemon import Daemon
from nedbus.settings import load_settings
Daemon(load_settings(source=["sim:"], listen=["tcp/127.0.0.1:7447"]), version="1.0")
unused = {"numpy", "asyncio", "ssl", "rich", "ctypes", "http.server", "pydantic.plugin._loader"}
unused |= {"nedbus.client.bus", "nedbus.client.receiving", "nedbus.flights.readers", "nedbus.ulog"}
unused |= {"nedbus.vehicle_events.story", "nedbus.monitoring.observer"}
assert not unused & set(sys.modules), unused & set(sys.modules)
"""
    process = start("-c", program, fresh=True)
    assert process.wait() == 0, process.err


@pytest.mark.slow
def test_list_loads_only_the_client(start: Start, endpoint: str) -> None:
    """`nedbus list` of an empty host loads neither arrays, nor events, nor asyncio, nor rich's tables and Markdown."""
    program = f"""
import sys
from nedbus.cli import main
sys.argv = ["nedbus", "list", "-c", {endpoint!r}]
try:
    main()
except SystemExit as exc:
    assert not exc.code
unused = "numpy nedbus.vehicle_events nedbus.flights nedbus.pki nedbus.doctor asyncio ssl rich cryptography http.server"
assert not set(unused.split()) & set(sys.modules), set(unused.split()) & set(sys.modules)
"""
    process = start("-c", program, fresh=True)
    assert process.wait() == 0, process.err


@pytest.mark.slow
def test_files_are_read_without_zenoh(start: Start, tmp_path: Path) -> None:
    """Reading files, in a script or with a command, loads neither Zenoh nor the client."""
    log = write_log(tmp_path / "flight.ulg", [1_000_000 * second for second in range(1, 20)])
    program = f"""
import sys
def absent():
    assert not [each for each in ("zenoh", "nedbus.client", "nedbus.transport") if each in sys.modules]
import nedbus
path = {str(log)!r}
with nedbus.open(path) as flight:
    assert len(list(flight())) == 19 and len(list(flight("*").batches())) == 1
    flight.addresses, flight.utc, flight.duration
absent()
nedbus.read(path), nedbus.align(path), nedbus.utc_of(path), nedbus.addresses_of(path)
absent()
from nedbus.cli import main
for arguments in ("convert", path, path + ".mcap"), ("plot", path), ("events", path), ("why", path), ("fusion", path):
    sys.argv = ["nedbus", *arguments]
    try:
        main()
    except SystemExit as exc:
        assert not exc.code, arguments
    absent()
"""
    process = start("-c", program, fresh=True)
    assert process.wait() == 0, process.err


@pytest.mark.slow
def test_public_names_need_no_optional_package(start: Start) -> None:
    """Without the extras, each name of `nedbus` exists, for tab completion and `help`; `convert` names the extra."""
    program = """
import sys
for name in ["mcap", "pymavlink", "matplotlib", "cryptography", "prometheus_client", "foxglove", "bokeh"]:
    sys.modules[name] = None
import nedbus
assert [name for name in dir(nedbus) if not hasattr(nedbus, name)] == []
try:
    nedbus.convert("flight.ulg", "flight.mcap")
except nedbus.ConfigError as exc:
    assert "[mcap]" in str(exc)
else:
    raise AssertionError
"""
    process = start("-c", program, fresh=True)
    assert process.wait() == 0, process.err
