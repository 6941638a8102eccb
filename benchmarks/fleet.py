"""A fleet at 100 Hz in one process: python -m benchmarks.fleet VEHICLES SECONDS ENDPOINT [noise].

The process prints "ready", waits for a line, publishes, and prints its maximum delay in seconds.
With `noise` no two messages are alike, so that a recording compresses no better than one of a real flight.
"""

from __future__ import annotations

import sys
import time
from typing import Any, Final

import numpy as np
from tests.flights.local_position import FIELD_TYPES, PAYLOAD_SIZE, encode_array

import nedbus

from .compare.case import TOPIC
from .compare.fields import FIELDS

RATE: Final = 100  # Hz
NOISY: Final = (
    "x", "y", "z", "vx", "vy", "vz", "z_deriv", "ax", "ay", "az", "unaided_heading", "heading_var", "eph", "epv",
)  # fmt: skip


def main() -> None:
    """Publish according to the arguments."""
    vehicles, seconds, endpoint = int(sys.argv[1]), float(sys.argv[2]), sys.argv[3]
    noise = sys.argv[4:] == ["noise"]
    messages = np.repeat(
        nedbus.to_array([nedbus.VehicleLocalPosition(**FIELDS)]), vehicles if noise else 1
    )
    random = np.random.default_rng(1)
    with nedbus.connect(endpoint) as bus:
        publishers = [bus.publisher(TOPIC, vehicle=f"v{number}") for number in range(vehicles)]
        print("ready", flush=True)
        sys.stdin.readline()
        start, late = time.monotonic(), 0.0
        for tick in range(int(seconds * RATE)):
            payloads = _encode(messages, tick, random if noise else None)
            wait = start + tick / RATE - time.monotonic()
            late = max(late, -wait)
            if wait > 0:
                time.sleep(wait)
            # One process simulates the hosts of all vehicles: encode their messages at once.
            for publisher, payload in zip(
                publishers, payloads * (vehicles // len(payloads)), strict=True
            ):
                publisher.publish_encoded(payload, FIELD_TYPES.keys())
        print(f"{late:.3f}", flush=True)
        sys.stdin.readline()


def _encode(messages: Any, tick: int, random: np.random.Generator | None) -> list[bytes]:
    """Return the payloads of a tick; without noise all vehicles share one."""
    messages["timestamp"] = 10_000_000 + tick * 10_000
    messages["timestamp_sample"] = messages["timestamp"] - 5_000
    if random is not None:
        for name in NOISY:
            messages[name] = random.random(len(messages), np.float32)
    payloads = encode_array(messages)
    return [
        payloads[start : start + PAYLOAD_SIZE] for start in range(0, len(payloads), PAYLOAD_SIZE)
    ]


if __name__ == "__main__":
    main()
