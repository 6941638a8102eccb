"""VehicleOdometry: pose and twist in one message."""

from nedbus_msgs.model import Layout, Message, RenamedField, Topic, UnitQuaternion
from nedbus_msgs.model.px4_types import Float32x3, Float32x4, Int8, Uint8, Uint64, field


class VehicleOdometry(Message):
    """Pose and twist of a vehicle: EKF2's estimate, or a measurement from vision or motion capture.

    pose_frame is the frame of position and q, velocity_frame that of velocity: NED, aligned to true north, or FRD with
    arbitrary origin and heading; z points down in both. The body frame is also FRD: x forward, y right.
    An array is unknown if its first element is NaN; q also if it is all zeros. There are variances, but no covariances.
    reset_counter counts resets of all kinds; no field holds their deltas.
    q of vision or motion capture is as its sender wrote it. EKF2 fuses the attitude only if its norm is 1 within 1e-5,
    and otherwise position and velocity alone; EKF2 of 1.13 fuses any finite q.
    timestamp_sample may be from another computer's clock, and later than timestamp.

    Layout 1.13 lacks quality; its covariance matrices and q_offset are dropped on upgrade, and NaN on downgrade.
    local_frame (0 NED, 1 FRD, 2 other) becomes pose_frame. velocity_frame is copied, although 1.13 numbers it like
    local_frame (plus 3 for body): EKF2 of 1.13 sends 1 for a velocity in NED, which is correct in newer layouts.
    """

    TOPICS = (
        Topic(
            "vehicle_odometry",
            100.0,
            "EKF2, or the EKF2 selector in multi-EKF mode",
            priority="data_high",
        ),
        Topic("vehicle_mocap_odometry", 100.0, "a motion capture system, over MAVLink or DDS"),
        Topic(
            "vehicle_visual_odometry",
            100.0,
            "visual odometry of a companion computer, over MAVLink or DDS",
        ),
        Topic("estimator_odometry", 2.0, "each EKF2 instance in multi-EKF mode", instances=True),
    )
    LAYOUTS = (
        Layout(
            "1.13",
            """
                timestamp timestamp_sample local_frame x y z q q_offset pose_covariance
                velocity_frame vx vy vz rollspeed pitchspeed yawspeed velocity_covariance
                reset_counter
            """,
            other_types={
                "q_offset": "float32[4]",
                "pose_covariance": "float32[21]",
                "velocity_covariance": "float32[21]",
            },
        ),
        Layout("1.14", "*"),
    )
    OLDER = (
        RenamedField(
            "local_frame",
            "pose_frame",
            lambda f: {0: 1, 1: 2}.get(f, 0),
            lambda f: {1: 0, 2: 1}.get(f, 2),
        ),
        *(RenamedField(name, f"position[{i}]") for i, name in enumerate(("x", "y", "z"))),
        *(RenamedField(name, f"velocity[{i}]") for i, name in enumerate(("vx", "vy", "vz"))),
        *(
            RenamedField(f"{name}speed", f"angular_velocity[{i}]")
            for i, name in enumerate(("roll", "pitch", "yaw"))
        ),
    )
    RULES = (UnitQuaternion("q", tolerance=0.1, or_zeros=True),)

    POSE_FRAME_UNKNOWN, POSE_FRAME_NED, POSE_FRAME_FRD = range(3)
    VELOCITY_FRAME_UNKNOWN, VELOCITY_FRAME_NED, VELOCITY_FRAME_FRD, VELOCITY_FRAME_BODY_FRD = range(
        4
    )

    timestamp_sample: Uint64 = field("Time of the underlying sensor data [us]")
    pose_frame: Uint8 = field(
        "Frame of position and q: 0 unknown, 1 NED, 2 FRD with arbitrary heading"
    )
    position: Float32x3 = field("Position [m] [pose_frame]")
    q: Float32x4 = field("Rotation from FRD body to pose_frame, Hamilton (w, x, y, z)")

    velocity_frame: Uint8 = field(
        "Frame of velocity: 0 unknown, 1 NED, 2 FRD with arbitrary heading, 3 body FRD"
    )
    velocity: Float32x3 = field("Velocity [m/s] [velocity_frame]")
    angular_velocity: Float32x3 = field("Angular velocity [rad/s] [body FRD]")

    position_variance: Float32x3 = field("Variance of position [m^2] [pose_frame]")
    orientation_variance: Float32x3 = field("Variance of attitude [rad^2] [body FRD]")
    velocity_variance: Float32x3 = field("Variance of velocity [m^2/s^2] [velocity_frame]")

    reset_counter: Uint8 = field("Count of attitude, velocity and position resets, wraps at 255")
    quality: Int8 = field("Quality reported by the source, 0 if unknown")
