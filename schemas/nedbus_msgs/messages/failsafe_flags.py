"""FailsafeFlags: unmet mode requirements and failsafe triggers."""

from nedbus_msgs.model import Layout, Message, RenamedField, Topic
from nedbus_msgs.model.px4_types import Bool, Uint8, Uint32, field


class FailsafeFlags(Message):
    """Mode requirements and unmet conditions: the reasons why a vehicle does not arm, and the triggers of failsafes.

    Bit n (1 << n) of a mode_req_ mask stands for mode n of VehicleStatus.NAVIGATION_STATE_.
    A mode is blocked while, for example, its bit in mode_req_local_position and local_position_invalid are both set.
    Flags are false without a fault; remote_id_unhealthy and the like are also set if no such system is installed.
    primary_geofence_breached (1.14) and local_position_accuracy_low (up to 1.16) are now without primary_ and local_.
    """

    TOPICS = (Topic("failsafe_flags", 2.0, "the commander", on_change=True),)
    LAYOUTS = (
        Layout(
            "1.14",
            base="1.15",
            without="geofence_breached",
            insert_after={
                "battery_unhealthy": "primary_geofence_breached",
            },
        ),
        Layout(
            "1.15",
            base="1.16",
            without="navigator_failure",
        ),
        Layout(
            "1.16",
            base="1.17",
            without="""
                mode_req_global_position_relaxed global_position_invalid_relaxed
                position_accuracy_low
            """,
            insert_after={
                "flight_time_limit_exceeded": "local_position_accuracy_low",
            },
        ),
        Layout(
            "1.17",
            base="main",
            without="""
                fd_critical_failure fd_esc_arming_failure fd_imbalanced_prop
                fd_motor_failure fd_alt_loss parachute_unhealthy traffic_avoidance_unhealthy
                remote_id_unhealthy gnss_lost
            """,
            insert_after={
                "navigator_failure": "fd_critical_failure fd_esc_arming_failure fd_imbalanced_prop fd_motor_failure",
            },
        ),
        Layout(
            "1.18",
            base="main",
            without="traffic_avoidance_unhealthy",
        ),
        Layout("main", "*"),
    )
    OLDER = (
        RenamedField("primary_geofence_breached", "geofence_breached"),
        RenamedField("local_position_accuracy_low", "position_accuracy_low"),
    )

    mode_req_angular_velocity: Uint32 = field("Modes that require angular velocity (bitmask)")
    mode_req_attitude: Uint32 = field("Modes that require attitude (bitmask)")
    mode_req_local_alt: Uint32 = field("Modes that require local altitude (bitmask)")
    mode_req_local_position: Uint32 = field("Modes that require local position (bitmask)")
    mode_req_local_position_relaxed: Uint32 = field(
        "Modes that require local position of relaxed accuracy (bitmask)"
    )
    mode_req_global_position: Uint32 = field("Modes that require global position (bitmask)")
    mode_req_global_position_relaxed: Uint32 = field(
        "Modes that require global position of relaxed accuracy (bitmask)"
    )
    mode_req_mission: Uint32 = field("Modes that require a mission (bitmask)")
    mode_req_offboard_signal: Uint32 = field(
        "Modes that require an offboard control signal (bitmask)"
    )
    mode_req_home_position: Uint32 = field("Modes that require a home position (bitmask)")
    mode_req_wind_and_flight_time_compliance: Uint32 = field(
        "Modes with wind and flight time limits (bitmask)"
    )
    mode_req_prevent_arming: Uint32 = field("Modes that prevent arming (bitmask)")
    mode_req_manual_control: Uint32 = field("Modes that require manual control (bitmask)")
    mode_req_other: Uint32 = field("Modes with other requirements (bitmask)")

    angular_velocity_invalid: Bool = field("Angular velocity invalid")
    attitude_invalid: Bool = field("Attitude invalid")
    local_altitude_invalid: Bool = field("Local altitude invalid")
    local_position_invalid: Bool = field("Local position invalid")
    local_position_invalid_relaxed: Bool = field("Local position invalid even at relaxed accuracy")
    local_velocity_invalid: Bool = field("Local velocity invalid")
    global_position_invalid: Bool = field("Global position invalid")
    global_position_invalid_relaxed: Bool = field(
        "Global position invalid even at relaxed accuracy"
    )

    auto_mission_missing: Bool = field("No mission available")
    offboard_control_signal_lost: Bool = field("Offboard control signal lost")
    home_position_invalid: Bool = field("No home position available")
    manual_control_signal_lost: Bool = field("Manual control (RC or joystick) signal lost")
    gcs_connection_lost: Bool = field("Ground control station connection lost")

    battery_warning: Uint8 = field(
        "Battery warning: 0 none, 1 low, 2 critical, 3 emergency, 4 failed ..."
    )
    battery_low_remaining_time: Bool = field("Remaining battery time too short")
    battery_unhealthy: Bool = field("Battery unhealthy")

    fd_critical_failure: Bool = field(
        "Failure detector: critical failure (roll, pitch or external)"
    )
    fd_esc_arming_failure: Bool = field("Failure detector: ESC failed to arm")
    fd_imbalanced_prop: Bool = field("Failure detector: imbalanced propeller")
    fd_motor_failure: Bool = field("Failure detector: motor failure")
    fd_alt_loss: Bool = field("Failure detector: uncommanded altitude loss")

    geofence_breached: Bool = field("Geofence breached")
    mission_failure: Bool = field("Mission failure")
    vtol_fixed_wing_system_failure: Bool = field("VTOL fixed-wing system failure (quadchute)")
    wind_limit_exceeded: Bool = field("Wind limit exceeded")
    flight_time_limit_exceeded: Bool = field("Flight time limit exceeded")
    position_accuracy_low: Bool = field("Position valid but inaccurate")
    navigator_failure: Bool = field("Navigator failed to execute its mode")
    parachute_unhealthy: Bool = field("Parachute system missing or unhealthy")
    traffic_avoidance_unhealthy: Bool = field("Traffic avoidance system missing or unhealthy")
    remote_id_unhealthy: Bool = field("Remote ID system missing or unhealthy")
    gnss_lost: Bool = field("GNSS receivers missing or inconsistent")
