"""A plain Zenoh client, for the compared forms that do not use nedbus."""

import json
from collections.abc import Callable, Mapping

import zenoh

from .case import TOPIC, Case

KEY = f"bench/1/{TOPIC}"  # for forms that support only one vehicle


def client_config(endpoint: str, more: Mapping[str, object] | None = None) -> zenoh.Config:
    """Return the configuration of a client without shared memory and scouting, like nedbus."""
    config = zenoh.Config()
    settings = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }
    for key, value in {**settings, **(more or {})}.items():
        config.insert_json5(key, json.dumps(value))
    return config


def open_session(endpoint: str) -> zenoh.Session:
    """Open a client session."""
    return zenoh.open(client_config(endpoint))


def key(vehicle: str) -> str:
    """Return the key of a vehicle, or for "*" the key expression of all."""
    return f"bench/{vehicle}/{TOPIC}"


def declare_publishers(session: zenoh.Session, case: Case) -> list[zenoh.Publisher]:
    """Declare a publisher for each vehicle."""
    control = zenoh.CongestionControl.BLOCK if case.lossless else zenoh.CongestionControl.DROP
    return [
        session.declare_publisher(key(vehicle), congestion_control=control)
        for vehicle in case.vehicles
    ]


def receive_each(
    case: Case,
    ready: Callable[[], None],
    seen: Callable[[int], bool],
    stamp: Callable[[bytes], int],
) -> None:
    """Receive payloads until `seen` returns False; `stamp` decodes a payload and returns its timestamp."""
    with open_session(case.endpoint) as session:
        subscriber = session.declare_subscriber(key(case.vehicle), zenoh.handlers.FifoChannel(1024))
        ready()
        for sample in subscriber:
            if not seen(stamp(sample.payload.to_bytes())):
                break
        subscriber.undeclare()
