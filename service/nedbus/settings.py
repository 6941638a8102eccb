"""Settings from `nedbus.toml`, the environment and flags, each overriding the previous; no other module reads them."""

import difflib
import logging
import os
import re
import tomllib
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, TypeGuard

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
)
from pydantic_core import ErrorDetails

from nedbus.endpoints import check_endpoints, dial_endpoint, split_http
from nedbus.errors import ConfigError, system_reason
from nedbus.log_event import about
from nedbus.transport import Tls, router_endpoints
from nedbus_msgs import DEFAULT_PREFIX, check_prefix, check_vehicle, vehicle_name

_log = logging.getLogger(__name__)

__all__ = ["Settings", "find_mistakes", "load_settings", "locate_setting", "locate_source"]

DEFAULT_FILE: Final = Path("nedbus.toml")
_OTHER_VARIABLES: Final = ("config", "log_level", "log_format")  # read by the commands
_SHORTEST_PREFIX: Final = len("NEDBUS_TLS")  # of a variable that counts as a truncated setting
_SIMILARITY: Final = 0.85  # of a misspelled variable, from 0 to 1


def split_sources(value: object) -> object:
    """Split a string at semicolons and line breaks; without any, at commas followed by `KIND:`."""
    if not isinstance(value, str):
        return value
    separator = r",(?=\s*[a-z][a-z0-9-]*:)"
    if re.search(r"[;\n]", value):
        separator = r"[;\n]"
    return _stripped(re.split(separator, value))


def split_values(value: object) -> object:
    """Split a string at commas."""
    if not isinstance(value, str):
        return value
    return _stripped(value.split(","))


def _stripped(parts: Iterable[str]) -> tuple[str, ...]:
    """Return the parts without surrounding blanks, and without empty ones."""
    texts = [part.strip() for part in parts]
    return tuple(text for text in texts if text)


def _checked(check: Callable[[str], object]) -> AfterValidator:
    """Return a validator that calls `check`, which raises for an invalid value, and keeps the value."""

    def validate(value: str) -> str:
        check(value)
        return value

    return AfterValidator(validate)


_Endpoint = Annotated[
    str, _checked(lambda endpoint: check_endpoints((endpoint,), where="endpoint"))
]
Endpoints = Annotated[tuple[_Endpoint, ...], BeforeValidator(split_values)]


class Settings(BaseModel):
    """All settings; in the environment they are NEDBUS_<FIELD>, with multiple values separated by commas.

    Separate sources by semicolons if their options contain commas.
    Create an instance with `load_settings`, whose errors name the flag, the variable, or file, line and column.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    connect: Endpoints = Field(
        (), description="Endpoints of Zenoh routers; the first that answers is used"
    )
    tls_ca: Path | None = Field(
        None, description="CA certificate for the routers of tls/ endpoints, PEM"
    )
    tls_certificate: Path | None = Field(
        None, description="Certificate that this client presents to routers, PEM"
    )
    tls_key: Path | None = Field(None, description="Private key of that certificate, PEM")
    listen: Endpoints = Field((), description="Endpoints of the embedded router")
    router_config: Path | None = Field(
        None, description="JSON5 configuration of the embedded router"
    )
    prefix: Annotated[str, _checked(check_prefix)] = Field(
        DEFAULT_PREFIX, description="Prefix of every key expression"
    )
    vehicle: Annotated[str, BeforeValidator(vehicle_name), _checked(check_vehicle)] = Field(
        "1", description="Default vehicle id of sources"
    )
    source: Annotated[tuple[str | dict[str, Any], ...], BeforeValidator(split_sources)] = Field(
        (), description="Sources to publish: strings, or TOML tables"
    )
    http: Annotated[str, _checked(split_http)] | None = Field(
        None,
        description="HOST:PORT of the HTTP server for /metrics, /healthz, /readyz, /vehicles and /status",
    )
    until_done: bool = Field(False, description="Exit when every finite source has ended")

    _set_by: dict[str, str] = PrivateAttr(default_factory=dict)
    _file: Path | None = PrivateAttr(None)
    _left_out: frozenset[str] = PrivateAttr(frozenset())

    @property
    def routers(self) -> tuple[str, ...]:
        """Endpoints that a client dials: `connect`, else the endpoints of the embedded router."""
        return self.connect or tuple(map(dial_endpoint, self.router_endpoints))

    @property
    def router_endpoints(self) -> tuple[str, ...]:
        """Endpoints that the embedded router of a service listens on."""
        return router_endpoints(self.listen, self.router_config)

    @property
    def is_client(self) -> bool:
        """True if a service connects to routers without running one itself."""
        return bool(self.connect) and not (self.listen or self.router_config)

    def set_by(self, name: str) -> str:
        """Return the origin of a setting: the name of the flag, variable or file; "" for a default."""
        return self._set_by.get(name, "")

    @property
    def left_out(self) -> frozenset[str]:
        """Settings that `find_mistakes` dropped, in whole or in part, because they are invalid or unreadable."""
        return self._left_out

    @property
    def tls(self) -> Tls | None:
        """TLS files for tls/ endpoints; raises ConfigError if some are missing."""
        if self.tls_ca is None:
            if self.tls_certificate or self.tls_key:
                raise ConfigError(
                    "tls_ca", "a certificate is set, but not the CA to trust; set both"
                )
            return None
        return Tls(self.tls_ca, self.tls_certificate, self.tls_key)


def load_settings(
    file: str | Path | None = None, needed: Collection[str] | None = None, /, **given: object
) -> Settings:
    """Return the settings of a file (default: NEDBUS_CONFIG, else ./nedbus.toml if it exists) and the environment.

    Keyword arguments that are not None override both. `needed`: the settings to read from the file; None for all.

    Raises ConfigError, with file, line and column, or with the name of the flag or variable.
    """
    settings, mistakes = find_mistakes(file, needed, **given)
    if mistakes:
        raise mistakes[0]
    return settings


def load_client_settings(
    file: str | Path | None,
    *,
    connect: str | Sequence[str] | None,
    prefix: str | None,
    tls: Tls | None,
) -> Settings:
    """Return the settings of a client; with `connect`, settings that a client ignores may be invalid in the file."""
    needed: set[str] | None = None
    if connect is not None:
        needed = set()
        if prefix is None:
            needed.add("prefix")
        is_secure = "tls/" in str(connect) or "quic/" in str(connect)
        if is_secure and tls is None:
            needed |= {"tls_ca", "tls_certificate", "tls_key"}
    return load_settings(file, needed, connect=connect, prefix=prefix)


def find_mistakes(
    file: str | Path | None = None, needed: Collection[str] | None = None, /, **given: object
) -> tuple[Settings, list[ConfigError]]:
    """Return the settings as `load_settings` does, without invalid values, and an error for each invalid value."""
    flags = {name: value for name, value in given.items() if value is not None}
    mistakes: list[ConfigError] = []
    path = None
    content = dict[str, object]()
    try:
        path = _settings_file(file)
        if path and needed != set():
            content = _read_toml(path)
    except ConfigError as exc:
        mistakes.append(exc)
    is_read = not mistakes
    if needed is not None:
        content = {name: value for name, value in content.items() if name in needed}
    values: dict[str, Any] = content | _read_environment() | flags
    details = list[ErrorDetails]()
    try:
        settings = _usual_settings(values) or Settings(**values)
    except ValidationError as exc:
        details = exc.errors()
        settings = Settings(**_without_mistakes(values, details))
    if needed != set():
        _warn_about_misspelled_variables()
    wrong = {str(detail["loc"][0]) for detail in details}
    settings._file = path
    for name in wrong | settings.model_fields_set:
        settings._set_by[name] = _set_by(name, path, flags)
    mistakes += [_setting_error(settings, detail) for detail in details]
    left_out = wrong
    if not is_read:  # the file may have set any other setting
        left_out = wrong | (Settings.model_fields.keys() - settings._set_by)
    settings._left_out = frozenset(left_out)
    return settings, mistakes


def _usual_settings(values: Mapping[str, Any]) -> Settings | None:
    """Return valid settings without Pydantic, whose schema and search for plugins take a tenth of a client's start.

    None lets Pydantic decide: there are other settings than those below, or one may be invalid.
    """
    if not values.keys() <= {"connect", "listen", "prefix", "source"}:
        return None
    connect = split_values(values.get("connect", ()))
    listen = split_values(values.get("listen", ()))
    source = split_sources(values.get("source", ()))
    prefix = values.get("prefix", DEFAULT_PREFIX)
    if not (_are_texts(connect) and _are_texts(listen) and _are_texts(source)):
        return None
    if not isinstance(prefix, str):
        return None
    try:
        check_endpoints((*connect, *listen), where="endpoint")
        check_prefix(prefix)
    except ValueError:
        return None
    return Settings.model_construct(
        {*values}, connect=tuple(connect), listen=tuple(listen), source=tuple(source), prefix=prefix
    )


def _are_texts(value: object) -> TypeGuard[Sequence[str]]:
    """Return whether a value is a tuple or list of strings."""
    return isinstance(value, tuple | list) and all(isinstance(item, str) for item in value)


def state_folder() -> Path:
    """Return the folder of state that outlives a process: systemd's StateDirectory, or that of the XDG directories."""
    given = os.environ.get("STATE_DIRECTORY")
    if given:
        first, _, _ = given.partition(":")
        return Path(first)
    return Path(os.environ.get("XDG_STATE_HOME") or "~/.local/state", "nedbus").expanduser()


def locate_setting(settings: Settings, name: str, reason: str) -> ConfigError:
    """Return the error for a setting, located by file, line and column, or by the name of the flag or variable."""
    path = settings._file
    setter = settings.set_by(name) or name
    if path is None or setter != str(path):
        return ConfigError(setter, reason)
    text = _read_text(path)
    return ConfigError.in_text(path, reason, text, _find_key(text, name))


def locate_source(settings: Settings, index: int, error: ConfigError) -> ConfigError:
    """Return the error of a source, located by file, line and column, or by the name of the variable."""
    path = settings._file
    setter = settings.set_by("source")
    if path is not None and setter == str(path):
        text = _read_text(path)
        place = _find_source(text, settings.source, index, error.key)
        return ConfigError.in_text(path, str(error), text, place)
    if setter in {"", "source"}:
        return error
    return ConfigError(setter, str(error), key=error.key)


def _settings_file(given: str | Path | None) -> Path | None:
    """Return the settings file, None if there is none; raise ConfigError if a given file does not exist."""
    named = given or os.environ.get("NEDBUS_CONFIG")
    if not named:
        if DEFAULT_FILE.is_file():
            return DEFAULT_FILE
        return None
    if not Path(named).is_file():
        raise ConfigError.in_file(Path(named), "there is no such file")
    return Path(named)


def _variable(name: str) -> str:
    return f"NEDBUS_{name.upper()}"


def _from_environment(name: str) -> str | None:
    return os.environ.get(_variable(name))


def _read_environment() -> dict[str, str]:
    """Return the settings in the environment as text, which `Settings` parses; an empty variable is not set."""
    texts = {name: _from_environment(name) for name in Settings.model_fields}
    return {name: text for name, text in texts.items() if text}


def _without_mistakes(values: Mapping[str, Any], details: Sequence[ErrorDetails]) -> dict[str, Any]:
    """Return the values with invalid settings replaced by their defaults; a list loses only its invalid items."""
    wrong: dict[str, set[int | str]] = defaultdict(set)
    for detail in details:
        wrong[str(detail["loc"][0])].update(detail["loc"][1:2])
    valid = {name: value for name, value in values.items() if name not in wrong}
    for name in wrong.keys() & Settings.model_fields.keys():
        if name == "source":
            split = split_sources
        else:
            split = split_values
        items = split(values.get(name))
        indices = wrong[name]
        if indices and isinstance(items, list | tuple):
            kept = [item for index, item in enumerate(items) if index not in indices]
            valid[name] = tuple(kept)
        else:
            valid[name] = Settings.model_fields[name].default
    return valid


def _set_by(name: str, path: Path | None, flags: Collection[str]) -> str:
    """Return the origin of a setting: the name of the flag, variable or file."""
    if name in flags:
        return name
    if _from_environment(name):
        return _variable(name)
    return str(path or name)


def _warn_about_misspelled_variables() -> None:
    known = {_variable(name) for name in (*Settings.model_fields, *_OTHER_VARIABLES)}
    ours = {variable for variable in os.environ if variable.startswith("NEDBUS_")}
    for variable in sorted(ours - known):
        near = _similar_variables(variable, known)
        if near:
            text = "ignored variable %s: did you mean %s?"
            _log.warning(text, variable, " or ".join(near), extra=about("setting"))


def _similar_variables(variable: str, known: Collection[str]) -> list[str]:
    """Return the variables that a truncated or misspelled name may mean."""
    if len(variable) >= _SHORTEST_PREFIX:
        longer = sorted(name for name in known if name.startswith(variable))
        if longer:
            return longer
    return difflib.get_close_matches(variable, known, 1, _SIMILARITY)


def _setting_error(settings: Settings, detail: ErrorDetails) -> ConfigError:
    name = str(detail["loc"][0])
    reason = detail["msg"].removeprefix("Value error, ").removeprefix("endpoint: ")
    if detail["type"] == "extra_forbidden":
        reason = f"unknown setting {name!r}: choose from {', '.join(Settings.model_fields)}"
    elif "ctx" not in detail:
        reason = f"{name}: {reason} (is {detail['input']!r:.60})"
    return locate_setting(settings, name, reason)


def _read_text(path: Path) -> str:
    """Return the text of a file without a byte order mark; raise ConfigError if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as exc:
        raise ConfigError.in_file(path, "not UTF-8 text") from exc
    except OSError as exc:
        reason = system_reason(exc)
        raise ConfigError.in_file(path, f"cannot be read ({reason})") from exc


def _read_toml(path: Path) -> dict[str, object]:
    try:
        return tomllib.loads(_read_text(path))
    except tomllib.TOMLDecodeError as exc:  # whose text ends with line and column
        raise ConfigError.in_file(path, str(exc)) from exc


def _find_key(text: str, name: str, start: int = 0) -> int:
    """Return the index of a key or table from `start` on, which `tomllib` does not report; -1 if there is none."""
    key = re.compile(rf"^[ \t]*\[*[ \t]*(\"?{re.escape(name)}\"?)[ \t]*[=.\]]", re.MULTILINE)
    match = key.search(text, start)
    if match:
        return match.start(1)
    return -1


def _find_source(text: str, sources: Sequence[object], index: int, option: str) -> int:
    """Return the index of a source: of its string in a list, or of its table or the option in it."""
    source = sources[index]
    if isinstance(source, str):  # equal sources have equal mistakes
        quoted = re.search(rf"[\"']({re.escape(source)})[\"']", text)
        if quoted:
            return quoted.start(1)
        return _find_key(text, "source")
    tables = [
        match.start(1) for match in re.finditer(r"^[ \t]*\[\[[ \t]*(source)\b", text, re.MULTILINE)
    ]
    if index >= len(tables):  # tables within a list
        return _find_key(text, "source")
    table, end = [*tables, len(text)][index : index + 2]
    if not option:
        return table
    return max(table, _find_key(text[:end], option, table))
