"""The built-in messages, one file each."""

from importlib import import_module
from pkgutil import iter_modules
from typing import TYPE_CHECKING

from nedbus_msgs.model.declaration import DEFAULT_TOPIC
from nedbus_msgs.model.definition import MESSAGES

for _name in sorted(
    (module.name for module in iter_modules(__path__)),
    key=lambda name: (name != DEFAULT_TOPIC, name),
):
    import_module(f"{__name__}.{_name}")

if TYPE_CHECKING:  # one line per file, for type checkers
    from .battery_status import BatteryStatus as BatteryStatus
    from .estimator_status_flags import EstimatorStatusFlags as EstimatorStatusFlags
    from .failsafe_flags import FailsafeFlags as FailsafeFlags
    from .home_position import HomePosition as HomePosition
    from .log_message import LogMessage as LogMessage
    from .sensor_gps import SensorGps as SensorGps
    from .timesync_status import TimesyncStatus as TimesyncStatus
    from .vehicle_attitude import VehicleAttitude as VehicleAttitude
    from .vehicle_global_position import VehicleGlobalPosition as VehicleGlobalPosition
    from .vehicle_land_detected import VehicleLandDetected as VehicleLandDetected
    from .vehicle_local_position import VehicleLocalPosition as VehicleLocalPosition
    from .vehicle_odometry import VehicleOdometry as VehicleOdometry
    from .vehicle_status import VehicleStatus as VehicleStatus

globals().update({name: definition.model for name, definition in MESSAGES.items()})
