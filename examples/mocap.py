"""Publish the pose of a rigid body at 50 Hz, as a motion capture system would, for a service with `position=`."""

import math
import sys
import time
from contextlib import suppress

import nedbus


def read_pose(
    seconds: float,
) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    """Return position (NED, m) and attitude (w, x, y, z): replace this circle by your system's pose."""
    turn = 0.5 * seconds
    return (math.cos(turn), math.sin(turn), -1.5), (
        math.cos(turn / 2),
        0.0,
        0.0,
        math.sin(turn / 2),
    )


try:
    with suppress(KeyboardInterrupt), nedbus.connect() as bus:
        publisher = bus.publisher("vehicle_visual_odometry", vehicle="mocap", source="mocap")
        print("publishing mocap/vehicle_visual_odometry at 50 Hz", flush=True)
        while True:
            measured = time.monotonic_ns() // 1000  # one monotonic clock for both times
            position, q = read_pose(measured / 1e6)
            pose = {
                "pose_frame": nedbus.VehicleOdometry.POSE_FRAME_NED,
                "position": position,
                "q": q,
            }
            variances = {
                "position_variance": (1e-4, 1e-4, 1e-4),
                "orientation_variance": (1e-4, 1e-4, 1e-4),
            }
            times = {"timestamp_sample": measured, "timestamp": time.monotonic_ns() // 1000}
            # without a velocity, because none is measured
            publisher.publish({**times, **pose, **variances})
            time.sleep(0.02)
except nedbus.ConnectError as exc:
    sys.exit(str(exc))
