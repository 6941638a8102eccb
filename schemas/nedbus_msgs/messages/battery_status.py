"""BatteryStatus: voltage, current and charge of a battery."""

from typing import ClassVar

from nedbus_msgs.model import InRange, Layout, Message, Topic
from nedbus_msgs.model.px4_types import Bool, Float32, Float32x14, Uint8, Uint16, Uint32, field


class BatteryStatus(Message):
    """State of one battery: voltage, current and charge; smart batteries provide more fields than power modules.

    One uORB instance per battery; id (from 1) identifies the battery on its vehicle.
    Unknown values are -1 in current_a, current_average_a, discharged_mah, remaining and scale (any negative value of
    remaining, because PX4 divides the -1 of a MAVLink battery by 100), NaN in time_remaining_s
    and temperature, and 0 in the others. Simulators always report a current of -1 and no cell voltages.
    Bit n (1 << n) of faults stands for the FAULT_ constant n; warning may also be STATE_UNHEALTHY or STATE_CHARGING.
    """

    TOPICS = (
        Topic(
            "battery_status",
            1.0,
            "each battery's driver or estimator",
            instances=True,
            plain_first=True,
        ),
    )
    LAYOUTS = (
        Layout(
            "1.13",
            base="1.16",
            without="""
                internal_resistance_estimate ocv_estimate ocv_estimate_filtered
                volt_based_soc_estimate voltage_prediction prediction_error
                estimation_covariance_norm
            """,
            insert_after={
                "voltage_v": "voltage_filtered_v",
                "current_a": "current_filtered_a",
                "faults": "custom_faults",
                "warning": "mode average_power available_energy",
                "remaining_capacity_wh": "design_capacity average_time_to_full",
            },
        ),
        Layout(
            "1.16",
            base="1.17",
            without="warning",
            insert_after={
                "average_time_to_empty": "serial_number",
                "faults": "warning",
            },
        ),
        Layout(
            "1.17",
            without="""
                serial_number voltage_filtered_v current_filtered_a custom_faults mode
                average_power available_energy design_capacity average_time_to_full
            """,
        ),
    )
    RULES = (InRange("remaining", -1.0, 2.0),)

    MAX_INSTANCES: ClassVar = 3
    SOURCE_POWER_MODULE, SOURCE_EXTERNAL, SOURCE_ESCS = range(3)
    WARNING_NONE, WARNING_LOW, WARNING_CRITICAL, WARNING_EMERGENCY, WARNING_FAILED = range(5)
    STATE_UNHEALTHY, STATE_CHARGING = range(6, 8)
    (
        FAULT_DEEP_DISCHARGE, FAULT_SPIKES, FAULT_CELL_FAIL, FAULT_OVER_CURRENT, FAULT_OVER_TEMPERATURE,
        FAULT_UNDER_TEMPERATURE, FAULT_INCOMPATIBLE_VOLTAGE, FAULT_INCOMPATIBLE_FIRMWARE, FAULT_INCOMPATIBLE_MODEL,
        FAULT_HARDWARE_FAILURE, FAULT_FAILED_TO_ARM, FAULT_COUNT,
    ) = range(12)  # fmt: skip

    connected: Bool = field("Battery is connected, based on its voltage")
    voltage_v: Float32 = field("Battery voltage [V], 0 if unknown")
    current_a: Float32 = field("Battery current [A], positive when discharging, -1 if unknown")
    current_average_a: Float32 = field("Average current in level flight [A], -1 if unknown")
    discharged_mah: Float32 = field("Discharged capacity [mAh], -1 if unknown")

    remaining: Float32 = field(
        "Remaining charge, 0 (empty) to 1 (full); above 1 while charging, negative if unknown"
    )
    scale: Float32 = field("Thrust compensation for battery sag, at least 1, -1 if unknown")
    time_remaining_s: Float32 = field(
        "Predicted time until empty at the recent load [s], NaN if unknown"
    )
    temperature: Float32 = field("Temperature [deg C], NaN if unknown")

    cell_count: Uint8 = field("Number of cells in series, 0 if unknown")
    source: Uint8 = field("Source: 0 power module, 1 external, 2 ESCs")
    priority: Uint8 = field("Index of the power input on the board, from 0")

    capacity: Uint16 = field("Actual capacity [mAh]")
    cycle_count: Uint16 = field("Number of discharge cycles")
    average_time_to_empty: Uint16 = field("Average time to empty [min]")
    manufacture_date: Uint16 = field("Date of manufacture: day + 32 * month + 512 * (year - 1980)")
    state_of_health: Uint16 = field(
        "State of health: full charge relative to that of a new battery [%], 0 to 100"
    )
    max_error: Uint16 = field("Expected error of the state of charge [%], 1 to 100")

    id: Uint8 = field("Battery ID on this vehicle, from 1")
    interface_error: Uint16 = field("Number of interface errors")

    voltage_cell_v: Float32x14 = field("Cell voltages [V], 0 if unknown")
    max_cell_voltage_delta: Float32 = field("Maximum difference between cell voltages [V]")

    is_powering_off: Bool = field("Battery is about to power off")
    is_required: Bool = field("Battery is required for arming")
    warning: Uint8 = field(
        "Warning: 0 none, 1 low, 2 critical, 3 emergency, 4 failed, 6 unhealthy, 7 charging"
    )
    faults: Uint16 = field("Fault bitmask, see FAULT_; 0 if none")

    full_charge_capacity_wh: Float32 = field("Energy when fully charged [Wh]")
    remaining_capacity_wh: Float32 = field("Remaining energy [Wh]")
    over_discharge_count: Uint16 = field("Number of over-discharges")
    nominal_voltage: Float32 = field("Nominal voltage [V]")

    internal_resistance_estimate: Float32 = field("Estimated internal resistance per cell [Ohm]")
    ocv_estimate: Float32 = field("Estimated open circuit voltage [V]")
    ocv_estimate_filtered: Float32 = field("Estimated open circuit voltage, filtered [V]")
    volt_based_soc_estimate: Float32 = field("State of charge estimated from voltage alone, 0 to 1")
    voltage_prediction: Float32 = field("Predicted voltage [V]")
    prediction_error: Float32 = field("Error of voltage_prediction [V]")
    estimation_covariance_norm: Float32 = field("Norm of the estimation covariance")

    # Up to 1.16:
    serial_number: Uint16 = field("Serial number")

    # Up to 1.15:
    voltage_filtered_v: Float32 = field("Filtered voltage [V], 0 if unknown")
    current_filtered_a: Float32 = field("Filtered current [A], 0 or -1 if unknown")
    custom_faults: Uint32 = field("Manufacturer-specific fault bitmask")
    mode: Uint8 = field("Mode: 0 normal or unknown, 1 auto-discharging, 2 hot swap")
    average_power: Float32 = field("Average power of this discharge, in battery-specific units")
    available_energy: Float32 = field("Remaining charge or energy, in battery-specific units")
    design_capacity: Float32 = field("Design capacity, in battery-specific units")
    average_time_to_full: Uint16 = field("Average time to full [min]")
