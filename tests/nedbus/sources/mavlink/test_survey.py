"""Survey of a MAVLink link, with packets as PX4's mavlink module sends them."""

from __future__ import annotations

import socket
import struct
import time
from types import SimpleNamespace
from typing import cast

import pytest
from pymavlink.dialects.v20 import common as dialect

from nedbus import limits
from nedbus.errors import ConfigError, SourceError
from nedbus.sources import LinkSurvey, survey_link
from nedbus.sources.mavlink.link import Link, Packet
from nedbus.sources.mavlink.survey import _Surveyor
from tests.peers.ports import free_port
from tests.waits import DEADLINE, repeating

HEARTBEAT = dialect.MAVLink_heartbeat_message(
    dialect.MAV_TYPE_QUADROTOR, dialect.MAV_AUTOPILOT_PX4, 0, 0, 4, 3
)


def survey(*packets: bytes, until: str) -> LinkSurvey:
    """Survey a link on which these packets arrive again and again, until the survey mentions a text."""
    port = free_port()
    end = time.monotonic() + DEADLINE
    with socket.socket(type=socket.SOCK_DGRAM) as sender:

        def send() -> None:
            for packet in packets:
                sender.sendto(packet, ("127.0.0.1", port))

        with repeating(send):
            while time.monotonic() < end:
                result = survey_link(f"udpin:127.0.0.1:{port}", 0.2)
                if until in str(result):
                    return result
    pytest.fail(f"no {until} in {result}")


def packets_of(system: int, component: int, *messages: dialect.MAVLink_message) -> list[bytes]:
    encoder = dialect.MAVLink(None, system, component)
    return [message.pack(encoder) for message in messages]


def test_survey_tells_autopilots_from_other_senders() -> None:
    """An autopilot is listed with its messages and its parameter, a camera with the reason why it is ignored."""
    (backend,) = struct.unpack("<f", struct.pack("<i", 3))
    parameter = dialect.MAVLink_param_value_message(
        b"SDLOG_BACKEND", backend, dialect.MAV_PARAM_TYPE_INT32, 1, 0
    )
    log = dialect.MAVLink_logging_data_message(245, 191, 7, 1, 0, [0] * 249)
    own = packets_of(7, 1, parameter, HEARTBEAT, log)
    camera = packets_of(7, 100, HEARTBEAT)
    result = survey(*own, *camera, until="(7, 100)")
    assert set(result.systems) == {7}
    system = result.systems[7]
    assert system.is_px4
    assert system.log_backend == 3
    assert system.log_clients == {(245, 191)}
    assert system.sends_log_to_nedbus
    assert set(system.messages) == {"HEARTBEAT", "PARAM_VALUE", "LOGGING_DATA"}
    assert system.size >= sum(map(len, own))
    assert [*result.ignored] == [(7, 100)]  # the autopilot only until its first HEARTBEAT
    assert result.ignored[7, 100].startswith("not an autopilot")
    assert len(result.packets) == 1


def test_packets_are_counted_for_few_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    """A link on which many addresses send lists the first ones; memory does not grow with their number."""
    monkeypatch.setattr(limits, "SHOWN_NAMES", 5)
    port = free_port()
    senders = [socket.socket(type=socket.SOCK_DGRAM) for _ in range(8)]

    def send() -> None:
        for sender in senders:
            sender.sendto(b"noise", ("127.0.0.1", port))

    try:
        with repeating(send):
            surveys = [survey_link(f"udpin:127.0.0.1:{port}", 0.3).packets for _ in range(3)]
    finally:
        for sender in senders:
            sender.close()
    assert max(map(len, surveys)) == 5
    assert max(packets.total() for packets in surveys) > 5, "all packets of these"


def test_round_trip_is_the_shortest_of_this_survey() -> None:
    """The shortest answer to TIMESYNC counts; answers to other programs, whose clock differs, do not."""
    surveyor = _Surveyor(cast("Link", SimpleNamespace(stream=False, send=lambda *_: True)), 5.0)
    for system, age in ((7, 0.5), (7, 0.1), (7, 0.8), (8, 60.0), (8, -1.0)):
        sent = time.monotonic_ns() - round(age * 1e9)
        for packet in packets_of(system, 1, HEARTBEAT, dialect.MAVLink_timesync_message(1, sent)):
            surveyor._on_packet(Packet(packet, "peer", time.monotonic()), time.monotonic())
    trip = surveyor.survey.systems[7].round_trip
    assert trip is not None
    assert 0.1 <= trip < 0.5
    assert surveyor.survey.systems[8].round_trip is None


def test_invalid_links_raise() -> None:
    """An invalid link raises ConfigError; a port in use raises SourceError."""
    with pytest.raises(ConfigError, match="is not a link"):
        survey_link("udp:14540", 0.1)
    with socket.socket(type=socket.SOCK_DGRAM) as owner:
        owner.bind(("127.0.0.1", 0))
        with pytest.raises(SourceError, match="address already in use"):
            survey_link(f"udpin:127.0.0.1:{owner.getsockname()[1]}", 0.1)
