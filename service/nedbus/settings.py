"""Settings from `nedbus.toml`, the environment and flags, each overriding the one before; nothing else reads them."""

from __future__ import annotations

import difflib
import logging
import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, PrivateAttr, ValidationError
from pydantic_settings import (
    BaseSettings,
    InitSettingsSource,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
)

from nedbus_msgs import DEFAULT_PREFIX, check_prefix, check_vehicle

from .errors import ConfigError
from .transport import Tls, check_endpoints, dial_endpoint, router_endpoints

_log = logging.getLogger(__name__)

DEFAULT_FILE = Path("nedbus.toml")
_BEGUN = len("NEDBUS_TLS")  # characters of a variable from which on it is taken for the beginning of a setting


def _split_sources(value: object) -> object:
    """Split at semicolons and line breaks; without any, at commas before KIND: that are no part of an option."""
    if not isinstance(value, str):
        return value
    parts = re.split(r"[;\n]", value) if re.search(r"[;\n]", value) else re.split(r",(?=\s*[a-z][a-z0-9-]*:)", value)
    return tuple(part.strip() for part in parts if part.strip())


def _split(value: object) -> object:
    return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value


def _endpoints(value: tuple[str, ...]) -> tuple[str, ...]:
    check_endpoints(value, where="endpoint")
    return value


def _prefix(value: str) -> str:
    check_prefix(value)
    return value


def split_http(where: str) -> tuple[str, int]:
    """Return host and port of HOST:PORT or [HOST]:PORT; raise ValueError for anything else."""
    host, _, port = where.rpartition(":")
    bare = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    if not bare or (":" in bare) != (host != bare) or not port.isdecimal() or int(port) > 65_535:
        raise ValueError(f"{where!r} is not an address: write HOST:PORT, such as 127.0.0.1:9464")
    return bare, int(port)


def _http(value: str) -> str:
    split_http(value)
    return value


def _text(value: object) -> object:
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _vehicle(value: str) -> str:
    check_vehicle(value)
    return value


Endpoints = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_split), AfterValidator(_endpoints)]


class Settings(BaseSettings):
    """All settings; every field is also NEDBUS_<FIELD> in the environment, with commas between several values.

    Sources whose options contain commas are separated by semicolons.
    `load_settings` makes one; it raises ConfigError with the flag, the variable, or file, line and column.
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
    source: Annotated[tuple[str, ...], NoDecode, BeforeValidator(_split_sources)] = Field(
        (), description="What is published"
    )
    http: Annotated[str, AfterValidator(_http)] | None = Field(
        None, description="HOST:PORT of /metrics, /healthz, /readyz and /status"
    )
    until_done: bool = Field(False, description="End when every finite source has ended")

    _set_by: dict[str, str] = PrivateAttr(default_factory=dict)

    @property
    def routers(self) -> tuple[str, ...]:
        """The endpoints that a client joins: `connect`, else the router that these settings start on this host."""
        return self.connect or tuple(map(dial_endpoint, self.router_endpoints))

    @property
    def router_endpoints(self) -> tuple[str, ...]:
        """The endpoints on which the embedded router of a service with these settings listens."""
        return router_endpoints(self.listen, self.router_config)

    @property
    def is_client(self) -> bool:
        """Whether a service with these settings joins other routers without being one itself."""
        return bool(self.connect) and not (self.listen or self.router_config)

    def set_by(self, name: str) -> str:
        """Return what sets a setting: the name of a flag, an environment variable, or a file; "" for a default."""
        return self._set_by.get(name, "")

    @property
    def tls(self) -> Tls | None:
        """The files of a client of tls/ endpoints; raise ConfigError for half of what is needed."""
        if self.tls_ca is None:
            if self.tls_certificate or self.tls_key:
                raise ConfigError("tls_ca", "a certificate is given, but not the authority to trust: give both")
            return None
        return Tls(self.tls_ca, self.tls_certificate, self.tls_key)


def load_settings(file: str | Path | None = None, **given: object) -> Settings:
    """Return the settings of a file (default: NEDBUS_CONFIG, else ./nedbus.toml if there is one) and the environment.

    What is given here and not None overrides both.

    Raises ConfigError, with file, line and column or the name of the flag or variable.
    """
    path = _settings_file(file)
    flags: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    try:
        settings = _with_file(_read_toml(path) if path else {})(**flags)
    except ValidationError as exc:
        raise _setting_error(path, flags, exc) from exc
    _warn_of_misspelt_variables()
    settings._set_by.update({name: _set_by(name, path, flags) for name in settings.model_fields_set})
    return settings


def _settings_file(given: str | Path | None) -> Path | None:
    """Return the file to read, None if there is none; raise ConfigError when one is named that does not exist."""
    path = Path(given) if given else (Path(os.environ["NEDBUS_CONFIG"]) if os.environ.get("NEDBUS_CONFIG") else None)
    if path is not None and not path.is_file():
        raise ConfigError.in_file(path, "there is no such file")
    return path or (DEFAULT_FILE if DEFAULT_FILE.is_file() else None)


def _set_by(name: str, path: Path | None, flags: Mapping[str, object]) -> str:
    """Return what sets a setting: the flag or argument of that name, its environment variable, or the file."""
    variable = f"NEDBUS_{name.upper()}"
    if name in flags or not (os.environ.get(variable) or path):
        return name
    return variable if os.environ.get(variable) else str(path)


def _warn_of_misspelt_variables() -> None:
    """Warn of environment variables that look like a setting, and are none."""
    known = {f"NEDBUS_{name.upper()}" for name in (*Settings.model_fields, "config")}
    for variable in sorted(name for name in os.environ if name.startswith("NEDBUS_") and name not in known):
        begun = sorted(each for each in known if each.startswith(variable) and len(variable) >= _BEGUN)
        if near := begun or difflib.get_close_matches(variable, known, 1, 0.85):
            _log.warning("%s is not a setting: did you mean %s?", variable, " or ".join(near))


def _with_file(content: Mapping[str, object]) -> type[Settings]:
    """Return Settings with this content of a file below the environment, which is below flags and arguments."""

    class FileSettings(Settings):
        @classmethod
        def settings_customise_sources(
            cls,
            settings_cls: type[BaseSettings],
            init_settings: PydanticBaseSettingsSource,
            env_settings: PydanticBaseSettingsSource,
            dotenv_settings: PydanticBaseSettingsSource,
            file_secret_settings: PydanticBaseSettingsSource,
        ) -> tuple[PydanticBaseSettingsSource, ...]:
            return init_settings, env_settings, InitSettingsSource(settings_cls, dict(content))

    return FileSettings


def _read_text(path: Path) -> str:
    """Return the text of a file, without the mark that editors on Windows put first; raise ConfigError."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as exc:
        raise ConfigError.in_file(path, "this is not text in UTF-8") from exc
    except OSError as exc:
        raise ConfigError.in_file(path, f"cannot be read: {(exc.strerror or str(exc)).lower()}") from exc


def _read_toml(path: Path) -> dict[str, object]:
    text = _read_text(path)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as exc:
        position = re.search(r"\(at line (\d+), column (\d+)\)", str(exc))
        reason = re.sub(r" \(at .*\)", "", str(exc))
        if position is None:  # "at end of document"
            lines = text.splitlines() or [""]
            raise ConfigError.in_file(path, reason, line=len(lines), column=len(lines[-1]) + 1) from exc
        raise ConfigError.in_file(path, reason, line=int(position[1]), column=int(position[2])) from exc


def _setting_error(path: Path | None, flags: Mapping[str, object], error: ValidationError) -> ConfigError:
    detail = error.errors()[0]
    name = str(detail["loc"][0])
    reason = detail["msg"].removeprefix("Value error, ").removeprefix("endpoint: ")
    if detail["type"] == "extra_forbidden":
        reason = f"there is no setting {name!r}: choose from {', '.join(Settings.model_fields)}"
    elif "ctx" not in detail:
        reason = f"{name}: {reason} (is {detail['input']!r:.60})"
    setter = _set_by(name, path, flags)
    if path is None or setter != str(path):
        return ConfigError(setter, reason)
    line, column = _find_key(_read_text(path), name)
    return ConfigError.in_file(path, reason, line=line, column=column)


def _find_key(text: str, name: str) -> tuple[int | None, int | None]:
    """Return line and column of a key or a table; TOML parsers do not keep them."""
    found = re.search(rf"^[ \t]*\[*[ \t]*(\"?{re.escape(name)}\"?)[ \t]*[=.\]]", text, re.MULTILINE)
    if found is None:
        return None, None
    start = found.start(1)
    return text.count("\n", 0, start) + 1, start - text.rfind("\n", 0, start)
