"""EstimatorStatusFlags: fused sensors and faults of an EKF2 instance."""

from nedbus_msgs.model import Layout, Message, NotLater, RenamedField, Topic
from nedbus_msgs.model.px4_types import Bool, Uint32, Uint64, field


class EstimatorStatusFlags(Message):
    """Status flags of one EKF2 instance: control (cs_), faults (fs_) and, up to 1.17, rejected innovations (reject_).

    It is published when a flag changes, and about once a second.
    While cs_inertial_dead_reckoning is set, the horizontal position is not aided: it drifts and soon becomes invalid.
    A flag that the vehicle's layout lacks is false, and absent from `model_fields_set`.

    cs_gps, cs_gps_yaw and cs_gps_yaw_fault (up to 1.15) are now cs_gnss_pos, cs_gnss_yaw and cs_gnss_yaw_fault.
    In those layouts cs_gnss_pos covers GNSS position and velocity; since 1.16 cs_gnss_vel is a separate flag.
    """

    TOPICS = (
        Topic(
            "estimator_status_flags",
            1.0,
            "each EKF2 instance",
            instances=True,
            on_change=True,
            plain_first=True,
        ),
    )
    LAYOUTS = (
        Layout(
            "1.13",
            base="1.14",
            without="cs_fake_pos cs_fake_hgt cs_gravity_vector",
            insert_after={
                "reject_ver_pos": "reject_mag_x reject_mag_y reject_mag_z",
            },
        ),
        Layout(
            "1.14",
            base="1.15",
            without="cs_mag cs_ev_yaw_fault cs_mag_heading_consistent cs_aux_gpos",
            insert_after={
                "fs_bad_optflow_y": "fs_bad_vel_n fs_bad_vel_e fs_bad_vel_d fs_bad_pos_n fs_bad_pos_e fs_bad_pos_d",
            },
        ),
        Layout(
            "1.15",
            base="1.16",
            without="""
                cs_gnss_pos cs_gnss_yaw cs_gnss_yaw_fault cs_rng_terrain cs_opt_flow_terrain
                cs_valid_fake_pos cs_constant_pos cs_baro_fault cs_gnss_vel
            """,
            insert_after={
                "cs_yaw_align": "cs_gps",
                "cs_rng_stuck": "cs_gps_yaw",
                "cs_vehicle_at_rest": "cs_gps_yaw_fault",
                "fs_bad_optflow_y": "fs_bad_acc_bias",
            },
        ),
        Layout(
            "1.16",
            base="1.17",
            without="cs_gnss_fault cs_yaw_manual cs_gnss_hgt_fault",
        ),
        Layout(
            "1.17",
            without="""
                cs_in_transition cs_heading_observable fs_bad_acc_bias fs_bad_vel_n
                fs_bad_vel_e fs_bad_vel_d fs_bad_pos_n fs_bad_pos_e fs_bad_pos_d
                reject_mag_x reject_mag_y reject_mag_z
            """,
        ),
        Layout(
            "1.18",
            base="1.17",
            without="""
                innovation_fault_status_changes reject_hor_vel reject_ver_vel reject_hor_pos
                reject_ver_pos reject_yaw reject_airspeed reject_sideslip reject_hagl
                reject_optflow_x reject_optflow_y
            """,
            insert_after={
                "cs_gnss_hgt_fault": "cs_in_transition cs_heading_observable",
            },
        ),
    )
    OLDER = (
        RenamedField("cs_gps", "cs_gnss_pos"),
        RenamedField("cs_gps_yaw", "cs_gnss_yaw"),
        RenamedField("cs_gps_yaw_fault", "cs_gnss_yaw_fault"),
    )
    RULES = (NotLater("timestamp_sample", "timestamp"),)

    timestamp_sample: Uint64 = field("Time of the underlying sensor data [us], <= timestamp")
    control_status_changes: Uint32 = field("Number of changes of the cs_ flags")
    cs_tilt_align: Bool = field("Tilt alignment is complete")
    cs_yaw_align: Bool = field("Yaw alignment is complete")
    cs_gnss_pos: Bool = field("GNSS position fusion is active")
    cs_opt_flow: Bool = field("Optical flow fusion is active")
    cs_mag_hdg: Bool = field("Magnetic heading fusion is active")
    cs_mag_3d: Bool = field("3-axis magnetometer fusion is active")
    cs_mag_dec: Bool = field("Magnetic declination fusion is active")
    cs_in_air: Bool = field("Vehicle is considered airborne")
    cs_wind: Bool = field("Wind estimation is active")
    cs_baro_hgt: Bool = field("Barometric height fusion is active")
    cs_rng_hgt: Bool = field("Range finder height fusion is active")
    cs_gps_hgt: Bool = field("GNSS height fusion is active")
    cs_ev_pos: Bool = field("External vision position fusion is active")
    cs_ev_yaw: Bool = field("External vision yaw fusion is active")
    cs_ev_hgt: Bool = field("External vision height fusion is active")
    cs_fuse_beta: Bool = field("Synthetic sideslip fusion is active")
    cs_mag_field_disturbed: Bool = field(
        "Magnetic field differs from the field expected at this location"
    )
    cs_fixed_wing: Bool = field("Vehicle is considered to fly as a fixed wing")
    cs_mag_fault: Bool = field("Magnetometer is faulty and no longer used")
    cs_fuse_aspd: Bool = field("Airspeed fusion is active")
    cs_gnd_effect: Bool = field("Ground effect compensation of barometric height is active")
    cs_rng_stuck: Bool = field("Range finder readings are stuck")
    cs_gnss_yaw: Bool = field("GNSS yaw (dual antenna) fusion is active")
    cs_mag_aligned_in_flight: Bool = field("In-flight magnetic field alignment is complete")
    cs_ev_vel: Bool = field("External vision velocity fusion is active")
    cs_synthetic_mag_z: Bool = field("Synthesized magnetometer Z is used instead of a measurement")
    cs_vehicle_at_rest: Bool = field("Vehicle is considered at rest")
    cs_gnss_yaw_fault: Bool = field("GNSS yaw is faulty and not used")
    cs_rng_fault: Bool = field("Range finder is faulty and not used")
    cs_inertial_dead_reckoning: Bool = field("No fused measurement limits horizontal drift")
    cs_wind_dead_reckoning: Bool = field("Only airspeed or sideslip limits horizontal drift")
    cs_rng_kin_consistent: Bool = field("Range finder is consistent with vertical velocity")
    cs_fake_pos: Bool = field("Constant position fusion is active, for lack of measurements")
    cs_fake_hgt: Bool = field("Constant height fusion is active, for lack of measurements")
    cs_gravity_vector: Bool = field("Gravity vector (accelerometer) fusion is active")
    cs_mag: Bool = field("3-axis magnetometer fusion is active, for the magnetic field states only")
    cs_ev_yaw_fault: Bool = field("External vision yaw is faulty and not used")
    cs_mag_heading_consistent: Bool = field("Magnetic heading is consistent with the estimate")
    cs_aux_gpos: Bool = field("Auxiliary global position fusion is active")
    cs_rng_terrain: Bool = field("Range finder fusion for terrain is active")
    cs_opt_flow_terrain: Bool = field("Optical flow fusion for terrain is active")
    cs_valid_fake_pos: Bool = field("Constant position fusion is active, and the position is valid")
    cs_constant_pos: Bool = field("Vehicle is considered to hold its position")
    cs_baro_fault: Bool = field("Barometer is faulty and not used")
    cs_gnss_vel: Bool = field("GNSS velocity fusion is active")
    cs_gnss_fault: Bool = field("GNSS is faulty and not used")
    cs_yaw_manual: Bool = field("Yaw was set manually")
    cs_gnss_hgt_fault: Bool = field("GNSS height is faulty and not used")
    cs_in_transition: Bool = field("VTOL is in transition")
    cs_heading_observable: Bool = field("Heading is observable from the vehicle's motion")

    fault_status_changes: Uint32 = field("Number of changes of the fs_ flags")
    fs_bad_mag_x: Bool = field("Numerical error in magnetometer X fusion")
    fs_bad_mag_y: Bool = field("Numerical error in magnetometer Y fusion")
    fs_bad_mag_z: Bool = field("Numerical error in magnetometer Z fusion")
    fs_bad_hdg: Bool = field("Numerical error in heading fusion")
    fs_bad_mag_decl: Bool = field("Numerical error in magnetic declination fusion")
    fs_bad_airspeed: Bool = field("Numerical error in airspeed fusion")
    fs_bad_sideslip: Bool = field("Numerical error in sideslip fusion")
    fs_bad_optflow_x: Bool = field("Numerical error in optical flow X fusion")
    fs_bad_optflow_y: Bool = field("Numerical error in optical flow Y fusion")
    fs_bad_acc_vertical: Bool = field("Vertical accelerometer data is bad")
    fs_bad_acc_clipping: Bool = field("Accelerometer is clipping")

    # Up to 1.17:
    innovation_fault_status_changes: Uint32 = field("Number of changes of the reject_ flags")
    reject_hor_vel: Bool = field("Horizontal velocity was rejected")
    reject_ver_vel: Bool = field("Vertical velocity was rejected")
    reject_hor_pos: Bool = field("Horizontal position was rejected")
    reject_ver_pos: Bool = field("Vertical position was rejected")
    reject_yaw: Bool = field("Yaw was rejected")
    reject_airspeed: Bool = field("Airspeed was rejected")
    reject_sideslip: Bool = field("Sideslip was rejected")
    reject_hagl: Bool = field("Height above ground was rejected")
    reject_optflow_x: Bool = field("Optical flow X was rejected")
    reject_optflow_y: Bool = field("Optical flow Y was rejected")

    # Up to 1.15:
    fs_bad_acc_bias: Bool = field("Accelerometer bias estimate is bad")

    # Up to 1.14:
    fs_bad_vel_n: Bool = field("Numerical error in north velocity fusion")
    fs_bad_vel_e: Bool = field("Numerical error in east velocity fusion")
    fs_bad_vel_d: Bool = field("Numerical error in down velocity fusion")
    fs_bad_pos_n: Bool = field("Numerical error in north position fusion")
    fs_bad_pos_e: Bool = field("Numerical error in east position fusion")
    fs_bad_pos_d: Bool = field("Numerical error in down position fusion")

    # Up to 1.13:
    reject_mag_x: Bool = field("Magnetometer X was rejected")
    reject_mag_y: Bool = field("Magnetometer Y was rejected")
    reject_mag_z: Bool = field("Magnetometer Z was rejected")
