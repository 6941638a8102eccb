"""Settings from a file, the environment and flags, each overriding the one before; nothing else reads them."""

from __future__ import annotations

import difflib
import logging
import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError
from pydantic_core import ErrorDetails
from pydantic_settings import BaseSettings, InitSettingsSource, PydanticBaseSettingsSource

from nedbus.errors import ConfigError
from nedbus.log_event import about

from .model import Settings, split_sources, split_values
from .toml_file import find_key, find_source, read_text, read_toml

_log = logging.getLogger(__name__)

DEFAULT_FILE: Final = Path("nedbus.toml")
_BEGUN: Final = len("NEDBUS_TLS")  # characters of a variable from which on it is taken for the beginning of a setting


def load_settings(file: str | Path | None = None, **given: object) -> Settings:
    """Return the settings of a file (default: NEDBUS_CONFIG, else ./nedbus.toml if there is one) and the environment.

    What is given here and not None overrides both.

    Raises ConfigError, with file, line and column or the name of the flag or variable.
    """
    settings, mistakes = find_mistakes(file, **given)
    if mistakes:
        raise mistakes[0]
    return settings


def find_mistakes(file: str | Path | None = None, **given: object) -> tuple[Settings, list[ConfigError]]:
    """Return the settings as `load_settings` does, and all mistakes; what is wrong is left out of the settings."""
    flags: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    mistakes: list[ConfigError] = []
    path, content = None, dict[str, object]()
    try:
        path = _settings_file(file)
        content = read_toml(path) if path else {}
    except ConfigError as exc:
        mistakes.append(exc)
    is_read, wrong = not mistakes, set[str]()
    try:
        settings = _with_file(content)(**flags)
    except ValidationError as exc:
        details = exc.errors()
        mistakes += [_setting_error(path, flags, detail) for detail in details]
        wrong = {str(detail["loc"][0]) for detail in details}
        rest = {name: value for name, value in content.items() if name not in wrong}
        settings = _with_file(rest)(**_without_mistakes(content, flags, details))
    _warn_of_misspelt_variables()
    settings._set_by.update({name: _set_by(name, path, flags) for name in settings.model_fields_set})
    settings._file = path
    settings._left_out = frozenset(wrong if is_read else wrong | (Settings.model_fields.keys() - settings._set_by))
    return settings, mistakes


def locate_setting(settings: Settings, name: str, reason: str) -> ConfigError:
    """Return the error of a setting with its place: file, line and column, or the name of the flag or variable."""
    setter = settings.set_by(name)
    if settings.file is None or setter != str(settings.file):
        return ConfigError(setter or name, reason)
    line, column = find_key(read_text(settings.file), name)
    return ConfigError.in_file(settings.file, reason, line=line, column=column)


def locate_source(settings: Settings, index: int, error: ConfigError) -> ConfigError:
    """Return the error of a source with its place: file, line and column, or the name of the variable."""
    setter = settings.set_by("source")
    if settings.file is None or setter != str(settings.file):
        return error if setter in {"", "source"} else ConfigError(setter, str(error), key=error.key)
    line, column = find_source(read_text(settings.file), settings.source, index, error.key)
    return ConfigError.in_file(settings.file, str(error), line=line, column=column)


def _settings_file(given: str | Path | None) -> Path | None:
    """Return the file to read, None if there is none; raise ConfigError when one is named that does not exist."""
    path = Path(given) if given else (Path(os.environ["NEDBUS_CONFIG"]) if os.environ.get("NEDBUS_CONFIG") else None)
    if path is not None and not path.is_file():
        raise ConfigError.in_file(path, "there is no such file")
    return path or (DEFAULT_FILE if DEFAULT_FILE.is_file() else None)


def _without_mistakes(
    content: Mapping[str, object], flags: Mapping[str, Any], details: Sequence[ErrorDetails]
) -> dict[str, Any]:
    """Return the flags, with the default of each wrong setting in its place, or with what is right of a list."""
    wrong: dict[str, set[int | str]] = defaultdict(set)
    for detail in details:
        wrong[str(detail["loc"][0])].update(detail["loc"][1:2])
    kept = {name: value for name, value in flags.items() if name not in wrong}
    for name in wrong.keys() & Settings.model_fields.keys():
        value = flags.get(name) or os.environ.get(f"NEDBUS_{name.upper()}") or content.get(name)
        items = split_sources(value) if name == "source" else split_values(value)
        if wrong[name] and isinstance(items, list | tuple):
            kept[name] = tuple(item for index, item in enumerate(items) if index not in wrong[name])
        else:
            kept[name] = Settings.model_fields[name].default
    return kept


def _set_by(name: str, path: Path | None, flags: Mapping[str, object]) -> str:
    """Return what sets a setting: the flag or argument of that name, its environment variable, or the file."""
    variable = f"NEDBUS_{name.upper()}"
    if name in flags or not (os.environ.get(variable) or path):
        return name
    return variable if os.environ.get(variable) else str(path)


def _warn_of_misspelt_variables() -> None:
    """Warn of environment variables that look like a setting, and are none."""
    known = {f"NEDBUS_{name.upper()}" for name in (*Settings.model_fields, "config", "log_level", "log_format")}
    for variable in sorted(name for name in os.environ if name.startswith("NEDBUS_") and name not in known):
        begun = sorted(each for each in known if each.startswith(variable) and len(variable) >= _BEGUN)
        if near := begun or difflib.get_close_matches(variable, known, 1, 0.85):
            _log.warning("%s is not a setting: did you mean %s?", variable, " or ".join(near), extra=about("setting"))


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


def _setting_error(path: Path | None, flags: Mapping[str, object], detail: ErrorDetails) -> ConfigError:
    name = str(detail["loc"][0])
    reason = detail["msg"].removeprefix("Value error, ").removeprefix("endpoint: ")
    if detail["type"] == "extra_forbidden":
        reason = f"there is no setting {name!r}: choose from {', '.join(Settings.model_fields)}"
    elif "ctx" not in detail:
        reason = f"{name}: {reason} (is {detail['input']!r:.60})"
    setter = _set_by(name, path, flags)
    if path is None or setter != str(path):
        return ConfigError(setter, reason)
    line, column = find_key(read_text(path), name)
    return ConfigError.in_file(path, reason, line=line, column=column)
