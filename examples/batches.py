"""Read the messages of all vehicles as NumPy arrays, and print the mean speed of each."""

from contextlib import suppress

import numpy as np

import nedbus

with suppress(KeyboardInterrupt), nedbus.connect() as bus, bus.subscribe(mode="every") as subscription:
    for batch in subscription.batches():
        for address in batch.addresses:
            own = batch.of(address)
            own = own[own["v_xy_valid"]]
            if len(own):
                print(address.vehicle, len(own), f"{np.hypot(own['vx'], own['vy']).mean():.2f} m/s", flush=True)
