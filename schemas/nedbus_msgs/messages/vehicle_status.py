"""VehicleStatus: arming, mode and failsafe."""

from nedbus_msgs.model import Layout, Message, RenamedField, Topic
from nedbus_msgs.model.px4_types import Bool, Uint8, Uint16, Uint32, Uint64, field


class VehicleStatus(Message):
    """State of a vehicle from PX4's commander: arming, mode, failsafe, links.

    nav_state is the active mode; nav_state_user_intention is the user's choice, which a failsafe does not change.
    Bit n (1 << n) of a mask stands for mode n of NAVIGATION_STATE_; modes 23 to 30 are external modes of a companion.

    The constants are those of main; some numbers had another meaning in older releases. Mode 8 was landing after an
    engine failure in 1.13. Up to 1.17, ARM_DISARM_REASON_ 6 was the safety button, 7 landing, 8 no take-off, 9 the
    kill switch, 10 lockdown, 11 the failure detector, 12 shutdown, 13 a unit test.
    data_link_lost and data_link_lost_counter of layout 1.13 are now gcs_connection_lost and its counter.
    """

    TOPICS = (Topic("vehicle_status", 2.0, "the commander", on_change=True),)
    LAYOUTS = (
        Layout(
            "1.13",
            """
                timestamp nav_state nav_state_timestamp arming_state hil_state failsafe
                failsafe_timestamp system_type system_id component_id vehicle_type is_vtol
                is_vtol_tailsitter vtol_fw_permanent_stab in_transition_mode
                in_transition_to_fw rc_signal_lost data_link_lost data_link_lost_counter
                high_latency_data_link_lost engine_failure mission_failure geofence_violated
                failure_detector_status onboard_control_sensors_present
                onboard_control_sensors_enabled onboard_control_sensors_health
                latest_arming_reason latest_disarming_reason armed_time takeoff_time
            """,
            other_types={
                "failure_detector_status": "uint8",
            },
        ),
        Layout(
            "1.14",
            base="1.15",
            without="""
                executor_in_charge valid_nav_states_mask can_set_nav_states_mask
                failsafe_defer_state
            """,
        ),
        Layout(
            "1.15",
            base="1.16",
            insert_after={
                "parachute_system_healthy": "avoidance_system_required avoidance_system_valid",
            },
        ),
        Layout(
            "1.16",
            base="1.18",
            without="nav_state_display accepts_offboard_setpoints traffic_avoidance_system_present",
            insert_after={
                "can_set_nav_states_mask": "failure_detector_status",
            },
        ),
        Layout(
            "1.18",
            without="""
                failure_detector_status avoidance_system_required avoidance_system_valid
                failsafe_timestamp vtol_fw_permanent_stab rc_signal_lost engine_failure
                mission_failure geofence_violated onboard_control_sensors_present
                onboard_control_sensors_enabled onboard_control_sensors_health
            """,
        ),
    )
    OLDER = (
        RenamedField("data_link_lost", "gcs_connection_lost"),
        RenamedField("data_link_lost_counter", "gcs_connection_lost_counter"),
    )

    ARMING_STATE_DISARMED, ARMING_STATE_ARMED = range(1, 3)
    (
        ARM_DISARM_REASON_STICK_GESTURE, ARM_DISARM_REASON_RC_SWITCH, ARM_DISARM_REASON_COMMAND_INTERNAL,
        ARM_DISARM_REASON_COMMAND_EXTERNAL, ARM_DISARM_REASON_MISSION_START, ARM_DISARM_REASON_LANDING,
        ARM_DISARM_REASON_PREFLIGHT_INACTION, ARM_DISARM_REASON_KILL_SWITCH,
    ) = range(1, 9)  # fmt: skip
    ARM_DISARM_REASON_RC_BUTTON, ARM_DISARM_REASON_FAILSAFE = range(13, 15)
    (
        NAVIGATION_STATE_MANUAL, NAVIGATION_STATE_ALTCTL, NAVIGATION_STATE_POSCTL, NAVIGATION_STATE_AUTO_MISSION,
        NAVIGATION_STATE_AUTO_LOITER, NAVIGATION_STATE_AUTO_RTL, NAVIGATION_STATE_POSITION_SLOW,
        NAVIGATION_STATE_GUIDED_COURSE, NAVIGATION_STATE_ALTITUDE_CRUISE, NAVIGATION_STATE_FREE3,
        NAVIGATION_STATE_ACRO, NAVIGATION_STATE_FREE2, NAVIGATION_STATE_DESCEND, NAVIGATION_STATE_TERMINATION,
        NAVIGATION_STATE_OFFBOARD, NAVIGATION_STATE_STAB, NAVIGATION_STATE_FREE1, NAVIGATION_STATE_AUTO_TAKEOFF,
        NAVIGATION_STATE_AUTO_LAND, NAVIGATION_STATE_AUTO_FOLLOW_TARGET, NAVIGATION_STATE_AUTO_PRECLAND,
        NAVIGATION_STATE_ORBIT, NAVIGATION_STATE_AUTO_VTOL_TAKEOFF, NAVIGATION_STATE_EXTERNAL1,
        NAVIGATION_STATE_EXTERNAL2, NAVIGATION_STATE_EXTERNAL3, NAVIGATION_STATE_EXTERNAL4,
        NAVIGATION_STATE_EXTERNAL5, NAVIGATION_STATE_EXTERNAL6, NAVIGATION_STATE_EXTERNAL7,
        NAVIGATION_STATE_EXTERNAL8, NAVIGATION_STATE_MAX,
    ) = range(32)  # fmt: skip
    HIL_STATE_OFF, HIL_STATE_ON = range(2)
    (
        VEHICLE_TYPE_UNSPECIFIED,
        VEHICLE_TYPE_ROTARY_WING,
        VEHICLE_TYPE_FIXED_WING,
        VEHICLE_TYPE_ROVER,
    ) = range(4)
    (
        FAILSAFE_DEFER_STATE_DISABLED,
        FAILSAFE_DEFER_STATE_ENABLED,
        FAILSAFE_DEFER_STATE_WOULD_FAILSAFE,
    ) = range(3)

    armed_time: Uint64 = field("Time of arming, since boot [us], 0 if not armed")
    takeoff_time: Uint64 = field("Time of take-off, since boot [us], 0 if none")
    arming_state: Uint8 = field(
        "1 disarmed, 2 armed; up to 1.14 also 0 init, 3 error, 4 shutdown, 5 in-air restore"
    )
    latest_arming_reason: Uint8 = field(
        "Arming reason: 1 stick, 2 switch, 3, 4 command, 5 mission: ARM_DISARM_REASON_"
    )
    latest_disarming_reason: Uint8 = field(
        "Disarming reason, as latest_arming_reason: 6 landing (up to 1.17: 7) ..."
    )

    nav_state_timestamp: Uint64 = field("Time of the latest change of nav_state, since boot [us]")
    nav_state_user_intention: Uint8 = field("Mode selected by the user, as nav_state")
    nav_state: Uint8 = field(
        "Mode: 0 manual, 1 altitude, 2 position, 3 mission, 4 hold, 5 return, 14 offboard ..."
    )
    executor_in_charge: Uint8 = field("Mode executor in charge: 0 autopilot")
    nav_state_display: Uint8 = field("Mode to display to the user, as nav_state")
    accepts_offboard_setpoints: Bool = field("Active mode accepts offboard setpoints")
    valid_nav_states_mask: Uint32 = field("Available modes, as a bitmask of nav_state")
    can_set_nav_states_mask: Uint32 = field(
        "Modes that the user can select, as a bitmask of nav_state"
    )

    hil_state: Uint8 = field("Hardware in the loop: 0 off, 1 on")
    vehicle_type: Uint8 = field(
        "Current type: 0 unspecified, 1 rotary wing, 2 fixed wing, 3 rover; a VTOL changes it"
    )

    failsafe: Bool = field("Failsafe is active")
    failsafe_and_user_took_over: Bool = field("User took over from a failsafe")
    failsafe_defer_state: Uint8 = field(
        "Failsafe deferral: 0 disabled, 1 enabled, 2 enabled with a failsafe pending"
    )

    gcs_connection_lost: Bool = field("Ground control station connection lost")
    gcs_connection_lost_counter: Uint8 = field("Number of ground control station connection losses")
    high_latency_data_link_lost: Bool = field("High-latency (satellite) link lost")

    is_vtol: Bool = field("Vehicle is a VTOL")
    is_vtol_tailsitter: Bool = field("Vehicle is a tailsitter")
    in_transition_mode: Bool = field("VTOL is in transition")
    in_transition_to_fw: Bool = field("VTOL is in transition to fixed wing")

    system_type: Uint8 = field("Vehicle type, MAVLink's MAV_TYPE")
    system_id: Uint8 = field("MAVLink system ID")
    component_id: Uint8 = field("MAVLink component ID")

    safety_button_available: Bool = field("Safety button available")
    safety_off: Bool = field("Safety is off: arming is allowed")
    power_input_valid: Bool = field("Power input is valid")
    usb_connected: Bool = field("USB is connected, or was since boot")

    open_drone_id_system_present: Bool = field("Remote ID system present")
    open_drone_id_system_healthy: Bool = field("Remote ID system healthy")
    parachute_system_present: Bool = field("Parachute system present")
    parachute_system_healthy: Bool = field("Parachute system healthy")
    traffic_avoidance_system_present: Bool = field("Traffic avoidance system present")

    rc_calibration_in_progress: Bool = field("RC calibration in progress")
    calibration_enabled: Bool = field("Sensor calibration in progress")
    pre_flight_checks_pass: Bool = field("Preflight checks pass")

    # Up to 1.17:
    failure_detector_status: Uint16 = field(
        "Failure detector bitmask: 1 roll, 2 pitch, 4 altitude, 8 external, 16 ESC, 32 ... by release"
    )

    # Up to 1.15:
    avoidance_system_required: Bool = field("Companion's collision avoidance system is required")
    avoidance_system_valid: Bool = field("Companion's collision avoidance system is working")

    # Up to 1.13:
    failsafe_timestamp: Uint64 = field("Time when the failsafe started, since boot [us]")
    vtol_fw_permanent_stab: Bool = field("VTOL is stabilised in fixed-wing flight too")
    rc_signal_lost: Bool = field("RC signal lost")
    engine_failure: Bool = field("Engine failure")
    mission_failure: Bool = field("Mission failure")
    geofence_violated: Bool = field("Geofence violated")
    onboard_control_sensors_present: Uint64 = field(
        "Sensors present, as a bitmask of MAVLink's SYS_STATUS"
    )
    onboard_control_sensors_enabled: Uint64 = field(
        "Sensors enabled, as a bitmask of MAVLink's SYS_STATUS"
    )
    onboard_control_sensors_health: Uint64 = field(
        "Sensors healthy, as a bitmask of MAVLink's SYS_STATUS"
    )
