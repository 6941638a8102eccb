"""Settings from `nedbus.toml`, the environment and flags, in that rising order; the one place that reads them."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, ValidationError
from pydantic_settings import (
    BaseSettings,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

from nedbus_msgs import DEFAULT_PREFIX, check_prefix, check_vehicle

from .errors import ConfigError
from .session import DEFAULT_ENDPOINT, Tls, check_endpoints

DEFAULT_FILE = Path("nedbus.toml")


def _split(value: object) -> object:
    return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value


def _endpoints(value: tuple[str, ...]) -> tuple[str, ...]:
    check_endpoints(value, where="endpoint")
    return value


def _prefix(value: str) -> str:
    check_prefix(value)
    return value


def _text(value: object) -> object:
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _vehicle(value: str) -> str:
    check_vehicle(value)
    return value


def dialled(endpoint: str) -> str:
    """Return where a client of this host reaches a router that listens here, on all interfaces perhaps."""
    return endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


Endpoints = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_split), AfterValidator(_endpoints)]


class Settings(BaseSettings):
    """What can be set; every field is also NEDBUS_<FIELD> in the environment, with commas between several values.

    Make one with `load_settings`, which turns every mistake into a ConfigError that names its place.
    """

    model_config = SettingsConfigDict(env_prefix="NEDBUS_", env_ignore_empty=True, extra="forbid", frozen=True)

    connect: Endpoints = Field((), description="Zenoh routers to join, the first that answers")
    tls_ca: Path | None = Field(None, description="Authority that signed the routers of tls/ endpoints, PEM")
    tls_certificate: Path | None = Field(None, description="Certificate that this client shows to a router, PEM")
    tls_key: Path | None = Field(None, description="Key of that certificate, PEM")
    listen: Endpoints = Field((), description="Endpoints of the embedded router")
    router_config: Path | None = Field(None, description="JSON5 configuration of the embedded router")
    prefix: Annotated[str, AfterValidator(_prefix)] = Field(DEFAULT_PREFIX, description="First chunks of every key")
    vehicle: Annotated[str, BeforeValidator(_text), AfterValidator(_vehicle)] = Field(
        "1", description="Vehicle of sources that name none"
    )
    source: Annotated[tuple[str, ...], NoDecode, BeforeValidator(_split)] = Field((), description="What is published")
    until_done: bool = Field(False, description="End when every finite source has ended")

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Put the file below the environment, and the environment below flags and arguments."""
        return init_settings, env_settings, TomlConfigSettingsSource(settings_cls)

    @property
    def routers(self) -> tuple[str, ...]:
        """The endpoints that a client joins: `connect`, else the router that these settings start on this host."""
        return self.connect or tuple(map(dialled, self.listen)) or (DEFAULT_ENDPOINT,)

    @property
    def tls(self) -> Tls | None:
        """The files of a client of tls/ endpoints; raise ConfigError for a certificate without an authority."""
        if self.tls_ca is None:
            if self.tls_certificate or self.tls_key:
                raise ConfigError("tls_ca", "a certificate is given, but not the authority to trust: give both")
            return None
        return Tls(self.tls_ca, self.tls_certificate, self.tls_key)


def load_settings(file: str | Path | None = None, **given: object) -> Settings:
    """Return the settings of a file (default: NEDBUS_CONFIG, else ./nedbus.toml if there is one) and the environment.

    What is given here and not None wins.

    Raises ConfigError, with file, line and column or the name of the flag or variable.
    """
    path = Path(file) if file else (Path(os.environ["NEDBUS_CONFIG"]) if os.environ.get("NEDBUS_CONFIG") else None)
    if path is not None and not path.is_file():
        raise ConfigError.in_file(path, "there is no such file")
    path = path or (DEFAULT_FILE if DEFAULT_FILE.is_file() else None)
    flags: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    try:
        return _with_file(path)(**flags)
    except UnicodeDecodeError as exc:
        raise ConfigError.in_file(path or DEFAULT_FILE, "this is no text in UTF-8") from exc
    except tomllib.TOMLDecodeError as exc:
        raise _toml_error(path or DEFAULT_FILE, exc) from exc
    except ValidationError as exc:
        raise _setting_error(path, flags, exc) from exc


def _with_file(path: Path | None) -> type[Settings]:
    """Return Settings that read this file: the path is part of Pydantic's class configuration."""

    class FileSettings(Settings):
        model_config = SettingsConfigDict(toml_file=path)

    return FileSettings


def _toml_error(path: Path, error: tomllib.TOMLDecodeError) -> ConfigError:
    place = re.search(r"\(at line (\d+), column (\d+)\)", str(error))
    reason = re.sub(r" \(at .*\)", "", str(error))
    if place is None:  # "at end of document"
        lines = path.read_text().splitlines() or [""]
        return ConfigError.in_file(path, reason, line=len(lines), column=len(lines[-1]) + 1)
    return ConfigError.in_file(path, reason, line=int(place[1]), column=int(place[2]))


def _setting_error(path: Path | None, flags: Mapping[str, object], error: ValidationError) -> ConfigError:
    detail = error.errors()[0]
    name = str(detail["loc"][0])
    reason = detail["msg"].removeprefix("Value error, ").removeprefix("endpoint: ")
    if detail["type"] == "extra_forbidden":
        reason = f"there is no setting {name!r}: choose from {', '.join(Settings.model_fields)}"
    elif "ctx" not in detail:
        reason = f"{name}: {reason} (is {detail['input']!r:.60})"
    if name in flags:
        return ConfigError(name, reason)
    variable = f"NEDBUS_{name.upper()}"
    if variable in os.environ:
        return ConfigError(variable, reason)
    if path is None:
        return ConfigError(name, reason)
    line, column = _find_key(path.read_text(), name)
    return ConfigError.in_file(path, reason, line=line, column=column)


def _find_key(text: str, name: str) -> tuple[int | None, int | None]:
    """Return line and column of a key or a table; TOML parsers do not keep them."""
    found = re.search(rf"^[ \t]*\[*[ \t]*(\"?{re.escape(name)}\"?)[ \t]*[=.\]]", text, re.MULTILINE)
    if found is None:
        return None, None
    start = found.start(1)
    return text.count("\n", 0, start) + 1, start - text.rfind("\n", 0, start)
