"""The text that names a source, `KIND:TARGET?OPTION=VALUE&...`, and the one table of kinds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import PurePath
from typing import Annotated, Final, Literal, cast
from urllib.parse import parse_qsl

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from nedbus.errors import ConfigError
from nedbus.extras import needs
from nedbus.session import Tls
from nedbus_msgs import LAYOUTS, check_vehicle

from .record import Home, Source


def _vehicle(value: str) -> str:
    check_vehicle(value)
    return value


def _vehicles(text: object) -> object:
    """Read `NAME:VEHICLE,NAME:VEHICLE`."""
    if not isinstance(text, str):
        return text
    parts = [part.strip().rpartition(":") for part in text.split(",")]
    named = {name.strip("/"): vehicle for name, _, vehicle in parts}
    for vehicle in named.values():
        check_vehicle(vehicle)
    if "" in named or len(named) < len(parts):
        raise ValueError(text)
    return named


def _systems(named: Mapping[str, str]) -> Mapping[str, str]:
    """Let pass what names each system once, and gives no two of them the same vehicle."""
    if not all(name.isdecimal() and 0 < int(name) < 256 for name in named) or len(set(named.values())) < len(named):
        raise ValueError(named)
    return named


def _layout(name: str) -> str:
    if name not in LAYOUTS:
        raise ValueError(name)
    return name


Vehicle = Annotated[str, AfterValidator(_vehicle)]
Vehicles = Annotated[Mapping[str, str], BeforeValidator(_vehicles)]


class Options(BaseModel):
    """What all options have in common."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ReplayOptions(Options):
    """Options of every replay."""

    vehicle: Vehicle | None = Field(None, description="1 to 64 of A-Z a-z 0-9 _ -")
    speed: Annotated[float, Field(ge=0.001, le=1000)] | Literal["max"] = Field(
        1.0, description="a factor from 0.001 to 1000, or max: as fast as readers take it"
    )
    wait: bool = Field(False, description="1 to start when a subscriber is there, or 0")


class RecordedOptions(ReplayOptions):
    """Options of `ulog:` and `mcap:`."""

    loop: bool = Field(False, description="1 to start again at the end, or 0")


class SimulatorOptions(ReplayOptions):
    """Options of `sim:`."""

    seed: int = Field(0, description="a whole number: same seed, same flight")
    duration: Annotated[float, Field(ge=0.01, le=1e8)] | None = Field(
        None, description="seconds, 0.01 to 1e8; endless without it"
    )


class Px4ZenohOptions(Options):
    """Options of `px4-zenoh:`."""

    domain: Annotated[int, Field(ge=0, le=232)] | None = Field(
        None, description="a ROS domain, 0 to 232; all without it"
    )
    vehicle: Vehicle | None = Field(None, description="1 to 64 of A-Z a-z 0-9 _ -, for what has no namespace")
    vehicles: Vehicles = Field({}, description="NAMESPACE:VEHICLE or DOMAIN:VEHICLE, with commas between them")
    layout: Annotated[str, AfterValidator(_layout)] | None = Field(
        None, description=f"the layout of keys without a type hash: {', '.join(LAYOUTS)}"
    )


class MavlinkOptions(Options):
    """Options of `mavlink:`."""

    rate: Annotated[float, Field(ge=0.1, le=200)] = Field(
        30.0, description="positions a second to ask the vehicle for, 0.1 to 200"
    )
    baud: Annotated[int, Field(ge=300, le=12_000_000)] = Field(57600, description="of a serial port, 300 to 12000000")
    vehicles: Annotated[Vehicles, AfterValidator(_systems)] = Field(
        {}, description="SYSTEM_ID:VEHICLE, with commas between them, each id and each vehicle once"
    )


@dataclass(frozen=True, slots=True)
class SourceKind:
    """One kind of source: its options, what stands after the colon, and where the code is, imported when it is used.

    `target` is None if nothing stands there, and in brackets if it may be left out.
    `extra`: what to install for it besides nedbus itself.
    """

    options: type[Options]
    target: str | None
    module: str
    function: str
    extra: str = ""

    def takes(self, target: str) -> bool:
        """Return whether this may, or may not, stand after the colon."""
        return self.target is not None if target else self.target is None or self.target.startswith("[")


SOURCE_KINDS: Final[Mapping[str, SourceKind]] = {
    "sim": SourceKind(SimulatorOptions, None, "nedbus.sources.simulator", "SimulatorSource"),
    "ulog": SourceKind(RecordedOptions, "FILE", "nedbus.sources.ulog", "UlogSource"),
    "mcap": SourceKind(RecordedOptions, "FILE", "nedbus.sources.mcap", "McapSource", "mcap"),
    "px4-zenoh": SourceKind(Px4ZenohOptions, "[ENDPOINT]", "nedbus.sources.px4_zenoh", "Px4ZenohSource"),
    "mavlink": SourceKind(MavlinkOptions, "LINK", "nedbus.sources.mavlink", "MavlinkSource", "mavlink"),
}


_SUFFIXES: Final = {".ulg": "ulog", ".mcap": "mcap"}


@dataclass(frozen=True, slots=True)
class SourceSpec:
    """One source as it was asked for."""

    text: str
    kind: str
    target: str
    options: Options

    def open_source(self, *, vehicle: str, routers: tuple[str, ...] = (), tls: Tls | None = None) -> Source:
        """Return the source, for a service with this default vehicle that is reached at these routers.

        Raises ConfigError for a target that cannot be, and when what a kind needs is not installed.
        """
        kind = SOURCE_KINDS[self.kind]
        make = cast("Callable[..., Source]", getattr(needs(kind.extra, kind.module), kind.function))
        return make(self.target, self.options, Home(vehicle, routers, tls))


def parse_source(text: str) -> SourceSpec:
    """Return the source that a text such as `ulog:flight.ulg?speed=2&vehicle=7` names.

    Raises ConfigError for an unknown kind, a missing target, or an option that does not exist or cannot be.
    """
    kind_name, _, rest = text.partition(":")
    kind = SOURCE_KINDS.get(kind_name)
    if kind is None:
        hint = (
            f"write {_SUFFIXES[suffix]}:{text}"
            if (suffix := PurePath(text.partition("?")[0]).suffix) in _SUFFIXES
            else f"choose from {', '.join(SOURCE_KINDS)}"
        )
        raise ConfigError(f"source {text!r}", f"there is no kind {kind_name!r}: {hint}")
    target, _, query = rest.rpartition("?") if "?" in rest else (rest, "", "")
    if not kind.takes(target):
        form = f"{kind_name}:{kind.target}" if kind.target else f"{kind_name}:?OPTION=VALUE"
        raise ConfigError(f"source {text!r}", f"write it as {form}")
    try:
        given = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
        options = kind.options.model_validate(dict(given))
    except ValidationError as exc:
        raise ConfigError(f"source {text!r}", _explain(exc, kind)) from exc
    except ValueError:
        raise ConfigError(f"source {text!r}", f"{query!r} is not OPTION=VALUE&OPTION=VALUE") from None
    if len(dict(given)) < len(given):
        raise ConfigError(f"source {text!r}", "an option is given twice: take one away")
    return SourceSpec(text, kind_name, target, options)


def _explain(error: ValidationError, kind: SourceKind) -> str:
    detail = error.errors()[0]
    name = str(detail["loc"][0])
    field = kind.options.model_fields.get(name)
    if field is None:
        return f"there is no option {name!r}: choose from {', '.join(kind.options.model_fields)}"
    return f"{name}={detail['input']} cannot be: expected {field.description}"
