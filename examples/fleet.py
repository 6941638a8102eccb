"""Query once: which vehicles are there, where are they, and how old are their last messages?"""

from contextlib import suppress

import nedbus

with suppress(KeyboardInterrupt), nedbus.connect() as bus:
    for vehicle, addresses in bus.vehicles().items():
        print(f"vehicle {vehicle}: {len(addresses)} streams")
    for sample in bus.latest():
        age = "unknown" if sample.latency is None else f"{sample.latency:.3f} s"
        doubt = ", dead reckoning" if sample.message.dead_reckoning else ""
        print(
            f"{sample.vehicle}: {sample.message.x:.2f} {sample.message.y:.2f} {sample.message.z:.2f}, {age} old{doubt}"
        )
