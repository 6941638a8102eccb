# Made by `make generated` from nedbus_msgs/messages.
from collections.abc import Awaitable, Callable
from typing import Any, Literal, Protocol, TypedDict, overload

from typing_extensions import Unpack

import nedbus_msgs.messages as m

from .sample import Mode, Sample
from .subscription import AsyncSubscription, Subscription

class Options(TypedDict, total=False):
    vehicle: str | int
    instance: int | None
    mode: Mode
    max_rate: float | None

class LatestOptions(TypedDict, total=False):
    vehicle: str | int
    instance: int | None
    timeout: float

_VehicleLocalPosition = Literal[
    "vehicle_local_position",
    "vehicle_local_position_groundtruth",
    "external_ins_local_position",
    "estimator_local_position",
]
_BatteryStatus = Literal["battery_status"]
_EstimatorStatusFlags = Literal["estimator_status_flags"]
_FailsafeFlags = Literal["failsafe_flags"]
_HomePosition = Literal["home_position"]
_SensorGps = Literal["sensor_gps", "vehicle_gps_position"]
_TimesyncStatus = Literal["timesync_status"]
_VehicleAttitude = Literal[
    "vehicle_attitude", "vehicle_attitude_groundtruth", "external_ins_attitude", "estimator_attitude"
]
_VehicleGlobalPosition = Literal[
    "vehicle_global_position",
    "vehicle_global_position_groundtruth",
    "external_ins_global_position",
    "estimator_global_position",
]
_VehicleLandDetected = Literal["vehicle_land_detected"]
_VehicleOdometry = Literal[
    "vehicle_odometry", "vehicle_mocap_odometry", "vehicle_visual_odometry", "estimator_odometry"
]
_VehicleStatus = Literal["vehicle_status"]

class Subscribe(Protocol):
    @overload
    def __call__(
        self, topic: _VehicleLocalPosition = ..., **options: Unpack[Options]
    ) -> Subscription[m.VehicleLocalPosition]: ...
    @overload
    def __call__(self, topic: _BatteryStatus, **options: Unpack[Options]) -> Subscription[m.BatteryStatus]: ...
    @overload
    def __call__(
        self, topic: _EstimatorStatusFlags, **options: Unpack[Options]
    ) -> Subscription[m.EstimatorStatusFlags]: ...
    @overload
    def __call__(self, topic: _FailsafeFlags, **options: Unpack[Options]) -> Subscription[m.FailsafeFlags]: ...
    @overload
    def __call__(self, topic: _HomePosition, **options: Unpack[Options]) -> Subscription[m.HomePosition]: ...
    @overload
    def __call__(self, topic: _SensorGps, **options: Unpack[Options]) -> Subscription[m.SensorGps]: ...
    @overload
    def __call__(self, topic: _TimesyncStatus, **options: Unpack[Options]) -> Subscription[m.TimesyncStatus]: ...
    @overload
    def __call__(self, topic: _VehicleAttitude, **options: Unpack[Options]) -> Subscription[m.VehicleAttitude]: ...
    @overload
    def __call__(
        self, topic: _VehicleGlobalPosition, **options: Unpack[Options]
    ) -> Subscription[m.VehicleGlobalPosition]: ...
    @overload
    def __call__(
        self, topic: _VehicleLandDetected, **options: Unpack[Options]
    ) -> Subscription[m.VehicleLandDetected]: ...
    @overload
    def __call__(self, topic: _VehicleOdometry, **options: Unpack[Options]) -> Subscription[m.VehicleOdometry]: ...
    @overload
    def __call__(self, topic: _VehicleStatus, **options: Unpack[Options]) -> Subscription[m.VehicleStatus]: ...
    @overload
    def __call__(self, topic: str, **options: Unpack[Options]) -> Subscription[Any]: ...

class AsyncSubscribe(Protocol):
    @overload
    def __call__(
        self, topic: _VehicleLocalPosition = ..., **options: Unpack[Options]
    ) -> AsyncSubscription[m.VehicleLocalPosition]: ...
    @overload
    def __call__(self, topic: _BatteryStatus, **options: Unpack[Options]) -> AsyncSubscription[m.BatteryStatus]: ...
    @overload
    def __call__(
        self, topic: _EstimatorStatusFlags, **options: Unpack[Options]
    ) -> AsyncSubscription[m.EstimatorStatusFlags]: ...
    @overload
    def __call__(self, topic: _FailsafeFlags, **options: Unpack[Options]) -> AsyncSubscription[m.FailsafeFlags]: ...
    @overload
    def __call__(self, topic: _HomePosition, **options: Unpack[Options]) -> AsyncSubscription[m.HomePosition]: ...
    @overload
    def __call__(self, topic: _SensorGps, **options: Unpack[Options]) -> AsyncSubscription[m.SensorGps]: ...
    @overload
    def __call__(self, topic: _TimesyncStatus, **options: Unpack[Options]) -> AsyncSubscription[m.TimesyncStatus]: ...
    @overload
    def __call__(self, topic: _VehicleAttitude, **options: Unpack[Options]) -> AsyncSubscription[m.VehicleAttitude]: ...
    @overload
    def __call__(
        self, topic: _VehicleGlobalPosition, **options: Unpack[Options]
    ) -> AsyncSubscription[m.VehicleGlobalPosition]: ...
    @overload
    def __call__(
        self, topic: _VehicleLandDetected, **options: Unpack[Options]
    ) -> AsyncSubscription[m.VehicleLandDetected]: ...
    @overload
    def __call__(self, topic: _VehicleOdometry, **options: Unpack[Options]) -> AsyncSubscription[m.VehicleOdometry]: ...
    @overload
    def __call__(self, topic: _VehicleStatus, **options: Unpack[Options]) -> AsyncSubscription[m.VehicleStatus]: ...
    @overload
    def __call__(self, topic: str, **options: Unpack[Options]) -> AsyncSubscription[Any]: ...

class Latest(Protocol):
    @overload
    def __call__(
        self, topic: _VehicleLocalPosition = ..., **options: Unpack[LatestOptions]
    ) -> list[Sample[m.VehicleLocalPosition]]: ...
    @overload
    def __call__(self, topic: _BatteryStatus, **options: Unpack[LatestOptions]) -> list[Sample[m.BatteryStatus]]: ...
    @overload
    def __call__(
        self, topic: _EstimatorStatusFlags, **options: Unpack[LatestOptions]
    ) -> list[Sample[m.EstimatorStatusFlags]]: ...
    @overload
    def __call__(self, topic: _FailsafeFlags, **options: Unpack[LatestOptions]) -> list[Sample[m.FailsafeFlags]]: ...
    @overload
    def __call__(self, topic: _HomePosition, **options: Unpack[LatestOptions]) -> list[Sample[m.HomePosition]]: ...
    @overload
    def __call__(self, topic: _SensorGps, **options: Unpack[LatestOptions]) -> list[Sample[m.SensorGps]]: ...
    @overload
    def __call__(self, topic: _TimesyncStatus, **options: Unpack[LatestOptions]) -> list[Sample[m.TimesyncStatus]]: ...
    @overload
    def __call__(
        self, topic: _VehicleAttitude, **options: Unpack[LatestOptions]
    ) -> list[Sample[m.VehicleAttitude]]: ...
    @overload
    def __call__(
        self, topic: _VehicleGlobalPosition, **options: Unpack[LatestOptions]
    ) -> list[Sample[m.VehicleGlobalPosition]]: ...
    @overload
    def __call__(
        self, topic: _VehicleLandDetected, **options: Unpack[LatestOptions]
    ) -> list[Sample[m.VehicleLandDetected]]: ...
    @overload
    def __call__(
        self, topic: _VehicleOdometry, **options: Unpack[LatestOptions]
    ) -> list[Sample[m.VehicleOdometry]]: ...
    @overload
    def __call__(self, topic: _VehicleStatus, **options: Unpack[LatestOptions]) -> list[Sample[m.VehicleStatus]]: ...
    @overload
    def __call__(self, topic: str, **options: Unpack[LatestOptions]) -> list[Sample[Any]]: ...

class AsyncLatest(Protocol):
    @overload
    def __call__(
        self, topic: _VehicleLocalPosition = ..., **options: Unpack[LatestOptions]
    ) -> Awaitable[list[Sample[m.VehicleLocalPosition]]]: ...
    @overload
    def __call__(
        self, topic: _BatteryStatus, **options: Unpack[LatestOptions]
    ) -> Awaitable[list[Sample[m.BatteryStatus]]]: ...
    @overload
    def __call__(
        self, topic: _EstimatorStatusFlags, **options: Unpack[LatestOptions]
    ) -> Awaitable[list[Sample[m.EstimatorStatusFlags]]]: ...
    @overload
    def __call__(
        self, topic: _FailsafeFlags, **options: Unpack[LatestOptions]
    ) -> Awaitable[list[Sample[m.FailsafeFlags]]]: ...
    @overload
    def __call__(
        self, topic: _HomePosition, **options: Unpack[LatestOptions]
    ) -> Awaitable[list[Sample[m.HomePosition]]]: ...
    @overload
    def __call__(self, topic: _SensorGps, **options: Unpack[LatestOptions]) -> Awaitable[list[Sample[m.SensorGps]]]: ...
    @overload
    def __call__(
        self, topic: _TimesyncStatus, **options: Unpack[LatestOptions]
    ) -> Awaitable[list[Sample[m.TimesyncStatus]]]: ...
    @overload
    def __call__(
        self, topic: _VehicleAttitude, **options: Unpack[LatestOptions]
    ) -> Awaitable[list[Sample[m.VehicleAttitude]]]: ...
    @overload
    def __call__(
        self, topic: _VehicleGlobalPosition, **options: Unpack[LatestOptions]
    ) -> Awaitable[list[Sample[m.VehicleGlobalPosition]]]: ...
    @overload
    def __call__(
        self, topic: _VehicleLandDetected, **options: Unpack[LatestOptions]
    ) -> Awaitable[list[Sample[m.VehicleLandDetected]]]: ...
    @overload
    def __call__(
        self, topic: _VehicleOdometry, **options: Unpack[LatestOptions]
    ) -> Awaitable[list[Sample[m.VehicleOdometry]]]: ...
    @overload
    def __call__(
        self, topic: _VehicleStatus, **options: Unpack[LatestOptions]
    ) -> Awaitable[list[Sample[m.VehicleStatus]]]: ...
    @overload
    def __call__(self, topic: str, **options: Unpack[LatestOptions]) -> Awaitable[list[Sample[Any]]]: ...

def by_topic(method: Callable[..., Any]) -> Subscribe: ...
def by_topic_async(method: Callable[..., Any]) -> AsyncSubscribe: ...
def last(method: Callable[..., Any]) -> Latest: ...
def last_async(method: Callable[..., Any]) -> AsyncLatest: ...
