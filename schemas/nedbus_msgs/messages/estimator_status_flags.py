"""EstimatorStatusFlags: what an estimator fuses, and which faults it sees."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from nedbus_msgs.model.declaration import Topic, older
from nedbus_msgs.model.message import Message
from nedbus_msgs.model.px4_types import Bool, Uint32, Uint64
from nedbus_msgs.model.rules import NotLater


class EstimatorStatusFlags(Message):
    """Fusions of one EKF2 instance: active (cs_), failed (fs_) and, up to 1.17, rejected data (reject_).

    Published when a flag changes and about once a second, by each instance of several.
    While cs_inertial_dead_reckoning is set nothing holds the horizontal position: it drifts, and is not valid for long.
    A flag that a vehicle's layout lacks is false here, and not in `model_fields_set`.

    cs_gps, cs_gps_yaw and cs_gps_yaw_fault (up to 1.15) are cs_gnss_pos, cs_gnss_yaw and cs_gnss_yaw_fault here.
    In those layouts cs_gnss_pos stands for position and velocity of GNSS; since 1.16 cs_gnss_vel is a flag of its own.
    """

    TOPICS: ClassVar = (
        Topic(
            "estimator_status_flags", 1.0, "each EKF instance, one or several",
            instances=True, on_change=True, plain_first=True,
        ),
    )  # fmt: skip
    LAYOUTS: ClassVar = {
        "1.13": """
            timestamp timestamp_sample control_status_changes cs_tilt_align cs_yaw_align cs_gps cs_opt_flow
            cs_mag_hdg cs_mag_3d cs_mag_dec cs_in_air cs_wind cs_baro_hgt cs_rng_hgt cs_gps_hgt cs_ev_pos cs_ev_yaw
            cs_ev_hgt cs_fuse_beta cs_mag_field_disturbed cs_fixed_wing cs_mag_fault cs_fuse_aspd cs_gnd_effect
            cs_rng_stuck cs_gps_yaw cs_mag_aligned_in_flight cs_ev_vel cs_synthetic_mag_z cs_vehicle_at_rest
            cs_gps_yaw_fault cs_rng_fault cs_inertial_dead_reckoning cs_wind_dead_reckoning cs_rng_kin_consistent
            fault_status_changes fs_bad_mag_x fs_bad_mag_y fs_bad_mag_z fs_bad_hdg fs_bad_mag_decl fs_bad_airspeed
            fs_bad_sideslip fs_bad_optflow_x fs_bad_optflow_y fs_bad_vel_n fs_bad_vel_e fs_bad_vel_d fs_bad_pos_n
            fs_bad_pos_e fs_bad_pos_d fs_bad_acc_bias fs_bad_acc_vertical fs_bad_acc_clipping
            innovation_fault_status_changes reject_hor_vel reject_ver_vel reject_hor_pos reject_ver_pos reject_mag_x
            reject_mag_y reject_mag_z reject_yaw reject_airspeed reject_sideslip reject_hagl reject_optflow_x
            reject_optflow_y""",
        "1.14": """
            1.13, without reject_mag_x reject_mag_y reject_mag_z, cs_rng_kin_consistent: cs_fake_pos cs_fake_hgt
            cs_gravity_vector""",
        "1.15": """
            1.14, without fs_bad_vel_n fs_bad_vel_e fs_bad_vel_d fs_bad_pos_n fs_bad_pos_e fs_bad_pos_d,
            cs_gravity_vector: cs_mag cs_ev_yaw_fault cs_mag_heading_consistent cs_aux_gpos""",
        "1.16": """
            1.15, without cs_gps cs_gps_yaw cs_gps_yaw_fault fs_bad_acc_bias, cs_yaw_align: cs_gnss_pos,
            cs_rng_stuck: cs_gnss_yaw, cs_vehicle_at_rest: cs_gnss_yaw_fault, cs_aux_gpos: cs_rng_terrain
            cs_opt_flow_terrain cs_valid_fake_pos cs_constant_pos cs_baro_fault cs_gnss_vel""",
        "1.17": "1.16, cs_gnss_vel: cs_gnss_fault cs_yaw_manual cs_gnss_hgt_fault",
        "1.18": """
            1.17, without innovation_fault_status_changes reject_hor_vel reject_ver_vel reject_hor_pos
            reject_ver_pos reject_yaw reject_airspeed reject_sideslip reject_hagl reject_optflow_x reject_optflow_y,
            cs_gnss_hgt_fault: cs_in_transition cs_heading_observable""",
    }  # fmt: skip
    OLDER: ClassVar = {
        "cs_gps": older("cs_gnss_pos"),
        "cs_gps_yaw": older("cs_gnss_yaw"),
        "cs_gps_yaw_fault": older("cs_gnss_yaw_fault"),
    }
    RULES: ClassVar = (NotLater("timestamp_sample", "timestamp"),)

    timestamp: Uint64 = Field(description="Time since boot [us]")
    timestamp_sample: Uint64 = Field(0, description="Time of the sensor data behind this [us], <= timestamp")

    control_status_changes: Uint32 = Field(0, description="Count of changes of the flags cs_")
    cs_tilt_align: Bool = Field(False, description="Tilt is aligned")
    cs_yaw_align: Bool = Field(False, description="Yaw is aligned")
    cs_gnss_pos: Bool = Field(False, description="GNSS position is fused")
    cs_opt_flow: Bool = Field(False, description="Optical flow is fused")
    cs_mag_hdg: Bool = Field(False, description="Magnetic heading is fused")
    cs_mag_3d: Bool = Field(False, description="The magnetometer's three axes are fused")
    cs_mag_dec: Bool = Field(False, description="Magnetic declination is fused")
    cs_in_air: Bool = Field(False, description="The vehicle is taken to be in the air")
    cs_wind: Bool = Field(False, description="Wind is estimated")
    cs_baro_hgt: Bool = Field(False, description="Height of the barometer is fused")
    cs_rng_hgt: Bool = Field(False, description="Height of the range finder is fused")
    cs_gps_hgt: Bool = Field(False, description="Height of GNSS is fused")
    cs_ev_pos: Bool = Field(False, description="Position of external vision is fused")
    cs_ev_yaw: Bool = Field(False, description="Yaw of external vision is fused")
    cs_ev_hgt: Bool = Field(False, description="Height of external vision is fused")
    cs_fuse_beta: Bool = Field(False, description="A sideslip of zero is fused")
    cs_mag_field_disturbed: Bool = Field(False, description="The magnetic field is not as expected here")
    cs_fixed_wing: Bool = Field(False, description="The vehicle is taken to fly as a fixed wing")
    cs_mag_fault: Bool = Field(False, description="The magnetometer is faulty and no longer used")
    cs_fuse_aspd: Bool = Field(False, description="Airspeed is fused")
    cs_gnd_effect: Bool = Field(False, description="Baro height is guarded against ground effect")
    cs_rng_stuck: Bool = Field(False, description="The range finder's values do not change as they should")
    cs_gnss_yaw: Bool = Field(False, description="Yaw of GNSS (two antennas) is fused")
    cs_mag_aligned_in_flight: Bool = Field(False, description="The magnetic field was aligned in flight")
    cs_ev_vel: Bool = Field(False, description="Velocity of external vision is fused")
    cs_synthetic_mag_z: Bool = Field(False, description="The magnetometer's z is computed, not measured")
    cs_vehicle_at_rest: Bool = Field(False, description="The vehicle is taken to be at rest")
    cs_gnss_yaw_fault: Bool = Field(False, description="Yaw of GNSS is faulty and not used")
    cs_rng_fault: Bool = Field(False, description="The range finder is faulty and not used")
    cs_inertial_dead_reckoning: Bool = Field(False, description="Nothing that is fused bounds horizontal drift")
    cs_wind_dead_reckoning: Bool = Field(False, description="Only airspeed or sideslip bounds horizontal drift")
    cs_rng_kin_consistent: Bool = Field(False, description="The range finder agrees with vertical velocity")
    cs_fake_pos: Bool = Field(False, description="A constant position is fused, for lack of a measured one")
    cs_fake_hgt: Bool = Field(False, description="A constant height is fused, for lack of a measured one")
    cs_gravity_vector: Bool = Field(False, description="Gravity, by the accelerometer, is fused")
    cs_mag: Bool = Field(False, description="The magnetometer is fused, for the magnetic field only")
    cs_ev_yaw_fault: Bool = Field(False, description="Yaw of external vision is faulty and not used")
    cs_mag_heading_consistent: Bool = Field(False, description="Magnetic heading agrees with the estimate")
    cs_aux_gpos: Bool = Field(False, description="An auxiliary global position is fused")
    cs_rng_terrain: Bool = Field(False, description="The range finder is fused for terrain")
    cs_opt_flow_terrain: Bool = Field(False, description="Optical flow is fused for terrain")
    cs_valid_fake_pos: Bool = Field(False, description="A constant position is fused, and is a valid one")
    cs_constant_pos: Bool = Field(False, description="The vehicle is taken to stay at its position")
    cs_baro_fault: Bool = Field(False, description="The barometer is faulty and not used")
    cs_gnss_vel: Bool = Field(False, description="GNSS velocity is fused")
    cs_gnss_fault: Bool = Field(False, description="GNSS is faulty and not used")
    cs_yaw_manual: Bool = Field(False, description="Yaw was set by the user")
    cs_gnss_hgt_fault: Bool = Field(False, description="Height of GNSS is faulty and not used")
    cs_in_transition: Bool = Field(False, description="A VTOL is in transition")
    cs_heading_observable: Bool = Field(False, description="The vehicle's motion shows its heading")

    fault_status_changes: Uint32 = Field(0, description="Count of changes of the flags fs_")
    fs_bad_mag_x: Bool = Field(False, description="Fusion of the magnetometer's x failed numerically")
    fs_bad_mag_y: Bool = Field(False, description="Fusion of the magnetometer's y failed numerically")
    fs_bad_mag_z: Bool = Field(False, description="Fusion of the magnetometer's z failed numerically")
    fs_bad_hdg: Bool = Field(False, description="Fusion of heading failed numerically")
    fs_bad_mag_decl: Bool = Field(False, description="Fusion of magnetic declination failed numerically")
    fs_bad_airspeed: Bool = Field(False, description="Fusion of airspeed failed numerically")
    fs_bad_sideslip: Bool = Field(False, description="Fusion of sideslip failed numerically")
    fs_bad_optflow_x: Bool = Field(False, description="Fusion of optical flow's x failed numerically")
    fs_bad_optflow_y: Bool = Field(False, description="Fusion of optical flow's y failed numerically")
    fs_bad_acc_vertical: Bool = Field(False, description="The accelerometer's vertical values are bad")
    fs_bad_acc_clipping: Bool = Field(False, description="The accelerometer clips")

    # Up to 1.17:
    innovation_fault_status_changes: Uint32 = Field(0, description="Count of changes of the flags reject_")
    reject_hor_vel: Bool = Field(False, description="Horizontal velocity was rejected")
    reject_ver_vel: Bool = Field(False, description="Vertical velocity was rejected")
    reject_hor_pos: Bool = Field(False, description="Horizontal position was rejected")
    reject_ver_pos: Bool = Field(False, description="Vertical position was rejected")
    reject_yaw: Bool = Field(False, description="Yaw was rejected")
    reject_airspeed: Bool = Field(False, description="Airspeed was rejected")
    reject_sideslip: Bool = Field(False, description="Sideslip was rejected")
    reject_hagl: Bool = Field(False, description="Height above ground was rejected")
    reject_optflow_x: Bool = Field(False, description="Optical flow's x was rejected")
    reject_optflow_y: Bool = Field(False, description="Optical flow's y was rejected")

    # Up to 1.15:
    fs_bad_acc_bias: Bool = Field(False, description="The accelerometer's bias is estimated badly")

    # Up to 1.14:
    fs_bad_vel_n: Bool = Field(False, description="Fusion of north velocity failed numerically")
    fs_bad_vel_e: Bool = Field(False, description="Fusion of east velocity failed numerically")
    fs_bad_vel_d: Bool = Field(False, description="Fusion of down velocity failed numerically")
    fs_bad_pos_n: Bool = Field(False, description="Fusion of north position failed numerically")
    fs_bad_pos_e: Bool = Field(False, description="Fusion of east position failed numerically")
    fs_bad_pos_d: Bool = Field(False, description="Fusion of down position failed numerically")

    # Up to 1.13:
    reject_mag_x: Bool = Field(False, description="The magnetometer's x was rejected")
    reject_mag_y: Bool = Field(False, description="The magnetometer's y was rejected")
    reject_mag_z: Bool = Field(False, description="The magnetometer's z was rejected")
