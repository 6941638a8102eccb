"""Who may send a position over a network: with certificates and access rules, the named sender alone."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import pytest
import zenoh

import nedbus
from nedbus.pki import write_access_rules
from nedbus.transport import RawSample, Session, open_client, open_router
from nedbus_msgs import codec_of
from tests.peers.certificates import client_tls, pki, secure_endpoint, tls_options, write_config
from tests.peers.live_source import source_status
from tests.peers.ports import free_port
from tests.peers.processes import Start
from tests.waits import DEADLINE, wait_for, wait_for_matching

from .px4_vision import Px4OnLink
from .test_external_position import odometry

__all__ = ["pki"]

KEY: Final = "nedbus/mocap/vehicle_visual_odometry"
MARKER: Final = "nedbus/1/marker"  # a key of vehicle 1, whose messages follow those on KEY
ENCODE: Final = codec_of(nedbus.VehicleOdometry.DEFINITION).encode


def put_positions(session: Session, quality: int, count: int = 1) -> None:
    """Publish positions without nedbus, which would ask the router for the permission first."""
    for _ in range(count):
        now = time.monotonic_ns() // 1000
        position = odometry(timestamp=now, timestamp_sample=now, quality=quality)
        session.put(KEY, ENCODE(position), congestion_control=zenoh.CongestionControl.BLOCK)


@pytest.mark.slow
@pytest.mark.parametrize("is_router", [True, False], ids=["own router", "client of a router"])
def test_only_the_named_sender_may_send_a_position(
    start: Start, pki: Path, tmp_path: Path, is_router: bool
) -> None:
    """The certificate of the sender reaches the vehicle; the router drops the position of another vehicle's."""
    endpoint, port = secure_endpoint(), free_port()
    readers = {'cert_common_names: ["reader"]': 'cert_common_names: ["reader", "vehicle-1"]'}
    file = write_config(pki, tmp_path / "router-secure.json5", endpoint, **readers)
    write_access_rules(file, ["1", "mocap"])
    source = f"mavlink:udpin:127.0.0.1:{port}?position=mocap/vehicle_visual_odometry"
    with ExitStack() as opened:
        if is_router:
            start("-m", "nedbus", "serve", "--source", source, "--router-config", str(file))
        else:
            opened.enter_context(open_router(config_file=file))
            options = ["--connect", endpoint, *tls_options(pki, "vehicle-1")]
            start("-m", "nedbus", "serve", "--source", source, *options)

        def join(name: str) -> Session:
            return opened.enter_context(
                open_client([endpoint], tls=client_tls(pki, name), timeout=DEADLINE)
            )

        sender, other, reader = join("vehicle-mocap"), join("vehicle-1"), join("reader")
        bus = opened.enter_context(
            nedbus.connect(endpoint, tls=client_tls(pki, "reader"), timeout=DEADLINE)
        )
        ring: zenoh.handlers.RingChannel[RawSample] = zenoh.handlers.RingChannel(1)
        markers = reader.declare_subscriber(MARKER, ring)
        px4 = opened.enter_context(Px4OnLink(port))
        wait_for(lambda: source_status(bus).published > 2, what="the vehicle")
        wait_for_matching(sender, KEY)
        wait_for_matching(other, MARKER)
        put_positions(other, quality=66, count=20)
        other.put(MARKER, b"end")
        wait_for(markers.handler.try_recv, what="the message after the positions")
        put_positions(sender, quality=77)
        wait_for(lambda: px4.count() > 0, what="the position of the sender")
        wait_for(
            lambda: any(status.sent for status in source_status(bus).positions), what="the status"
        )
        [status] = source_status(bus).positions
        assert {message.quality for _, message in px4.messages} == {77}
        assert (status.sent, status.left_out) == (1, ())
