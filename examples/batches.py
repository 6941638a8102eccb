"""Read the messages of all vehicles as NumPy arrays, and print the mean speed of each."""

import os
import sys
from contextlib import suppress

import numpy as np

import nedbus

try:
    with (
        suppress(KeyboardInterrupt),
        nedbus.connect() as bus,
        bus.subscribe(mode="every") as subscription,
    ):
        for batch in subscription.batches():
            for address in batch.addresses:
                own = nedbus.mask_invalid(batch.of(address))  # NaN while v_xy_valid is false
                speeds = np.hypot(own["vx"], own["vy"])
                if not np.isnan(speeds).all():
                    print(address.vehicle, len(own), f"{np.nanmean(speeds):.2f} m/s", flush=True)
except BrokenPipeError:
    os._exit(0)  # the reader, such as `head`, has ended: a normal exit would print the rest
except nedbus.ConnectError as exc:
    sys.exit(str(exc))
