"""VehicleOdometry: pose and twist in one message."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from nedbus_msgs.model.declaration import Topic, older
from nedbus_msgs.model.message import Message
from nedbus_msgs.model.px4_types import NAN, Float32x3, Float32x4, Int8, Uint8, Uint64
from nedbus_msgs.model.rules import UnitQuaternion


class VehicleOdometry(Message):
    """Pose and twist of a vehicle in one message: EKF2's estimate, or what vision or motion capture measured.

    pose_frame is the frame of position and q, velocity_frame that of velocity: NED, aligned to true north, or FRD, with
    an origin and heading of its own; z points down in both. A body frame is FRD too: x forward, y right.
    Not known: NaN in the first element of an array. Variances are without covariances.
    reset_counter counts resets of all kinds together, and no field says how far they jumped.
    timestamp_sample may be another computer's, so that it can be later than timestamp.

    Layout 1.13: its covariance matrices and q_offset are dropped on upgrade, NaN on downgrade; it has no quality.
    local_frame (0 NED, 1 FRD, 2 other) becomes pose_frame. velocity_frame is kept as it is, though 1.13 numbers it
    as local_frame, with 3 the body: EKF2 of 1.13 says 1 for a velocity in NED, which is right in today's numbers.
    """

    TOPICS: ClassVar = (
        Topic("vehicle_odometry", 100.0, "EKF2, or the EKF2 selector of several", priority="data_high"),
        Topic("vehicle_mocap_odometry", 100.0, "a motion capture system, over MAVLink or DDS"),
        Topic("vehicle_visual_odometry", 100.0, "visual odometry of a companion computer, over MAVLink or DDS"),
        Topic("estimator_odometry", 2.0, "each EKF instance, when several run", instances=True),
    )
    LAYOUTS: ClassVar = {
        "1.13": """
            timestamp timestamp_sample local_frame:uint8 x:float32 y:float32 z:float32 q q_offset:float32[4]
            pose_covariance:float32[21] velocity_frame vx:float32 vy:float32 vz:float32 rollspeed:float32
            pitchspeed:float32 yawspeed:float32 velocity_covariance:float32[21] reset_counter""",
        "1.14": "*",
    }  # fmt: skip
    OLDER: ClassVar = {
        "local_frame": older(
            "pose_frame", lambda frame: {0: 1, 1: 2}.get(frame, 0), lambda frame: {1: 0, 2: 1}.get(frame, 2)
        ),
        "x": older("position[0]"),
        "y": older("position[1]"),
        "z": older("position[2]"),
        "vx": older("velocity[0]"),
        "vy": older("velocity[1]"),
        "vz": older("velocity[2]"),
        "rollspeed": older("angular_velocity[0]"),
        "pitchspeed": older("angular_velocity[1]"),
        "yawspeed": older("angular_velocity[2]"),
    }
    ENUMS: ClassVar = {"pose_frame": "POSE_FRAME_", "velocity_frame": "VELOCITY_FRAME_"}
    RULES: ClassVar = (UnitQuaternion("q"),)

    POSE_FRAME_UNKNOWN: ClassVar = 0
    POSE_FRAME_NED: ClassVar = 1
    POSE_FRAME_FRD: ClassVar = 2
    VELOCITY_FRAME_UNKNOWN: ClassVar = 0
    VELOCITY_FRAME_NED: ClassVar = 1
    VELOCITY_FRAME_FRD: ClassVar = 2
    VELOCITY_FRAME_BODY_FRD: ClassVar = 3

    timestamp: Uint64 = Field(description="Time since boot [us]")
    timestamp_sample: Uint64 = Field(0, description="Time of the sensor data behind this [us]")

    pose_frame: Uint8 = Field(0, description="Frame of position and q: 0 unknown, 1 NED, 2 FRD of its own heading")
    position: Float32x3 = Field((NAN,) * 3, description="Position [m] [pose_frame]")
    q: Float32x4 = Field((NAN,) * 4, description="Rotation from FRD body to pose_frame, Hamilton (w, x, y, z)")

    velocity_frame: Uint8 = Field(
        0, description="Frame of velocity: 0 unknown, 1 NED, 2 FRD of its own heading, 3 body FRD"
    )
    velocity: Float32x3 = Field((NAN,) * 3, description="Velocity [m/s] [velocity_frame]")
    angular_velocity: Float32x3 = Field((NAN,) * 3, description="Angular velocity [rad/s] [body FRD]")

    position_variance: Float32x3 = Field((NAN,) * 3, description="Variance of position [m^2] [pose_frame]")
    orientation_variance: Float32x3 = Field((NAN,) * 3, description="Variance of attitude [rad^2] [body FRD]")
    velocity_variance: Float32x3 = Field((NAN,) * 3, description="Variance of velocity [m^2/s^2] [velocity_frame]")

    reset_counter: Uint8 = Field(0, description="Count of resets of attitude, velocity and position, wraps at 255")
    quality: Int8 = Field(0, description="Quality as its source says it, 0 if not known")
