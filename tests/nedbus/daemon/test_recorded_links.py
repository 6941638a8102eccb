"""Events, health and verdict of a service on the link of a real PX4 in flight, from recordings (../shared/data/px4)."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Final

import pytest

from nedbus.flights import read_file_events
from nedbus.vehicle_events import report_of, verdict_of
from tests.flights.recorded_link import Service
from tests.flights.ulogs import LOGS

PX4: Final = LOGS.parent / "px4"
# tests of the MAVLink source read these
OTHER_FORMAT: Final = {"gps_loss_mavlink", "twelve_messages_mavlink"}
RECORDINGS: Final = [
    path
    for path in sorted(PX4.rglob("*.bin.gz"))
    if path.name.removesuffix(".bin.gz") not in OTHER_FORMAT
]

pytestmark = [
    pytest.mark.logs,
    pytest.mark.slow,
    pytest.mark.skipif(
        not (PX4 / "gps_off_in_flight.bin.gz").exists(), reason=f"no recordings of a PX4 in {PX4}"
    ),
]


@pytest.mark.parametrize(
    "name", ["foreign_stop_in_flight", "link_cut_20s_in_flight", "baro_failure_mavlink"]
)
def test_changes_between_streamed_and_converted_messages_are_no_resets(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Reset counters that converted messages lack cause neither reset events nor counted resets; the log has none."""
    service = Service(PX4 / f"{name}.bin.gz", monkeypatch).run()
    assert service.events("reset", "origin_set", "origin_moved") == []
    assert {sum(health.resets.values()) for health in service.healths.values()} == {0}


@pytest.mark.long
@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.name.removesuffix(".bin.gz"))
def test_no_message_is_rejected_and_no_estimate_contradicted(
    monkeypatch: pytest.MonkeyPatch, path: Path
) -> None:
    """No streamed or converted message of a real PX4 is rejected, and none contradicts the estimate."""
    service = Service(path, monkeypatch).run()
    assert service.rejected == []
    assert service.output.rejected == 0
    assert service.output.published > 1000
    assert [
        event.text for event in service.event_log.events if event.kind.endswith("_contradicted")
    ] == []


def test_drop_of_the_rate_is_not_a_series_of_gaps(monkeypatch: pytest.MonkeyPatch) -> None:
    """When attitudes drop from 50 to 8 Hz for the rest of the flight, gaps end after some messages."""
    service = Service(PX4 / "foreign_stop_in_flight.bin.gz", monkeypatch).run()
    gaps = {str(address): health.gaps for address, health in service.healths.items()}
    assert gaps["4/vehicle_attitude"] < 20
    assert max(gaps.values()) < 20


def test_topics_on_a_slow_link_are_not_stale_at_their_usual_rate(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """On a link of 57,600 baud a topic is logged at most twice as stale: until its rate is known, and as flapping."""
    Service(PX4 / "slow_link_header_stalls.bin.gz", monkeypatch).run()
    stale = Counter(text.split()[1] for text in caplog.messages if " is stale: " in text)
    assert stale["4/battery_status/0"] == 2
    assert max(stale.values()) == 2


def test_gps_that_falls_silent_is_an_event_and_evidence(monkeypatch: pytest.MonkeyPatch) -> None:
    """`failure gps off` stops both GPS topics: an event at the time of the last message, and evidence for what follows.

    Until the position is lost, it is a fault by itself; the vehicle's own log has the same event.
    """
    service = Service(PX4 / "gps_off_in_flight.bin.gz", monkeypatch).run(until=21.5)
    (silent,) = service.events("no_messages")
    assert (silent.text, silent.severity, silent.names) == ("no GPS message", "watch", ("GPS",))
    assert silent.time - service.start == pytest.approx(17.15, abs=0.1)
    assert "no GPS message" in service.verdict().text
    found = service.run().verdict()
    assert [each.kind for each in found.cause if each.kind != "text"] == [
        "no_messages",
        "dead_reckoning",
    ]
    injected = '08:30:02.6 PX4: "Injected: gps off, all instances"'
    assert (
        f". Evidence: {injected}; 08:30:02.7 no GPS message; 08:30:03.8 dead reckoning"
        in found.text
    )
    logged = read_file_events(PX4 / "gps_off_in_flight.ulg").event_log.events
    assert [each.text for each in logged if each.kind == "no_messages"] == ["no GPS message"]


def test_gps_is_read_from_another_topic_when_the_stream_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """When a stream ends, `sensor_gps` replaces `vehicle_gps_position`; topics without a replacement are missing."""
    service = Service(PX4 / "foreign_stop_in_flight.bin.gz", monkeypatch).run()
    silent = service.events("no_messages")
    assert {each.change for each in silent} == {"begin"}
    assert sorted(name for each in silent for name in each.names) == [
        "barometer",
        "estimator flags",
        "failsafe flags",
    ]


def test_link_cut_is_the_end_of_messages_of_no_topic(monkeypatch: pytest.MonkeyPatch) -> None:
    """While no message arrives at all, the vehicle is gone from its last message on, and no topic is silent."""
    service = Service(PX4 / "link_cut_20s_in_flight.bin.gz", monkeypatch).run()
    assert service.events("no_messages") == []
    assert (
        "gone: no publisher of vehicle_local_position from 07:08:40.9 to 07:09:01.9 UTC (21.0 s)"
        in (service.verdict().text)
    )


def test_sensor_failure_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    """PX4's text about a failed sensor is a fault, and evidence for the missing messages that follow; so in the log."""
    service = Service(PX4 / "baro_failure_mavlink.bin.gz", monkeypatch).run(until=21)
    assert service.verdict().text.startswith(
        'position valid now, but PX4: "Baro sensor #0 failure: Timeout" at 07:24:54.0 UTC.'
    )
    found = service.run().verdict()
    assert found.text.startswith("position valid now, but no barometer message")
    assert 'PX4: "Baro sensor #0 failure: Timeout"' in found.text
    read = read_file_events(PX4 / "baro_failure.ulg")
    report = report_of(read.event_log, "", "", read.end, within=1e9).vehicles["4"]
    logged = verdict_of(
        "4",
        read.event_log.events,
        report.held,
        topics=report.topics,
        times=read.times,
        end=read.end,
    )
    assert logged.usable
    assert logged.text.startswith(
        "position valid throughout, but no barometer message from 07:24:53.4 to 07:25:18.1"
    )
    assert 'PX4: "Baro sensor #0 failure: Timeout"' in logged.text


def test_missing_seconds_of_the_log_are_logged_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A stream that resumes without a new header leaves no second gap in the log on the SD card."""
    caplog.set_level("INFO")
    Service(PX4 / "link_cut_20s_in_flight.bin.gz", monkeypatch).run()
    logged = [
        text.partition(": ")[2] for text in caplog.messages if "receiving the ULog stream" in text
    ]
    assert logged == [
        "receiving the ULog stream; the log on the SD card lacks the 1.3 s in which the header was sent",
        "receiving the ULog stream again",
    ]
