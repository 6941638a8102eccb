"""BatteryStatus: voltage, current and charge of a battery."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from nedbus_msgs.model.declaration import Topic
from nedbus_msgs.model.message import Message
from nedbus_msgs.model.px4_types import NAN, Bool, Float32, Float32x14, Uint8, Uint16, Uint32, Uint64
from nedbus_msgs.model.rules import InRange


class BatteryStatus(Message):
    """State of one battery: voltage, current, charge; a smart battery says more than a power module.

    One uORB instance for each battery; id, from 1, names the battery on its vehicle.
    Not known: -1 in current_a, current_average_a, discharged_mah, remaining and scale, NaN in time_remaining_s and
    temperature, 0 in the others. Simulators have current -1 and no cell voltages throughout.
    faults has bit n (1 << n) for number n of FAULT_; numbers 6 and 7 of warning are STATE_UNHEALTHY and STATE_CHARGING.
    """

    TOPICS: ClassVar = (
        Topic("battery_status", 1.0, "each battery's driver, or its estimate", instances=True, plain_first=True),
    )
    LAYOUTS: ClassVar = {
        "1.13": """
            timestamp connected voltage_v voltage_filtered_v current_a current_filtered_a current_average_a
            discharged_mah remaining scale time_remaining_s temperature cell_count source priority capacity
            cycle_count average_time_to_empty serial_number manufacture_date state_of_health max_error id
            interface_error voltage_cell_v max_cell_voltage_delta is_powering_off is_required faults custom_faults
            warning mode average_power available_energy full_charge_capacity_wh remaining_capacity_wh
            design_capacity average_time_to_full over_discharge_count nominal_voltage""",
        "1.16": """
            1.13, without voltage_filtered_v current_filtered_a custom_faults mode average_power available_energy
            design_capacity average_time_to_full, nominal_voltage: internal_resistance_estimate ocv_estimate
            ocv_estimate_filtered volt_based_soc_estimate voltage_prediction prediction_error
            estimation_covariance_norm""",
        "1.17": """
            timestamp connected voltage_v current_a current_average_a discharged_mah remaining scale
            time_remaining_s temperature cell_count source priority capacity cycle_count average_time_to_empty
            manufacture_date state_of_health max_error id interface_error voltage_cell_v max_cell_voltage_delta
            is_powering_off is_required warning faults full_charge_capacity_wh remaining_capacity_wh
            over_discharge_count nominal_voltage internal_resistance_estimate ocv_estimate ocv_estimate_filtered
            volt_based_soc_estimate voltage_prediction prediction_error estimation_covariance_norm""",
    }  # fmt: skip
    ENUMS: ClassVar = {"source": "SOURCE_", "warning": "WARNING_"}
    RULES: ClassVar = (InRange("remaining", 0.0, 1.0, or_=-1.0),)

    MAX_INSTANCES: ClassVar = 3
    SOURCE_POWER_MODULE: ClassVar = 0
    SOURCE_EXTERNAL: ClassVar = 1
    SOURCE_ESCS: ClassVar = 2
    WARNING_NONE: ClassVar = 0
    WARNING_LOW: ClassVar = 1
    WARNING_CRITICAL: ClassVar = 2
    WARNING_EMERGENCY: ClassVar = 3
    WARNING_FAILED: ClassVar = 4
    STATE_UNHEALTHY: ClassVar = 6
    STATE_CHARGING: ClassVar = 7
    FAULT_DEEP_DISCHARGE: ClassVar = 0
    FAULT_SPIKES: ClassVar = 1
    FAULT_CELL_FAIL: ClassVar = 2
    FAULT_OVER_CURRENT: ClassVar = 3
    FAULT_OVER_TEMPERATURE: ClassVar = 4
    FAULT_UNDER_TEMPERATURE: ClassVar = 5
    FAULT_INCOMPATIBLE_VOLTAGE: ClassVar = 6
    FAULT_INCOMPATIBLE_FIRMWARE: ClassVar = 7
    FAULT_INCOMPATIBLE_MODEL: ClassVar = 8
    FAULT_HARDWARE_FAILURE: ClassVar = 9
    FAULT_FAILED_TO_ARM: ClassVar = 10
    FAULT_COUNT: ClassVar = 11

    timestamp: Uint64 = Field(description="Time since boot [us]")

    connected: Bool = Field(False, description="The battery is connected, by its voltage")
    voltage_v: Float32 = Field(NAN, description="Voltage [V], 0 if not known")
    current_a: Float32 = Field(NAN, description="Current out of the battery [A], -1 if not known")
    current_average_a: Float32 = Field(NAN, description="Average current in level flight [A], -1 if not known")
    discharged_mah: Float32 = Field(NAN, description="Charge taken [mAh], -1 if not known")

    remaining: Float32 = Field(NAN, description="Charge left, 0 empty to 1 full, -1 if not known")
    scale: Float32 = Field(NAN, description="Factor of thrust against low voltage, 1 or more, -1 if not known")
    time_remaining_s: Float32 = Field(NAN, description="Time until empty at the recent load [s], NaN if not known")
    temperature: Float32 = Field(NAN, description="Temperature [deg C], NaN if not known")

    cell_count: Uint8 = Field(0, description="Count of cells in series, 0 if not known")
    source: Uint8 = Field(0, description="Source: 0 power module, 1 external, 2 ESCs")
    priority: Uint8 = Field(0, description="Number of the power input on the board, from 0")

    capacity: Uint16 = Field(0, description="Actual capacity [mAh]")
    cycle_count: Uint16 = Field(0, description="Count of discharge cycles")
    average_time_to_empty: Uint16 = Field(0, description="Time until empty, averaged [min]")
    manufacture_date: Uint16 = Field(0, description="Day of manufacture: day + 32 * month + 512 * (year - 1980)")
    state_of_health: Uint16 = Field(0, description="Full charge in proportion to that of a new battery [%], 0 to 100")
    max_error: Uint16 = Field(0, description="Greatest error of the charge [%], 1 to 100")

    id: Uint8 = Field(0, description="Number of the battery on this vehicle, from 1")
    interface_error: Uint16 = Field(0, description="Count of errors of the interface to the battery")

    voltage_cell_v: Float32x14 = Field((NAN,) * 14, description="Voltage of each cell [V], 0 if not known")
    max_cell_voltage_delta: Float32 = Field(NAN, description="Greatest difference between cell voltages [V]")

    is_powering_off: Bool = Field(False, description="The battery is about to switch off")
    is_required: Bool = Field(False, description="The battery is needed before arming")
    warning: Uint8 = Field(
        0, description="Warning: 0 none, 1 low, 2 critical, 3 emergency, 4 failed, 6 unhealthy, 7 charges"
    )
    faults: Uint16 = Field(0, description="Faults as bits, 1 << number of FAULT_; 0 none")

    full_charge_capacity_wh: Float32 = Field(NAN, description="Energy when full [Wh]")
    remaining_capacity_wh: Float32 = Field(NAN, description="Energy left [Wh]")
    over_discharge_count: Uint16 = Field(0, description="Count of discharges below the limit")
    nominal_voltage: Float32 = Field(NAN, description="Nominal voltage [V]")

    internal_resistance_estimate: Float32 = Field(NAN, description="Internal resistance of a cell, estimated [Ohm]")
    ocv_estimate: Float32 = Field(NAN, description="Open circuit voltage, estimated [V]")
    ocv_estimate_filtered: Float32 = Field(NAN, description="Open circuit voltage, estimated and filtered [V]")
    volt_based_soc_estimate: Float32 = Field(NAN, description="Charge left by voltage alone, 0 to 1")
    voltage_prediction: Float32 = Field(NAN, description="Voltage predicted by the estimator [V]")
    prediction_error: Float32 = Field(NAN, description="Error of voltage_prediction [V]")
    estimation_covariance_norm: Float32 = Field(NAN, description="Norm of the estimator's covariance")

    # Up to 1.16:
    serial_number: Uint16 = Field(0, description="Serial number")

    # Up to 1.15:
    voltage_filtered_v: Float32 = Field(NAN, description="Voltage, filtered [V], 0 if not known")
    current_filtered_a: Float32 = Field(NAN, description="Current, filtered [A], 0 or -1 if not known")
    custom_faults: Uint32 = Field(0, description="The maker's own faults as bits")
    mode: Uint8 = Field(0, description="Mode: 0 normal or not known, 1 discharges itself, 2 hot swap")
    average_power: Float32 = Field(NAN, description="Average power of this discharge, in the battery's own unit")
    available_energy: Float32 = Field(NAN, description="Charge or energy left, in the battery's own unit")
    design_capacity: Float32 = Field(NAN, description="Capacity by design, in the battery's own unit")
    average_time_to_full: Uint16 = Field(0, description="Time until full, averaged [min]")
