"""EstimatorStatusFlags: sensors that an estimator fuses, and faults that it sees."""

from nedbus_msgs.model import Layout, Message, NotLater, Older, Topic
from nedbus_msgs.model.px4_types import Bool, Uint32, Uint64, field


class EstimatorStatusFlags(Message):
    """Fusions of one EKF2 instance: active (cs_), failed (fs_) and, up to 1.17, rejected data (reject_).

    Each EKF2 instance publishes it when a flag changes, and about once a second.
    While cs_inertial_dead_reckoning is set, the horizontal position is not aided: it drifts, and soon becomes invalid.
    A flag that a vehicle's layout lacks is false here, and not in `model_fields_set`.

    cs_gps, cs_gps_yaw and cs_gps_yaw_fault (up to 1.15) are cs_gnss_pos, cs_gnss_yaw and cs_gnss_yaw_fault here.
    In those layouts cs_gnss_pos covers GNSS position and velocity; since 1.16 cs_gnss_vel is a separate flag.
    """

    TOPICS = (
        Topic(
            "estimator_status_flags", 1.0, "each EKF instance, one or several",
            instances=True, on_change=True, plain_first=True,
        ),
    )  # fmt: skip
    LAYOUTS = (
        Layout("1.13", """
            1.14, without cs_fake_pos cs_fake_hgt cs_gravity_vector,
            reject_ver_pos: reject_mag_x reject_mag_y reject_mag_z"""),
        Layout("1.14", """
            1.15, without cs_mag cs_ev_yaw_fault cs_mag_heading_consistent cs_aux_gpos,
            fs_bad_optflow_y: fs_bad_vel_n fs_bad_vel_e fs_bad_vel_d fs_bad_pos_n fs_bad_pos_e fs_bad_pos_d"""),
        Layout("1.15", """
            1.16, without cs_gnss_pos cs_gnss_yaw cs_gnss_yaw_fault cs_rng_terrain cs_opt_flow_terrain
            cs_valid_fake_pos cs_constant_pos cs_baro_fault cs_gnss_vel, cs_yaw_align: cs_gps,
            cs_rng_stuck: cs_gps_yaw, cs_vehicle_at_rest: cs_gps_yaw_fault, fs_bad_optflow_y: fs_bad_acc_bias"""),
        Layout("1.16", "1.17, without cs_gnss_fault cs_yaw_manual cs_gnss_hgt_fault"),
        Layout("1.17", """
            *, without cs_in_transition cs_heading_observable fs_bad_acc_bias fs_bad_vel_n fs_bad_vel_e fs_bad_vel_d
            fs_bad_pos_n fs_bad_pos_e fs_bad_pos_d reject_mag_x reject_mag_y reject_mag_z"""),
        Layout("1.18", """
            1.17, without innovation_fault_status_changes reject_hor_vel reject_ver_vel reject_hor_pos
            reject_ver_pos reject_yaw reject_airspeed reject_sideslip reject_hagl reject_optflow_x reject_optflow_y,
            cs_gnss_hgt_fault: cs_in_transition cs_heading_observable"""),
    )  # fmt: skip
    OLDER = (
        Older("cs_gps", "cs_gnss_pos"),
        Older("cs_gps_yaw", "cs_gnss_yaw"),
        Older("cs_gps_yaw_fault", "cs_gnss_yaw_fault"),
    )
    RULES = (NotLater("timestamp_sample", "timestamp"),)

    timestamp_sample: Uint64 = field("Time of the sensor data behind this [us], <= timestamp")

    control_status_changes: Uint32 = field("Count of changes of the flags cs_")
    cs_tilt_align: Bool = field("Tilt is aligned")
    cs_yaw_align: Bool = field("Yaw is aligned")
    cs_gnss_pos: Bool = field("GNSS position is fused")
    cs_opt_flow: Bool = field("Optical flow is fused")
    cs_mag_hdg: Bool = field("Magnetic heading is fused")
    cs_mag_3d: Bool = field("The magnetometer's three axes are fused")
    cs_mag_dec: Bool = field("Magnetic declination is fused")
    cs_in_air: Bool = field("The vehicle is taken to be in the air")
    cs_wind: Bool = field("Wind is estimated")
    cs_baro_hgt: Bool = field("Height of the barometer is fused")
    cs_rng_hgt: Bool = field("Height of the range finder is fused")
    cs_gps_hgt: Bool = field("Height of GNSS is fused")
    cs_ev_pos: Bool = field("Position of external vision is fused")
    cs_ev_yaw: Bool = field("Yaw of external vision is fused")
    cs_ev_hgt: Bool = field("Height of external vision is fused")
    cs_fuse_beta: Bool = field("A sideslip of zero is fused")
    cs_mag_field_disturbed: Bool = field("The magnetic field is not as expected here")
    cs_fixed_wing: Bool = field("The vehicle is taken to fly as a fixed wing")
    cs_mag_fault: Bool = field("The magnetometer is faulty and no longer used")
    cs_fuse_aspd: Bool = field("Airspeed is fused")
    cs_gnd_effect: Bool = field("Baro height is guarded against ground effect")
    cs_rng_stuck: Bool = field("The range finder's values do not change as they should")
    cs_gnss_yaw: Bool = field("Yaw of GNSS (two antennas) is fused")
    cs_mag_aligned_in_flight: Bool = field("The magnetic field was aligned in flight")
    cs_ev_vel: Bool = field("Velocity of external vision is fused")
    cs_synthetic_mag_z: Bool = field("The magnetometer's z is computed, not measured")
    cs_vehicle_at_rest: Bool = field("The vehicle is taken to be at rest")
    cs_gnss_yaw_fault: Bool = field("Yaw of GNSS is faulty and not used")
    cs_rng_fault: Bool = field("The range finder is faulty and not used")
    cs_inertial_dead_reckoning: Bool = field("Nothing that is fused bounds horizontal drift")
    cs_wind_dead_reckoning: Bool = field("Only airspeed or sideslip bounds horizontal drift")
    cs_rng_kin_consistent: Bool = field("The range finder agrees with vertical velocity")
    cs_fake_pos: Bool = field("A constant position is fused, for lack of a measured one")
    cs_fake_hgt: Bool = field("A constant height is fused, for lack of a measured one")
    cs_gravity_vector: Bool = field("Gravity, by the accelerometer, is fused")
    cs_mag: Bool = field("The magnetometer is fused, for the magnetic field only")
    cs_ev_yaw_fault: Bool = field("Yaw of external vision is faulty and not used")
    cs_mag_heading_consistent: Bool = field("Magnetic heading agrees with the estimate")
    cs_aux_gpos: Bool = field("An auxiliary global position is fused")
    cs_rng_terrain: Bool = field("The range finder is fused for terrain")
    cs_opt_flow_terrain: Bool = field("Optical flow is fused for terrain")
    cs_valid_fake_pos: Bool = field("A constant position is fused, and is a valid one")
    cs_constant_pos: Bool = field("The vehicle is taken to stay at its position")
    cs_baro_fault: Bool = field("The barometer is faulty and not used")
    cs_gnss_vel: Bool = field("GNSS velocity is fused")
    cs_gnss_fault: Bool = field("GNSS is faulty and not used")
    cs_yaw_manual: Bool = field("Yaw was set by the user")
    cs_gnss_hgt_fault: Bool = field("Height of GNSS is faulty and not used")
    cs_in_transition: Bool = field("A VTOL is in transition")
    cs_heading_observable: Bool = field("The vehicle's motion shows its heading")

    fault_status_changes: Uint32 = field("Count of changes of the flags fs_")
    fs_bad_mag_x: Bool = field("Fusion of the magnetometer's x failed numerically")
    fs_bad_mag_y: Bool = field("Fusion of the magnetometer's y failed numerically")
    fs_bad_mag_z: Bool = field("Fusion of the magnetometer's z failed numerically")
    fs_bad_hdg: Bool = field("Fusion of heading failed numerically")
    fs_bad_mag_decl: Bool = field("Fusion of magnetic declination failed numerically")
    fs_bad_airspeed: Bool = field("Fusion of airspeed failed numerically")
    fs_bad_sideslip: Bool = field("Fusion of sideslip failed numerically")
    fs_bad_optflow_x: Bool = field("Fusion of optical flow's x failed numerically")
    fs_bad_optflow_y: Bool = field("Fusion of optical flow's y failed numerically")
    fs_bad_acc_vertical: Bool = field("The accelerometer's vertical values are bad")
    fs_bad_acc_clipping: Bool = field("The accelerometer clips")

    # Up to 1.17:
    innovation_fault_status_changes: Uint32 = field("Count of changes of the flags reject_")
    reject_hor_vel: Bool = field("Horizontal velocity was rejected")
    reject_ver_vel: Bool = field("Vertical velocity was rejected")
    reject_hor_pos: Bool = field("Horizontal position was rejected")
    reject_ver_pos: Bool = field("Vertical position was rejected")
    reject_yaw: Bool = field("Yaw was rejected")
    reject_airspeed: Bool = field("Airspeed was rejected")
    reject_sideslip: Bool = field("Sideslip was rejected")
    reject_hagl: Bool = field("Height above ground was rejected")
    reject_optflow_x: Bool = field("Optical flow's x was rejected")
    reject_optflow_y: Bool = field("Optical flow's y was rejected")

    # Up to 1.15:
    fs_bad_acc_bias: Bool = field("The accelerometer's bias is estimated badly")

    # Up to 1.14:
    fs_bad_vel_n: Bool = field("Fusion of north velocity failed numerically")
    fs_bad_vel_e: Bool = field("Fusion of east velocity failed numerically")
    fs_bad_vel_d: Bool = field("Fusion of down velocity failed numerically")
    fs_bad_pos_n: Bool = field("Fusion of north position failed numerically")
    fs_bad_pos_e: Bool = field("Fusion of east position failed numerically")
    fs_bad_pos_d: Bool = field("Fusion of down position failed numerically")

    # Up to 1.13:
    reject_mag_x: Bool = field("The magnetometer's x was rejected")
    reject_mag_y: Bool = field("The magnetometer's y was rejected")
    reject_mag_z: Bool = field("The magnetometer's z was rejected")
