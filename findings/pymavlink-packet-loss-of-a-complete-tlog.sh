#!/usr/bin/env bash
# pymavlink 2.4.50, 2026-11-29: opening a .tlog reads ahead and rewinds, and packet_loss() counts the rewind as a gap: of a
# complete file of 20 messages, most count as lost. On UDP a duplicated datagram counts as 255 lost messages, a swapped
# pair as 256, a valid message that the dialect does not know as 1.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q pymavlink==2.4.50
cat >probe.py <<'PYTHON'
import socket
import struct

from pymavlink import mavutil
from pymavlink.dialects.v20 import common
from pymavlink.generator.mavcrc import x25crc


def heartbeat(sequence):
    link = common.MAVLink(None, srcSystem=1, srcComponent=1)
    link.seq = sequence
    return common.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3).pack(link)


def event(sequence):
    """Return PX4's EVENT, number 410, which pymavlink's dialects lack."""
    frame = struct.pack("<BBBBBBBH", 54, 0, 0, sequence, 1, 1, 410 & 255, 410 >> 8) + bytes(53) + b"\x01"
    crc = x25crc(frame)
    crc.accumulate(bytes([160]))
    return b"\xfd" + frame + struct.pack("<H", crc.crc)


def counts_of_udp(frames):
    """Send the frames over loopback; return what arrived, and what counts as lost."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    received = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}")
    count = 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for frame in frames:
            sock.sendto(frame, ("127.0.0.1", port))
            count += received.recv_match(blocking=True, timeout=10) is not None
    received.close()
    return count, received.mav_loss


with open("complete.tlog", "wb") as stream:
    for number in range(20):
        stream.write(struct.pack(">Q", 1_700_000_000_000_000 + number * 100_000) + heartbeat(number))
log = mavutil.mavlink_connection("complete.tlog")
count = 0
while log.recv_match() is not None:
    count += 1
print(f"complete.tlog: {count} messages, {log.mav_loss} lost, packet_loss() {log.packet_loss():.0f} %")
assert count == 20 and log.packet_loss() > 90
frames = [heartbeat(number) for number in range(10)]
cases = {
    "complete": frames,
    "duplicate": [*frames[:5], frames[4], *frames[5:]],
    "swap": [*frames[:4], frames[5], frames[4], *frames[6:]],
    "unknown message": [*frames[:5], event(5), *frames[6:]],
}
seen = {name: counts_of_udp(case) for name, case in cases.items()}
print("UDP, received and lost:", seen)
assert seen == {"complete": (10, 0), "duplicate": (11, 255), "swap": (10, 256), "unknown message": (10, 1)}
PYTHON
timeout 60 venv/bin/python probe.py
