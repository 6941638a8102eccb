"""`nedbus fusion`: errors of its arguments."""

from __future__ import annotations

from pathlib import Path

from tests.flights.ulogs import write_log
from tests.peers.command_line import run_command


def test_command_needs_its_topics_and_no_duration(tmp_path: Path) -> None:
    """A log without evidence of fusion is an error that names the topics; --duration is for live vehicles."""
    log = str(
        write_log(tmp_path / "a.ulg", [1_000_000], topic="vehicle_local_position_groundtruth")
    )
    ended = run_command("fusion", log)
    assert (ended.exit_code, ended.out) == (1, "")
    assert f"{log}: topics " in ended.err
    ended = run_command("fusion", log, "--duration", "1")
    assert ended.exit_code == 2
    assert "--duration: needs live vehicles, not a file" in ended.err
