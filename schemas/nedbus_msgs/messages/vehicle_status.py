"""VehicleStatus: armed or not, which mode, which failsafe."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from nedbus_msgs.model.declaration import Topic, older
from nedbus_msgs.model.message import Message
from nedbus_msgs.model.px4_types import Bool, Uint8, Uint16, Uint32, Uint64


class VehicleStatus(Message):
    """State of a vehicle as its commander has it: armed or not, mode, failsafe, links.

    nav_state is the mode in force; nav_state_user_intention is what the user chose, which a failsafe does not change.
    A mask has bit n (1 << n) for the mode n of NAVIGATION_STATE_; modes 23 to 30 are a companion's.

    The constants are those of main; numbers that were free in older releases have names now. What changed its meaning:
    mode 8 landed after an engine failure in 1.13; ARM_DISARM_REASON_ from 6 on: up to 1.17 6 was the safety button,
    7 landed, 8 no take-off, 9 the kill switch, 10 lockdown, 11 the failure detector, 12 shutdown, 13 a test.
    data_link_lost and data_link_lost_counter of layout 1.13 are gcs_connection_lost and its counter here.
    """

    TOPICS: ClassVar = (Topic("vehicle_status", 2.0, "the commander", on_change=True),)
    LAYOUTS: ClassVar = {
        "1.13": """
            timestamp nav_state nav_state_timestamp arming_state hil_state failsafe failsafe_timestamp system_type
            system_id component_id vehicle_type is_vtol is_vtol_tailsitter vtol_fw_permanent_stab in_transition_mode
            in_transition_to_fw rc_signal_lost data_link_lost data_link_lost_counter high_latency_data_link_lost
            engine_failure mission_failure geofence_violated failure_detector_status:uint8
            onboard_control_sensors_present onboard_control_sensors_enabled onboard_control_sensors_health
            latest_arming_reason latest_disarming_reason armed_time takeoff_time""",
        "1.14": """
            timestamp armed_time takeoff_time arming_state latest_arming_reason latest_disarming_reason
            nav_state_timestamp nav_state_user_intention nav_state failure_detector_status hil_state vehicle_type
            failsafe failsafe_and_user_took_over gcs_connection_lost gcs_connection_lost_counter
            high_latency_data_link_lost is_vtol is_vtol_tailsitter in_transition_mode in_transition_to_fw
            system_type system_id component_id safety_button_available safety_off power_input_valid usb_connected
            open_drone_id_system_present open_drone_id_system_healthy parachute_system_present
            parachute_system_healthy avoidance_system_required avoidance_system_valid rc_calibration_in_progress
            calibration_enabled pre_flight_checks_pass""",
        "1.15": """
            1.14, nav_state: executor_in_charge valid_nav_states_mask can_set_nav_states_mask,
            failsafe_and_user_took_over: failsafe_defer_state""",
        "1.16": "1.15, without avoidance_system_required avoidance_system_valid",
        "1.18": """
            1.16, without failure_detector_status, executor_in_charge: nav_state_display accepts_offboard_setpoints,
            parachute_system_healthy: traffic_avoidance_system_present""",
    }  # fmt: skip
    OLDER: ClassVar = {
        "data_link_lost": older("gcs_connection_lost"),
        "data_link_lost_counter": older("gcs_connection_lost_counter"),
    }
    ENUMS: ClassVar = {
        "arming_state": "ARMING_STATE_",
        "latest_arming_reason": "ARM_DISARM_REASON_",
        "latest_disarming_reason": "ARM_DISARM_REASON_",
        "nav_state_user_intention": "NAVIGATION_STATE_",
        "nav_state": "NAVIGATION_STATE_",
        "nav_state_display": "NAVIGATION_STATE_",
        "hil_state": "HIL_STATE_",
        "vehicle_type": "VEHICLE_TYPE_",
        "failsafe_defer_state": "FAILSAFE_DEFER_STATE_",
    }

    ARMING_STATE_DISARMED: ClassVar = 1
    ARMING_STATE_ARMED: ClassVar = 2
    ARM_DISARM_REASON_STICK_GESTURE: ClassVar = 1
    ARM_DISARM_REASON_RC_SWITCH: ClassVar = 2
    ARM_DISARM_REASON_COMMAND_INTERNAL: ClassVar = 3
    ARM_DISARM_REASON_COMMAND_EXTERNAL: ClassVar = 4
    ARM_DISARM_REASON_MISSION_START: ClassVar = 5
    ARM_DISARM_REASON_LANDING: ClassVar = 6
    ARM_DISARM_REASON_PREFLIGHT_INACTION: ClassVar = 7
    ARM_DISARM_REASON_KILL_SWITCH: ClassVar = 8
    ARM_DISARM_REASON_RC_BUTTON: ClassVar = 13
    ARM_DISARM_REASON_FAILSAFE: ClassVar = 14
    NAVIGATION_STATE_MANUAL: ClassVar = 0
    NAVIGATION_STATE_ALTCTL: ClassVar = 1
    NAVIGATION_STATE_POSCTL: ClassVar = 2
    NAVIGATION_STATE_AUTO_MISSION: ClassVar = 3
    NAVIGATION_STATE_AUTO_LOITER: ClassVar = 4
    NAVIGATION_STATE_AUTO_RTL: ClassVar = 5
    NAVIGATION_STATE_POSITION_SLOW: ClassVar = 6
    NAVIGATION_STATE_GUIDED_COURSE: ClassVar = 7
    NAVIGATION_STATE_ALTITUDE_CRUISE: ClassVar = 8
    NAVIGATION_STATE_FREE3: ClassVar = 9
    NAVIGATION_STATE_ACRO: ClassVar = 10
    NAVIGATION_STATE_FREE2: ClassVar = 11
    NAVIGATION_STATE_DESCEND: ClassVar = 12
    NAVIGATION_STATE_TERMINATION: ClassVar = 13
    NAVIGATION_STATE_OFFBOARD: ClassVar = 14
    NAVIGATION_STATE_STAB: ClassVar = 15
    NAVIGATION_STATE_FREE1: ClassVar = 16
    NAVIGATION_STATE_AUTO_TAKEOFF: ClassVar = 17
    NAVIGATION_STATE_AUTO_LAND: ClassVar = 18
    NAVIGATION_STATE_AUTO_FOLLOW_TARGET: ClassVar = 19
    NAVIGATION_STATE_AUTO_PRECLAND: ClassVar = 20
    NAVIGATION_STATE_ORBIT: ClassVar = 21
    NAVIGATION_STATE_AUTO_VTOL_TAKEOFF: ClassVar = 22
    NAVIGATION_STATE_EXTERNAL1: ClassVar = 23
    NAVIGATION_STATE_EXTERNAL2: ClassVar = 24
    NAVIGATION_STATE_EXTERNAL3: ClassVar = 25
    NAVIGATION_STATE_EXTERNAL4: ClassVar = 26
    NAVIGATION_STATE_EXTERNAL5: ClassVar = 27
    NAVIGATION_STATE_EXTERNAL6: ClassVar = 28
    NAVIGATION_STATE_EXTERNAL7: ClassVar = 29
    NAVIGATION_STATE_EXTERNAL8: ClassVar = 30
    NAVIGATION_STATE_MAX: ClassVar = 31
    HIL_STATE_OFF: ClassVar = 0
    HIL_STATE_ON: ClassVar = 1
    VEHICLE_TYPE_UNSPECIFIED: ClassVar = 0
    VEHICLE_TYPE_ROTARY_WING: ClassVar = 1
    VEHICLE_TYPE_FIXED_WING: ClassVar = 2
    VEHICLE_TYPE_ROVER: ClassVar = 3
    FAILSAFE_DEFER_STATE_DISABLED: ClassVar = 0
    FAILSAFE_DEFER_STATE_ENABLED: ClassVar = 1
    FAILSAFE_DEFER_STATE_WOULD_FAILSAFE: ClassVar = 2

    timestamp: Uint64 = Field(description="Time since boot [us]")

    armed_time: Uint64 = Field(0, description="Time of arming, since boot [us], 0 if not armed")
    takeoff_time: Uint64 = Field(0, description="Time of take-off, since boot [us], 0 if there was none")

    arming_state: Uint8 = Field(
        0, description="Arming: 1 disarmed, 2 armed; up to 1.14 also 0 start, 3 error, 4 shutdown, 5 restored in air"
    )
    latest_arming_reason: Uint8 = Field(
        0, description="Why armed: 1 stick, 2 switch, 3, 4 command, 5 mission ..., see ARM_DISARM_REASON_"
    )
    latest_disarming_reason: Uint8 = Field(
        0, description="Why disarmed, as latest_arming_reason: 6 landed (up to 1.17: 7) ..."
    )

    nav_state_timestamp: Uint64 = Field(0, description="Time of the latest change of nav_state, since boot [us]")
    nav_state_user_intention: Uint8 = Field(0, description="Mode that the user chose, as nav_state")
    nav_state: Uint8 = Field(
        0, description="Mode in force: 0 manual, 1 altitude, 2 position, 3 mission, 4 hold, 5 return, 14 offboard ..."
    )

    executor_in_charge: Uint8 = Field(0, description="Executor of modes in charge: 0 the autopilot")
    nav_state_display: Uint8 = Field(0, description="Mode to show to the user, as nav_state")
    accepts_offboard_setpoints: Bool = Field(False, description="The mode in force takes setpoints from a companion")

    valid_nav_states_mask: Uint32 = Field(0, description="Modes that exist, as bits of nav_state")
    can_set_nav_states_mask: Uint32 = Field(0, description="Modes that a user can choose, as bits of nav_state")

    hil_state: Uint8 = Field(0, description="Hardware in the loop: 0 off, 1 on")
    vehicle_type: Uint8 = Field(
        0, description="Kind now: 0 unspecified, 1 rotary wing, 2 fixed wing, 3 rover; a VTOL's changes"
    )

    failsafe: Bool = Field(False, description="A failsafe is in force")
    failsafe_and_user_took_over: Bool = Field(False, description="The user took over from a failsafe")
    failsafe_defer_state: Uint8 = Field(0, description="Failsafes put off: 0 no, 1 yes, 2 yes, and one is due")

    gcs_connection_lost: Bool = Field(False, description="The link to the ground station is lost")
    gcs_connection_lost_counter: Uint8 = Field(0, description="Count of losses of the link to the ground station")
    high_latency_data_link_lost: Bool = Field(False, description="The satellite (high latency) link is lost")

    is_vtol: Bool = Field(False, description="The vehicle is a VTOL")
    is_vtol_tailsitter: Bool = Field(False, description="The vehicle is a tailsitter")
    in_transition_mode: Bool = Field(False, description="A VTOL is in transition")
    in_transition_to_fw: Bool = Field(False, description="A VTOL is in transition to fixed wing")

    system_type: Uint8 = Field(0, description="Kind of vehicle, MAVLink's MAV_TYPE")
    system_id: Uint8 = Field(0, description="MAVLink system ID")
    component_id: Uint8 = Field(0, description="MAVLink component ID")

    safety_button_available: Bool = Field(False, description="There is a safety button")
    safety_off: Bool = Field(False, description="Safety is off: the vehicle may be armed")
    power_input_valid: Bool = Field(False, description="The supply of power is good")
    usb_connected: Bool = Field(False, description="USB is, or was, connected")

    open_drone_id_system_present: Bool = Field(False, description="There is a remote ID transmitter")
    open_drone_id_system_healthy: Bool = Field(False, description="The remote ID transmitter works")
    parachute_system_present: Bool = Field(False, description="There is a parachute")
    parachute_system_healthy: Bool = Field(False, description="The parachute works")
    traffic_avoidance_system_present: Bool = Field(False, description="There is a traffic avoidance system")

    rc_calibration_in_progress: Bool = Field(False, description="The remote control is being calibrated")
    calibration_enabled: Bool = Field(False, description="A sensor is being calibrated")
    pre_flight_checks_pass: Bool = Field(False, description="The checks before arming pass")

    # Up to 1.17:
    failure_detector_status: Uint16 = Field(
        0, description="Failures as bits: 1 roll, 2 pitch, 4 altitude, 8 external, 16 ESC, 32 ... by release"
    )

    # Up to 1.15:
    avoidance_system_required: Bool = Field(False, description="Collision avoidance by a companion is required")
    avoidance_system_valid: Bool = Field(False, description="Collision avoidance by a companion works")

    # Up to 1.13:
    failsafe_timestamp: Uint64 = Field(0, description="Time when the failsafe began, since boot [us]")
    vtol_fw_permanent_stab: Bool = Field(False, description="A VTOL is stabilised in fixed wing flight too")
    rc_signal_lost: Bool = Field(False, description="The remote control is lost")
    engine_failure: Bool = Field(False, description="An engine failed")
    mission_failure: Bool = Field(False, description="The mission failed")
    geofence_violated: Bool = Field(False, description="The vehicle is outside its geofence")
    onboard_control_sensors_present: Uint64 = Field(0, description="Sensors present, MAVLink's bits of SYS_STATUS")
    onboard_control_sensors_enabled: Uint64 = Field(0, description="Sensors enabled, MAVLink's bits of SYS_STATUS")
    onboard_control_sensors_health: Uint64 = Field(0, description="Sensors healthy, MAVLink's bits of SYS_STATUS")
