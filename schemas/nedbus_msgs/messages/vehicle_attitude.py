"""VehicleAttitude: orientation of the vehicle's body."""

from nedbus_msgs.model import Layout, Message, NotLater, Topic, UnitQuaternion
from nedbus_msgs.model.px4_types import Float32x4, Uint8, Uint64, field


class VehicleAttitude(Message):
    """Attitude of a vehicle: the rotation from its body frame (FRD) to the local frame (NED).

    Quaternions follow the Hamilton convention, (w, x, y, z), with norm 1; FRD: x forward, y right, z down.
    q rotates a vector from the body frame to NED; q and -q are the same attitude, and both occur.
    The attitude is unknown if the first element of q is NaN.

    delta_q_reset holds the latest reset: it explains a jump only if quat_reset_counter rose by exactly 1.
    In some ground truth, delta_q_reset is all zeros, which is not a rotation.
    """

    TOPICS = (
        Topic(
            "vehicle_attitude",
            50.0,
            "EKF2, or the EKF2 selector in multi-EKF mode",
            priority="data_high",
        ),
        Topic("vehicle_attitude_groundtruth", 50.0, "simulators (SITL, HITL)"),
        Topic("external_ins_attitude", 50.0, "an external INS driver (VectorNav, ...)"),
        Topic("estimator_attitude", 2.0, "each EKF2 instance in multi-EKF mode", instances=True),
    )
    LAYOUTS = (Layout("1.13", "*"),)
    RULES = (NotLater("timestamp_sample", "timestamp"), UnitQuaternion("q"))

    timestamp_sample: Uint64 = field("Time of the underlying sensor data [us], <= timestamp")
    q: Float32x4 = field("Rotation from FRD body to NED, Hamilton (w, x, y, z)")
    delta_q_reset: Float32x4 = field(
        "Change of q at its latest reset: q after = delta_q_reset * q before"
    )
    quat_reset_counter: Uint8 = field("Count of q resets, wraps at 255")
