#!/usr/bin/env bash
# Rust crate mavlink 0.21.0, 2026-11-28: one enum value that its dialect does not know makes the whole message an error:
# PX4's COMMAND_ACK to a vendor's command, and the HEARTBEAT of a newer type of vehicle, cannot be read at all.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q pymavlink==2.4.50
venv/bin/python - <<'PYTHON'
from pymavlink.dialects.v20 import common

link = common.MAVLink(None, srcSystem=1, srcComponent=1)
messages = [
    common.MAVLink_command_ack_message(common.MAV_CMD_NAV_LAND, common.MAV_RESULT_ACCEPTED),
    common.MAVLink_command_ack_message(50_000, common.MAV_RESULT_UNSUPPORTED),
    common.MAVLink_heartbeat_message(200, 12, 81, 3 << 16, 4, 3),
    common.MAVLink_heartbeat_message(2, 12, 81, 3 << 16, 4, 3),
]
with open("frames.bin", "wb") as stream:
    stream.writelines(message.pack(link) for message in messages)
PYTHON
cargo init -q --vcs none --name probe probe
cd probe
cargo add -q mavlink@=0.21.0
cat >src/main.rs <<'RUST'
use mavlink::{dialects::common::MavMessage, error::MessageReadError, MavlinkReader, Message};

fn main() {
    let mut reader = MavlinkReader::new(std::fs::File::open("../frames.bin").unwrap());
    let mut seen = Vec::new();
    loop {
        match reader.read_any_message::<MavMessage>() {
            Ok((_, message)) => seen.push(message.message_name().to_string()),
            Err(MessageReadError::Io(_)) => break,
            Err(error) => seen.push(format!("{error:?}")),
        }
    }
    println!("{}", seen.join("\n"));
    let unknown = |name, value| format!("Parse(InvalidEnum {{ enum_type: \"{name}\", value: {value} }})");
    let (command, vehicle) = (unknown("MavCmd", 50000), unknown("MavType", 200));
    assert_eq!(seen, ["COMMAND_ACK", command.as_str(), vehicle.as_str(), "HEARTBEAT"]);
}
RUST
cargo run -q
