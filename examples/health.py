"""Print the health of all streams every two seconds: rate, loss, gaps, and the share of valid messages."""

import os
import sys
import time
from contextlib import suppress

import nedbus

try:
    with (
        suppress(KeyboardInterrupt),
        nedbus.connect() as bus,
        bus.subscribe("*", mode="every") as subscription,
    ):
        monitor = nedbus.health.Monitor()
        shown = time.monotonic()
        for sample in subscription:
            monitor.add(sample)
            if time.monotonic() - shown < 2.0:
                continue
            shown = time.monotonic()
            for address, health in monitor.snapshot().items():
                shares = "".join(
                    f", {flag} {share:.0%}" for flag, share in (health.flags or {}).items()
                )
                rates = f"{health.rate or 0.0:.1f} of {health.nominal:g} Hz"
                print(
                    f"{address}: {rates}, {health.lost} lost, {health.gaps} gaps{shares}",
                    flush=True,
                )
except BrokenPipeError:
    os._exit(0)  # the reader, such as `head`, has ended: a normal exit would print the rest
except nedbus.ConnectError as exc:
    sys.exit(str(exc))
