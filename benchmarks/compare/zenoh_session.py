"""A plain Zenoh client, as the forms without nedbus use it."""

import json

import zenoh

from .case import TOPIC, Case

KEY = f"bench/1/{TOPIC}"  # of forms that know one vehicle only


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


def key(vehicle: str) -> str:
    """Return the key of a vehicle, or the key expression of all."""
    return f"bench/{vehicle}/{TOPIC}"


def declare_publishers(session: zenoh.Session, case: Case) -> list[zenoh.Publisher]:
    """Declare a publisher for each vehicle."""
    control = zenoh.CongestionControl.BLOCK if case.lossless else zenoh.CongestionControl.DROP
    return [session.declare_publisher(key(vehicle), congestion_control=control) for vehicle in case.vehicles]
