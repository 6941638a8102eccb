"""The same flight in each format, with one or two vehicles."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

from pymavlink.dialects.v20 import common as dialect

from nedbus.flights import RecordingWriter
from nedbus_msgs import Address, Provenance, VehicleLocalPosition
from tests.flights.messages import message
from tests.flights.ulogs import UlogWriter

VLP = "vehicle_local_position"
EPOCH = 1_700_000_000_000_000  # us
BOOT = 10_000_000  # us, timestamp of the first message
STEP = 100_000  # us


def write_flight(
    path: Path,
    *,
    vehicles: Sequence[int] = (1,),
    count: int = 50,
    start: int = EPOCH,
    pause_before: int | None = None,
) -> Path:
    """Write `count` positions of each vehicle in the format of the suffix; x is the index plus 1000 x vehicle.

    `pause_before`: the index of the message before which two minutes pass.
    """
    late = count if pause_before is None else pause_before
    times = [BOOT + index * STEP + 120_000_000 * (index >= late) for index in range(count)]
    if path.suffix == ".ulg":
        return _write_log(path, vehicles[0], times, start)
    if path.suffix == ".mcap":
        return _write_recording(path, vehicles, times, start)
    out = b""
    for index, time in enumerate(times):
        for vehicle in vehicles:
            sender = dialect.MAVLink(None, srcSystem=vehicle, srcComponent=1)
            sender.seq = 2 * index % 256
            boot, stamp = time // 1000, start + time
            x = 1000.0 * vehicle + index
            sent = dialect.MAVLink_local_position_ned_message(boot, x, 0.0, -1.0, 0.0, 0.0, 0.0)
            out += struct.pack(">Q", stamp) + sent.pack(sender)
            clock = dialect.MAVLink_system_time_message(stamp, boot)
            sender.seq = (2 * index + 1) % 256
            out += struct.pack(">Q", stamp) + clock.pack(sender)
    path.write_bytes(out)
    return path


def _write_log(path: Path, vehicle: int, times: Sequence[int], start: int) -> Path:
    writer = UlogWriter(system_id=vehicle)
    key = b"uint64_t boot_time_utc_us"
    writer.put("I", bytes([len(key)]) + key + struct.pack("<Q", start))
    writer.define([VLP])
    for index, time in enumerate(times):
        writer.add(VLP, _position(vehicle, index, time))
    return writer.write(path)


def _write_recording(path: Path, vehicles: Sequence[int], times: Sequence[int], start: int) -> Path:
    with RecordingWriter(path, chunk_size=2**16, boot_utc=start) as writer:
        writer.write_messages(
            (
                _position(each, index, time),
                Address(str(each), VLP),
                Provenance("sim"),
                1000 * (start + time),
            )
            for index, time in enumerate(times)
            for each in vehicles
        )
    return path


def _position(vehicle: int, index: int, time: int) -> VehicleLocalPosition:
    return message(time, x=1000.0 * vehicle + index)
