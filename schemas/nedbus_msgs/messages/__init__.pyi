# Made by `make generated`.
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
