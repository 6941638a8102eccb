"""A plain Zenoh client, as the forms without nedbus use it."""

import json

import zenoh

KEY = "bench/vehicle_local_position"


def open_session(endpoint: str) -> zenoh.Session:
    """Open a client of this router, with shared memory and scouting off, as nedbus has it."""
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)
