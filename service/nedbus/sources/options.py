"""The options of each kind of source, as Pydantic models."""

import re
from collections.abc import Collection, Mapping
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo

from nedbus.flights import parse_topics, topics_of
from nedbus_msgs import DEFAULT, RELEASES, Address, check_vehicle
from nedbus_msgs.messages import VehicleLocalPosition, VehicleOdometry


def _parse_vehicles(text: str) -> Mapping[str, str]:
    """Parse `NAME:VEHICLE,NAME:VEHICLE`."""
    vehicles: dict[str, str] = {}
    for part in text.split(","):
        name, _, vehicle = part.strip().rpartition(":")
        name = name.strip("/")
        if not name or name in vehicles:
            raise ValueError(text)
        vehicles[name] = check_vehicle(vehicle)
    return vehicles


def _check_system_ids(vehicles: Mapping[str, str]) -> Mapping[str, str]:
    """Raise ValueError unless all names are MAVLink system ids and no vehicle occurs twice."""
    for name in vehicles:
        if not name.isdecimal() or not 0 < int(name) < 256:
            raise ValueError(vehicles)
    if len(set(vehicles.values())) < len(vehicles):
        raise ValueError(vehicles)
    return vehicles


def _parse_topics(text: object) -> object:
    return parse_topics(text) if isinstance(text, str) else text


def _parse_speed(text: object) -> object:
    return None if text == "max" else text


def _parse_origin(text: object) -> object:
    return text.split(",") if isinstance(text, str) else text


def _parse_log(text: object) -> object:
    return "" if text == "0" else text


_Latitude = Annotated[float, Field(ge=-90, le=90)]
_Longitude = Annotated[float, Field(ge=-180, le=180)]
_Speed = Annotated[float, Field(ge=0.001, le=1000)]
_Altitude = Annotated[float, Field(ge=-500, le=1e4)]
_POSITIONS: Final = [
    topic.name
    for topic in (*VehicleOdometry.TOPICS, *VehicleLocalPosition.TOPICS)
    if not topic.instances
]
POSITION_TOPICS: Final = tuple(dict.fromkeys(("vehicle_visual_odometry", *_POSITIONS)))
"""Topics of positions that can be sent into a vehicle."""

_LAYOUTS: Final = tuple(dict.fromkeys((*RELEASES, *DEFAULT.layouts)))
_Layout = Annotated[str, Field(pattern=f"^({'|'.join(map(re.escape, _LAYOUTS))})$")]
Vehicle = Annotated[str, AfterValidator(check_vehicle)]
Vehicles = Annotated[Mapping[str, str], BeforeValidator(_parse_vehicles)]


class Options(BaseModel):
    """Options shared by all kinds of source."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    topics: Annotated[tuple[str, ...], BeforeValidator(_parse_topics)] = Field(
        (), description="topic or message names, separated by commas, or * for all"
    )

    @property
    def chosen_topics(self) -> Collection[str] | None:
        """The topics to deliver, by default the built-in ones; None means all."""
        return topics_of(self.topics)


class ReplayOptions(Options):
    """Options shared by all replays."""

    vehicle: Vehicle | None = Field(None, description="1 to 64 characters of A-Z a-z 0-9 _ -")
    speed: Annotated[_Speed | None, BeforeValidator(_parse_speed)] = Field(
        1.0, description="a factor from 0.001 to 1000, or max: as fast as readers receive"
    )
    wait: bool = Field(False, description="1 to wait for a subscriber before the start, or 0")


class RecordedOptions(ReplayOptions):
    """Options of `ulog:` and `tlog:`, and of `mcap:`."""

    loop: bool = Field(False, description="1 to restart at the end, or 0")


class RecordingOptions(RecordedOptions):
    """Options of `mcap:`."""

    layout: _Layout | None = Field(
        None,
        description=f"the PX4 release whose layouts the messages have, if not those in the file: {', '.join(_LAYOUTS)}",
    )


class SimulatorOptions(ReplayOptions):
    """Options of `sim:`."""

    seed: int = Field(0, description="an integer; the same seed produces the same flight")
    duration: Annotated[float, Field(ge=0.01, le=1e8)] | None = Field(
        None, description="seconds, 0.01 to 1e8 (default: endless)"
    )
    origin: Annotated[
        tuple[_Latitude, _Longitude, _Altitude] | None, BeforeValidator(_parse_origin)
    ] = Field(
        None,
        description="LATITUDE,LONGITUDE,ALTITUDE of the take-off, degrees and metres (default: Zurich, as in PX4)",
    )


class Px4ZenohOptions(Options):
    """Options of `px4-zenoh:`."""

    domain: Annotated[int, Field(ge=0, le=232)] | None = Field(
        None, description="a ROS domain, 0 to 232 (default: all)"
    )
    vehicle: Vehicle | None = Field(
        None, description="1 to 64 characters of A-Z a-z 0-9 _ -, for topics without a namespace"
    )
    vehicles: Vehicles = Field(
        {}, description="NAMESPACE:VEHICLE or DOMAIN:VEHICLE, separated by commas"
    )
    layout: _Layout | None = Field(
        None,
        description=f"the PX4 release whose layouts apply to keys without a type hash: {', '.join(_LAYOUTS)}",
    )
    msg: str = Field(
        "", description="PX4's message definitions: .msg files or folders, separated by commas"
    )


def _parse_address(text: object) -> object:
    """Parse VEHICLE/TOPIC; raise ValueError for a topic without a position, AddressError for an invalid name."""
    if not isinstance(text, str):
        return text
    vehicle, _, topic = text.partition("/")
    if topic not in POSITION_TOPICS:
        raise ValueError(text)
    return Address(vehicle, topic)


def _check_save(folder: str, info: ValidationInfo) -> str:
    if folder and not info.data.get("log"):
        raise ValueError(folder)
    return folder


class MavlinkOptions(Options):
    """Options of `mavlink:`."""

    rate: Annotated[float, Field(ge=0.1, le=200)] = Field(
        30.0, description="positions per second to request from the vehicle, 0.1 to 200"
    )
    baud: Annotated[int, Field(ge=300, le=12_000_000)] = Field(
        57600, description="baud rate of a serial port, 300 to 12000000"
    )
    vehicles: Annotated[Vehicles, AfterValidator(_check_system_ids)] = Field(
        {}, description="SYSTEM_ID:VEHICLE, separated by commas, each id and each vehicle once"
    )
    log: Annotated[Literal["", "1", "armed"], BeforeValidator(_parse_log)] = Field(
        "",
        description="1 to request the ULog stream of each PX4 on the link, armed to start it in flight as well, or 0",
    )
    header: Annotated[float, Field(ge=1, le=600)] | None = Field(
        None,
        description="seconds that the header of a ULog stream may take, 1 to 600 (default: 10)",
    )
    state: str = Field(
        "",
        description="a folder for the state of ULog streams, which a restarted service continues, or 0 for none"
        " (default: ulog-streams in $STATE_DIRECTORY, or in $XDG_STATE_HOME/nedbus)",
    )
    save: Annotated[str, AfterValidator(_check_save)] = Field(
        "", description="a folder in which each ULog stream is saved as a .ulg file; requires log="
    )

    position: Annotated[Address | None, BeforeValidator(_parse_address)] = Field(
        None,
        description="VEHICLE/TOPIC of a position on the bus that is sent into the vehicle on this link, as in"
        f" mocap/vehicle_visual_odometry; topics: {', '.join(POSITION_TOPICS)}",
    )
    position_clock: Literal["arrival", "timesync"] = Field(
        "arrival",
        description="arrival: PX4 stamps positions on arrival; timesync: answer PX4's TIMESYNC, so that PX4 uses the"
        " time of each measurement",
    )

    @property
    def chosen_topics(self) -> Collection[str] | None:
        """The topics to deliver; all of them if `log` is set and `topics` is not."""
        if self.log and not self.topics:
            return None
        return super().chosen_topics
