"""The commands that `nedbus serve` suggests for a second terminal."""

from __future__ import annotations

import re

import pytest

from nedbus.cli.output.progress import suggested_commands
from nedbus.endpoints import DEFAULT_ENDPOINT
from tests.peers.command_line import run_command
from tests.peers.ports import free_port
from tests.peers.processes import Start
from tests.waits import wait_for


def test_suggested_commands_use_an_endpoint_without_tls() -> None:
    """Suggested commands use an endpoint without TLS; if there is none, a hint says that readers need a certificate."""
    assert " list  published" in suggested_commands([DEFAULT_ENDPOINT])
    assert " hz -c tcp/b:1 " in suggested_commands(["tls/a:1", "tcp/b:1"])
    for endpoint in ("tls/a:1", "quic/a:1"):
        hint = f"Clients of {endpoint} need their own certificate, see docs/security.md"
        assert suggested_commands([endpoint]) == hint


def wait_for_message(endpoint: str) -> None:
    """Wait until a message is published at this endpoint."""
    wait_for(
        lambda: run_command("get", "--wait", "-c", endpoint).exit_code == 0,
        what=f"a message at {endpoint}",
    )


@pytest.mark.slow
def test_suggested_commands_for_wildcard_address_use_loopback(run_nedbus: Start) -> None:
    """For a service that listens on a wildcard address, the suggested commands name a loopback address, and work."""
    port = free_port()
    service = run_nedbus("serve", "--listen", f"tcp/0.0.0.0:{port}", "-s", "sim:")
    wait_for(lambda: " all fields" in service.err, what="the hint")
    (here,) = re.findall(r"nedbus list -c (\S+)", service.err)
    assert here == f"tcp/127.0.0.1:{port}"
    wait_for_message(here)
    assert " list  published" in suggested_commands(["tcp/0.0.0.0:7447"])
    assert " list -c tcp/[::1]:7448  published" in suggested_commands(["tcp/[::]:7448"])
