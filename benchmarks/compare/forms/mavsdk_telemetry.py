"""MAVSDK without a router: LOCAL_POSITION_NED, 7 numbers, from pymavlink over UDP to `subscribe_position_velocity_ned`.

MAVSDK does not pass on the message's time, so the velocities carry the timestamp: 24 bits each, exact in a float32.
UDP has no flow control: at full speed the kernel drops what MAVSDK does not receive in time.
"""

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mavsdk import ComponentType, Configuration
from mavsdk.asyncio import Mavsdk
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

from benchmarks.compare.case import Case
from benchmarks.compare.fields import FIELDS

PACKAGES = ["mavsdk==4.1.0", "pymavlink==2.4.50"]

PORT = 14577
MASK = (1 << 24) - 1


@contextmanager
def publish(case: Case) -> Iterator[list[Callable[[int], None]]]:
    link = mavutil.mavlink_connection(
        f"udpout:127.0.0.1:{PORT}", source_system=1, source_component=1
    )
    stop = threading.Event()
    position = [FIELDS[axis] for axis in "xyz"]

    def send_heartbeats() -> None:
        while not stop.wait(0.2):
            link.mav.heartbeat_send(
                mavlink.MAV_TYPE_QUADROTOR,
                mavlink.MAV_AUTOPILOT_PX4,
                0,
                0,
                mavlink.MAV_STATE_ACTIVE,
            )

    def send(stamp: int) -> None:
        link.mav.local_position_ned_send(
            0, *position, stamp >> 48, stamp >> 24 & MASK, stamp & MASK
        )

    heartbeats = threading.Thread(target=send_heartbeats, daemon=True)
    heartbeats.start()
    time.sleep(2.0)  # MAVSDK finds the vehicle by its heartbeats
    yield [send]
    stop.set()
    heartbeats.join()
    link.close()


def receive(case: Case, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    asyncio.run(_receive(ready, seen))


async def _receive(ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    async with Mavsdk(configuration) as client:
        await client.add_any_connection(f"udpin://127.0.0.1:{PORT}")
        ready()
        system = await client.first_autopilot(timeout_s=30.0)
        async for message in TelemetryAsync(system).subscribe_position_velocity_ned():
            velocity = message.velocity
            high, middle, low = (
                int(velocity.north_m_s),
                int(velocity.east_m_s),
                int(velocity.down_m_s),
            )
            if not seen(high << 48 | middle << 24 | low if message.position.north_m else 0):
                return
