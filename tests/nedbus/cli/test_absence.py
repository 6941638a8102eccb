"""Why no vehicle is published, as `list` and `why` explain it: the reason of a source comes first."""

from __future__ import annotations

import re

import pytest

import nedbus
from nedbus.transport import Session
from tests.flights.messages import VLP, message
from tests.nedbus.doctor.test_examination import service_status, source
from tests.peers.command_line import run_command
from tests.peers.processes import Start
from tests.waits import wait_for


@pytest.mark.parametrize("command", ["list", "why"])
@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"state": "failed", "error": "the disk is gone"}, "has failed: the disk is gone"),
        ({"state": "retrying", "error": "no such file"}, "fails and is restarted: no such file"),
        (
            {"stale": [f"1/{VLP}"], "state": "waiting"},
            f"receives no more messages of 1/{VLP}: check that the vehicle",
        ),
        ({"state": "waiting"}, "has received no message yet"),
    ],
)
def test_reason_of_a_source_comes_first(
    endpoint: str, zenoh_session: Session, *, command: str, fields: dict[str, object], text: str
) -> None:
    """A source that publishes nothing explains the absence; neither access rules nor `nedbus serve` are suggested."""
    with service_status(zenoh_session, sources=[source(**fields)]):
        shown = run_command(command, "-c", endpoint)
    assert re.search(f": source mavlink:x of service fake on elsewhere {text}", shown.err), (
        shown.err
    )
    assert not re.search(r"access rules|nedbus serve", shown.err)


def test_link_of_a_missing_vehicle_explains_its_absence(
    endpoint: str, zenoh_session: Session, bus: nedbus.Bus
) -> None:
    """For a requested vehicle, only its own link counts, and other published vehicles do not hide it."""
    bus.publisher(VLP, vehicle="1").publish(message(1))
    with service_status(
        zenoh_session, vehicle="7", sources=[source(stale=[f"7/{VLP}"], addresses=[f"1/{VLP}"])]
    ):
        cut, unknown = (
            run_command("list", "-c", endpoint, "-v", vehicle) for vehicle in ("7", "8")
        )
    assert f"receives no more messages of 7/{VLP}" in cut.err
    assert unknown.err.endswith(": choose one of 1\n")
    assert cut.exit_code == unknown.exit_code == 1


@pytest.mark.slow
@pytest.mark.process
def test_failed_source_of_a_real_service_is_explained(
    run_nedbus: Start, endpoint: str, bus: nedbus.Bus
) -> None:
    """`list` and `why` name the missing file of a log."""
    run_nedbus("serve", "--connect", endpoint, "-s", "ulog:gone.ulg")
    wait_for(
        lambda: any(each.error for service in bus.services() for each in service.sources),
        what="the failure",
    )
    for command in ("list", "why"):
        shown = run_command(command, "-c", endpoint)
        assert re.search(r"source ulog:gone.ulg of service .*gone.ulg: no such file", shown.err), (
            shown.err
        )


def test_other_prefix_is_named(endpoint: str, bus: nedbus.Bus) -> None:
    """If vehicles are published under another prefix alone, `list` proposes it and exits with 1."""
    bus.publisher(VLP, vehicle="1").publish(message(1))
    shown = run_command("list", "-c", endpoint, "--prefix", "fleet/wrong")
    assert shown.exit_code == 1
    assert (
        "messages are published under nedbus/, but the prefix here is fleet/wrong/: use --prefix nedbus"
        in shown.err
    )


def test_source_that_publishes_does_not_explain_the_absence(
    endpoint: str, zenoh_session: Session
) -> None:
    """A source that waits for further messages of a vehicle has received some."""
    waiting = source(state="waiting", addresses=[f"1/{VLP}"])
    with service_status(zenoh_session, sources=[waiting]):
        shown = run_command("list", "-c", endpoint)
    assert shown.err.endswith(
        ": a service answers: see 'nedbus info' and the access rules for it and this client (docs/security.md)\n"
    )
