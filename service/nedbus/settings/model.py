"""The settings: names, types, defaults and checks."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, PrivateAttr
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from nedbus.errors import ConfigError
from nedbus.transport import Tls, check_endpoints, dial_endpoint, router_endpoints
from nedbus_msgs import DEFAULT_PREFIX, check_prefix, check_vehicle, vehicle_name


def split_sources(value: object) -> object:
    """Split at semicolons and line breaks; if there are none, at commas followed by `KIND:`."""
    if not isinstance(value, str):
        return value
    parts = re.split(r"[;\n]", value) if re.search(r"[;\n]", value) else re.split(r",(?=\s*[a-z][a-z0-9-]*:)", value)
    return tuple(part.strip() for part in parts if part.strip())


def split_values(value: object) -> object:
    """Split a text at commas."""
    return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value


def split_http(where: str) -> tuple[str, int]:
    """Parse HOST:PORT or [HOST]:PORT; raise ValueError for anything else."""
    host, _, port = where.rpartition(":")
    bare = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    if not bare or (":" in bare) != (host != bare) or not port.isdecimal() or int(port) > 65_535:
        raise ValueError(f"{where!r} is not an address: write HOST:PORT, such as 127.0.0.1:9464")
    return bare, int(port)


def is_loopback(host: str) -> bool:
    """Return whether a server on this address can be reached from this host only."""
    return host in {"127.0.0.1", "::1", "localhost"}


def _checked(check: Callable[[str], object]) -> AfterValidator:
    """Return a validator that runs a check, which raises for an invalid value, and keeps the value."""

    def validate(value: str) -> str:
        check(value)
        return value

    return AfterValidator(validate)


_Endpoint = Annotated[str, _checked(lambda endpoint: check_endpoints((endpoint,), where="endpoint"))]
Endpoints = Annotated[tuple[_Endpoint, ...], NoDecode, BeforeValidator(split_values)]


class Settings(BaseSettings):
    """All settings. Each is also NEDBUS_<FIELD> in the environment, with several values separated by commas.

    Separate sources by semicolons if their options contain commas.
    Create it with `load_settings`, whose errors name the flag, the variable, or file, line and column.
    """

    model_config = SettingsConfigDict(env_prefix="NEDBUS_", env_ignore_empty=True, extra="forbid", frozen=True)

    connect: Endpoints = Field((), description="Endpoints of Zenoh routers; the first one that answers is joined")
    tls_ca: Path | None = Field(None, description="Authority that signed the routers of tls/ endpoints, PEM")
    tls_certificate: Path | None = Field(None, description="Certificate that this client presents to routers, PEM")
    tls_key: Path | None = Field(None, description="Key of that certificate, PEM")
    listen: Endpoints = Field((), description="Endpoints of the embedded router")
    router_config: Path | None = Field(None, description="JSON5 configuration of the embedded router")
    prefix: Annotated[str, _checked(check_prefix)] = Field(DEFAULT_PREFIX, description="First chunks of every key")
    vehicle: Annotated[str, BeforeValidator(vehicle_name), _checked(check_vehicle)] = Field(
        "1", description="Vehicle of sources that name none"
    )
    source: Annotated[tuple[str | dict[str, Any], ...], NoDecode, BeforeValidator(split_sources)] = Field(
        (), description="Published sources: texts, or tables of TOML"
    )
    http: Annotated[str, _checked(split_http)] | None = Field(
        None, description="HOST:PORT of /metrics, /healthz, /readyz, /vehicles and /status"
    )
    until_done: bool = Field(False, description="End when every finite source has ended")

    _set_by: dict[str, str] = PrivateAttr(default_factory=dict)
    _file: Path | None = PrivateAttr(None)
    _left_out: frozenset[str] = PrivateAttr(frozenset())

    @property
    def routers(self) -> tuple[str, ...]:
        """The endpoints for a client to join: `connect`, else those of the router that these settings start."""
        return self.connect or tuple(map(dial_endpoint, self.router_endpoints))

    @property
    def router_endpoints(self) -> tuple[str, ...]:
        """The endpoints that the embedded router of a service listens on."""
        return router_endpoints(self.listen, self.router_config)

    @property
    def is_client(self) -> bool:
        """True if a service joins other routers without being one itself."""
        return bool(self.connect) and not (self.listen or self.router_config)

    def set_by(self, name: str) -> str:
        """Return the origin of a setting: the name of the flag, variable or file; "" for a default."""
        return self._set_by.get(name, "")

    @property
    def left_out(self) -> frozenset[str]:
        """The settings that `find_mistakes` left out, in whole or in part, as they are invalid or cannot be read."""
        return self._left_out

    @property
    def tls(self) -> Tls | None:
        """The files for tls/ endpoints; raises ConfigError if some are missing."""
        if self.tls_ca is None:
            if self.tls_certificate or self.tls_key:
                raise ConfigError("tls_ca", "a certificate is set, but not the authority to trust: set both")
            return None
        return Tls(self.tls_ca, self.tls_certificate, self.tls_key)
