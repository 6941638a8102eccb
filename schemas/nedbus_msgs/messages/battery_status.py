"""BatteryStatus: voltage, current and charge of a battery."""

from typing import ClassVar

from nedbus_msgs.model import InRange, Layout, Message, Topic
from nedbus_msgs.model.px4_types import Bool, Float32, Float32x14, Uint8, Uint16, Uint32, field


class BatteryStatus(Message):
    """State of one battery: voltage, current and charge; smart batteries provide more fields than power modules.

    One uORB instance per battery; id, from 1, identifies the battery on its vehicle.
    Unknown values: -1 in current_a, current_average_a, discharged_mah, remaining and scale, NaN in time_remaining_s and
    temperature, 0 in the others. Simulators always have current -1 and no cell voltages.
    faults has bit n (1 << n) for number n of FAULT_; numbers 6 and 7 of warning are STATE_UNHEALTHY and STATE_CHARGING.
    """

    TOPICS = (Topic("battery_status", 1.0, "each battery's driver, or its estimate", instances=True, plain_first=True),)
    LAYOUTS = (
        Layout("1.13", """
            1.16, without internal_resistance_estimate ocv_estimate ocv_estimate_filtered volt_based_soc_estimate
            voltage_prediction prediction_error estimation_covariance_norm, voltage_v: voltage_filtered_v,
            current_a: current_filtered_a, faults: custom_faults, warning: mode average_power available_energy,
            remaining_capacity_wh: design_capacity average_time_to_full"""),
        Layout("1.16", "1.17, without warning, average_time_to_empty: serial_number, faults: warning"),
        Layout("1.17", """
            *, without serial_number voltage_filtered_v current_filtered_a custom_faults mode average_power
            available_energy design_capacity average_time_to_full"""),
    )  # fmt: skip
    RULES = (InRange("remaining", 0.0, 1.0, or_=-1.0),)

    MAX_INSTANCES: ClassVar = 3
    SOURCE_POWER_MODULE, SOURCE_EXTERNAL, SOURCE_ESCS = range(3)
    WARNING_NONE, WARNING_LOW, WARNING_CRITICAL, WARNING_EMERGENCY, WARNING_FAILED = range(5)
    STATE_UNHEALTHY, STATE_CHARGING = range(6, 8)
    (
        FAULT_DEEP_DISCHARGE, FAULT_SPIKES, FAULT_CELL_FAIL, FAULT_OVER_CURRENT, FAULT_OVER_TEMPERATURE,
        FAULT_UNDER_TEMPERATURE, FAULT_INCOMPATIBLE_VOLTAGE, FAULT_INCOMPATIBLE_FIRMWARE, FAULT_INCOMPATIBLE_MODEL,
        FAULT_HARDWARE_FAILURE, FAULT_FAILED_TO_ARM, FAULT_COUNT,
    ) = range(12)  # fmt: skip

    connected: Bool = field("The battery is connected, by its voltage")
    voltage_v: Float32 = field("Voltage [V], 0 if not known")
    current_a: Float32 = field("Current out of the battery [A], -1 if not known")
    current_average_a: Float32 = field("Average current in level flight [A], -1 if not known")
    discharged_mah: Float32 = field("Charge taken [mAh], -1 if not known")

    remaining: Float32 = field("Charge left, 0 empty to 1 full, -1 if not known")
    scale: Float32 = field("Factor of thrust against low voltage, 1 or more, -1 if not known")
    time_remaining_s: Float32 = field("Time until empty at the recent load [s], NaN if not known")
    temperature: Float32 = field("Temperature [deg C], NaN if not known")

    cell_count: Uint8 = field("Count of cells in series, 0 if not known")
    source: Uint8 = field("Source: 0 power module, 1 external, 2 ESCs")
    priority: Uint8 = field("Number of the power input on the board, from 0")

    capacity: Uint16 = field("Actual capacity [mAh]")
    cycle_count: Uint16 = field("Count of discharge cycles")
    average_time_to_empty: Uint16 = field("Time until empty, averaged [min]")
    manufacture_date: Uint16 = field("Day of manufacture: day + 32 * month + 512 * (year - 1980)")
    state_of_health: Uint16 = field("Full charge in proportion to that of a new battery [%], 0 to 100")
    max_error: Uint16 = field("Greatest error of the charge [%], 1 to 100")

    id: Uint8 = field("Number of the battery on this vehicle, from 1")
    interface_error: Uint16 = field("Count of errors of the interface to the battery")

    voltage_cell_v: Float32x14 = field("Voltage of each cell [V], 0 if not known")
    max_cell_voltage_delta: Float32 = field("Greatest difference between cell voltages [V]")

    is_powering_off: Bool = field("The battery is about to switch off")
    is_required: Bool = field("The battery is needed before arming")
    warning: Uint8 = field("Warning: 0 none, 1 low, 2 critical, 3 emergency, 4 failed, 6 unhealthy, 7 charges")
    faults: Uint16 = field("Faults as bits, 1 << number of FAULT_; 0 none")

    full_charge_capacity_wh: Float32 = field("Energy when full [Wh]")
    remaining_capacity_wh: Float32 = field("Energy left [Wh]")
    over_discharge_count: Uint16 = field("Count of discharges below the limit")
    nominal_voltage: Float32 = field("Nominal voltage [V]")

    internal_resistance_estimate: Float32 = field("Internal resistance of a cell, estimated [Ohm]")
    ocv_estimate: Float32 = field("Open circuit voltage, estimated [V]")
    ocv_estimate_filtered: Float32 = field("Open circuit voltage, estimated and filtered [V]")
    volt_based_soc_estimate: Float32 = field("Charge left by voltage alone, 0 to 1")
    voltage_prediction: Float32 = field("Voltage predicted by the estimator [V]")
    prediction_error: Float32 = field("Error of voltage_prediction [V]")
    estimation_covariance_norm: Float32 = field("Norm of the estimator's covariance")

    # Up to 1.16:
    serial_number: Uint16 = field("Serial number")

    # Up to 1.15:
    voltage_filtered_v: Float32 = field("Voltage, filtered [V], 0 if not known")
    current_filtered_a: Float32 = field("Current, filtered [A], 0 or -1 if not known")
    custom_faults: Uint32 = field("The maker's own faults as bits")
    mode: Uint8 = field("Mode: 0 normal or not known, 1 discharges itself, 2 hot swap")
    average_power: Float32 = field("Average power of this discharge, in the battery's own unit")
    available_energy: Float32 = field("Charge or energy left, in the battery's own unit")
    design_capacity: Float32 = field("Capacity by design, in the battery's own unit")
    average_time_to_full: Uint16 = field("Time until full, averaged [min]")
