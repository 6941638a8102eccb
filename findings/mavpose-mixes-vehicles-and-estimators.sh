#!/usr/bin/env bash
# mavpose 0.4.0, 2026-11-29: of a .tlog with two vehicles, LogExtractor gives one table per message type in which their rows
# alternate, without a system id. The same holds for ArduPilot's EKF cores in a .bin (XKF1), while the instances of a PX4
# log are apart. Array fields, such as the cell voltages of BATTERY_STATUS, are left out.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q mavpose==0.4.0 pymavlink==2.4.50
venv/bin/python - <<'PYTHON'
import struct

from mavpose import LogExtractor
from pymavlink.dialects.v20 import common

with open("two.tlog", "wb") as stream:
    for number in range(5):
        for system, east in ((1, 0.0), (2, 900.0)):
            link = common.MAVLink(None, srcSystem=system, srcComponent=1)
            link.seq = 2 * number % 256
            messages = [
                common.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3),
                common.MAVLink_local_position_ned_message(1000 + 100 * number, 0, east, -5, 0, 0, 0),
                common.MAVLink_battery_status_message(0, 0, 0, 2000, [4000] * 4 + [65535] * 6, 100, 10, 10, 57),
            ]
            for offset, message in enumerate(messages):
                link.seq = (3 * number + offset) % 256
                stream.write(struct.pack(">Q", 1_700_000_000_000_000 + 100_000 * number) + message.pack(link))
log = LogExtractor("two.tlog")
log.extract_all()
position, battery = log.frames["LOCAL_POSITION_NED"], log.frames["BATTERY_STATUS"]
print(position.to_string(index=False))
print("BATTERY_STATUS:", list(battery.columns))
assert position["y"].tolist() == [0.0, 900.0] * 5
assert not [name for name in position.columns if "sys" in name.lower() or "comp" in name.lower()]
assert not [name for name in battery.columns if name.startswith("voltages")]

# an ArduPilot log: XKF1 of two cores, with the unit "#" that marks the core's number
SIZES = {"B": "B", "Q": "Q", "f": "f", "n": "4s", "N": "16s", "Z": "64s"}


def record(kind, types, *values):
    return b"\xa3\x95" + bytes([kind]) + struct.pack("<" + "".join(SIZES[each] for each in types), *values)


def definition(kind, name, types, columns):
    length = 3 + struct.calcsize("<" + "".join(SIZES[each] for each in types))
    return record(128, "BBnNZ", kind, length, name.encode(), types.encode(), columns.encode())


with open("cores.bin", "wb") as stream:
    stream.write(definition(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns"))
    stream.write(definition(140, "FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds"))
    stream.write(definition(131, "XKF1", "QBff", "TimeUS,C,PN,PE"))
    stream.write(record(140, "QBNN", 900_000, 131, b"s#mm", b"F-00"))
    for number in range(5):
        for core in (0, 1):
            stream.write(record(131, "QBff", 1_000_000 + 100_000 * number, core, 100.0 * core, 0.0))
log = LogExtractor("cores.bin")
log.extract_all()
print("EKF cores:", {name: table["PN"].tolist() for name, table in log.frames.items() if name.startswith("XKF1")})
assert log.frames["XKF1"]["PN"].tolist() == [0.0, 100.0] * 5
PYTHON
