"""Embedded Zenoh router, with default settings or a configuration file of `zenohd`; state of reachable routers."""

from __future__ import annotations

import json
import logging
import os
import re
import resource
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import zenoh

from nedbus import limits
from nedbus.endpoints import DEFAULT_ENDPOINT, check_endpoints
from nedbus.errors import ConfigError, ListenError
from nedbus.log_event import about
from nedbus.timings import TIMINGS

from .queries import query
from .session import (
    COMMON_SETTINGS,
    Session,
    error_reason,
    insert_settings,
    open_session,
    random_backoff,
)
from .tls import Tls

if TYPE_CHECKING:
    from .access_control import AccessControl

_log = logging.getLogger(__name__)

# open files other than sessions: 21 of a router, plus sources and HTTP clients of a service
_OTHER_FILES: Final = 100
_ADMIN_KEY: Final = re.compile(r"@/([0-9a-f]{1,32})/router")
# Readers count unread heartbeats, of 4 bytes, and rejection reports, not their bytes, so the router drops larger ones.
# In the readers this filter would take 8 % of the instructions for each message.
# `**` does not match a chunk that begins with @.
_SIZE_FILTER: Final = [
    {
        "id": "heartbeat-size",
        "flows": ["ingress"],
        "messages": ["put", "delete"],
        "key_exprs": ["**/@adv/**", "**/@rate/*/@adv/**"],
        "size_limit": 64,
    },
    {
        "id": "report-size",
        "flows": ["ingress"],
        "messages": ["put", "delete"],
        "key_exprs": ["**/@rejected/**"],
        "size_limit": 16384,
    },
]
_LARGEST_LIMIT: Final = 2**32  # of sessions, accepted from a router


def open_router(
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    config_file: Path | None = None,
    tls: Tls | None = None,
) -> Session:
    """Open a session in router mode, by default on loopback, or as configured by a `zenohd` file.

    `listen`, `connect`: override the endpoints of the file, as the flags of `zenohd` do.
    `tls`: files for the `tls/` routers in `connect`, unless the file has a TLS section.

    With RUST_LOG set, Zenoh writes its own log to stdout, such as `zenoh_link_tls=warn` for refused clients.
    Plugins in the file are logged, not loaded: Zenoh's Python library does not support them.
    The admin space shows `max_sessions` in `metadata`. The soft limit of open files is raised to the hard limit.

    Raises ListenError if it cannot listen; ConfigError for a malformed endpoint or file, an unreadable TLS file, or a
    plugin that the file requires.
    """
    check_endpoints(listen, where="listen")
    check_endpoints(connect, where="connect")
    zenoh.try_init_log_from_env()
    if config_file is None:
        config = zenoh.Config()
        settings = {
            **COMMON_SETTINGS,
            "mode": "router",
            # Longer than the clients' lease, so a router drops a silent client before the client joins another router.
            # If two routers have the same client, Zenoh 1.10.2 loses its queryables on a third router that joins later.
            "transport/link/tx/lease": round(1000 * TIMINGS.router_lease),
            "scouting/delay": 0,  # do not wait 0.5 s for scouting replies: scouting is off
            "listen/endpoints": list(router_endpoints(listen)),
            "connect/endpoints": list(connect),
            "connect/retry": random_backoff(),
            "adminspace/enabled": True,
            "transport/unicast/accept_pending": 1000,
            "transport/link/rx/max_message_size": 2**20,
            "low_pass_filter": _SIZE_FILTER,
        }
    else:
        config = _read_config(config_file)
        _check_config(config, config_file)
        settings = {}
        if listen:
            settings["listen/endpoints"] = list(listen)
        if connect:
            settings["connect/endpoints"] = list(connect)
    insert_settings(config, settings, where="listen")
    if tls is not None and not _get(config, "transport/link/tls").get("root_ca_certificate"):
        files = tls.zenoh_settings().items()
        by_key = {f"transport/link/tls/{name}": value for name, value in files}
        insert_settings(config, by_key, where="tls")
    sessions = _get(config, "transport/unicast/max_sessions")
    metadata = _get(config, "metadata")
    if metadata is None:
        metadata = {}
    if isinstance(metadata, dict):  # any JSON value is allowed
        metadata["max_sessions"] = sessions
        insert_settings(config, {"metadata": metadata}, where="metadata")
    raise_file_limit(sessions)
    try:
        return open_session(config)
    except zenoh.ZError as exc:
        raise ListenError(router_endpoints(listen, config_file), error_reason(exc)) from exc


def _check_config(config: zenoh.Config, path: Path) -> None:
    """Log the plugins of a configuration; raise ConfigError for an unreadable TLS file, which Zenoh does not name."""
    plugins = _get(config, "plugins")
    if plugins:
        text = "%s: %s not loaded, because this router, unlike zenohd, loads no plugins"
        _log.warning(text, path, _plugin_names(plugins), extra=about("router"))
    for name, file in _tls_files(config).items():
        if not os.access(file, os.R_OK):
            reason = f"{name}: {file} cannot be read: check that it exists and that this user may read it"
            raise ConfigError.in_file(path, reason)


def raise_file_limit(sessions: int) -> None:
    """Raise the soft limit of open files to the hard limit; each session of a router is an open file.

    At the limit a router stops accepting connections without an error. A warning is logged if the limit is too low.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with suppress(OSError, ValueError):  # the kernel may allow less than the hard limit
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < sessions + _OTHER_FILES:
        text = (
            "the limit of %s open files allows about %s sessions, but max_sessions is %s:"
            " raise the limit (ulimit -n, LimitNOFILE=)"
        )
        _log.warning(text, soft, max(0, soft - _OTHER_FILES), sessions, extra=about("router"))


def router_endpoints(
    listen: Sequence[str] = (), config_file: Path | None = None
) -> tuple[str, ...]:
    """Return the listening endpoints of a router: those given, else those of the file, else the default.

    Raises ConfigError for a malformed file.
    """
    endpoints = tuple(listen)
    if not endpoints and config_file is not None:
        endpoints = _endpoints(_read_config(config_file), "listen")
    return endpoints or (DEFAULT_ENDPOINT,)


class RouterConfig(NamedTuple):
    """Configuration of a router: endpoints, PEM files of the TLS section by name, session limit and access rules."""

    listen: tuple[str, ...]
    connect: tuple[str, ...]
    tls_files: Mapping[str, Path]
    max_sessions: int
    access: AccessControl


def read_router_config(path: Path | None = None) -> RouterConfig:
    """Read the configuration file of a router; without a file, return Zenoh's defaults.

    Raises ConfigError, with line and column, for a malformed file.
    """
    from .access_control import AccessControl

    if path is None:
        config = zenoh.Config()
    else:
        config = _parse_config(path)
    sessions = int(_get(config, "transport/unicast/max_sessions"))
    access = AccessControl(_get(config, "access_control"), _get(config, "low_pass_filter"))
    return RouterConfig(
        _endpoints(config, "listen"),
        _endpoints(config, "connect"),
        _tls_files(config),
        sessions,
        access,
    )


def _get(config: zenoh.Config, key: str) -> Any:
    return json.loads(config.get_json(key))


def _endpoints(config: zenoh.Config, name: str) -> tuple[str, ...]:
    endpoints = _get(config, f"{name}/endpoints")
    if isinstance(endpoints, dict):  # by mode
        endpoints = endpoints.get("router")
    return tuple(endpoints or ())


def _tls_files(config: zenoh.Config) -> dict[str, Path]:
    files: dict[str, Path] = {}
    for name, file in _get(config, "transport/link/tls").items():
        if file and name.endswith(("_certificate", "_private_key")):
            files[name] = Path(file)
    return files


def _read_config(path: Path) -> zenoh.Config:
    """Read the file for an embedded router; raise ConfigError if it is malformed or requires a plugin."""
    config = _parse_config(path)
    required: list[str] = []
    for name, settings in _get(config, "plugins").items():
        if settings and settings.get("__required__"):
            required.append(name)
    if required:
        reason = f"it requires {_plugin_names(required)}, but this router loads no plugins: run it with zenohd -c"
        raise ConfigError.in_file(path, reason)
    return config


def _plugin_names(plugins: Iterable[str]) -> str:
    return " and ".join(f"plugin {name}" for name in plugins)


def _parse_config(path: Path) -> zenoh.Config:
    if path.suffix not in {".json5", ".json", ".yaml", ".yml"}:
        raise ConfigError.in_file(
            path, "not a Zenoh configuration: expected a .json5, .json, .yaml or .yml file"
        )
    if not path.is_file():
        raise ConfigError.in_file(path, "there is no such file")
    try:
        config = zenoh.Config.from_file(path)
        if config.get_json("mode") == "null":
            config.insert_json5("mode", '"router"')  # as zenohd does
    except zenoh.ZError as exc:
        text = str(exc)
        position = re.search(r"(?:line: |--> )(\d+)(?:, column: |:)(\d+)", text)
        line: int | None = None
        column: int | None = None
        if position:
            line, column = map(int, position.groups())
        # Strip the source excerpt and source paths that Zenoh's parser adds.
        message = re.search(r'(?:msg: "|= )(.*?)(?: at /|", location)', text, re.DOTALL)
        reason = "not a Zenoh configuration"
        if message:
            reason = message[1].replace("`", "'")
        raise ConfigError.in_file(path, reason, line=line, column=column) from exc
    return config


@dataclass(frozen=True, slots=True)
class RouterState:
    """State of a router: Zenoh id, number of open sessions (including those to other routers), and session limit.

    `max_sessions`: None unless the router's configuration has it in `metadata`; Zenoh does not report its limit.
    """

    zid: str
    sessions: int
    max_sessions: int | None


def query_routers(session: Session, *, timeout: float) -> list[RouterState]:
    """Return the state of each router that replies within `timeout` seconds, sorted by id.

    `session`: from `bus.open_session`, because a large reply delays the other messages of its session.
    A router is missing if its admin space is off or denied, or if its reply exceeds the message size of this session:
    2**18 bytes for a client, about 1,400 sessions.
    """
    replies = query(session, "@/*/router", timeout=timeout)
    by_zid: dict[str, RouterState] = {}
    for reply in replies:
        if len(reply.payload) > limits.ROUTER_STATE_BYTES:
            continue
        state = parse_state(str(reply.key_expr), reply.payload.to_bytes())
        if state is not None:
            by_zid[state.zid] = state
    return [by_zid[zid] for zid in sorted(islice(by_zid, limits.ROUTERS))]


def parse_state(key: str, payload: bytes) -> RouterState | None:
    """Parse a reply of the admin space; return None if it is malformed, because any peer may reply."""
    match = _ADMIN_KEY.fullmatch(key)
    try:
        state = json.loads(payload)
    except (ValueError, RecursionError):
        return None
    if match is None or not isinstance(state, dict):
        return None
    sessions = state.get("sessions")
    if not isinstance(sessions, list):
        return None
    limit = None
    metadata = state.get("metadata")
    if isinstance(metadata, dict):
        limit = metadata.get("max_sessions")
    if type(limit) is not int or not 0 < limit <= _LARGEST_LIMIT:  # nor a bool
        limit = None
    return RouterState(match[1], len(sessions), limit)
