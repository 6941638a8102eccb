"""The text that names a source, `KIND:TARGET?OPTION=VALUE&...`, and the one table of kinds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Final, Literal, cast
from urllib.parse import parse_qsl

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from nedbus.errors import ConfigError
from nedbus_msgs import check_vehicle

from .record import Source


def _vehicle(value: str) -> str:
    check_vehicle(value)
    return value


class Options(BaseModel):
    """Options of every replay."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    vehicle: Annotated[str, AfterValidator(_vehicle)] | None = Field(None, description="1 to 64 of A-Z a-z 0-9 _ -")
    speed: Annotated[float, Field(ge=0.001, le=1000)] | Literal["max"] = Field(
        1.0, description="a factor from 0.001 to 1000, or max: as fast as readers take it"
    )
    wait: bool = Field(False, description="1 to start when a subscriber is there, or 0")


class UlogOptions(Options):
    """Options of `ulog:`."""

    loop: bool = Field(False, description="1 to start again at the end, or 0")


class SimulatorOptions(Options):
    """Options of `sim:`."""

    seed: int = Field(0, description="a whole number: same seed, same flight")
    duration: Annotated[float, Field(ge=0.01, le=1e8)] | None = Field(
        None, description="seconds, 0.01 to 1e8; endless without it"
    )


@dataclass(frozen=True, slots=True)
class SourceKind:
    """One kind of source: its options, whether it needs a target, and where the code is, imported when it is used."""

    options: type[Options]
    target: str | None
    module: str
    function: str


SOURCE_KINDS: Final[Mapping[str, SourceKind]] = {
    "sim": SourceKind(SimulatorOptions, None, "nedbus.sources.simulator", "SimulatorSource"),
    "ulog": SourceKind(UlogOptions, "FILE", "nedbus.sources.ulog", "UlogSource"),
}


@dataclass(frozen=True, slots=True)
class SourceSpec:
    """One source as it was asked for."""

    text: str
    kind: str
    target: str
    options: Options

    def open_source(self, *, vehicle: str) -> Source:
        """Return the source; `vehicle` is for a source that neither names nor knows one."""
        kind = SOURCE_KINDS[self.kind]
        make = cast("Callable[..., Source]", getattr(import_module(kind.module), kind.function))
        return make(self.target, self.options, vehicle=vehicle) if kind.target else make(self.options, vehicle=vehicle)


def parse_source(text: str) -> SourceSpec:
    """Return the source that a text such as `ulog:flight.ulg?speed=2&vehicle=7` names.

    Raises ConfigError for an unknown kind, a missing target, or an option that does not exist or cannot be.
    """
    kind_name, _, rest = text.partition(":")
    kind = SOURCE_KINDS.get(kind_name)
    if kind is None:
        hint = (
            f"write ulog:{text}"
            if text.partition("?")[0].endswith(".ulg")
            else f"choose from {', '.join(SOURCE_KINDS)}"
        )
        raise ConfigError(f"source {text!r}", f"there is no kind {kind_name!r}: {hint}")
    target, _, query = rest.rpartition("?") if "?" in rest else (rest, "", "")
    if bool(target) != bool(kind.target):
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
