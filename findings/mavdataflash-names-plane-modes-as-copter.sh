#!/usr/bin/env bash
# mavdataflash 3.0.0, 2026-11-29: GetModes names the modes of every ArduPilot log as those of ArduCopter: an ArduPlane in
# FBWA (mode 5) is in LOITER, one in RTL (11) in DRIFT, one in AUTO (10) in UNKNOWN. pymavlink, which it reads
# logs with, knows the vehicle from the same log.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q mavdataflash==3.0.0 pymavlink==2.4.50
venv/bin/python - <<'PYTHON'
import struct

from MAVdataflash import DataFlash
from pymavlink import mavutil

SIZES = {"B": "B", "H": "H", "I": "I", "M": "B", "Q": "Q", "L": "i", "n": "4s", "N": "16s", "Z": "64s"}


def record(kind, types, *values):
    return b"\xa3\x95" + bytes([kind]) + struct.pack("<" + "".join(SIZES[each] for each in types), *values)


def definition(kind, name, types, columns):
    length = 3 + struct.calcsize("<" + "".join(SIZES[each] for each in types))
    return record(128, "BBnNZ", kind, length, name.encode(), types.encode(), columns.encode())


with open("plane.bin", "wb") as stream:
    stream.write(definition(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns"))
    stream.write(definition(133, "MSG", "QZ", "TimeUS,Message"))
    stream.write(definition(132, "MODE", "QMBB", "TimeUS,Mode,ModeNum,Rsn"))
    stream.write(definition(130, "GPS", "QBBIHBLL", "TimeUS,I,Status,GMS,GWk,NSats,Lat,Lng"))
    stream.write(record(133, "QZ", 1_000_000, b"ArduPlane V4.6.0 (a1b2c3d4)"))
    stream.write(record(130, "QBBIHBLL", 1_050_000, 0, 3, 100_000_000, 2300, 12, 473977420, 85455940))
    for number, mode in enumerate((5, 11, 10)):
        stream.write(record(132, "QMBB", 1_100_000 + 1_000_000 * number, mode, mode, 1))
    stream.write(record(130, "QBBIHBLL", 4_050_000, 0, 3, 100_003_000, 2300, 12, 473977420, 85455940))
names = DataFlash("plane.bin").GetModes()["ModeName"].tolist()
log = mavutil.mavlink_connection("plane.bin")
own = []
while (message := log.recv_match(type="MODE")) is not None:
    own.append(log.flightmode)
print("mavdataflash 3.0.0:", names, "- pymavlink 2.4.50:", own)
assert names == ["LOITER", "DRIFT", "UNKNOWN"]
assert own == ["FBWA", "RTL", "AUTO"]
PYTHON
