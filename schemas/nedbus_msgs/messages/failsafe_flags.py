"""FailsafeFlags: missing requirements of modes, and triggers of failsafes."""

from nedbus_msgs.model import Layout, Message, Older, Topic
from nedbus_msgs.model.px4_types import Bool, Uint8, Uint32, field


class FailsafeFlags(Message):
    """Requirements of the modes, and the unmet ones: reasons that a vehicle does not arm, and triggers of failsafes.

    The masks mode_req_ have bit n (1 << n) for mode n of VehicleStatus.NAVIGATION_STATE_.
    An unmet requirement blocks a mode, for example its bit in mode_req_local_position with local_position_invalid.
    All flags are false if there is no fault, but remote_id_unhealthy and the like are also set without such a system.
    primary_geofence_breached (1.14) and local_position_accuracy_low (up to 1.16) have their newer names here.
    """

    TOPICS = (Topic("failsafe_flags", 2.0, "the commander", on_change=True),)
    LAYOUTS = (
        Layout("1.14", "1.15, without geofence_breached, battery_unhealthy: primary_geofence_breached"),
        Layout("1.15", "1.16, without navigator_failure"),
        Layout("1.16", """
            1.17, without mode_req_global_position_relaxed global_position_invalid_relaxed position_accuracy_low,
            flight_time_limit_exceeded: local_position_accuracy_low"""),
        Layout("1.17", """
            main, without fd_critical_failure fd_esc_arming_failure fd_imbalanced_prop fd_motor_failure fd_alt_loss
            parachute_unhealthy traffic_avoidance_unhealthy remote_id_unhealthy gnss_lost,
            navigator_failure: fd_critical_failure fd_esc_arming_failure fd_imbalanced_prop fd_motor_failure"""),
        Layout("1.18", "main, without traffic_avoidance_unhealthy"),
        Layout("main", "*"),
    )  # fmt: skip
    OLDER = (
        Older("primary_geofence_breached", "geofence_breached"),
        Older("local_position_accuracy_low", "position_accuracy_low"),
    )

    mode_req_angular_velocity: Uint32 = field("Modes that need angular velocity, as bits")
    mode_req_attitude: Uint32 = field("Modes that need attitude, as bits")
    mode_req_local_alt: Uint32 = field("Modes that need local altitude, as bits")
    mode_req_local_position: Uint32 = field("Modes that need local position, as bits")
    mode_req_local_position_relaxed: Uint32 = field("Modes that need local position, even inaccurate, as bits")
    mode_req_global_position: Uint32 = field("Modes that need global position, as bits")
    mode_req_global_position_relaxed: Uint32 = field("Modes that need global position, even inaccurate, as bits")
    mode_req_mission: Uint32 = field("Modes that need a mission, as bits")
    mode_req_offboard_signal: Uint32 = field("Modes that need setpoints from a companion, as bits")
    mode_req_home_position: Uint32 = field("Modes that need home, as bits")
    mode_req_wind_and_flight_time_compliance: Uint32 = field("Modes with limits of wind and time of flight, as bits")
    mode_req_prevent_arming: Uint32 = field("Modes in which the vehicle cannot be armed, as bits")
    mode_req_manual_control: Uint32 = field("Modes that need manual control, as bits")
    mode_req_other: Uint32 = field("Modes that need something else, as bits")

    angular_velocity_invalid: Bool = field("Angular velocity is not valid")
    attitude_invalid: Bool = field("Attitude is not valid")
    local_altitude_invalid: Bool = field("Local altitude is not valid")
    local_position_invalid: Bool = field("Local position is not valid")
    local_position_invalid_relaxed: Bool = field("Local position is not valid, not even inaccurate")
    local_velocity_invalid: Bool = field("Local velocity is not valid")
    global_position_invalid: Bool = field("Global position is not valid")
    global_position_invalid_relaxed: Bool = field("Global position is not valid, not even inaccurate")

    auto_mission_missing: Bool = field("There is no mission")
    offboard_control_signal_lost: Bool = field("There are no setpoints from a companion")
    home_position_invalid: Bool = field("Home is not set")
    manual_control_signal_lost: Bool = field("Manual control (RC, joystick) is lost")
    gcs_connection_lost: Bool = field("The link to the ground station is lost")

    battery_warning: Uint8 = field("Battery's warning: 0 none, 1 low, 2 critical, 3 emergency, 4 failed ...")
    battery_low_remaining_time: Bool = field("The time until empty is too short")
    battery_unhealthy: Bool = field("A battery has a fault")

    fd_critical_failure: Bool = field("Failure detector: roll, pitch, or told from outside")
    fd_esc_arming_failure: Bool = field("Failure detector: an ESC does not arm")
    fd_imbalanced_prop: Bool = field("Failure detector: a propeller is out of balance")
    fd_motor_failure: Bool = field("Failure detector: a motor failed")
    fd_alt_loss: Bool = field("Failure detector: altitude is lost, uncommanded")

    geofence_breached: Bool = field("The vehicle is outside its geofence")
    mission_failure: Bool = field("The mission failed")
    vtol_fixed_wing_system_failure: Bool = field("A VTOL left fixed wing flight for a failure")
    wind_limit_exceeded: Bool = field("The wind is above its limit")
    flight_time_limit_exceeded: Bool = field("The time of flight is above its limit")
    position_accuracy_low: Bool = field("The position is valid, but inaccurate")
    navigator_failure: Bool = field("The navigator cannot carry out its mode")
    parachute_unhealthy: Bool = field("The parachute is missing or does not work")
    traffic_avoidance_unhealthy: Bool = field("Traffic avoidance is missing or does not work")
    remote_id_unhealthy: Bool = field("Remote ID is missing or does not work")
    gnss_lost: Bool = field("GNSS receivers are missing or disagree")
