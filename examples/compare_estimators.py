"""Print the distance of each EKF instance from the ground truth, in mode "every" to compare every message."""

import math
import os
import sys
from contextlib import suppress

import nedbus

truth: nedbus.frames.Ned | None = None
try:
    with suppress(KeyboardInterrupt), nedbus.connect() as bus:
        for sample in bus.subscribe("*", vehicle="1", mode="every"):
            message = sample.message
            if not isinstance(message, nedbus.VehicleLocalPosition):
                continue
            if sample.topic == "vehicle_local_position_groundtruth":
                truth = message.position
            elif sample.topic == "estimator_local_position" and truth and message.position:
                error = math.dist(message.position, truth)
                print(
                    f"estimator {sample.instance}: {error:6.2f} m off, reports eph {message.eph:5.2f} m"
                )
except BrokenPipeError:
    os._exit(0)  # the reader, such as `head`, has ended: a normal exit would print the rest
except nedbus.ConnectError as exc:
    sys.exit(str(exc))
