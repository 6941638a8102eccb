"""Zenoh sessions: the client of a script, the router of a daemon; the one place for zenoh.Config and ZError."""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final, TypeVar

import zenoh

from .errors import ClosedError, ConfigError, ConnectError, ListenError

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"

_ENDPOINT = re.compile(r"(tcp|tls|udp|ws|quic|unixsock-stream)/(\S+)")
_BACKOFF: Final = (0.05, 0.1, 0.2, 0.4, 0.8, 1.0)
_T = TypeVar("_T")

Session = zenoh.Session
RawSample = zenoh.Sample

# What holds for every session of ours. Shared memory costs 351 sessions per router and gains nothing at 244 bytes.
# Gossip and multicast would let peers find each other and bypass the router.
# Sessions do not stamp: a publisher stamps each message itself, so that a router never replaces a stamp.
_COMMON: Final = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "timestamping/enabled": False,
    "transport/shared_memory/enabled": False,
}


def open_client(endpoints: Sequence[str], *, timeout: float) -> Session:
    """Open a session as a client of the first router that answers; Ctrl-C ends the wait.

    It reconnects by itself whenever the link breaks.

    Raises ConnectError when no endpoint answers within `timeout` seconds, ConfigError for a malformed endpoint.
    """
    check_endpoints(endpoints, where="connect")
    config = _config(
        {
            **_COMMON,
            "mode": "client",
            "connect/endpoints": list(endpoints),
            "connect/timeout_ms": 0,
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
            "listen/endpoints": [],
            "transport/unicast/open_timeout": 3000,
        }
    )
    start = time.monotonic()
    pause = threading.Event()
    for attempt in range(2**30):
        try:
            return zenoh.open(config)
        except zenoh.ZError:
            left = start + timeout - time.monotonic()
            if left <= 0:
                raise ConnectError(endpoints, timeout) from None
            pause.wait(min(left, _BACKOFF[min(attempt, len(_BACKOFF) - 1)]))
    raise AssertionError


def open_router(
    *, listen: Sequence[str] = (DEFAULT_ENDPOINT,), connect: Sequence[str] = (), config_file: Path | None = None
) -> Session:
    """Open a session that is itself a router, from these endpoints or from a JSON5 file that `zenohd` reads too.

    Raises ListenError when it cannot listen, ConfigError for a malformed endpoint or file.
    """
    if config_file is not None:
        config = _read_config(config_file)
        listen = (f"what {config_file} names",)
    else:
        check_endpoints(listen, where="listen")
        check_endpoints(connect, where="connect")
        config = _config(
            {
                **_COMMON,
                "mode": "router",
                "scouting/delay": 0,  # nobody is scouted, so there is nobody to wait 0.5 s for
                "listen/endpoints": list(listen),
                "connect/endpoints": list(connect),
                "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
                "adminspace/enabled": True,
                "transport/unicast/accept_pending": 1000,
                "transport/link/rx/max_message_size": 2**20,
            }
        )
    try:
        return zenoh.open(config)
    except zenoh.ZError as exc:
        raise ListenError(listen, _first_sentence(exc)) from exc


def check_endpoints(endpoints: Sequence[str], *, where: str) -> None:
    """Raise ConfigError unless each of these is a Zenoh endpoint."""
    for endpoint in endpoints:
        if not _ENDPOINT.fullmatch(endpoint):
            raise ConfigError(where, f"{endpoint!r} is no endpoint: write PROTOCOL/HOST:PORT, as in {DEFAULT_ENDPOINT}")


@contextmanager
def while_open() -> Iterator[None]:
    """Translate what Zenoh raises inside a session that was closed."""
    try:
        yield
    except zenoh.ZError as exc:
        raise ClosedError from exc


def query(session: Session, key_expr: str, *, timeout: float) -> list[RawSample]:
    """Return the newest answer for each key from all who answer within `timeout` seconds."""
    target, newest = zenoh.QueryTarget.ALL, zenoh.ConsolidationMode.LATEST
    with while_open():
        replies = session.get(key_expr, target=target, consolidation=newest, timeout=timeout)
        return [reply.ok for reply in replies if reply.ok is not None]


def alive_keys(session: Session, key_expr: str, *, timeout: float) -> list[str]:
    """Return the keys of all liveliness tokens that match, sorted."""
    with while_open():
        replies = session.liveliness().get(key_expr, timeout=timeout)
        return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)


def receive(handler: zenoh.Handler[_T]) -> list[_T]:
    """Wait for something, and return all that is there, up to 256; empty once the subscriber is undeclared."""
    try:
        batch = [handler.recv()]
        while len(batch) < 256 and (item := handler.try_recv()) is not None:
            batch.append(item)
    except zenoh.ZError:
        return []
    return batch


def drain(handler: zenoh.Handler[_T]) -> list[_T]:
    """Return what is there without waiting; empty once the subscriber is undeclared."""
    batch: list[_T] = []
    try:
        while (item := handler.try_recv()) is not None:
            batch.append(item)
    except zenoh.ZError:
        pass
    return batch


def _config(settings: dict[str, object]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _read_config(path: Path) -> zenoh.Config:
    if path.suffix not in {".json5", ".json", ".yaml", ".yml"}:
        raise ConfigError.in_file(path, "a Zenoh configuration is a .json5, .json, .yaml or .yml file")
    if not path.is_file():
        raise ConfigError.in_file(path, "there is no such file")
    try:
        return zenoh.Config.from_file(path)
    except zenoh.ZError as exc:
        text = str(exc)
        place = re.search(r"line: (\d+), column: (\d+)", text) or re.search(r"--> (\d+):(\d+)", text)
        line, column = map(int, place.groups()) if place else (None, None)
        raise ConfigError.in_file(path, _reason(text), line=line, column=column) from exc


def _reason(text: str) -> str:
    """Return what is wrong, without the parser's drawing and its source paths."""
    found = re.search(r'msg: "(.*?)(?: at /|", location)', text, re.DOTALL) or re.search(
        r"= (.*?) at /", text, re.DOTALL
    )
    return found[1].replace("`", "'") if found else "this is no Zenoh configuration"


def _first_sentence(error: zenoh.ZError) -> str:
    """Return the reason that the system gave, or all of the text without source paths."""
    text = re.sub(r" at /\S+", "", str(error)).strip()
    found = re.search(r": ([A-Z][a-z][^:\[\]]*) \(os error", text)
    return found[1].lower() if found else text
