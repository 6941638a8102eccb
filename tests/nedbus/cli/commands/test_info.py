"""`nedbus info`: what the services on the network report."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict

import pytest

from nedbus import limits
from nedbus.health import StreamHealth
from nedbus.transport import Session
from tests.flights.messages import VLP
from tests.nedbus.doctor.test_examination import service_status, source
from tests.peers.command_line import run_command


def test_row_of_a_source_has_its_counts_and_its_worst_remark(
    endpoint: str, zenoh_session: Session
) -> None:
    """Losses are marked as an estimate if a ULog stream has gaps; the remark is the error, else what is gone."""
    log_stream = {"vehicle": "1", "gaps": 2, "state": "streaming"}
    failed = source(source="mavlink:a", lost=7, error="no link", log_streams=[log_stream])
    silent = source(source="mavlink:b", lost=5, stale=[f"1/{VLP}"], published=3)
    with service_status(zenoh_session, sources=[failed, silent]):
        lines = run_command("info", "-c", endpoint).out.splitlines()
    rows = [line.split() for line in lines if line.startswith("mavlink:")]
    assert rows == [
        ["mavlink:a", "running", "0", "0", "~7", "0", "0", "no", "link"],
        ["mavlink:b", "running", "3", "0", "5", "0", "0", "1", "gone"],
    ]
    assert f"gone: 1/{VLP}" in lines
    assert any(line.startswith("ULog stream of vehicle 1: streaming") for line in lines)


def test_remarks_name_what_a_service_does_not_publish(
    endpoint: str, zenoh_session: Session
) -> None:
    """Silent topics, messages without a definition, copies, and the first five warnings of a source."""
    warnings = [f"damage {number}" for number in range(6)]
    parts = source(silent=["1/a", "1/b"], not_carried=["TUNNEL"], copies=4, warnings=warnings)
    with service_status(zenoh_session, sources=[parts, source(source="mavlink:y", copies=1)]):
        lines = run_command("info", "-c", endpoint).out.splitlines()
    assert [line for line in lines if ": " in line] == [
        "announced, nothing arrives: 1/a, 1/b",
        "not carried: TUNNEL",
        "left out: 5 messages that came again, or late, over a second link to their vehicle",
        *(f"warning: damage {number}" for number in range(5)),
    ]


def test_stream_row_names_the_reason_of_its_state(endpoint: str, zenoh_session: Session) -> None:
    """A stream that the router refuses has no other state; a topic that is not built in is marked."""
    health = asdict(StreamHealth(VLP).snapshot(0))
    names = f"1/{VLP}", "1/own_topic", f"2/{VLP}"
    streams = [{"address": name, "health": health} for name in names]
    sources = [source(addresses=names, streams=streams)]
    with service_status(zenoh_session, sources=sources, refused=["2"]):
        lines = run_command("info", "-c", endpoint).out.splitlines()
    states = {
        line.split()[0]: line.split(maxsplit=5)[5] for line in lines if line[:2] in ("1/", "2/")
    }
    assert states[f"2/{VLP}"] == "refused by the router"
    assert states["1/own_topic"] == f"{states[f'1/{VLP}']}, by PX4's definition"
    assert "vehicles refused by the router: 2" in lines


def test_services_beyond_the_limit_are_counted(
    endpoint: str, zenoh_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any peer may claim to be a service, so the table is bounded, and the others are counted."""
    monkeypatch.setattr(limits, "TABLE_ROWS", 2)
    with ExitStack() as services:
        for name in ("a", "b", "c"):
            services.enter_context(service_status(zenoh_session, name))
        lines = run_command("info", "-c", endpoint).out.splitlines()
    assert sum(line.startswith("service ") for line in lines) == 2
    assert lines[-1] == "1 more service"
