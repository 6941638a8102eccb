"""A Zenoh router in this process: with our settings, or with a configuration file that `zenohd` reads too."""

from __future__ import annotations

import json
import logging
import os
import re
import resource
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

import zenoh

from nedbus.errors import ConfigError, ListenError
from nedbus.log_event import about

from .endpoints import DEFAULT_ENDPOINT, check_endpoints
from .session import COMMON_SETTINGS, Session, draw_retry, error_reason, insert_settings, open_session
from .tls import Tls

_log = logging.getLogger(__name__)

# Longer than that of clients, so that a router gives up a client that falls silent before that one goes to another
# router. Zenoh 1.10.2 forgets queryables of a client that two routers have for a moment, where a third one joins later.
_LEASE: Final = 8.0  # s
_OTHER_FILES: Final = 100  # open files that are no sessions: a router has 21, a service its sources and HTTP clients


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
    The admin space shows `max_sessions` in `metadata`, and the soft limit of open files is raised to the hard one.

    Raises ListenError when it cannot listen, ConfigError for a malformed endpoint or file, a TLS file that cannot be
    read, or a plugin that the file requires.
    """
    check_endpoints(listen, where="listen")
    check_endpoints(connect, where="connect")
    if config_file is None:
        config = zenoh.Config()
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
    else:
        config = _read_config(config_file)
        _check_files(config_file, config)
        given = {"listen/endpoints": list(listen), "connect/endpoints": list(connect)}
        settings = {name: endpoints for name, endpoints in given.items() if endpoints}
    insert_settings(config, settings, where="listen")
    if tls is not None and not _get(config, "transport/link/tls").get("root_ca_certificate"):
        files = {f"transport/link/tls/{name}": value for name, value in tls.zenoh_settings().items()}
        insert_settings(config, files, where="tls")
    sessions = _get(config, "transport/unicast/max_sessions")
    metadata = _get(config, "metadata")
    if metadata is None or isinstance(metadata, dict):  # it is the user's: it may be anything
        insert_settings(config, {"metadata": {**(metadata or {}), "max_sessions": sessions}}, where="metadata")
    allow_sessions(sessions)
    try:
        return open_session(config)
    except zenoh.ZError as exc:
        raise ListenError(router_endpoints(listen, config_file), error_reason(exc)) from exc


def allow_sessions(sessions: int) -> None:
    """Raise the soft limit of open files of this process to the hard one, as each session of a router is an open file.

    At the limit a router accepts no more connections, and Zenoh does not log it. Logs a warning when there is no room
    for all sessions.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with suppress(OSError, ValueError):  # a kernel may allow less than the hard limit says
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < sessions + _OTHER_FILES:
        text = (
            "only %s open files are allowed: room for about %s sessions, and not for the %s of max_sessions:"
            " raise the limit (ulimit -n, LimitNOFILE=)"
        )
        _log.warning(text, soft, max(0, soft - _OTHER_FILES), sessions, extra=about("router"))


def router_endpoints(listen: Sequence[str] = (), config_file: Path | None = None) -> tuple[str, ...]:
    """Return the endpoints of a router with these settings: those given, else those of the file, else the default.

    Raises ConfigError for a malformed file.
    """
    if listen or config_file is None:
        return tuple(listen) or (DEFAULT_ENDPOINT,)
    return _endpoints(_read_config(config_file), "listen") or (DEFAULT_ENDPOINT,)


class RouterConfig(NamedTuple):
    """The configuration of a router: endpoints, the PEM files of its TLS section by name, and its limit of sessions."""

    listen: tuple[str, ...]
    connect: tuple[str, ...]
    tls_files: Mapping[str, Path]
    max_sessions: int


def read_router_config(path: Path | None = None) -> RouterConfig:
    """Read a file for zenohd or for a router of ours, by default Zenoh's defaults.

    Raises ConfigError, with line and column, for a mistake.
    """
    config = zenoh.Config() if path is None else _parse_config(path)
    sessions = int(_get(config, "transport/unicast/max_sessions"))
    return RouterConfig(_endpoints(config, "listen"), _endpoints(config, "connect"), _tls_files(config), sessions)


def _get(config: zenoh.Config, key: str) -> Any:
    return json.loads(config.get_json(key))


def _endpoints(config: zenoh.Config, name: str) -> tuple[str, ...]:
    found = _get(config, f"{name}/endpoints")
    return tuple(found.get("router", ()) if isinstance(found, dict) else found or ())


def _tls_files(config: zenoh.Config) -> dict[str, Path]:
    section = _get(config, "transport/link/tls").items()
    return {name: Path(file) for name, file in section if file and name.endswith(("_certificate", "_private_key"))}


def _read_config(path: Path) -> zenoh.Config:
    """Read a file that a router in this process is to use; raise ConfigError if it requires a plugin."""
    config = _parse_config(path)
    plugins = _get(config, "plugins").items()
    if required := [name for name, settings in plugins if settings and settings.get("__required__")]:
        reason = f"it requires {_names(required)}, and this router loads no plugins: start it with zenohd -c"
        raise ConfigError.in_file(path, reason)
    return config


def _check_files(path: Path, config: zenoh.Config) -> None:
    """Log the plugins of a file, and raise ConfigError for a TLS file that cannot be read: Zenoh would not name it."""
    if plugins := _get(config, "plugins"):
        text = "%s: without %s: this router loads no plugins, as zenohd does"
        _log.warning(text, path, _names(plugins), extra=about("router"))
    for name, file in _tls_files(config).items():
        if not os.access(file, os.R_OK):
            reason = f"{name}: {file} cannot be read: does it exist, and may this user read it?"
            raise ConfigError.in_file(path, reason)


def _names(plugins: Iterable[str]) -> str:
    return " and ".join(f"plugin {name}" for name in plugins)


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
        position = re.search(r"(?:line: |--> )(\d+)(?:, column: |:)(\d+)", text)
        line, column = map(int, position.groups()) if position else (None, None)
        # Without the drawing of Zenoh's parser and its source paths.
        message = re.search(r'(?:msg: "|= )(.*?)(?: at /|", location)', text, re.DOTALL)
        reason = message[1].replace("`", "'") if message else "not a Zenoh configuration"
        raise ConfigError.in_file(path, reason, line=line, column=column) from exc
    return config
