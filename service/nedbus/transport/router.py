"""A Zenoh router in this process: with our settings, or with a configuration file that `zenohd` reads too."""

from __future__ import annotations

import json
import logging
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import zenoh

from nedbus.errors import ConfigError, ListenError
from nedbus.log_event import about

from .endpoints import DEFAULT_ENDPOINT, check_endpoints
from .file_limit import allow_sessions
from .session import COMMON_SETTINGS, Session, draw_retry, error_reason, insert_settings, open_session
from .tls import Tls

_log = logging.getLogger(__name__)

# Longer than that of clients, so that a router gives up a client that falls silent before that one goes to another
# router. Zenoh 1.10.2 forgets queryables of a client that two routers have for a moment, where a third one joins later.
_LEASE: Final = 8.0  # s


def open_router(
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    config_file: Path | None = None,
    tls: Tls | None = None,
) -> Session:
    """Open a session that is itself a router, by default on loopback, or as a JSON5 file for `zenohd` configures it.

    Endpoints that are given replace those of the file, as the flags of `zenohd` do.
    `tls` is for the `tls/` routers that it joins, unless the file has a TLS section of its own.

    Plugins of the file are not loaded, as Zenoh's Python library has none: they are logged.
    The admin space shows `max_sessions` in `metadata`, and as many files may be open as these sessions need.

    Raises ListenError when it cannot listen, ConfigError for a malformed endpoint or file, a TLS file that cannot be
    read, or a plugin that the file requires.
    """
    check_endpoints(listen, where="listen")
    check_endpoints(connect, where="connect")
    if config_file is None:
        settings = {
            **COMMON_SETTINGS,
            "mode": "router",
            "transport/link/tx/lease": round(1000 * _LEASE),
            "scouting/delay": 0,  # scouting is off: there are no answers to wait 0.5 s for
            "listen/endpoints": list(router_endpoints(listen)),
            "connect/endpoints": list(connect),
            "connect/retry": draw_retry(),
            "adminspace/enabled": True,
            "transport/unicast/accept_pending": 1000,
            "transport/link/rx/max_message_size": 2**20,
        }
        config = insert_settings(zenoh.Config(), settings, where="listen")
    else:
        given = {"listen/endpoints": list(listen), "connect/endpoints": list(connect)}
        config = _read_config(config_file)
        plugins = json.loads(config.get_json("plugins"))
        if plugins:
            _log.warning(
                "%s: without %s: this router loads no plugins, as zenohd does",
                config_file,
                _names(plugins),
                extra=about("router"),
            )
        _check_tls_files(config_file, config)
        insert_settings(config, {name: endpoints for name, endpoints in given.items() if endpoints}, where="listen")
    if tls is not None and not json.loads(config.get_json("transport/link/tls")).get("root_ca_certificate"):
        files = {f"transport/link/tls/{name}": value for name, value in tls.zenoh_settings().items()}
        insert_settings(config, files, where="tls")
    sessions = _tell_max_sessions(config)
    allow_sessions(sessions, pending=json.loads(config.get_json("transport/unicast/accept_pending")))
    try:
        return open_session(config)
    except zenoh.ZError as exc:
        raise ListenError(router_endpoints(listen, config_file), error_reason(exc)) from exc


def router_endpoints(listen: Sequence[str] = (), config_file: Path | None = None) -> tuple[str, ...]:
    """Return what a router with these settings listens on: what is given, else what the file says, else the default.

    Raises ConfigError for a malformed file.
    """
    if listen or config_file is None:
        return tuple(listen) or (DEFAULT_ENDPOINT,)
    return _endpoints(_read_config(config_file), "listen") or (DEFAULT_ENDPOINT,)


def router_max_sessions(config_file: Path | None = None) -> int:
    """Return how many sessions a router accepts: what the file says, else Zenoh's default.

    Raises ConfigError for a malformed file.
    """
    return _max_sessions(zenoh.Config() if config_file is None else _read_config(config_file))


class RouterConfig(NamedTuple):
    """What a router's configuration file says: its endpoints, and the PEM files of its TLS section by name."""

    listen: tuple[str, ...]
    connect: tuple[str, ...]
    tls_files: Mapping[str, Path]


def read_router_config(path: Path) -> RouterConfig:
    """Read a file for zenohd or for a router of ours; raise ConfigError, with line and column, for a mistake."""
    config = _parse_config(path)
    tls = json.loads(config.get_json("transport/link/tls"))
    files = {
        name: Path(value) for name, value in tls.items() if value and name.endswith(("_certificate", "_private_key"))
    }
    return RouterConfig(_endpoints(config, "listen"), _endpoints(config, "connect"), files)


def _max_sessions(config: zenoh.Config) -> int:
    return int(config.get_json("transport/unicast/max_sessions"))


def _tell_max_sessions(config: zenoh.Config) -> int:
    """Put `max_sessions` where the admin space shows it, in place of what a file says there; return it."""
    sessions = _max_sessions(config)
    metadata = json.loads(config.get_json("metadata"))
    if metadata is None or isinstance(metadata, dict):  # it is the user's: it may be anything
        config.insert_json5("metadata", json.dumps({**(metadata or {}), "max_sessions": sessions}))
    return sessions


def _endpoints(config: zenoh.Config, name: str) -> tuple[str, ...]:
    found = json.loads(config.get_json(f"{name}/endpoints"))
    return tuple(found.get("router", ()) if isinstance(found, dict) else found or ())


def _read_config(path: Path) -> zenoh.Config:
    """Read a file that a router in this process is to use; raise ConfigError for what it cannot do."""
    config = _parse_config(path)
    plugins = json.loads(config.get_json("plugins"))
    required = [name for name, settings in plugins.items() if settings and settings.get("__required__")]
    if required:
        reason = f"it requires {_names(required)}, and this router loads no plugins: start it with zenohd -c"
        raise ConfigError.in_file(path, reason)
    return config


def _check_tls_files(path: Path, config: zenoh.Config) -> None:
    for name, value in json.loads(config.get_json("transport/link/tls")).items():
        # Zenoh would report only that there is no such file, and not which.
        if name.endswith(("_certificate", "_private_key")) and value and not os.access(value, os.R_OK):
            raise ConfigError.in_file(
                path, f"{name}: {value} cannot be read: does it exist, and may this user read it?"
            )


def _parse_config(path: Path) -> zenoh.Config:
    if path.suffix not in {".json5", ".json", ".yaml", ".yml"}:
        raise ConfigError.in_file(path, "a Zenoh configuration is a .json5, .json, .yaml or .yml file")
    if not path.is_file():
        raise ConfigError.in_file(path, "there is no such file")
    try:
        config = zenoh.Config.from_file(path)
        if config.get_json("mode") == "null":
            config.insert_json5("mode", '"router"')  # as zenohd does
    except zenoh.ZError as exc:
        text = str(exc)
        position = re.search(r"line: (\d+), column: (\d+)", text) or re.search(r"--> (\d+):(\d+)", text)
        line, column = map(int, position.groups()) if position else (None, None)
        raise ConfigError.in_file(path, _parser_message(text), line=line, column=column) from exc
    return config


def _names(plugins: Iterable[str]) -> str:
    return " and ".join(f"plugin {name}" for name in plugins)


def _parser_message(text: str) -> str:
    """Return the message of Zenoh's parser, without its drawing and its source paths."""
    found = re.search(r'msg: "(.*?)(?: at /|", location)', text, re.DOTALL) or re.search(
        r"= (.*?) at /", text, re.DOTALL
    )
    return found[1].replace("`", "'") if found else "not a Zenoh configuration"
